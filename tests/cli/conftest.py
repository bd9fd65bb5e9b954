"""Command lines of the programs in this process, and the data set that their tests share."""

import re
import signal
from functools import partial

import pytest

from tests.programs import output_of, shared, typed


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    """The folder of the small data set, of its features and of its matches."""
    return shared(tmp_path_factory)


@pytest.fixture
def call(monkeypatch, capsys):
    """Runs a command line: exit code, stdout, stderr."""
    return partial(typed, monkeypatch, capsys)


@pytest.fixture
def succeed(monkeypatch, capsys):
    """Runs a command line that must succeed: stdout, stderr."""
    return partial(output_of, monkeypatch, capsys)


@pytest.fixture
def refuse(call):
    """Runs a command line that must end with exit code 2 and no result: the error, which is the last line."""

    def run(program, *arguments):
        code, stdout, stderr = call(program, *arguments)
        assert (code, stdout) == (2, ""), stderr
        assert "Traceback" not in stderr
        error = stderr.splitlines()[-1]
        assert error.startswith("error: ")
        return error

    return run


@pytest.fixture
def interrupt(tmp_path):
    """Sends Ctrl-C to a process, which must end with exit code 130, say so in its last line, and leave no file."""

    def send(process):
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
        assert process.returncode == 130, stderr[-2000:]
        assert stderr.splitlines()[-1].startswith("interrupted")
        assert "Traceback" not in stderr
        assert list(tmp_path.iterdir()) == []

    return send


@pytest.fixture
def refuse_at_once(call, tmp_path, monkeypatch):
    """Runs a command line that must be refused before any work: the only line, and no file is left."""

    def run(program, *arguments):
        monkeypatch.chdir(tmp_path)
        code, stdout, stderr = call(program, *arguments)
        stderr = re.sub(r"\Asystem=auto: .*\n", "", stderr)  # which system runs without a choice
        assert (code, stdout, stderr.count("\n")) == (2, "", 1), stderr
        assert list(tmp_path.iterdir()) == []
        return stderr

    return run
