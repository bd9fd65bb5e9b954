"""Programs with features, on the small street."""

import json

import pytest

from tests.programs import typed


@pytest.fixture
def street_settings(small_street):
    """Settings of a data set for the command line."""
    folders = f"dataset.database={small_street}/database", f"dataset.queries={small_street}/queries"
    return ("dataset=folder", *folders, "dataset.ground_truth=order")


@pytest.fixture
def run_program(monkeypatch, capsys):
    """Run a command line, which ends with an exit code; return its messages."""

    def run_program(program, *arguments, code=0):
        actual, stdout, stderr = typed(monkeypatch, capsys, program, *arguments)
        assert (actual or 0) == code, stderr
        assert not (code and stdout)
        return stderr

    return run_program


def read_rows(out):
    """Rows of an evaluation's results."""
    return json.loads((out / "results.json").read_text())
