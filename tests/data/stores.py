"""Small feature stores, for tests."""

import hashlib
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np

from mfvpr import Features
from mfvpr.data.feature_store import open_store
from tests.builders import make_features

ROOT = Path(__file__).parents[2]
RECIPE = {
    "weights": {"sha256": "ab" * 32},
    "extractor": {"name": "d2net", "max_keypoints": 800, "image_size": (336, 336), "sigma": 1.6},
    "images": [{"name": f"{row}.png", "sha256": f"{row:064x}"} for row in range(3)],
}
ARRAYS = ("descriptors", "keypoints", "scores", "image_size", "count")


def features_of(row: int, count: int = 40, dimension: int = 16) -> Features:
    return make_features(np.random.default_rng(row), count, dimension=dimension)


def assert_same(got: Features, expected: Features) -> None:
    for part in fields(Features):
        np.testing.assert_array_equal(getattr(got, part.name), getattr(expected, part.name))


def fill(folder: Path, num_images: int = 3, batch: int = 2) -> list[int]:
    """Do what is not done; the rows that were not."""
    with open_store(folder, RECIPE, num_images=num_images) as store:
        todo = np.flatnonzero(~store.done).tolist()
        for start in range(0, len(todo), batch):
            store.write({row: features_of(row) for row in todo[start : start + batch]})
    return todo


def read_all(folder: Path, num_images: int = 3) -> dict[int, Features]:
    with open_store(folder, RECIPE, num_images=num_images) as store:
        return dict(store.read())


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file; leftovers of tensorstore's would be seen."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def run_here(call: str, *, prefix: tuple[str, ...] = ()) -> str:
    """Standard output of a call of test_store_faults' functions in a process of its own."""
    command = [*prefix, sys.executable, "-c", f"from tests.data.test_store_faults import *; {call}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout
