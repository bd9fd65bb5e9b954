"""Features of hloc, D2-Net and NumPy's archives: read as they were written; what cannot be used is one line."""

import sys

import h5py
import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.io import open_features, write_features
from tests.io.checks import one_line_error
from tests.io.other_programs import NAMES, SIZE, append_hloc, assert_equal, feature, hloc_parts, write_hloc

PATHS = ["feats.h5", "feats.hdf5", "feats.npz", "feats"]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "feats-d2net-ss.h5"


def read_one(path, name, **options):
    [(_, features)] = open_features(path, [name], **options).read()
    return features


# Files that are written here


@pytest.mark.parametrize("file", PATHS)
@pytest.mark.parametrize("half", [False, True])
def test_written_and_read(tmp_path, file, half):
    written = [feature(seed, count=seed * 8) for seed in range(3)]
    write_features(tmp_path / file, NAMES, enumerate(written), half=half)
    source = open_features(tmp_path / file, NAMES, lengths="keep" if half else "unit")
    assert source.counts.tolist() == [0, 8, 16]
    for row, features in source.read():
        kind = np.float16 if half else np.float32
        values = {name: getattr(written[row], name).astype(kind) for name in ("keypoints", "descriptors", "scores")}
        assert_equal(features, type(features)(**(vars(written[row]) | values)))
    if file != "feats":
        assert [path.name for path in tmp_path.iterdir()] == [file]


def test_hloc_reads_what_is_written(tmp_path):
    written = feature(0)
    write_features(tmp_path / "f.h5", ["a/b.jpg"], [(0, written)], half=True)
    with h5py.File(tmp_path / "f.h5", "r", libver="latest") as file:
        group = file["a/b.jpg"]
        assert {name: (data.dtype.name, data.shape) for name, data in group.items()} == {
            "keypoints": ("float16", (30, 2)),
            "descriptors": ("float16", (16, 30)),
            "scores": ("float16", (30,)),
            "image_size": ("int64", (2,)),
        }
        np.testing.assert_array_equal(group["descriptors"], written.descriptors.T.astype(np.float16))
        assert group["image_size"][()].tolist() == [640, 480]


def test_any_name(tmp_path):
    paths = [f"sub/{name}" for name in ("a b", "é.jpg", "\udcff.png", "日本", "@1@2@", "a.b.c")]
    for file in ("f.h5", "f.npz"):
        write_features(tmp_path / file, paths, [(row, feature(0, count=3)) for row in range(len(paths))])
        assert open_features(tmp_path / file, paths).counts.tolist() == [3] * len(paths)


@pytest.mark.parametrize("file", PATHS)
def test_a_failure_leaves_no_unfinished_file(tmp_path, file):
    def broken():
        yield 0, feature(9)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_features(tmp_path / file, NAMES, broken())
    left = [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()]
    assert left == ([f"{file}/{NAMES[0]}.npz"] if file == "feats" else [])


def test_what_cannot_be_written(tmp_path):
    written = feature(0)
    loud = type(written)(**(vars(written) | {"scores": written.scores * 1e6}))
    with pytest.raises(InputError, match=r"a\.jpg: scores: .*float16"):
        write_features(tmp_path / "f.h5", ["a.jpg"], [(0, loud)], half=True)
    for name in ("../a.jpg", "/a.jpg", ""):
        with pytest.raises(InputError, match="expected a path below the folder of images"):
            write_features(tmp_path / "f", [name], [(0, written)])
    assert not list(tmp_path.iterdir())


# hloc


def test_float32_comes_back_exactly_in_the_order_of_the_names(path):
    written = [feature(seed, count=40) for seed in range(3)]
    write_hloc(path, NAMES, written, half=False)
    source = open_features(path, NAMES[::-1])
    assert (len(source), source.dimension, source.counts.tolist()) == (3, 16, [40] * 3)
    for (_, features), expected in zip(source.read(), written[::-1], strict=True):
        assert_equal(features, expected)
    assert [row for row, _ in source.read([2, 0, 2])] == [2, 0, 2]


def test_float16_becomes_float32_of_unit_length(path):
    written = feature(0, count=200)
    write_hloc(path, ["a.jpg"], [written])
    features = read_one(path, "a.jpg")
    np.testing.assert_array_equal(features.keypoints, written.keypoints.astype(np.float16).astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1.2e-6)
    np.testing.assert_allclose(features.descriptors, written.descriptors, atol=5e-4)


def test_images_without_keypoints(path):
    write_hloc(path, ["a.jpg", "e.jpg"], [feature(0), feature(0, count=0)])
    for name, shape in (("b.jpg", (0,)), ("c.jpg", (0, 16)), ("d.jpg", (16, 3))):
        append_hloc(path, name, hloc_parts(feature(0, count=0)) | {"descriptors": np.ones(shape, np.float16)})
    source = open_features(path, ["a.jpg", "b.jpg", "c.jpg", "e.jpg", "d.jpg"])
    assert source.counts.tolist() == [30, 0, 0, 0, 0]
    for _, features in source.read([1, 2, 3]):
        assert (features.keypoints.shape, features.descriptors.shape, features.mask.shape) == ((0, 2), (0, 16), (0,))
    with pytest.raises(InputError, match=r"d\.jpg: expected 0 keypoints"):
        list(source.read([4]))


