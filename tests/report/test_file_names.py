"""File names of what users name: different, safe, and for plain names as they always were."""

import pytest

from mfvpr.report.runs import file_names
from mfvpr.utils import InputError

HOSTILE = (
    "a/b", "a_b", "../up", "..", ".", "", "nul\0", "two\nlines", "a\\b", "c:d", "e*?", "not utf-8 \udcff", "\ud800",
    ".hidden", "ends in dot.", " ", "x" * 300, "x" * 301, "ü" * 150, "a + b", "A + B", "count", "Count", "c_d", "c + d",
)  # fmt: skip


def test_plain_names_are_files_of_their_own_name():
    files = {
        "histogram": "histogram",
        "histogram + anchor + retrieval": "histogram_anchor_retrieval",
        "homography_24 + retrieval": "homography_24_retrieval",
        "my score (v2), straße=1": "my score (v2), straße=1",
    }
    assert file_names([*files]) == files


def test_names_have_different_files_that_every_folder_takes(tmp_path):
    names = list(HOSTILE)
    files = file_names(names)
    assert len({file.casefold() for file in files.values()}) == len(names)
    for name, file in files.items():
        (tmp_path / f"{file}.csv").write_text(repr(name))
    assert len([*tmp_path.iterdir()]) == len(names)  # none in a folder, or above
    for name, file in files.items():
        assert (tmp_path / f"{file}.csv").read_text() == repr(name)


def test_a_repeated_name_is_refused():
    with pytest.raises(InputError, match="got one twice"):
        file_names(["one", "two", "one"])
