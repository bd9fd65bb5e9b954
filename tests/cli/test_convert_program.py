"""mfvpr convert: files of other programs from an evaluation and from localized images."""

import json
import shutil
from pathlib import Path

import pytest

from mfvpr.cli import evaluation
from mfvpr.cli.jobs import dataset_of
from mfvpr.io import read_shortlist
from tests.programs import csv_rows, settings_of, small

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def settings(root, tmp_path_factory):
    run = tmp_path_factory.mktemp("convert") / "run"
    settings = settings_of(*small(root), "scorer=histogram", "figures=0", f"out={run}")
    evaluation.evaluate(settings)
    return settings


@pytest.fixture
def convert(call, tmp_path):
    """Writes to `tmp_path / out`: the path, what is printed, and errors."""

    def run(source, layout, *more, out="out", code=0):
        exit_code, stdout, stderr = call("convert", source, tmp_path / out, "--layout", layout, *more)
        assert exit_code == code, stderr
        return tmp_path / out, stdout, stderr

    return run


def first_candidates(run):
    return {row["query"]: row["database"] for row in csv_rows(Path(run) / "predictions.csv") if row["rank"] == "1"}


@pytest.mark.parametrize("layout", ["preds", "hloc", "kapture"])
def test_candidates_of_a_run(convert, settings, layout, tmp_path):
    dataset = dataset_of(settings.dataset)
    path, stdout, _ = convert(settings.out, layout)
    assert stdout == f"{path}: candidates of {len(dataset.queries)} queries\n"
    shortlist = read_shortlist(path, dataset.queries.names, dataset.database.names)
    first = {query: dataset.database.names[row]
             for query, row in zip(dataset.queries.names, shortlist.indices[:, 0], strict=True)}  # fmt: skip
    assert first == first_candidates(settings.out)
    if layout == "hloc":
        prefixed, *_ = convert(settings.out, layout, "--query-prefix", "q/", "--database-prefix", "d/", out="prefixed")
        assert [line.split() for line in prefixed.read_text().splitlines()] == [
            [f"{'qd'[side]}/{name}" for side, name in enumerate(line.split())] for line in path.read_text().splitlines()
        ]
    if layout == "preds":
        lines = (path / "004.txt").read_text().splitlines()
        correct = dataset.truth.positives(1).of(4)  # the middle tolerance of this run
        assert lines[1] == str(dataset.queries.paths[4])
        positives = lines[lines.index("Positives paths:") + 1 : -1]
        assert positives == [str(dataset.database.paths[row]) for row in correct]
        run = shutil.copytree(settings.out, tmp_path / "run")  # as if images beside the queries had been left out
        about = (run / "run.json").read_text()
        (run / "run.json").write_text(about.replace('"exclude_neighbors": null', '"exclude_neighbors": 1'))
        path, *_ = convert(run, layout, out="left_out")
        assert (path / "004.txt").read_text().splitlines() == lines[: lines.index("Positives paths:")]


def poses_of(dataset, path, num_numbers):
    times = [f"{row}.5 " if num_numbers == 7 else "" for row in range(len(dataset.database))]
    numbers = [f"{row}.0" + " 1e-3" * (num_numbers - 1) for row in range(len(times))]
    path.write_text("".join(f"{time}{pose}\n" for time, pose in zip(times, numbers, strict=True)))
    return dict(zip(dataset.database.names, numbers, strict=True))


def test_trajectories_and_shifts_of_a_run(convert, settings, tmp_path):
    dataset = dataset_of(settings.dataset)
    first = first_candidates(settings.out)
    poses = poses_of(dataset, tmp_path / "kitti.txt", 12)
    path, stdout, _ = convert(settings.out, "kitti", "--poses", tmp_path / "kitti.txt")
    expected = [poses[first[query]] for query in dataset.queries.names]
    assert path.read_text().splitlines() == expected
    assert stdout == f"{path}: {len(expected)} images with a place, 0 without\n"
    poses = poses_of(dataset, tmp_path / "tum.txt", 7)
    (tmp_path / "times.txt").write_text("".join(f"{row}.000000001\n" for row in range(len(expected))))
    times = ("--times", tmp_path / "times.txt")
    path, *_ = convert(settings.out, "tum", "--poses", tmp_path / "tum.txt", *times, out="tum")
    expected = [f"{row}.000000001 {poses[first[query]]}" for row, query in enumerate(dataset.queries.names)]
    assert path.read_text().splitlines() == expected
    path, *_ = convert(settings.out, "shifts", *times, out="shifts")
    rows = {row["image"]: row for row in csv_rows(path)}
    assert {name: row["place"] for name, row in rows.items()} == first
    for row in csv_rows(Path(settings.out) / "shifts.csv"):
        assert rows[row["query"]]["shift_x"] == row["shift_x"]
        assert rows[row["query"]]["image_width"] == "160"


def test_lines_of_localize(convert, tmp_path, settings):
    dataset = dataset_of(settings.dataset)
    poses = poses_of(dataset, tmp_path / "tum.txt", 7)
    line = {"image": "/drive/1403636579763555584.png", "place": "a", "confidence": None, "shift": None, "reason": None,
            "shift_interval": None, "image_width": 9,
            "alternatives": [{"name": dataset.database.names[3], "score": 2.0}]}  # fmt: skip
    (tmp_path / "lines").write_text(json.dumps(line) + "\n" + json.dumps({"image": "/drive/1.5.png", "error": "bad"}))
    files = ("--poses", tmp_path / "tum.txt", "--database", dataset.database.root)
    path, stdout, _ = convert(tmp_path / "lines", "tum", *files)
    assert path.read_text() == f"1403636579.763555584 {poses[dataset.database.names[3]]}\n"
    assert stdout == f"{path}: 1 images with a place, 1 without\n"
    path, *_ = convert(tmp_path / "lines", "shifts", out="shifts")
    assert [row["header.stamp.nanosec"] for row in csv_rows(path)] == ["500000000", "763555584"]


@pytest.mark.parametrize(("layout", "more", "words"), [
    ("tum", [], "--poses: expected a path for --layout tum"),
    ("shifts", [], "0000.png: expected the time as the name of the file"),
    ("csv", [], "argument --layout: invalid choice: 'csv'"),
])  # fmt: skip
def test_wrong_arguments_are_one_line(convert, settings, layout, more, words):
    path, _, stderr = convert(settings.out, layout, *more, code=2)
    assert words in stderr
    assert stderr.count("\n") == 1
    assert not path.exists()


@pytest.mark.parametrize("layout", ["preds", "hloc", "kapture", "kitti", "shifts"])
def test_files_that_exist_are_not_overwritten(convert, settings, tmp_path, layout):
    """Also those that are read."""
    dataset = dataset_of(settings.dataset)
    poses_of(dataset, tmp_path / "out", 12)
    (tmp_path / "times").write_text("".join(f"{row}.5\n" for row in range(len(dataset.queries))))
    before = (tmp_path / "out").read_text()
    more = {"kitti": ["--poses", tmp_path / "out"], "shifts": ["--times", tmp_path / "times"]}.get(layout, [])
    _, _, stderr = convert(settings.out, layout, *more, code=2)
    assert stderr.startswith(f"error: {tmp_path}/out: expected a new")
    assert (tmp_path / "out").read_text() == before
