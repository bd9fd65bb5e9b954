"""Predictions as files of other programs, from the lines of `mfvpr localize` and from the files of a run."""

import csv
import json

import pytest

from mfvpr.report.run_files import (
    SHIFT_COLUMNS,
    SHIFTS,
    read_lines,
    read_run_images,
    shortlist_of,
    write_poses,
    write_shift_table,
)
from tests.io.checks import one_line_error

DATABASE = ["0.png", "1.png", "2.png"]
POSES = ["0 0 0 0 0 0 1", "1.50 -0 0 0 0 0 1", "2e0 0 0 0 0 0 1"]
CELLS = {"alternatives": [], "confidence": None, "shift": None, "shift_interval": None, "image_width": 448}
LINES = [
    {"image": "/drive/1403636580000000001.png", "place": "1.png", "score": 19.09, "confidence": 0.9400000000000001,
     "shift": [61.1, -12.5], "shift_interval": [[47.6, -16.0], [76.0, 24.4]], "reason": None,
     "image_width": 448, "alternatives": [{"row": 1, "name": "1.png", "place": "1.png", "score": 19.09}]},
    {"image": "/drive/1403636579763555584.png", "error": "cannot be read, it is damaged"},
    {**CELLS, "image": "/drive/1403636579900000000.png", "place": None, "reason": "low confidence", "confidence": 0.1,
     "alternatives": [{"row": 0, "name": "0.png", "place": "0.png", "score": 1.0}]},
    {**CELLS, "image": "/drive/1403636579800000000.png", "place": {"x": 1.5, "y": "é"}, "reason": None,
     "alternatives": [{"row": 2, "name": "2.png", "place": {}, "score": 3.0}]},
]  # fmt: skip
STAMPS = [1403636580000000001, 1403636579763555584, 1403636579900000000, 1403636579800000000]


@pytest.fixture
def write(tmp_path):
    """Writes the lines, JSON values or text, to a file."""

    def call(lines):
        texts = [line if isinstance(line, str) else json.dumps(line, ensure_ascii=False) for line in lines]
        (tmp_path / "lines.jsonl").write_text("\r\n".join(texts) + "\r\n\r\n", "utf-8", newline="")
        return tmp_path / "lines.jsonl"

    return call


def test_shifts_have_exact_times_and_their_order(write, tmp_path):
    write_shift_table(tmp_path / "shifts.csv", read_lines(write(LINES)), STAMPS)
    with (tmp_path / "shifts.csv").open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == SHIFT_COLUMNS
    assert [int(sec) * 10**9 + int(nanosec) for sec, nanosec, *_ in rows] == sorted(STAMPS)
    cells = [dict(zip(header[3:], row[3:], strict=True)) for row in rows]
    assert [row["place"] for row in cells] == ["", '{"x": 1.5, "y": "é"}', "", "1.png"]
    assert [row["reason"] for row in cells] == ["cannot be read, it is damaged", "", "low confidence", ""]
    assert [row["image"] for row in cells] == [LINES[row]["image"] for row in (1, 3, 2, 0)]
    numbers = ["0.9400000000000001", "61.1", "-12.5", "47.6", "-16.0", "76.0", "24.4", "448"]
    names = ("confidence", "shift_x", "shift_y", "low_x", "low_y", "high_x", "high_y", "image_width")
    assert [cells[3][name] for name in names] == numbers
    assert cells[2]["confidence"] == "0.1"
    assert cells[2]["shift_x"] == cells[0]["image_width"] == ""


def test_trajectory_leaves_out_images_without_a_place(write, tmp_path):
    (tmp_path / "poses.txt").write_text("".join(f"{row} {pose}\n" for row, pose in enumerate(POSES)))
    images = read_lines(write(LINES))
    write_poses(tmp_path / "tum.txt", images, tmp_path / "poses.txt", DATABASE, STAMPS)
    expected = f"1403636579.800000000 {POSES[2]}\n1403636580.000000001 {POSES[1]}\n"
    assert (tmp_path / "tum.txt").read_text() == expected
    with one_line_error("expected a place of all images, .* of 4 images"):
        write_poses(tmp_path / "kitti.txt", images, tmp_path / "poses.txt", DATABASE, None)
    with one_line_error("expected a database image with a pose, got 1.png; localize with"):
        write_poses(tmp_path / "tum2.txt", images, tmp_path / "poses.txt", ["a", "b", "c"], STAMPS)
    assert not [*tmp_path.glob("kitti*"), *tmp_path.glob("tum2*")]


@pytest.mark.parametrize("line", ["{", {**LINES[0], "shift": [1.0]}])
def test_other_lines_are_one_line(write, line):
    with one_line_error("expected lines of mfvpr localize", "lines.jsonl"):
        read_lines(write([LINES[0], line]))


def test_files_of_a_run(tmp_path):
    """Refused queries have no place, and a query without candidates is not lost."""
    (tmp_path / "predictions.csv").write_text(
        "query,rank,database,score,correct,refused\n"
        "b.png,1,2.png,5,1,\nb.png,2,0.png,4.5,0,\nc.png,1,no place,9,1,1.png\n"
    )
    (tmp_path / "top_predictions.csv").write_text(
        "query,prediction,refused,score,confidence,reason\n"
        "a.png,no place,,,,too few features\nb.png,2.png,,5,0.75,\nc.png,no place,1.png,9,0.25,low confidence\n"
    )
    (tmp_path / "shifts.csv").write_text(f"query,prediction,{','.join(SHIFTS)}\nb.png,2.png,1.5,-2,1,2,-3,-1,336,240\n")
    images = read_run_images(tmp_path, ["a.png", "b.png", "c.png"])
    assert [image.place for image in images] == [None, "2.png", None]
    assert [image.cells.get("reason") for image in images] == ["too few features", None, "low confidence"]
    assert images[1].cells == {"confidence": "0.75", "shift_x": "1.5", "shift_y": "-2", "low_x": "1", "high_x": "2",
                               "low_y": "-3", "high_y": "-1", "image_width": "336"}  # fmt: skip
    shortlist = shortlist_of(images, DATABASE)
    assert shortlist.indices.tolist() == [[-1, -1], [2, 0], [-1, -1]]
    assert shortlist.scores.tolist() == [[0, 0], [5, 4.5], [0, 0]]
    with one_line_error("predictions.csv: .*expected the folder of an evaluation, of this data set"):
        read_run_images(tmp_path, ["a.png", "b.png"])
    with one_line_error(r"2\.png: expected an image of the database"):
        shortlist_of(images, DATABASE[:2])
