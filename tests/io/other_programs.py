"""Files as other programs write them, and features to put in."""

import h5py
import numpy as np

from tests.builders import make_features

SIZE = (640, 480)
NAMES = ("a/image 1.jpg", "a/b/image2.jpg", "image10.png")


def feature(seed, count=30, dimension=16):
    """Features in an image of `SIZE`, with detection scores in (0, 1)."""
    features = make_features(np.random.default_rng(seed), count, dimension=dimension, size=480)
    return type(features)(**(vars(features) | {"image_size": np.array(SIZE, np.float32)}))


def features_of(num_images):
    return [feature(seed) for seed in range(num_images)]


def hloc_parts(features, half=True):
    """Results of hloc's extractors for an image: float32, or float16 with `as_half`; sizes in int64."""
    kind = np.float16 if half else np.float32
    return {
        "keypoints": features.keypoints.astype(kind),
        "descriptors": features.descriptors.T.astype(kind),
        "scores": features.scores.astype(kind),
        "image_size": np.array(features.image_size, np.int64),
    }


def append_hloc(path, name, parts, uncertainty=1.0):
    """One image, as `hloc.extract_features` adds it: the file is opened for every image, libver latest."""
    with h5py.File(str(path), "a", libver="latest") as file:
        group = file.create_group(name)
        for part, array in parts.items():
            group.create_dataset(part, data=array)
        if "keypoints" in parts:
            group["keypoints"].attrs["uncertainty"] = uncertainty


def write_hloc(path, names, features=None, half=True):
    """A file of hloc, of random features by default."""
    for name, image_features in zip(names, features or features_of(len(names)), strict=True):
        append_hloc(path, name, hloc_parts(image_features, half))
    return path


def assert_equal(features, expected, *, rtol=0.0, atol=0.0):
    assert features.keypoints.dtype == features.descriptors.dtype == features.scores.dtype == np.float32
    assert features.image_size.dtype == np.float32
    assert features.mask.dtype == bool
    assert features.mask.shape == (len(features.keypoints),)
    assert features.mask.all()
    for part in ("keypoints", "descriptors", "scores", "image_size"):
        np.testing.assert_allclose(getattr(features, part), getattr(expected, part), rtol=rtol, atol=atol, err_msg=part)
