"""Features in npz: D2-Net's files, one for each image, one for all."""

import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.io import open_features
from tests.io.checks import one_line_error
from tests.io.other_programs import SIZE, assert_equal, feature


def d2net(path, features, scale=1.0):
    """As D2-Net's extract_features.py writes `path.d2-net`: (x, y, scale), rows of descriptors, no image size."""
    count = len(features.keypoints)
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(f"{path}.d2-net", "wb") as file:
        keypoints = np.c_[features.keypoints, np.full(count, scale)].astype(np.float64)
        np.savez(file, keypoints=keypoints, scores=features.scores, descriptors=features.descriptors)


def parts_of(features):
    return {part: getattr(features, part) for part in ("keypoints", "descriptors", "scores", "image_size")}


def named_parts(features):
    return {f"{name}/{part}": array for name in features for part, array in parts_of(features[name]).items()}


def test_files_of_d2net_beside_their_images(tmp_path):
    names, written = ["a/1.jpg", "a/2.jpg", "b/1.jpg"], [feature(seed) for seed in range(3)]
    for name, features in zip(names, written, strict=True):
        d2net(tmp_path / name, features)
        (tmp_path / name).write_bytes(b"the image itself")
    source = open_features(tmp_path, names[::-1], image_size=SIZE)
    assert source.counts.tolist() == [30] * 3
    for (_, features), expected in zip(source.read(), written[::-1], strict=True):
        assert_equal(features, expected)
    with pytest.raises(InputError, match=r"b/1\.jpg: .*got no image_size"):
        open_features(tmp_path, names[::-1])


@pytest.mark.parametrize("count", [30, 16])  # with 16, shapes do not tell the layout of descriptors
def test_one_for_each_image_by_path_or_stem(tmp_path, count):
    written = feature(0, count=count)
    (tmp_path / "a").mkdir()
    np.savez(tmp_path / "a" / "1.jpg.npz", **parts_of(written))
    np.savez(tmp_path / "a" / "2.npz", **parts_of(written))
    np.savez(tmp_path / ".hidden.npz", nothing=0)
    for names in (["a/1.jpg", "a/2.jpg"], ["1.jpg", "2.png"]):
        for _, features in open_features(tmp_path, names).read():
            assert_equal(features, written)


def test_one_for_all(tmp_path):
    names, written = ["a/1.jpg", "keypoints", "b"], [feature(seed, count=seed + 5) for seed in range(3)]
    np.savez_compressed(tmp_path / "all.npz", **named_parts(dict(zip(names, written, strict=True))))
    source = open_features(tmp_path / "all.npz", names)
    assert source.counts.tolist() == [5, 6, 7]
    for row, features in source.read([2, 0, 1]):
        assert_equal(features, written[row])


def test_pickles_are_never_loaded(tmp_path):
    class Trap:
        def __reduce__(self):
            return exec, ("raise SystemExit('executed')",)

    scores = np.array([Trap()], object)
    (tmp_path / "folder").mkdir()
    np.savez(tmp_path / "folder/1.jpg.npz", **(parts_of(feature(0)) | {"scores": scores}))
    np.savez(tmp_path / "all.npz", **{"1.jpg/keypoints": scores})
    with one_line_error("cannot be read .*Object arrays"):
        list(open_features(tmp_path / "folder", ["1.jpg"]).read())
    with one_line_error("keypoints"):
        list(open_features(tmp_path / "all.npz", ["1.jpg"]).read())


def test_what_is_no_store_of_features(tmp_path):
    path = tmp_path / "1.jpg.npz"
    np.savez(path, **parts_of(feature(0)))
    with pytest.raises(InputError, match=r"got keypoints, descriptors, scores, image_size; .*folder"):
        open_features(path, ["1.jpg"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: .*\.npz .*\.d2-net, got none"):
        open_features(tmp_path / "empty", ["1.jpg"])
    d2net(tmp_path / "1.jpg", feature(0))
    with pytest.raises(InputError, match=r"1\.jpg\.npz: 1\.jpg\.d2-net .*same image"):
        open_features(tmp_path, ["1.jpg"])
