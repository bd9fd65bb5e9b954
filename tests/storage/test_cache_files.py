"""Files of a cache: what comes back, kills, damage and full disks."""

import io
import json
import os
import shutil
import signal
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from mfvpr import InputError, Matches
from mfvpr.core.types import per_match, per_pair
from mfvpr.storage.cache_files import (
    CacheFiles,
    MatchStore,
    pack_arrays,
    pack_features,
    pack_matches,
    round_as_stored,
    unpack_arrays,
    unpack_features,
    unpack_matches,
)
from mfvpr.utils.fingerprints import fingerprint
from tests.small_disks import UNSHARE, mount, need_small_disks
from tests.storage.synthetic_features import DAMAGE, assert_same, digests, features_of, matches_of, run_here

pytestmark = pytest.mark.thorough

KEYS = [fingerprint(row) * 2 for row in range(60)]


def opened(root, recipe=1):
    return CacheFiles(Path(root), "Sift", {"number": recipe}, pack_features, unpack_features)


# What comes back


@pytest.mark.parametrize("count", [0, 1, 40, 2500])
def test_all_but_the_descriptors_is_exact(count):
    original = features_of(7, count)
    features = unpack_features(pack_features(original))
    for name in ("keypoints", "scores", "mask", "image_size"):
        np.testing.assert_array_equal(getattr(features, name), getattr(original, name), strict=name != "image_size")
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=2e-7)
    assert np.linalg.norm(features.descriptors - original.descriptors, axis=1).max(initial=0) < 5e-4


def test_descriptors_keep_their_length():
    """A projected descriptor need not be of unit length; float16 alone would lose or overflow the last of these."""
    lengths = np.array([1, 6.3, 0.1, 1e-9, 70000, 1e12], np.float32)
    original = features_of(0, len(lengths))
    original.descriptors[:] *= lengths[:, None]
    features = round_as_stored(original)
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), lengths, rtol=3e-7)
    assert (np.linalg.norm(features.descriptors - original.descriptors, axis=1) < 5e-4 * lengths).all()


@pytest.mark.parametrize("name", ["keypoints", "descriptors"])
def test_features_that_are_not_finite_are_refused(name):
    features = features_of(0)
    getattr(features, name).flat[1] = np.nan
    with pytest.raises(ValueError, match="must be finite"):
        pack_features(features)


def with_all(row, counts=(30, 0, 25, 5)):
    """Every field that Matches may have, those that it will gain included."""
    rng, present = np.random.default_rng(row), {*per_match(matches_of(row).matches), *per_pair(matches_of(row).matches)}
    optional = [part.name for part in fields(Matches) if part.default is None and part.name not in present]
    return matches_of(row, counts, **{name: rng.random(sum(counts), np.float32) for name in optional})


@pytest.mark.parametrize("counts", [(30, 0, 25, 5), (0, 0, 0, 0), (16_000, 9000, 0, 16_000)])
@pytest.mark.parametrize("make", [matches_of, with_all])
def test_matches_come_back_to_the_bit(tmp_path, make, counts):
    """Also infinities, NaN, denormal numbers and both zeros."""
    original = make(7, counts)
    special = np.resize(np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 1e-45], np.float32), sum(counts))
    original = replace(original, matches=replace(original.matches, distance=special))
    MatchStore(tmp_path, {"of": "any"}, 2).write({1: original})
    missing, got = MatchStore(tmp_path, {"of": "any"}, 2).read()
    assert missing is None
    assert_same(got, original)
    assert_same(unpack_matches(pack_matches(original)), original)


# Files


