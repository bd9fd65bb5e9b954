"""Functions that write files replace none of others; those that read say what is no file."""

import os

import jax
import numpy as np
import pytest

from mfvpr import InputError, Shortlist, io
from mfvpr.baselines.learned_weight import LearnedWeight, read_weight, write_weight
from mfvpr.evaluation import Confidence, read_confidences, write_confidences
from tests.builders import random_matches
from tests.io.other_programs import feature

WEIGHT = LearnedWeight.create(jax.random.key(1), random_matches(np.random.default_rng(0), 30), 3)


def test_files_that_exist_stay(tmp_path):
    """Only files of weights and of confidences are replaced, by their like."""
    names, single = ["1.jpg"], np.ones((1, 1))
    model = Confidence((0.0, 0.0), (1.0, 1.0), (1.0, 1.0), 0.0)
    writers = {
        "a.h5": lambda path: io.write_features(path, names, [(0, feature(0))]),
        "a": lambda path: io.write_features(path, names, [(0, feature(0))]),
        "g.npy": lambda path: io.write_global_descriptors(path, names, single),
        "s.txt": lambda path: io.write_shortlist(
            path, Shortlist(0 * single.astype(int), single, single > 0), names, names
        ),
        "t.txt": lambda path: io.write_trajectory(path, ["0 0 0 0 0 0 1"], [0]),
        "c.json": lambda path: write_confidences(path, {"histogram": model}, {}),
        "w.json": lambda path: write_weight(path, WEIGHT, {}),
    }
    for name, write in writers.items():
        path = tmp_path / name
        file = path / "1.jpg.npz" if name == "a" else path
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"precious")
        with pytest.raises(InputError, match="expected a new file, got one that exists"):
            write(path)
        assert file.read_bytes() == b"precious"
        file.unlink()
        write(path)
        if name.endswith(".json"):
            write(path)
        else:
            with pytest.raises(InputError, match="expected a new file"):
                write(path)


def test_confidences_and_weights(tmp_path):
    path = tmp_path / "confidence.json"
    model = Confidence((0.0, 0.0), (1.0, 1.0), (1.0, 1.0), 0.0)
    write_confidences(str(path), {"histogram": model}, {})
    assert read_confidences(str(path)) == ({"histogram": model}, {})
    os.mkfifo(tmp_path / "pipe.json")
    for read in (read_confidences, read_weight):
        for name, got in (("pipe.json", "a pipe or device"), ("no.json", "nothing"), ("", "a folder")):
            with pytest.raises(InputError, match=f"got {got}"):
                read(str(tmp_path / name))
