"""h5 files that are damaged or lead to other files: one line, and no link is followed."""

import h5py
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


def external_link(group, values, secret):
    group["scores"] = h5py.ExternalLink(str(secret), "/a.jpg/scores")


def external_storage(group, values, secret):
    external = [(str(secret), 0, values.nbytes)]
    group.create_dataset("scores", shape=values.shape, dtype=values.dtype, external=external)


def virtual_dataset(group, values, secret):
    layout = h5py.VirtualLayout(shape=values.shape, dtype=values.dtype)
    layout[:] = h5py.VirtualSource(str(secret), "a.jpg/scores", shape=values.shape)
    group.create_virtual_dataset("scores", layout)


@pytest.mark.parametrize(
    "put",
    [
        external_link,
        external_storage,
        virtual_dataset,
        lambda group, *_: group.create_group("scores"),
        lambda group, *_: group.create_dataset("scores", data=h5py.Empty("f")),
    ],
)
def test_other_data_sets_are_refused(path, secret, put):
    parts = hloc_parts(feature(0))
    scores = parts.pop("scores")
    append_hloc(path, "a.jpg", parts)
    with h5py.File(path, "a", libver="latest") as file:
        put(file["a.jpg"], scores, secret)
    check_refused(path, r"a\.jpg/scores: expected data in this file")


def test_what_leads_to_another_file_is_no_image(path, secret):
    append_hloc(path, "b.jpg", hloc_parts(feature(0)))
    with h5py.File(path, "a") as file:
        file["a.jpg"] = h5py.ExternalLink(str(secret), "/a.jpg")
        file["b.jpg/a"] = file["b.jpg"]  # a circle
    check_refused(path, r"got 0; the first without is a\.jpg")


def test_values_that_were_not_written(path):
    """HDF5 would make them up."""
    parts = hloc_parts(feature(0))
    scores = parts.pop("scores")
    append_hloc(path, "a.jpg", parts)
    with h5py.File(path, "a") as file:
        file["a.jpg"].create_dataset("scores", shape=scores.shape, dtype="f2", chunks=(10,))
    check_refused(path, r"a\.jpg/scores: .*not written")


def test_truncated_at_any_place(tmp_path, path):
    content = write_hloc(tmp_path / "whole.h5", ["a.jpg", "b.jpg"]).read_bytes()
    for length in (0, 10, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        check_refused(path, "cannot be read")
