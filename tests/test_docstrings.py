"""Examples of all public names, as `help()` shows them, run."""

import inspect
import json
import re
import shutil
import textwrap
from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.retrieval import Retrieval
from tests.builders import fill, make_features, stack, unit
from tests.programs import composed

SLOW = ["mfvpr.Cluster", "mfvpr.LightGlueMatcher", "mfvpr.Map", "mfvpr.Route", "mfvpr.load_system", "mfvpr.sweep"]
BLOCK = re.compile(r"\n\n(?:Example:\n)?((?: {4}.*(?:\n|$)|\n(?= {4}))+)")

IMPORTS = """
from dataclasses import field

import jax.numpy as jnp
import numpy as np

import mfvpr
from mfvpr import *
from mfvpr.checkpoints import load_model
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
"""  # of the examples


OBJECTS = {
    f"{module.__name__}.{name}": getattr(module, name) for module in (mfvpr, mfvpr.datasets) for name in module.__all__
}
# An error has no arguments of its own, and is not called.
WITH_EXAMPLE = [
    path for path, value in OBJECTS.items() if not (inspect.isclass(value) and issubclass(value, Exception))
]


def examples(path):
    """The indented blocks of a docstring as `help()` shows it, without equations, which have sums."""
    blocks = BLOCK.findall(inspect.getdoc(OBJECTS[path]) or "")
    return [textwrap.dedent(block) for block in blocks if "sum_" not in block]


@pytest.fixture(scope="module")
def names(small_street):
    """Values that examples use without making them; `data` is long enough to choose on one half."""
    sides = (mfvpr.datasets.image_folder(small_street / side) for side in ("database", "queries"))
    database, images = (replace(side, names=3 * side.names) for side in sides)
    truth = mfvpr.datasets.FrameTruth(tuple((row,) for row in range(len(images))), len(database))
    data = mfvpr.datasets.Dataset("street", database, (mfvpr.datasets.QuerySequence("street", images, truth),))
    rng = np.random.default_rng(0)
    sift = Sift(image_size=(160, 120), max_keypoints=40)
    retriever = Retrieval(Aggregated(sift, VladFitting(num_words=4)))
    pipeline = mfvpr.Pipeline(sift, retriever, candidates=5)
    system = mfvpr.System(pipeline, {"histogram": mfvpr.HistogramOfShifts()})
    features = [make_features(rng, 30, capacity=32) for _ in range(4)]
    cells = [make_features(rng, 26 * 26) for _ in range(2)]
    queries, candidates = stack(features[:2]), stack(features[1:])
    descriptors = unit(rng.normal(size=(8, 16)))
    shortlist = mfvpr.retrieve(descriptors[:3], descriptors, num_candidates=5)
    values = {"__name__": "example"}
    exec(IMPORTS, values)
    return values | {
        "data": data, "dataset": data, "night": data, "snow": data, "sift": sift, "extractor": sift,
        "retriever": retriever, "pipeline": pipeline, "system": system, "mine": system, "paper": system,
        "result": mfvpr.evaluate(data, system), "MyScorer": mfvpr.HistogramOfShifts,
        "keypoints": features[0].keypoints, "descriptors": features[0].descriptors, "query": features[0],
        "features0": features[0], "features1": features[1], "cells0": cells[0], "cells1": cells[1],
        "queries": queries, "candidates": candidates, "query_descriptors": descriptors[:3],
        "database_descriptors": descriptors, "shortlist": shortlist, "scores": rng.random((3, 5), np.float32),
        "matches": mfvpr.match(features[0], features[1], with_ratio=True),
        "candidate_matches": mfvpr.match_candidates(features[0], candidates, with_ratio=True),
        "image": rng.integers(0, 256, (60, 80, 3), np.uint8),
    }  # fmt: skip


@pytest.fixture(scope="module")
def files(small_street, tmp_path_factory):
    """Folders and files that examples use."""
    root = tmp_path_factory.mktemp("files")
    for name, side in (("day", "database"), ("night", "queries"), ("snow", "queries")):
        shutil.copytree(small_street / side, root / name)
        (root / name / "pairs.csv").write_text("query,database\n" + "".join(f"{row},{row}\n" for row in range(10)))
        (root / f"{name}.csv").write_text("name,label\n" + "".join(f"{row:04d}.png,{row // 5}\n" for row in range(10)))
    shutil.copy(root / "night" / "pairs.csv", root)
    shutil.copy(root / "night" / "0004.png", root / "query.jpg")
    fill(root / "DIR", [f"{side}/image0.png" for side in ("Reference", "Live")])
    (root / "DIR" / "GroundTruth.csv").write_text("Reference,Live\n0,0\n")
    run = root / "runs" / "streets" / "2026-01-31_12-00-00" / "run.json"
    run.parent.mkdir(parents=True)
    run.write_text(json.dumps({"settings": composed("system=steering")}))
    return root


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.*calibrate on a longer drive")
@pytest.mark.parametrize(
    "path", [pytest.param(path, marks=[pytest.mark.slow] if path in SLOW else []) for path in WITH_EXAMPLE]
)
def test_examples_run(path, names, files, tmp_path, monkeypatch, request):
    if path in SLOW:
        monkeypatch.setenv("MFVPR_WEIGHTS", str(request.getfixturevalue("weights")))
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    assert examples(path)
    for example in examples(path):
        exec(example, dict(names))
