"""The page of results: its links and pictures exist, and its pictures are drawn from its tables."""

import re

import pytest

from notebooks.draw_results import PAGE, candidate_times, draw, query_times, read_table, real_recall

TEXT = PAGE.read_text()


def slug(heading):
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def test_links_and_pictures_exist():
    targets = re.findall(r"\]\(([^)\s]+)\)", TEXT)
    headings = [slug(heading) for heading in re.findall(r"^#+ (.*)$", TEXT, flags=re.MULTILINE)]
    assert len(headings) == len({*headings})
    assert {target[1:] for target in targets if target.startswith("#")} <= {*headings}
    pictures = [target for target in targets if target.endswith(".png")]
    assert {PAGE.parent / picture for picture in pictures} == {*(PAGE.parent / "pictures").iterdir()}
    assert all((PAGE.parent / picture).stat().st_size < 100_000 for picture in pictures)


def test_tables_have_rows_of_one_length():
    blocks = re.findall(r"(?:^\|.*\|\n)+", TEXT, flags=re.MULTILINE)
    assert len(blocks) > 20
    for block in blocks:
        assert len({line.count("|") for line in block.splitlines()}) == 1, block


def test_pictures_are_drawn_from_the_tables(tmp_path):
    recall, times = real_recall(TEXT), query_times(TEXT)
    assert len(recall) == 12
    assert recall["system=mfvpr"] == {"SIFT": [53.5, 71.2], "ALIKED": [90.1, 86.5]}
    assert all({*by_features} == {"SIFT", "ALIKED"} for by_features in recall.values())
    assert [len(points) for points in times.values()] == [4, 2, 2, 2, 2]
    assert times["map, SIFT, candidates from memory"] == [[1000.0, 62.6], [10_000.0, 67.6]]
    draw(TEXT, tmp_path)
    assert all(len(points) == 5 for points in candidate_times(TEXT).values())
    assert {path.name for path in tmp_path.iterdir()} == {"recall.png", "database_size.png", "candidates.png"}


def test_a_missing_table_is_an_error():
    with pytest.raises(ValueError, match="unpack"):
        read_table(TEXT, "system", "no such column")
