"""The programs, and a small data set for them: called, as command lines of this process, or in one of their own."""

import csv
import json
import logging
import os
import signal
import subprocess
import sys
from copy import deepcopy
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf

from mfvpr.cli import programs, schema
from mfvpr.cli.programs import launch
from mfvpr.datasets.streets import streets_folder
from mfvpr.systems.assembly import CONF
from mfvpr.utils.fields import from_values

ROOT = Path(__file__).parent.parent
MFVPR = (sys.executable, "-c", "from mfvpr.cli.programs import main; main()")  # the command `mfvpr` of this clone
QUICK = ("figures=0", "features.max_keypoints=100", "retrieval.num_words=8")
QUERIES, CANDIDATES = 24, 8  # of the small data set


def run(*arguments, program="evaluate", cwd=ROOT, **environment):
    """A command line in a process of its own, which takes seconds to import what it needs: see `typed`."""
    command = [*MFVPR, program] if program in programs.COMMANDS else [sys.executable, "-m", f"experiments.{program}"]
    return subprocess.run(
        [*command, *map(str, arguments)],
        cwd=cwd, capture_output=True, text=True, timeout=280,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
    )  # fmt: skip


def composed(*overrides, config="evaluate"):
    """The settings of a command line, not yet checked."""
    return deepcopy(_composed(config, overrides))


def settings_of(*overrides, config="evaluate", **more):
    """The checked settings of a command line; `more` replaces some."""
    return replace(from_values(schema.PROGRAMS[config], composed(*overrides, config=config)), **more)


@cache
def _composed(config, overrides):
    schema.register()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return OmegaConf.to_container(hydra.compose(config, list(overrides)), resolve=True)


def folder(street, *more):
    """Settings of a synthetic street's folder."""
    index = ("dataset.ground_truth=index", f"dataset.index_file={street}/ground_truth.csv", "dataset.widen_index=true")
    return ("dataset=folder", f"dataset.database={street}/database", f"dataset.queries={street}/queries", *index, *more)


def shared(tmp_path_factory):
    """A folder of this session: the data set, its features and its matches."""
    return tmp_path_factory.getbasetemp() / "programs"


def small(root, *more):
    """Settings of the data set in `root`, which is drawn where it is not there."""
    street = streets_folder(root, num_frames=QUERIES, image_size=(160, 120))
    return folder(
        street, "features.max_keypoints=60", "features.image_size=[160,120]", "retrieval.num_words=8",
        f"candidates={CANDIDATES}", "recall.tolerances=[0,1]", "recall.ks=[1,5]", f"cache={root}/store", *more,
    )  # fmt: skip


def job_of(root, config, job, figures):
    """A function that runs a job in this process, without figures unless asked; what results.json holds comes back."""

    def call(out, *overrides, pictures=False):
        with pytest.MonkeyPatch.context() as patch:
            if not pictures:
                patch.setattr(*figures, lambda *_: [])
            job(settings_of(*small(root), f"out={out}", *overrides, config=config))
        return results(out)

    return call


def typed(monkeypatch, capsys, program, *arguments):
    """Exit code, stdout and stderr of a command line, in this process."""
    program, *command = program.split()
    monkeypatch.setattr(sys, "argv", [program, *command, *map(str, arguments)])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(logging, "shutdown", lambda *_: None)  # Hydra's call would close an earlier test's stderr
    handlers, code = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}, 0
    capsys.readouterr()
    try:
        if program in programs.COMMANDS:
            programs.run(program)
        elif program == "paper":
            launch("paper", "experiments.paper.program:paper")
        else:
            import_module(f"experiments.{program}").main()
    except SystemExit as left:
        code = left.code
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
    return code, *capsys.readouterr()


def output_of(monkeypatch, capsys, program, *arguments, code=0):
    """Stdout and stderr of a command line that must end with an exit code."""
    exit_code, stdout, stderr = typed(monkeypatch, capsys, program, *arguments)
    assert exit_code == code, stderr
    return stdout, stderr


def results(place):
    """results.json of a run folder, but for its seconds."""
    content = json.loads((place / "results.json").read_text())
    del content["seconds"]
    return content


def csv_rows(path):
    """The lines of a table, as dictionaries by column."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def snapshot(place):
    """Every file below a folder, but what is remembered of images."""
    files = (path for path in sorted(place.rglob("*")) if path.is_file() and path.parent.name != "contents")
    return {path: path.read_bytes() for path in files}