def test_as_many_keypoints_as_dimensions(path):
    """The other images of the file tell the layout; alone, it is hloc's."""
    square = feature(0, count=16)
    write_hloc(path, ["a.jpg"], [square], half=False)
    np.testing.assert_array_equal(read_one(path, "a.jpg").descriptors, square.descriptors)
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
    np.testing.assert_array_equal(read_one(path, "a.jpg").scores, written.scores)
    np.testing.assert_array_equal(read_one(path, "b.jpg").scores, np.ones(30))
    with pytest.raises(InputError, match="scores of all images or of none"):
        open_features(path, ["a.jpg", "b.jpg"])


def test_image_size_that_the_file_lacks_is_given(path):
    write_hloc(path, NAMES)
    parts = hloc_parts(feature(0))
    del parts["image_size"]
    append_hloc(path, "x.jpg", parts)
    with pytest.raises(InputError, match=r"x\.jpg: expected image_size, .*image_size="):
        open_features(path, ["x.jpg"])
    for size in (SIZE, [SIZE]):
        assert read_one(path, "x.jpg", image_size=size).image_size.tolist() == [640, 480]
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


def spoiled(part, value, row=3):
    def change(parts):
        array = parts[part].copy()
        array[row] = value
        return parts | {part: array}

    return change


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda p: {"keypoints": p["keypoints"]}, "expected descriptors, image_size, got none"),
        (lambda p: p | {"keypoints": p["keypoints"][:, :1]}, r"keypoints \[N, 2\] .* got \[30, 1\]"),
        (lambda p: p | {"descriptors": p["descriptors"][:, :-1]}, r"\[N, D\] or \[D, N\], got .* \[16, 29\]"),
        (lambda p: p | {"descriptors": p["descriptors"][:8]}, r"of one length, got lengths \[8, 16\]"),
        (lambda p: p | {"descriptors": p["descriptors"].T}, r"one layout, \[D, N\] or \[N, D\]"),
        (spoiled("keypoints", np.nan), "keypoints: .*finite .*nan"),
        (spoiled("descriptors", np.inf), "descriptors: .*finite .*inf"),
        (lambda p: p | {"scores": np.full(30, 1e300)}, "scores: .*finite .*1e.300"),
        (lambda p: p | {"descriptors": p["descriptors"] * 2}, r"got length 2.* lengths='normalize'"),
        (lambda p: p | {"descriptors": np.zeros((16, 30), np.uint8)}, "floating-point .*got uint8"),
        (lambda p: p | {"scores": p["scores"][1:]}, r"expected 30 keypoints with scores .* got 30, 29 and \[30, 16\]"),
        (lambda p: p | {"image_size": np.array([640, 0])}, r"image_size: expected .*got \[640\.0, 0\.0\]"),
        (spoiled("keypoints", (646, 200)), r"keypoints .*640 x 480 .*got \(646, 200\)"),
        (spoiled("keypoints", (300, 484)), r"keypoints .*640 x 480 .*got \(300, 484\)"),
    ],
)
def test_arrays_that_cannot_be_used(path, change, message):
    write_hloc(path, ["a.jpg"])
    append_hloc(path, "a/b.jpg", change(hloc_parts(feature(1))))
    with one_line_error(message, path.name):
        list(open_features(path, ["a.jpg", "a/b.jpg"]).read())


@pytest.mark.parametrize("point", [(645, 200), (-6, 483)])
def test_keypoints_may_lie_a_hundredth_of_the_image_outside(path, point):
    """640 x 480 pixels: as float16 rounds them, and as detectors extrapolate."""
    append_hloc(path, "a.jpg", spoiled("keypoints", point)(hloc_parts(feature(1))))
    assert read_one(path, "a.jpg").keypoints[3].tolist() == list(point)


def test_lengths_of_descriptors(path):
    written = feature(0)
    lengths = np.linspace(0.5, 3, 30, dtype=np.float32)[:, None]
    parts = hloc_parts(written, half=False) | {"descriptors": (written.descriptors * lengths).T}
    append_hloc(path, "a.jpg", parts)
    np.testing.assert_array_equal(read_one(path, "a.jpg", lengths="keep").descriptors, parts["descriptors"].T)
    unit = read_one(path, "a.jpg", lengths="normalize")
    np.testing.assert_allclose(unit.descriptors, written.descriptors, atol=1e-6)
    append_hloc(path, "zero.jpg", spoiled("descriptors", 0, row=np.s_[:, 4])(parts))
    with pytest.raises(InputError, match=r"zero\.jpg: descriptors: .*got zeros at 4"):
        read_one(path, "zero.jpg", lengths="normalize")


