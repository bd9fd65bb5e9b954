"""A small data set, and the programs on it: called, or as command lines of this process."""

import json
import logging
import signal
import sys
from importlib import import_module

from experiments.launch import launch
from mfvpr.data.streets import streets_folder
from tests.test_experiments import folder

QUERIES, CANDIDATES = 24, 8


def shared(tmp_path_factory):
    """A folder of this session: the data set, its features and its matches."""
    return tmp_path_factory.getbasetemp() / "programs"


def small(root, *more):
    """Settings of the data set in `root`, which is drawn where it is not there."""
    street = streets_folder(root, num_frames=QUERIES, image_size=(160, 120))
    return folder(
        street, "features.max_keypoints=60", "features.image_size=[160,120]", "retrieval.num_words=8",
        f"candidates={CANDIDATES}", "recall.tolerances=[0,1]", "recall.ks=[1,5]", f"store={root}/store", *more,
    )  # fmt: skip


def typed(monkeypatch, capsys, program, *arguments):
    """Exit code, stdout and stderr of a command line, in this process."""
    monkeypatch.setattr(sys, "argv", [program, *map(str, arguments)])
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # this and the next two are put back
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(logging, "shutdown", lambda *_: None)  # Hydra's call would close an earlier test's stderr
    handler, code = signal.getsignal(signal.SIGTERM), 0
    capsys.readouterr()
    try:
        launch(getattr(import_module(f"experiments.{program}"), program), program)
    except SystemExit as left:
        code = left.code
    finally:
        signal.signal(signal.SIGTERM, handler)
    return code, *capsys.readouterr()


def results(place):
    """results.json of a run folder, but for its seconds."""
    found = json.loads((place / "results.json").read_text())
    del found["seconds"]
    return found


def snapshot(place):
    """Every file below a folder, but what is remembered of images."""
    files = (path for path in sorted(place.rglob("*")) if path.is_file() and path.parent.name != "contents")
    return {path: path.read_bytes() for path in files}
