"""Arrays in a file: what comes back is what was written, or an error."""

import gc
import os
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.numerics import available_cpus

ARRAYS = {
    "scores": np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "rows": np.arange(5, dtype=np.int32)[::2],
    "none": np.zeros((0, 7), np.float16),
    "one": np.array(3.5),
    "flags": np.array([True, False]),
    "names": np.array(["a", "ö"]),
}


@pytest.mark.parametrize("compress", [False, True])
def test_the_same_arrays_come_back(tmp_path, compress):
    path = tmp_path / "below" / "a.npz"
    for _ in range(2):  # the second replaces the first
        write_arrays(path, ARRAYS, "this", compress=compress)
    arrays = read_arrays(path, "this")
    with np.load(path) as archive:
        plain = dict(archive)
    assert list(arrays) == list(plain) == list(ARRAYS)
    for name, expected in ARRAYS.items():
        for values in (arrays[name], plain[name]):
            assert (values.dtype, values.shape) == (expected.dtype, expected.shape)
            np.testing.assert_array_equal(values, expected)
    assert [file.name for file in path.parent.iterdir()] == ["a.npz"]


def test_equal_arrays_are_equal_files(tmp_path):
    for name in "ab":
        write_arrays(tmp_path / name, ARRAYS, compress=True)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("compress", [False, True])
def test_every_flipped_bit_and_every_missing_byte_is_noticed(tmp_path, compress):
    path = tmp_path / "a.npz"
    write_arrays(path, {"scores": ARRAYS["scores"]}, compress=compress)
    content = path.read_bytes()
    with path.open("r+b") as file:
        for position, byte in enumerate(content):
            for written in (byte ^ 1 << position % 8, byte):
                file.seek(position)
                file.write(bytes([written]))
                file.flush()
                if written != byte:
                    with pytest.raises(InputError, match=r"a\.npz: expected .* damaged ones; delete it$"):
                        read_arrays(path)
    np.testing.assert_array_equal(read_arrays(path)["scores"], ARRAYS["scores"])
    for length in reversed(range(len(content))):
        os.truncate(path, length)
        with pytest.raises(InputError, match="damaged"):
            read_arrays(path)


def test_arrays_about_something_else_are_refused(tmp_path):
    write_arrays(tmp_path / "a.npz", ARRAYS, "row 1 of \udcff")
    assert read_arrays(tmp_path / "a.npz", "row 1 of \udcff").keys() == ARRAYS.keys()
    for about in ("", "row 2 of \udcff"):
        with pytest.raises(InputError, match="got others or damaged ones"):
            read_arrays(tmp_path / "a.npz", about)


def test_what_fails_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.npz"
    write_arrays(path, {"one": np.ones(2)})
    with pytest.raises(ValueError, match="Object arrays"):
        write_arrays(path, {"one": np.array([{}, None], object)})
    np.testing.assert_array_equal(read_arrays(path)["one"], [1, 1])
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]
    with pytest.raises(FileNotFoundError):
        read_arrays(tmp_path / "b.npz")


def test_processors_are_those_that_this_process_may_use(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {3, 5, 8}, raising=False)
    assert available_cpus() == 3
    monkeypatch.delattr("os.sched_getaffinity")
    monkeypatch.setattr("os.cpu_count", lambda: None)
    assert available_cpus() == 1


def test_any_number_of_threads_read_at_the_same_time(tmp_path):
    """Python 3.11 fails in a fifth of these where each thread parses the headers for itself."""
    path = tmp_path / "a.npz"
    write_arrays(path, {name: np.zeros((4, 2), np.float32) for name in "abcdef"})

    def read(depth):
        return read(depth - 1) if depth else read_arrays(path)

    interval, threshold = sys.getswitchinterval(), gc.get_threshold()
    try:
        sys.setswitchinterval(1e-6)
        gc.set_threshold(1)
        with ThreadPoolExecutor(8) as pool:
            files = list(pool.map(read, np.arange(300) % 20))
    finally:
        sys.setswitchinterval(interval)
        gc.set_threshold(*threshold)
    assert all(arrays.keys() == set("abcdef") for arrays in files)
