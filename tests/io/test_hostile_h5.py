"""h5 files that are damaged or lead to other files: one line, and no link is followed."""

import h5py
import numpy as np
import pytest

from mfvpr.io import open_features
from tests.io.checks import one_line_error
from tests.io.other_programs import append_hloc, feature, hloc_parts, write_hloc


def check_refused(path, message, name="a.jpg"):
    with one_line_error(message, str(path)):
        list(open_features(path, [name]).read())


@pytest.fixture
def path(tmp_path):
    return tmp_path / "feats.h5"


@pytest.fixture
def secret(tmp_path):
    """A file beside it that nobody named."""
    return write_hloc(tmp_path / "secret.h5", ["a.jpg"])


def test_links_are_not_followed(path, secret):
    with h5py.File(path, "w") as file:
        file["a.jpg"] = h5py.ExternalLink(str(secret), "/a.jpg")
    check_refused(path, r"a\.jpg: .*got a link")
    with h5py.File(path, "w") as file:
        file["outside"] = h5py.ExternalLink(str(secret), "/a.jpg")
        file["a.jpg"] = h5py.SoftLink("/outside")
    check_refused(path, "expected data, got a link")


def external_link(group, values, secret):
    group["scores"] = h5py.ExternalLink(str(secret), "/a.jpg/scores")


def external_storage(group, values, secret):
    external = [(str(secret), 0, values.nbytes)]
    group.create_dataset("scores", shape=values.shape, dtype=values.dtype, external=external)


def virtual_dataset(group, values, secret):
    layout = h5py.VirtualLayout(shape=values.shape, dtype=values.dtype)
    layout[:] = h5py.VirtualSource(str(secret), "a.jpg/scores", shape=values.shape)
    group.create_virtual_dataset("scores", layout)


def of_type(dtype):
    return lambda group, *_: group.create_dataset("scores", shape=(30,), dtype=dtype)


@pytest.mark.parametrize(
    ("put", "message"),
    [
        (external_link, "expected data, got a link"),
        (external_storage, ".*storage in others"),
        (virtual_dataset, ".*storage in others"),
        (lambda group, *_: group.create_group("scores"), ".*got a group"),
        (lambda group, *_: group.create_dataset("scores", data=h5py.Empty("f")), ".*values, got .*without"),
        (of_type(h5py.string_dtype()), ".*array of numbers .*got objects"),
        (of_type([("x", "f4")]), ".*array of numbers .*got objects"),
    ],
)
def test_other_data_sets_are_refused(path, secret, put, message):
    parts = hloc_parts(feature(0))
    scores = parts.pop("scores")
    append_hloc(path, "a.jpg", parts)
    with h5py.File(path, "a", libver="latest") as file:
        put(file["a.jpg"], scores, secret)
    check_refused(path, rf"a\.jpg/scores: {message}")


def test_a_group_that_holds_itself(path):
    with h5py.File(path, "w") as file:
        group = file.create_group("a")
        group["b"] = group
    check_refused(path, "a/b: .*one name.* several")


def test_values_that_were_not_all_written(path):
    """HDF5 would make them up."""
    parts = hloc_parts(feature(0))
    append_hloc(path, "a.jpg", parts)
    with h5py.File(path, "a") as file:
        for name in ("b.jpg", "c.jpg"):
            for part, array in parts.items():
                chunked = {"chunks": (1,) * array.ndim} if name == "b.jpg" else {"compression": "gzip", "chunks": True}
                file.create_dataset(f"{name}/{part}", data=array, **chunked)
        del file["b.jpg/scores"]
        file["b.jpg"].create_dataset("scores", shape=(30,), dtype="f2", chunks=(10,))[:20] = 1
    [_, (_, features)] = open_features(path, ["a.jpg", "c.jpg"]).read()
    np.testing.assert_array_equal(features.scores, parts["scores"])
    check_refused(path, r"b\.jpg/scores: .*not written", "b.jpg")


def test_no_images(path):
    with h5py.File(path, "w") as file:
        file.create_group("a.jpg")
    check_refused(path, "group .*image.* got no datasets")


def test_truncated_at_any_place(tmp_path, path):
    content = write_hloc(tmp_path / "whole.h5", ["a.jpg", "b.jpg"]).read_bytes()
    for length in (0, 10, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        check_refused(path, "cannot be read")
