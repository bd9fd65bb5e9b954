"""Names of any characters in CSV, LaTeX, and as names of files."""

import csv
import io
import string

import pytest

from mfvpr.report import Table
from mfvpr.report.runs import file_names, read_csv, write_csv
from mfvpr.utils import InputError

NAMES = ["a\rb", "a\r\nb\r\n", "a\nb", "\r", 'a,"b"', "=a", "\udcff.png"]


def test_names_are_read_back_from_csv(tmp_path):
    write_csv(tmp_path / "a.csv", ["query", "rank"], [(name, 1) for name in NAMES])
    assert read_csv(tmp_path / "a.csv") == [{"query": name, "rank": "1"} for name in NAMES]
    text = Table(["name"], [[name] for name in NAMES]).csv()
    assert [*csv.reader(io.StringIO(text, newline=""))] == [["name"], *([name] for name in NAMES)]
    assert write_csv(tmp_path / "b.csv", ["a", "b"], [("c", 2)]) is None
    assert (tmp_path / "b.csv").read_bytes() == b"a,b\nc,2\n"


def test_no_character_is_a_command_of_latex():
    row = Table(["name"], [[string.punctuation]]).latex().splitlines()[4]
    escaped = r"!\"\#\$\%\&'()*+,-./:;<=>?@[\textbackslash{}]\textasciicircum{}\_`\{|\}\textasciitilde{}"
    assert row == escaped.replace(r"\"", '"') + r" \\"


HOSTILE = (
    "a/b", "a_b", "../up", "..", ".", "", "nul\0", "two\nlines", "a\\b", "c:d", "e*?", "not utf-8 \udcff", "\ud800",
    ".hidden", "ends in dot.", " ", "x" * 300, "x" * 301, "ü" * 150, "a + b", "A + B", "count", "Count", "c_d", "c + d",
)  # fmt: skip


def test_names_have_different_files_that_every_folder_takes(tmp_path):
    plain = {"histogram + anchor": "histogram_anchor", "my score (v2), straße=1": "my score (v2), straße=1"}
    assert file_names([*plain]) == plain
    files = file_names(HOSTILE)
    assert len({file.casefold() for file in files.values()}) == len(HOSTILE)
    for name, file in files.items():
        (tmp_path / f"{file}.csv").write_text(repr(name))
    assert len([*tmp_path.iterdir()]) == len(HOSTILE)  # none in a folder, or above
    with pytest.raises(InputError, match="got one twice"):
        file_names(["one", "two", "one"])