def test_without_h5py(path, monkeypatch):
    path.write_bytes(b"")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"the package h5py for HDF5, got none; pip install 'mfvpr\[hloc\]'"):
        open_features(path, NAMES)


@pytest.mark.parametrize(
    "put",
    [
        lambda group, secret: group.update(scores=h5py.ExternalLink(str(secret), "/a.jpg/scores")),
        lambda group, secret: group.create_dataset("scores", (30,), "f2", external=[(str(secret), 0, 60)]),
        lambda group, secret: group.create_group("scores"),
        lambda group, secret: group.create_dataset("scores", (30,), "f2", chunks=(10,)),  # HDF5 would make up values
    ],
)
def test_values_that_are_not_in_the_file(tmp_path, path, put):
    secret = write_hloc(tmp_path / "secret.h5", ["a.jpg"])
    parts = hloc_parts(feature(0))
    del parts["scores"]
    append_hloc(path, "a.jpg", parts)
    with h5py.File(path, "a", libver="latest") as file:
        put(file["a.jpg"], secret)
        file["b.jpg"] = h5py.ExternalLink(str(secret), "/a.jpg")  # no image
    with one_line_error(r"a\.jpg/scores: expected data in this file"):
        read_one(path, "a.jpg")
    with one_line_error(r"first without is b\.jpg"):
        read_one(path, "b.jpg")


def test_truncated_at_any_place(tmp_path, path):
    content = write_hloc(tmp_path / "whole.h5", ["a.jpg", "b.jpg"]).read_bytes()
    for length in (0, 10, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        with one_line_error("cannot be read"):
            read_one(path, "a.jpg")


# Archives of NumPy


def d2net(path, features):
    """As D2-Net's extract_features.py writes `path.d2-net`: (x, y, scale), rows of descriptors, no image size."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(f"{path}.d2-net", "wb") as file:
        keypoints = np.c_[features.keypoints, np.ones(len(features.keypoints))].astype(np.float64)
        np.savez(file, keypoints=keypoints, scores=features.scores, descriptors=features.descriptors)


def parts_of(features):
    return {part: getattr(features, part) for part in ("keypoints", "descriptors", "scores", "image_size")}


def test_files_of_d2net_beside_their_images(tmp_path):
    names, written = ["a/1.jpg", "a/2.jpg", "b/1.jpg"], [feature(seed) for seed in range(3)]
    for name, features in zip(names, written, strict=True):
        d2net(tmp_path / name, features)
        (tmp_path / name).write_bytes(b"the image itself")
    source = open_features(tmp_path, names[::-1], image_size=SIZE)
    for (_, features), expected in zip(source.read(), written[::-1], strict=True):
        assert_equal(features, expected)


@pytest.mark.parametrize("count", [30, 16])  # with 16, shapes do not tell the layout of descriptors
def test_an_archive_for_each_image_by_path_or_stem(tmp_path, count):
    written = feature(0, count=count)
    (tmp_path / "a").mkdir()
    np.savez(tmp_path / "a" / "1.jpg.npz", **parts_of(written))
    np.savez(tmp_path / "a" / "2.npz", **parts_of(written))
    np.savez(tmp_path / ".hidden.npz", nothing=0)
    for names in (["a/1.jpg", "a/2.jpg"], ["1.jpg", "2.png"]):
        for _, features in open_features(tmp_path, names).read():
            assert_equal(features, written)


def test_an_archive_for_all_images(tmp_path):
    written = {name: feature(seed, count=seed + 5) for seed, name in enumerate(("a/1.jpg", "keypoints", "b"))}
    arrays = {f"{name}/{part}": array for name in written for part, array in parts_of(written[name]).items()}
    np.savez_compressed(tmp_path / "all.npz", **arrays)
    source = open_features(tmp_path / "all.npz", [*written])
    assert source.counts.tolist() == [5, 6, 7]
    for row, features in source.read([2, 0, 1]):
        assert_equal(features, [*written.values()][row])


class Trap:
    def __reduce__(self):
        return exec, ("raise SystemExit('executed')",)


def test_what_is_no_archive_of_features(tmp_path):
    np.savez(tmp_path / "1.jpg.npz", **parts_of(feature(0)) | {"scores": np.array([Trap()], object)})
    for path, message in (
        (tmp_path, "cannot be read .*Object arrays"),
        (tmp_path / "1.jpg.npz", r"expected arrays named by images .*folder"),
    ):
        with one_line_error(message):
            read_one(path, "1.jpg")
    d2net(tmp_path / "1.jpg", feature(0))
    with one_line_error(r"1\.jpg\.npz: expected one file of an image, got 1\.jpg\.d2-net"):
        read_one(tmp_path, "1.jpg")
