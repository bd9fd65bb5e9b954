"""Data sets as a program: listed, and checked beside what is published."""

import pytest
from PIL import Image

from mfvpr.datasets.published import PUBLISHED
from tests.datasets.test_published import put


def test_all_are_listed_with_their_numbers(call):
    _, stdout, _ = call("data", "list")
    names = [line.split()[0].removesuffix(":") for line in stdout.splitlines()[2:]]
    assert names == [*PUBLISHED, "grief_season", "corridor", "streets_seasons"]
    assert "1,411" in next(line for line in stdout.splitlines() if line.startswith("robotcar"))


def test_images_that_cannot_be_read_are_counted(call, tmp_path):
    put(tmp_path, *(f"{side}/{i}.png" for side in ("database", "queries") for i in range(3)))
    (tmp_path / "queries/1.png").write_bytes((tmp_path / "queries/1.png").read_bytes()[:30])
    (tmp_path / "queries/2.png").write_text("text")
    code, stdout, stderr = call("data", "check", "grief_season", f"root={tmp_path}", "--sheet", tmp_path / "sheet.png")
    assert code == 2
    assert "queries grief_season: 3 images, 2 unreadable" in stdout
    assert stdout.count("unreadable: ") == 2
    assert "2 images cannot be read" in stderr


def test_what_is_there_stands_beside_what_is_published(call, tmp_path):
    put(tmp_path, *(f"Reference/image{i:04d}.png" for i in range(4)), *(f"Live/image{i:04d}.png" for i in range(2)))
    (tmp_path / "GroundTruth.csv").write_text("Reference,Live\n0,0\n3,1\n")
    code, stdout, stderr = call("data", "check", "berlin_a100", f"root={tmp_path}", "--sheet", tmp_path / "sheet.png")
    assert code == 2
    assert "database: 4 images, 0 unreadable" in stdout
    assert "berlin_a100: correct images of a query ±5: 4 to 4, median 4; 0 queries have none" in stdout
    assert "2 queries are images of the database" in stdout
    assert "4 database images where 85 are published" in stderr
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.size[0] > 500


def test_names_are_text_in_lists_of_folders_and_where_they_look_like_dates(call, tmp_path):
    put(tmp_path, *(f"{folder}/{i}.png" for folder in ("database", "nä", "b") for i in range(3)))
    queries = f"queries=[{tmp_path}/nä,{tmp_path}/b]"
    given = ("sequences", f"database={tmp_path}/database", queries, "ground_truth=order", "name=2026-01-31")
    code, stdout, _ = call("data", "check", *given, "--sheet", tmp_path / "sheet.png")
    assert code == 0
    assert "nä: 3 queries are images of the database" in stdout


@pytest.mark.parametrize(("arguments", "words"), [
    (["check", "sequences", "database=d", "queries=[q]", "ground_truth=label"], "expected dataset.query_labels=FILE"),
    (["check", "gardens_point"], "dataset.root: expected a value"),
    (["check", "gardens_point", "root=/no/such"], "expected the folder of gardens_point, got nothing"),
    (["check", "garden"], "dataset=garden: expected one of"),
    (["check"], "the following arguments are required: NAME"),
])  # fmt: skip
def test_mistakes_are_one_line(call, arguments, words):
    code, _, stderr = call("data", *arguments)
    assert (code, stderr.count("\n")) == (2, 1)
    assert words in stderr
