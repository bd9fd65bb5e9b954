"""Names of any characters in CSV and LaTeX."""

import csv
import io
import string

from mfvpr.report import Table
from mfvpr.report.tables import read_csv, write_csv

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
