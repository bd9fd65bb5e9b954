"""Arrays in a file: what comes back is what was written, or an error."""

import gc
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.utils.arrays import read_arrays, write_arrays

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
def test_flipped_bits_and_missing_bytes_raise(tmp_path, compress):
    path = tmp_path / "a.npz"
    write_arrays(path, {"scores": ARRAYS["scores"]}, compress=compress)
    content = path.read_bytes()
    flipped = [bytearray(content) for _ in content]
    for position, damaged in enumerate(flipped):
        damaged[position] ^= 1 << position % 8
    for damaged in (*flipped, *(content[:length] for length in range(len(content)))):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"a\.npz: expected .* damaged ones; delete it$"):
            read_arrays(path)


def test_arrays_with_another_label_raise(tmp_path):
    write_arrays(tmp_path / "a.npz", ARRAYS, "row 1 of \udcff")
    assert read_arrays(tmp_path / "a.npz", "row 1 of \udcff").keys() == ARRAYS.keys()
    for about in ("", "row 2 of \udcff"):
        with pytest.raises(InputError, match="got others or damaged ones"):
            read_arrays(tmp_path / "a.npz", about)


def test_a_failed_write_keeps_the_file_before(tmp_path):
    path = tmp_path / "a.npz"
    write_arrays(path, {"one": np.ones(2)})
    with pytest.raises(ValueError, match="Object arrays"):
        write_arrays(path, {"one": np.array([{}, None], object)})
    np.testing.assert_array_equal(read_arrays(path)["one"], [1, 1])
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]
    with pytest.raises(FileNotFoundError):
        read_arrays(tmp_path / "b.npz")


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
            assert all(arrays.keys() == set("abcdef") for arrays in pool.map(read, np.arange(300) % 20))
    finally:
        sys.setswitchinterval(interval)
        gc.set_threshold(*threshold)
