"""Small features and matches, and damage to files, for tests."""

import hashlib
import itertools
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mfvpr import Features, Matches
from mfvpr.matchers import MatchSet
from mfvpr.matchers.match_set import QueryMatches
from tests.builders import make_features
from tests.programs import ROOT


def features_of(row: int, count: int = 40, dimension: int = 16) -> Features:
    return make_features(np.random.default_rng(row), count, dimension=dimension)


def assert_same(got: Features | QueryMatches, expected: Features | QueryMatches) -> None:
    """The very same bits: shapes, types, and NaN included."""
    (arrays, structure), (expected_arrays, expected_structure) = (
        jax.tree.flatten(vars(row)) for row in (got, expected)
    )
    assert structure == expected_structure
    for values, expected_values in zip(arrays, expected_arrays, strict=True):
        assert (values.shape, values.dtype) == (expected_values.shape, expected_values.dtype)
        assert values.tobytes() == expected_values.tobytes()


def assert_same_match_sets(got: MatchSet, expected: MatchSet) -> None:
    np.testing.assert_array_equal(got.counts, expected.counts)
    assert got.capacity == expected.capacity
    for query in range(len(expected.counts)):
        jax.tree.map(np.testing.assert_array_equal, got[query], expected[query])


def interrupt_after(number: int) -> Callable[[Iterable[Any], int], Iterator[Any]]:
    """Progress that is interrupted after so many steps."""

    def track(steps: Iterable[Any], _: int) -> Iterator[Any]:
        yield from itertools.islice(steps, number)
        raise KeyboardInterrupt

    return track


def matches_of(row: int, counts: tuple[int, ...] = (30, 0, 25, 5), **more: Any) -> QueryMatches:
    """Matches of one query with so many matches of each candidate; no candidate where there are none."""
    rng, total = np.random.default_rng(row), sum(counts)
    numbers = lambda *shape: rng.uniform(0, 336, shape).astype(np.float32)  # noqa: E731
    flat = dict(
        points0=numbers(total, 2),
        points1=numbers(total, 2),
        distance=numbers(total),
        scores0=numbers(total),
        scores1=numbers(total),
        mask=np.ones(total, bool),
        image_size0=numbers(2),
        image_size1=numbers(len(counts), 2),
        ratio=numbers(total),
        index0=rng.integers(0, 800, total, np.int32),
        index1=rng.integers(0, 800, total, np.int32),
        count0=np.array(800, np.int32),
        count1=np.full(len(counts), 700, np.int32),
    )
    indices = np.where(np.array(counts) > 0, rng.permutation(len(counts)), -1).astype(np.int32)
    return QueryMatches(Matches(**flat | more), np.array(counts, np.int32), indices, numbers(len(counts)))


def flip(path: Path, position: int) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 1 << position % 8
    path.write_bytes(content)


DAMAGE: dict[str, Callable[[Path], Any]] = {
    "empty": lambda path: path.write_bytes(b""),
    "short": lambda path: path.write_bytes(path.read_bytes()[:-3]),
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "flipped": lambda path: flip(path, path.stat().st_size // 2),
    "gone": lambda path: path.unlink(),
}


def run_here(module: str, call: str, *, prefix: Sequence[str] = ()) -> str:
    """Standard output of a call of functions of a test module, in a process of its own."""
    command = [*prefix, sys.executable, "-c", f"from {module} import *; {call}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file; leftovers would be seen."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
