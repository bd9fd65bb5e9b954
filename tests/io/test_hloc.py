"""hloc's h5 as hloc writes it; files that do not fit, are damaged, or lead to other files."""

import sys

import h5py
import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.io import open_features
from tests.io.checks import one_line_error
from tests.io.other_programs import NAMES, append_hloc, assert_equal, feature, hloc_parts, write_hloc


@pytest.fixture
def path(tmp_path):
    return tmp_path / "feats-d2net-ss.h5"


def test_float32_comes_back_exactly_in_the_order_of_the_names(path):
    written = [feature(seed, count=40) for seed in range(3)]
    write_hloc(path, NAMES, written, half=False)
    source = open_features(path, NAMES[::-1])
    assert source.counts.tolist() == [40] * 3
    assert source.counts.dtype == np.int32
    assert (len(source), source.dimension, source.scored) == (3, 16, True)
    for (row, features), expected in zip(source.read(), written[::-1], strict=True):
        assert_equal(features, expected)
        assert 0 <= row < 3
    assert [row for row, _ in source.read([2, 0, 2])] == [2, 0, 2]


def test_float16_becomes_float32_of_unit_length(path):
    written = feature(0, count=200)
    write_hloc(path, ["a.jpg"], [written])
    [(_, features)] = open_features(path, ["a.jpg"]).read()
    np.testing.assert_array_equal(features.keypoints, written.keypoints.astype(np.float16).astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1.2e-6)
    assert_equal(features, written, atol=0.13)  # float16 at 480 px
    np.testing.assert_allclose(features.descriptors, written.descriptors, atol=5e-4)


def test_images_without_keypoints(path):
    write_hloc(path, ["a.jpg", "e.jpg"], [feature(0), feature(0, count=0)])
    for name, shape in (("b.jpg", (0,)), ("c.jpg", (0, 16)), ("d.jpg", (16, 3))):
        append_hloc(path, name, hloc_parts(feature(0, count=0)) | {"descriptors": np.ones(shape, np.float16)})
    source = open_features(path, ["a.jpg", "b.jpg", "c.jpg", "e.jpg", "d.jpg"])
    assert source.counts.tolist() == [30, 0, 0, 0, 0]
    _, *empty = source.read(range(4))
    for _, features in empty:
        assert (features.keypoints.shape, features.descriptors.shape, features.mask.shape) == ((0, 2), (0, 16), (0,))
    with pytest.raises(InputError, match=r"d\.jpg: expected 0 keypoints"):
        list(source.read([4]))


def test_as_many_keypoints_as_dimensions(path):
    """The other images of the file tell the layout; alone, it is hloc's."""
    square = feature(0, count=16)
    write_hloc(path, ["a.jpg"], [square], half=False)
    [(_, features)] = open_features(path, ["a.jpg"]).read()
    np.testing.assert_array_equal(features.descriptors, square.descriptors)
    for name, written in (("b.jpg", square), ("c.jpg", feature(1, count=9))):
        append_hloc(path, name, hloc_parts(written, half=False) | {"descriptors": written.descriptors})
    source = open_features(path, ["b.jpg", "c.jpg"])
    np.testing.assert_array_equal(dict(source.read())[0].descriptors, square.descriptors)


def test_scores_by_another_name_or_missing(path):
    written = feature(0)
    parts = hloc_parts(written, half=False)
    scores = parts.pop("scores")
    append_hloc(path, "a.jpg", parts | {"keypoint_scores": scores})
    append_hloc(path, "b.jpg", parts)
    source = open_features(path, ["a.jpg"])
    assert source.scored
    np.testing.assert_array_equal(next(source.read())[1].scores, written.scores)
    source = open_features(path, ["b.jpg"])
    assert not source.scored
    np.testing.assert_array_equal(next(source.read())[1].scores, np.ones(30))
    with pytest.raises(InputError, match=r"scores .*got none .*b\.jpg"):
        open_features(path, ["a.jpg", "b.jpg"])


def test_image_size_that_the_file_lacks_is_given(path):
    write_hloc(path, NAMES)
    parts = hloc_parts(feature(0))
    del parts["image_size"]
    append_hloc(path, "x.jpg", parts)
    with pytest.raises(InputError, match=r"x\.jpg: .*got no image_size; .*image_size="):
        open_features(path, ["x.jpg"])
    for size in ((640, 480), [[640, 480]]):
        [(_, features)] = open_features(path, ["x.jpg"], image_size=size).read()
        assert features.image_size.tolist() == [640, 480]
    with pytest.raises(InputError, match=r"a/image 1\.jpg: .*image_size: .*\[320"):
        next(open_features(path, NAMES, image_size=(320, 240)).read())
    for size in ((0, 3), (1, 2, 3)):
        with pytest.raises(InputError, match=r"image_size: .*width, height"):
            open_features(path, NAMES, image_size=size)


