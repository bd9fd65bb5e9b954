"""Files of learned weights, and weights by name: words, files of the package, files of users; in programs as well."""

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
from mfvpr.baselines.learned_weight import (
    ABSOLUTE,
    RELATIVE,
    WORDS,
    LearnedWeight,
    named_weight,
    provenance,
    read_weight,
    write_weight,
)
from mfvpr.core.weights import WEIGHTS
from mfvpr.systems.assembly import scorers
from tests.builders import random_matches
from tests.programs import shared, small, typed

pytestmark = pytest.mark.thorough

MATCHES = random_matches(np.random.default_rng(0), 30)
LEARNED = [name for name in WORDS if name not in WEIGHTS]
PROVENANCE = {"command": "by hand", "seeds": [1, 2]}
WEIGHT = replace(LearnedWeight.create(jax.random.key(1), MATCHES, 3), output=np.float32([1, -2, 0.5]))


@pytest.fixture
def file(tmp_path):
    write_weight(tmp_path / "mine.json", WEIGHT, PROVENANCE)
    return tmp_path / "mine.json"


@pytest.mark.parametrize("names", [RELATIVE, ABSOLUTE])
def test_to_the_last_bit(file, names):
    weight = LearnedWeight.create(jax.random.key(1), MATCHES, 3, names=names)
    write_weight(file, weight, PROVENANCE)
    got, provenance = read_weight(file)
    assert (got.names, provenance) == (names, PROVENANCE)
    jax.tree.map(np.testing.assert_array_equal, got, weight)
    assert {leaf.dtype for leaf in jax.tree.leaves(got)} == {np.dtype("float32")}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_weight(file.with_name("other.json"), replace(weight, output_bias=np.float32(np.nan)), PROVENANCE)
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize(
    "change",
    [
        {"format": "mfvpr match weight 0"},
        {"inputs": ["ratio", "x", "x0", "x1", "y0"]},
        {"hidden": [[0] * 3] * 4},
        {"center": None},
    ],
)
def test_damaged_files_raise(file, change):
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(InputError, match=r"mine\.json: .*mfvpr learn"):
        read_weight(file)


@pytest.mark.parametrize("name", LEARNED)
def test_weights_of_the_package_have_a_provenance(name):
    weight = named_weight(name)
    assert weight is named_weight(name)
    assert weight.names == RELATIVE
    weights = np.asarray(weight(MATCHES))[np.asarray(MATCHES.mask)]
    assert (weights > 0).all()
    assert weights.std() > 0.01
    path = Path(mfvpr.__file__).parent / "baselines" / "learned" / f"{name}.json"
    assert provenance(name) == read_weight(path)[1]
    assert provenance(name)["command"].startswith("python -m experiments.learn dataset=streets:seed=")
    assert not re.search(r"/(home|root|work|tmp|Users)/", path.read_text())


def test_the_file_of_a_user(file, monkeypatch):
    scorer = scorers({"method": "histogram", "weight": str(file)})["histogram"]
    jax.tree.map(np.testing.assert_array_equal, scorer.weight, WEIGHT)
    assert float(scorer(MATCHES)) == float(HistogramOfShifts(weight=WEIGHT)(MATCHES)) > 0
    assert named_weight(str(file)) is scorer.weight
    monkeypatch.setenv("HOME", str(file.parent))
    jax.tree.map(np.testing.assert_array_equal, named_weight("~/mine.json"), WEIGHT)
    write_weight(file, replace(WEIGHT, output_bias=np.float32(7)), {})
    os.utime(file, ns=(1, 1))
    assert float(named_weight(str(file)).output_bias) == 7 != float(scorer.weight.output_bias)


@pytest.fixture
def run(monkeypatch, capsys, tmp_path_factory):
    """Run a program on small data: its exit code, stdout and stderr."""
    settings = small(shared(tmp_path_factory))
    return lambda program, *options: typed(monkeypatch, capsys, program, *settings, *options)


def test_the_error_for_an_unknown_weight_is_one_line(run, tmp_path):
    expected = {"none.json": "none.json: expected a match weight", "mine.txt": "expected one of fs, dmf, ratio, unit"}
    for name, words in expected.items():
        code, stdout, stderr = run("evaluate", "scorer=histogram", f"scorer.weight={tmp_path}/{name}")
        assert (code, stdout, stderr.count("\n")) == (2, "", 1)
        assert words in stderr
