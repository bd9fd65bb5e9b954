"""h5 files that are damaged or lead to other files: one line, and no link is followed."""

import h5py
import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.io import open_features, read_global_descriptors
from tests.io.other_programs import append_hloc, feature, features_of, hloc_parts, write_hloc


def refused(path, message, names=("a.jpg",)):
    with pytest.raises(InputError, match=message) as error:
        list(open_features(path, names).read())
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "feats.h5"


@pytest.fixture
def secret(tmp_path):
    """A file beside it that nobody named."""
    return write_hloc(tmp_path / "secret.h5", ["a.jpg"], features_of(1))


def test_links_are_not_followed(path, secret):
    with h5py.File(path, "w") as file:
        file["a.jpg"] = h5py.ExternalLink(str(secret), "/a.jpg")
    refused(path, r"a\.jpg: .*got a link")
    with h5py.File(path, "w") as file:
        file["outside"] = h5py.ExternalLink(str(secret), "/a.jpg")
        file["a.jpg"] = h5py.SoftLink("/outside")
    refused(path, "expected data, got a link")


def external_link(group, values, secret):
    group["scores"] = h5py.ExternalLink(str(secret), "/a.jpg/scores")


def external_storage(group, values, secret):
    external = [(str(secret), 0, values.nbytes)]
    group.create_dataset("scores", shape=values.shape, dtype=values.dtype, external=external)


def virtual_dataset(group, values, secret):
    layout = h5py.VirtualLayout(shape=values.shape, dtype=values.dtype)
    layout[:] = h5py.VirtualSource(str(secret), "a.jpg/scores", shape=values.shape)
    group.create_virtual_dataset("scores", layout)


def subgroup(group, values, secret):
    group.create_group("scores")


def no_values(group, values, secret):
    group.create_dataset("scores", data=h5py.Empty("f"))


@pytest.mark.parametrize(
    ("put", "message"),
    [
        (external_link, "expected data, got a link"),
        (external_storage, ".*storage in others"),
        (virtual_dataset, ".*storage in others"),
        (subgroup, ".*got a group"),
        (no_values, ".*values, got .*without"),
    ],
)
def test_other_data_sets_are_refused(path, secret, put, message):
    parts = hloc_parts(feature(0))
    scores = parts.pop("scores")
    append_hloc(path, "a.jpg", parts)
    with h5py.File(path, "a", libver="latest") as file:
        put(file["a.jpg"], scores, secret)
    refused(path, rf"a\.jpg/scores: {message}")


def test_a_group_that_holds_itself(path):
    with h5py.File(path, "w") as file:
        group = file.create_group("a")
        group["b"] = group
    refused(path, "a/b: .*one name.* several")


def test_objects_and_records(path):
    for name, dtype in (("a.jpg", h5py.string_dtype()), ("b.jpg", np.dtype([("x", "f4")])), ("c.jpg", h5py.ref_dtype)):
        append_hloc(path, name, {k: v for k, v in hloc_parts(feature(0)).items() if k != "scores"})
        with h5py.File(path, "a") as file:
            file[name].create_dataset("scores", shape=(30,), dtype=dtype)
        refused(path, "scores: .*array of numbers .*got objects", [name])


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
    refused(path, r"b\.jpg/scores: .*not written", ["b.jpg"])


def test_no_images(path):
    with h5py.File(path, "w") as file:
        file.create_group("a.jpg")
    refused(path, "group .*image.* got no datasets")


def test_truncated_at_any_place(tmp_path, path):
    content = write_hloc(tmp_path / "whole.h5", ["a.jpg", "b.jpg"], features_of(2)).read_bytes()
    for length in (0, 10, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        refused(path, "cannot be read")


def test_not_a_file(tmp_path):
    for name, message in (("x.h5", "got nothing"), ("x.txt", "got nothing"), ("x", "got nothing")):
        refused(tmp_path / name, message)
    (tmp_path / "x.txt").write_text("")
    refused(tmp_path / "x.txt", r"\.h5, \.hdf5, \.npz, got \.txt")
    (tmp_path / "y.h5").write_text("text")
    with pytest.raises(InputError, match="cannot be read"):
        read_global_descriptors(tmp_path / "y.h5", ["a.jpg"])
