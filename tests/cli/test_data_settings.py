"""Data settings in the programs: ground truth, excluded images, image reading."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from mfvpr.cli.evaluation import evaluate
from mfvpr.cli.jobs import prepare
from mfvpr.utils import Stopwatch
from tests.programs import csv_rows, folder, settings_of

pytestmark = pytest.mark.thorough

QUICK = ("figures=0", "features.max_keypoints=60", "features.image_size=[160,120]", "retrieval.num_words=8",
         "scorer=sum", "candidates=4", "cache=null")  # fmt: skip


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """An evaluation in this process: its rows, what it printed, and its folder."""
    monkeypatch.chdir(tmp_path)

    def run(*settings, name="out"):
        place = tmp_path / name
        evaluate(settings_of(*QUICK, f"out={place}", *settings))
        return json.loads((place / "results.json").read_text()), capsys.readouterr(), place

    return run


def recall(rows, **threshold):
    return {row["system"]: row["recall_at"]["1"] for row in rows if threshold.items() <= row.items()}


def ranked(place):
    ranking = {}
    for line in csv_rows(place / "predictions.csv"):
        ranking.setdefault(line["query"], []).append(line["database"])
    return ranking


def same(street, *more):
    """The database against itself."""
    place = f"{street}/database"
    return ("dataset=folder", f"dataset.database={place}", f"dataset.queries={place}", *more)


def test_an_image_that_finds_itself_is_told_and_left_out(small_street, tmp_path, run):
    order = "dataset.ground_truth=order"
    rows, printed, _ = run(*same(small_street, order), name="told")
    assert "warning: 10 of 10 queries are database images" in printed.err
    assert set(recall(rows, tolerance=1).values()) == {1.0}

    shutil.copytree(small_street / "database", tmp_path / "copy")  # by content
    copied = (*same(small_street, order)[:2], f"dataset.queries={tmp_path}/copy", order)
    assert "10 of 10 queries are database images" in run(*copied, name="copied")[1].err

    rows, printed, place = run(*same(small_street, order, "dataset.exclude_neighbors=1"), name="left_out")
    assert "queries are database images" not in printed.err
    assert set(recall(rows, tolerance=1).values()) == {0.0}  # all that is within a frame is left out
    assert 0 < recall(rows, tolerance=5)["sum"] <= 1
    rankings = ranked(place)
    assert len(rankings) == 10
    for query, names in rankings.items():
        assert len(names) == 4
        assert all(abs(int(name[:4]) - int(query[:4])) > 1 for name in names)


def test_only_listed_images_are_candidates(small_street, tmp_path, run):
    listed = [[2, 3, 4], [], *([query, 7] for query in range(2, 10))]
    (tmp_path / "among.json").write_text(json.dumps([*enumerate(listed)]))
    more = ("dataset.ground_truth=order", f"dataset.among={tmp_path}/among.json", "dataset.exclude_neighbors=0")
    *_, place = run(*same(small_street, *more))
    names = {query: {f"{row:04d}.png" for row in rows if row != query} for query, rows in enumerate(listed)}
    assert {int(query[:4]): {*rows} for query, rows in ranked(place).items()} == {q: n for q, n in names.items() if n}


def test_labels_are_right_and_make_one_column(small_street, tmp_path, run):
    for side in ("database", "query"):
        lines = [f"{row:04d}.png,floor {row // 5}\n" for row in range(10)]
        (tmp_path / f"{side}.csv").write_text("name,label\n" + "".join(lines))
    files = [f"dataset.{side}_labels={tmp_path}/{side}.csv" for side in ("database", "query")]
    rows, printed, place = run(*folder(small_street)[:3], "dataset.ground_truth=label", *files)
    assert (place / "table.csv").read_text().splitlines()[0] == "system,R@1,R@5,R@10"
    assert all("tolerance" not in row and "radius" not in row for row in rows)
    correct = [int(query[:4]) // 5 == int(names[0][:4]) // 5 for query, names in ranked(place).items()]
    assert recall(rows)["sum"] == np.mean(correct)
    assert "recall in %" in printed.out
    assert "±" not in printed.out


def test_pairs_of_an_index_file_are_all_that_is_right_unless_asked(small_street, run):
    exact, printed, place = run(*folder(small_street, "dataset.widen_index=false"), name="exact")
    assert (place / "table.csv").read_text().splitlines()[0] == "system,R@1,R@5,R@10"
    assert len(exact) == 3
    assert "±" not in printed.out
    widened, _, place = run(*folder(small_street, "recall.tolerances=[0,1]"), name="widened")
    assert (place / "table.csv").read_text().splitlines()[0] == "system,R@1 ±0,R@1 ±1,R@5 ±1,R@10 ±1"
    assert recall(exact) == recall(widened, tolerance=0)


def test_images_of_12_bits_in_files_of_16_are_warned_of(tmp_path, capsys):
    for side in ("database", "queries"):
        (tmp_path / side).mkdir()
        Image.fromarray(np.full((120, 160), 4095, np.uint16)).save(tmp_path / side / "0.png")
    prepare(settings_of(*QUICK, *folder(tmp_path)[:3], "dataset.ground_truth=order"), Stopwatch())
    assert "16-bit images is 4095: they look dark; use dataset.bits=12" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["", None, "elsewhere"])
def test_an_empty_cache_variable_is_none(value, monkeypatch, succeed):
    """Or features would be kept in the root of the file system."""
    monkeypatch.setenv("MFVPR_CACHE", value or "")
    if value is None:
        monkeypatch.delenv("MFVPR_CACHE")
    calls, root = [], value or "~/.cache/mfvpr"
    monkeypatch.setattr("mfvpr.cli.evaluation.evaluate", calls.append)
    succeed("evaluate")
    assert (calls[0].cache, calls[0].dataset["cache"]) == (f"{root}/features", root)
