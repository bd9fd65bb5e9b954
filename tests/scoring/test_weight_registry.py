"""Match weights by name: words, files that ship, files of one's own; in programs as in the library."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import mfvpr
from mfvpr import HistogramOfShifts, InputError
from mfvpr.scoring.fields import from_values
from mfvpr.scoring.learned_weight import RELATIVE, LearnedWeight
from mfvpr.scoring.weight_files import read_weight, write_weight
from mfvpr.scoring.weight_registry import NAMED_WEIGHTS
from mfvpr.scoring.weights import WEIGHTS
from tests.builders import random_matches
from tests.programs import results, shared, small, typed

pytestmark = pytest.mark.thorough

MATCHES = random_matches(np.random.default_rng(0), 30)
LEARNED = [name for name in NAMED_WEIGHTS if name not in WEIGHTS]


@pytest.fixture
def weight():
    start = LearnedWeight.create(jax.random.key(1), MATCHES, 3)
    return replace(start, output=np.float32([1, -2, 0.5]))


@pytest.fixture
def file(tmp_path, weight):
    write_weight(tmp_path / "mine.json", weight, {"command": "by hand"})
    return tmp_path / "mine.json"


def test_names():
    assert [*NAMED_WEIGHTS][: len(WEIGHTS)] == [*WEIGHTS]
    assert len(NAMED_WEIGHTS) == len([*NAMED_WEIGHTS])
    assert {name: NAMED_WEIGHTS[name] for name in WEIGHTS} == WEIGHTS
    for name in ("heavy", "../weighting", None, ("fs",), 1):
        assert name not in NAMED_WEIGHTS


@pytest.mark.parametrize("name", LEARNED)
def test_what_ships_says_how_it_was_made_and_weighs(name):
    weight = NAMED_WEIGHTS[name]
    assert weight is NAMED_WEIGHTS[name]
    assert weight.names == RELATIVE
    weights = np.asarray(weight(MATCHES))[np.asarray(MATCHES.mask)]
    assert (weights > 0).all()
    assert weights.std() > 0.01
    path = Path(mfvpr.__file__).parent / "scoring" / "learned" / f"{name}.json"
    _, how = read_weight(path)
    assert how["command"].startswith("python -m experiments.learn dataset=streets:seed=")
    assert not re.search(r"/(home|root|work|tmp|Users)/", path.read_text())


def test_a_file_of_ones_own(file, weight, monkeypatch):
    scorer = from_values(HistogramOfShifts, {"weight": str(file)})
    jax.tree.map(np.testing.assert_array_equal, scorer.weight, weight)
    assert float(scorer(MATCHES)) == float(HistogramOfShifts(weight=weight)(MATCHES)) > 0
    assert NAMED_WEIGHTS[str(file)] is scorer.weight
    monkeypatch.setenv("HOME", str(file.parent))
    jax.tree.map(np.testing.assert_array_equal, NAMED_WEIGHTS["~/mine.json"], weight)


def test_a_file_that_changed_is_read_again(file, weight):
    before = NAMED_WEIGHTS[str(file)]
    write_weight(file, replace(weight, output_bias=np.float32(7)), {})
    os.utime(file, ns=(1, 1))
    assert float(NAMED_WEIGHTS[str(file)].output_bias) == 7 != float(before.output_bias)


def test_another_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"none\.json: .*experiments.learn"):
        NAMED_WEIGHTS[str(tmp_path / "none.json")]


@pytest.mark.slow
def test_programs_take_it(file, weight, tmp_path, tmp_path_factory, monkeypatch, capsys):
    """The weight of a file and the word that it equals rank alike; another ranks otherwise."""
    constant = replace(weight, output=np.zeros(3, np.float32))  # 1 for every match
    write_weight(tmp_path / "constant.json", constant, {})
    run = small(shared(tmp_path_factory))
    axis = f"grid.weight=[unit,{tmp_path}/constant.json,{file}]"
    code, _, stderr = typed(monkeypatch, capsys, "sweep", *run, "scorer=sum", axis, f"out={tmp_path}/sweep")
    assert code == 0, stderr
    swept = [json.dumps(one["recall_at"]) for one in results(tmp_path / "sweep")["settings"][:3]]
    assert swept[0] == swept[1]
    rankings = []
    for number, name in enumerate(("unit", f"{tmp_path}/constant.json", file)):
        own = (*run, "figures=0", "scorer=histogram", f"scorer.weight={name}", f"out={tmp_path}/{number}")
        code, _, stderr = typed(monkeypatch, capsys, "evaluate", *own)
        assert code == 0, stderr
        lines = (tmp_path / str(number) / "predictions" / "histogram.csv").read_text().splitlines()
        rankings.append([line.split(",")[:3] for line in lines])
    assert rankings[0] == rankings[1] != rankings[2]


def test_a_changed_file_is_another_setting_of_a_confidence(
    file, weight, tmp_path, tmp_path_factory, monkeypatch, capsys
):
    run = (*small(shared(tmp_path_factory)), "figures=0", "scorer=histogram", f"scorer.weight={file}")
    found = []
    for number, value in enumerate((weight, weight, replace(weight, output=np.float32([3, 0, 1])))):
        write_weight(file, value, {})
        os.utime(file, ns=(number, number))
        given = [f"confidence={tmp_path}/0/confidence.json"] if number else []
        code, _, stderr = typed(monkeypatch, capsys, "evaluate", *run, *given, f"out={tmp_path}/{number}")
        assert code == 0, stderr
        found.append("other settings of scorer" in stderr)
    assert found == [False, False, True]


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("FOLDER/none.json", "none.json: expected a match weight"),
        ("FOLDER/text.json", "text.json: expected a match weight"),
        ("FOLDER/mine.txt", "expected one of fs, dmf, ratio, unit"),
        ("7", "expected one of fs, dmf, ratio, unit"),
    ],
)
def test_what_is_none_is_one_line(tmp_path, tmp_path_factory, monkeypatch, capsys, value, words):
    (tmp_path / "text.json").write_text("[]")
    arguments = ("scorer=histogram", f"scorer.weight={value.replace('FOLDER', str(tmp_path))}")
    code, stdout, stderr = typed(monkeypatch, capsys, "evaluate", *small(shared(tmp_path_factory)), *arguments)
    assert (code, stdout, stderr.count("\n")) == (2, "", 1)
    assert words in stderr


@pytest.mark.parametrize("how", [
    {"data_sets": ["a", "b"]}, {"data_sets": 5}, {"data_fingerprint": ["x"]}, {"data_fingerprint": {"database": ["x"]}},
    {"settings": None}, {"settings": {"features": "sift"}}, {"data_sets": [{"data_fingerprint": {"query": None}}]},
])  # fmt: skip
def test_how_a_weight_of_another_program_was_made_stops_nothing(
    weight, tmp_path, tmp_path_factory, monkeypatch, capsys, how
):
    write_weight(tmp_path / "theirs.json", weight, how)
    options = ("scorer=histogram", f"scorer.weight={tmp_path}/theirs.json", "figures=0", f"out={tmp_path}/out")
    code, _, stderr = typed(monkeypatch, capsys, "evaluate", *small(shared(tmp_path_factory)), *options)
    assert code == 0, stderr
    assert "other features (unknown instead of sift" in stderr
    assert "other matching (unknown instead of neighbors" in stderr
