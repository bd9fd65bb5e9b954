"""Functions that take a path take it as text as well, and replace no file of others."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest

from mfvpr import InputError, Shortlist, io
from mfvpr.baselines.learned_weight import LearnedWeight, read_weight, write_weight
from mfvpr.datasets import ImageFolder, IndexFile, LabelFiles, datasets
from mfvpr.evaluation import Confidence, read_confidences, write_confidences
from mfvpr.retrieval import DescriptorFiles, FeatureFiles
from mfvpr.retrieval.precomputed import File
from tests.builders import fill, random_matches
from tests.io.other_programs import feature

WEIGHT = LearnedWeight.create(jax.random.key(1), random_matches(np.random.default_rng(0), 30), 3)


def test_files_of_other_programs(tmp_path):
    names, path = ["1.jpg", "2.jpg"], str(tmp_path / "all.npz")
    io.write_features(path, names, [(row, feature(row, count=4)) for row in range(2)])
    assert io.open_features(path, names).counts.tolist() == [4, 4]
    folder = ImageFolder(str(tmp_path), tuple(names))  # type: ignore[arg-type]
    files = FeatureFiles({str(tmp_path): File(path)})  # type: ignore[dict-item]
    assert files.open(folder, partial=False).counts.tolist() == [4, 4]
    assert File(path) == File(Path(path))  # type: ignore[arg-type]
    assert folder.paths == [tmp_path / name for name in names]
    path = str(tmp_path / "g.npy")
    io.write_global_descriptors(path, names, np.eye(2))
    np.testing.assert_array_equal(io.read_global_descriptors(path, names), np.eye(2))
    np.testing.assert_array_equal(DescriptorFiles({str(tmp_path): File(path)})._read(folder), np.eye(2))  # type: ignore
    path = str(tmp_path / "pairs.txt")
    io.write_shortlist(path, Shortlist(np.zeros((2, 1), int), np.ones((2, 1)), np.ones((2, 1), bool)), names, names)
    assert io.read_shortlist(path, names, names).indices.tolist() == [[0], [0]]


def test_files_that_exist_stay(tmp_path):
    """Only files of weights and of confidences are replaced, by their like."""
    names, single = ["1.jpg"], np.ones((1, 1))
    model = Confidence(("margin",), 5, (0.0,), (1.0,), (1.0,), 0.0)
    writers = {
        "a.h5": lambda path: io.write_features(path, names, [(0, feature(0))]),
        "a.npz": lambda path: io.write_features(path, names, [(0, feature(0))]),
        "a": lambda path: io.write_features(path, names, [(0, feature(0))]),
        "g.npy": lambda path: io.write_global_descriptors(path, names, single),
        "g.npz": lambda path: io.write_global_descriptors(path, names, single),
        "g.h5": lambda path: io.write_global_descriptors(path, names, single),
        "s.npz": lambda path: io.write_shortlist(
            path, Shortlist(0 * single.astype(int), single, single > 0), names, names
        ),
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


def test_data_sets(tmp_path):
    database, queries = (str(fill(tmp_path / name, ["0.png", "1.png"])) for name in ("db", "q"))
    index = tmp_path / "q/pairs.csv"
    index.write_text("query,database\n0,0\n1,1\n")
    labels = tmp_path / "labels.csv"
    labels.write_text("name,label\n0.png,a\n1.png,b\n")
    for truth in (IndexFile(str(index)), LabelFiles(str(labels), str(labels))):
        dataset = datasets.folder(database, queries, ground_truth=truth)
        assert dataset.truth.positives(0).counts.tolist() == [1, 1]
    dataset = datasets.folder(database, [queries], ground_truth=IndexFile("pairs.csv"))
    assert dataset.only.name == "q"
    assert datasets.folder(database, queries, ground_truth=dataset.only.truth).truth is dataset.only.truth


def test_confidences_and_weights(tmp_path):
    path = tmp_path / "confidence.json"
    model = Confidence(("margin",), 5, (0.0,), (1.0,), (1.0,), 0.0)
    write_confidences(str(path), {"histogram": model}, {})
    assert read_confidences(str(path)) == ({"histogram": model}, {})
    os.mkfifo(tmp_path / "pipe.json")
    for read in (read_confidences, read_weight):
        for name, got in (("pipe.json", "a pipe or device"), ("no.json", "nothing"), ("", "a folder")):
            with pytest.raises(InputError, match=f"got {got}"):
                read(str(tmp_path / name))