def test_missing_images(path):
    write_hloc(path, NAMES[:2])
    with pytest.raises(InputError, match=r"feats-d2net-ss\.h5: .*all 3 .*image10\.png"):
        open_features(path, NAMES)
    source = open_features(path, NAMES, partial=True)
    assert source.counts.tolist() == [30, 30, -1]
    assert [row for row, _ in source.read()] == [0, 1]
    for row in (2, 3, -1):
        with pytest.raises(InputError, match=f"image {row}, got none"):
            next(source.read([row]))


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda p: {"keypoints": p["keypoints"]}, "got no descriptors"),
        (lambda p: p | {"keypoints": p["keypoints"][:, :1]}, r"keypoints: expected \[N, 2\].* got \[30, 1\]"),
        (lambda p: p | {"descriptors": p["descriptors"][:, :-1]}, r"expected \[30, D\] or \[D, 30\].* got \[16, 29\]"),
        (lambda p: p | {"descriptors": p["descriptors"][:8]}, "of one length .*got lengths"),
        (lambda p: p | {"descriptors": p["descriptors"].T}, r"one layout, \[D, N\] or \[N, D\]"),
    ],
)
def test_arrays_that_do_not_fit(path, change, message):
    write_hloc(path, ["a.jpg"])
    append_hloc(path, "b.jpg", change(hloc_parts(feature(1))))
    with one_line_error(message, path.name):
        open_features(path, ["a.jpg", "b.jpg"])


def spoiled(part, value, row=3):
    def change(parts):
        array = parts[part].copy()
        array[row] = value
        return parts | {part: array}

    return change


@pytest.mark.parametrize(
    "change, message",
    [
        (spoiled("keypoints", np.nan), r"keypoints: .*finite .*nan at \[3, 0\]"),
        (spoiled("descriptors", np.inf), r"descriptors: .*finite .*inf at \[3, 0\]"),
        (lambda p: p | {"scores": np.full(30, 1e300)}, "scores: .*finite .*1e.300"),
        (lambda p: p | {"descriptors": p["descriptors"] * 2}, r"got length 2.* lengths='normalize'"),
        (lambda p: p | {"descriptors": np.zeros((16, 30), np.uint8)}, "floating-point .*got uint8"),
        (lambda p: p | {"scores": p["scores"][1:]}, r"expected 30 keypoints with scores .* got 30, 29 and \[30, 16\]"),
        (lambda p: p | {"image_size": np.array([640, 0])}, r"image_size: expected .*got \[640\.0, 0\.0\]"),
        (spoiled("keypoints", 700), r"keypoints .*640 x 480 .*got \(700, 700\)"),
    ],
)
def test_values_that_cannot_be_used(path, change, message):
    append_hloc(path, "a/b.jpg", change(hloc_parts(feature(1))))
    source = open_features(path, ["a/b.jpg"])
    with one_line_error(message, "a/b.jpg", path.name):
        list(source.read())


@pytest.mark.parametrize(
    ("point", "is_inside"),
    [((645, 200), True), ((-6, 483), True), ((646, 200), False), ((-7, 200), False), ((300, 484), False)],
)
def test_keypoints_may_lie_a_hundredth_of_the_image_outside(path, point, is_inside):
    """640 x 480 pixels: as float16 rounds them, and as detectors extrapolate."""
    append_hloc(path, "a.jpg", spoiled("keypoints", point)(hloc_parts(feature(1))))
    source = open_features(path, ["a.jpg"])
    if is_inside:
        assert next(source.read())[1].keypoints[3].tolist() == list(point)
    else:
        with pytest.raises(InputError, match="expected keypoints"):
            list(source.read())


def test_lengths_of_descriptors(path):
    written = feature(0)
    lengths = np.linspace(0.5, 3, 30, dtype=np.float32)[:, None]
    parts = hloc_parts(written, half=False) | {"descriptors": (written.descriptors * lengths).T}
    append_hloc(path, "a.jpg", parts)
    [(_, unscaled)] = open_features(path, ["a.jpg"], lengths="keep").read()
    np.testing.assert_array_equal(unscaled.descriptors, parts["descriptors"].T)
    [(_, unit)] = open_features(path, ["a.jpg"], lengths="normalize").read()
    np.testing.assert_allclose(unit.descriptors, written.descriptors, atol=1e-6)
    append_hloc(path, "zero.jpg", spoiled("descriptors", 0, row=np.s_[:, 4])(parts))
    with pytest.raises(InputError, match=r"zero\.jpg: descriptors: .*got zeros at 4"):
        list(open_features(path, ["zero.jpg"], lengths="normalize").read())
    with pytest.raises(InputError, match=r"lengths='l2': .*unit, normalize, keep"):
        open_features(path, ["a.jpg"], lengths="l2")  # type: ignore[arg-type]


def test_without_h5py(path, monkeypatch):
    path.write_bytes(b"")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"h5py; pip install 'mfvpr\[hloc\]'"):
        open_features(path, NAMES)


def check_refused(path, message, name="a.jpg"):
    with one_line_error(message, str(path)):
        list(open_features(path, [name]).read())


@pytest.fixture
def secret(tmp_path):
    """A file beside it that nobody named."""
    return write_hloc(tmp_path / "secret.h5", ["a.jpg"])


def external_link(group, values, secret):
    group["scores"] = h5py.ExternalLink(str(secret), "/a.jpg/scores")


def external_storage(group, values, secret):
    external = [(str(secret), 0, values.nbytes)]
    group.create_dataset("scores", shape=values.shape, dtype=values.dtype, external=external)


@pytest.mark.parametrize(
    "put",
    [
        external_link,
        external_storage,
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