def test_files_are_named_by_recipe_and_key(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    files = opened("ünï code/s @1%20?#|")
    monkeypatch.chdir(tmp_path / "elsewhere")
    files.update({KEYS[0]: features_of(0)})
    assert KEYS[0] in files
    assert KEYS[1] not in files
    assert_same(files.get(KEYS[0]), round_as_stored(features_of(0)))
    path = tmp_path / "ünï code/s @1%20?#|" / files.folder.name / KEYS[0][:2] / f"{KEYS[0][2:]}.npz"
    assert files.path(KEYS[0]) == path
    with np.load(path) as archive:
        np.testing.assert_array_equal(archive["keypoints"], features_of(0).keypoints)
    assert json.loads((files.folder / "recipe.json").read_text())["recipe"] == {"number": 1}
    assert opened(tmp_path, recipe=2).folder.name != files.folder.name


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_none_and_is_made_again(tmp_path, damage):
    files = opened(tmp_path)
    files.update({key: features_of(row) for row, key in enumerate(KEYS[:3])})
    before = digests(tmp_path)
    DAMAGE[damage](files.path(KEYS[1]))
    assert [files.get(key) is None for key in KEYS[:3]] == [False, True, False]
    assert (KEYS[1] in files) == (damage != "gone")
    files.update({KEYS[1]: features_of(1)})
    assert digests(tmp_path) == before


def test_arrays_come_back_and_equal_arrays_are_equal_bytes():
    arrays = {
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "rows": np.arange(5, dtype=np.int32)[::2],
        "none": np.zeros((0, 7), np.float16),
        "one": np.array(3.5),
        "names": np.array(["a", "ö"]),
    }
    for compress in (False, True):
        content = pack_arrays(arrays, compress=compress)
        assert content == pack_arrays(arrays, compress=compress)
        for got in (unpack_arrays(content), dict(np.load(io.BytesIO(content)))):
            assert list(got) == list(arrays)
            for name, expected in arrays.items():
                np.testing.assert_array_equal(got[name], expected, strict=True)


@pytest.mark.parametrize("compress", [False, True])
def test_flipped_bits_and_missing_bytes_change_no_number(compress):
    scores = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    content, noticed = pack_arrays({"scores": scores}, compress=compress), 0
    flipped = (content[:at] + bytes([content[at] ^ 1 << at % 8]) + content[at + 1 :] for at in range(len(content)))
    for damaged in (*flipped, *(content[:length] for length in range(len(content)))):
        try:
            [got] = unpack_arrays(damaged).values()  # of bytes that say nothing, such as the time
            np.testing.assert_array_equal(got, scores)
        except InputError:
            noticed += 1
    assert noticed > 1.5 * len(content)


def make(root):
    """A process that makes the files that are not there, in batches."""
    files = opened(root)
    missing = [row for row, key in enumerate(KEYS) if files.get(key) is None]
    for start in range(0, len(missing), 4):
        files.update({KEYS[row]: features_of(row, 200, 64) for row in missing[start : start + 4]})


def kill_rounds(root, rounds):
    """Kill processes that write at random times, finish their work, and print what happened. Forks, to save imports."""
    rng, killed = np.random.default_rng(0), 0
    make(f"{root}/whole")
    expected = digests(Path(root, "whole"))
    while killed < rounds:
        shutil.rmtree(f"{root}/killed", ignore_errors=True)
        for _ in range(4):
            if (child := os.fork()) == 0:
                make(f"{root}/killed")
                os._exit(0)
            time.sleep(rng.uniform(0.005, 0.08))
            os.kill(child, signal.SIGKILL)
            killed += os.waitpid(child, 0)[1] == signal.SIGKILL
            now = digests(Path(root, "killed")) if Path(root, "killed").exists() else {}
            assert {(name, digest) for name, digest in now.items() if "/." not in name} <= {*expected.items()}
        make(f"{root}/killed")
        assert {*expected.items()} <= {*digests(Path(root, "killed")).items()}
    print(killed)


@pytest.mark.slow
def test_killed_processes_leave_whole_files(tmp_path):
    assert int(run_here(__name__, f"kill_rounds({str(tmp_path)!r}, 40)")) >= 40


def fill_disk(root):
    """Write on a disk of 3 MB, which then grows, and can then only be read."""
    disk, files = Path(root), opened(f"{root}/s")
    mount(disk, "-o", "size=3m")
    items = {key: features_of(row, 700, 256) for row, key in enumerate(KEYS[:12])}
    with pytest.raises(InputError, match=f"^{files.folder}: the disk is full; free some space and run again"):
        files.update(items)
    assert 3 <= sum(files.get(key) is not None for key in items) < 12
    mount(disk, "-o", "remount,size=12m")
    files.update(items)
    mount(disk, "-o", "remount,ro")
    assert all(files.get(key) is not None for key in items)
    with pytest.raises(InputError, match=r"cannot be used \(Read-only file system\)"):
        files.update({KEYS[12]: features_of(12)})


def test_a_full_disk_is_one_line_and_what_was_written_stays(tmp_path):
    need_small_disks(tmp_path)
    run_here(__name__, f"fill_disk({str(tmp_path)!r})", prefix=UNSHARE)
