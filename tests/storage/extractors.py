"""Small extractors for tests of the cache."""

from dataclasses import dataclass

import jax
import numpy as np

from mfvpr.features import Description, Scale, Sift
from mfvpr.utils import recipe_of

SIFT = Sift(max_keypoints=60, image_size=(160, 120), batch_size=3)


class Counted:
    """An extractor that counts its images, and is killed after some."""

    def __init__(self, extractor=SIFT, limit=100):
        for name in ("image_size", "interpolation", "batch_size", "vector_size", "scales"):
            setattr(self, name, getattr(extractor, name))
        self.extractor, self.recipe, self.seen, self.limit = extractor, recipe_of(extractor), 0, limit

    def __call__(self, images):
        if self.seen + len(images) > self.limit:
            raise KeyboardInterrupt
        self.seen += len(images)
        return self.extractor(images)


@dataclass(frozen=True)
class Mean:
    """A global descriptor: the mean color, of unit length."""

    recipe = "mean color"

    image_size, interpolation, batch_size, vector_size, scales = (16, 16), "pil_bilinear", 4, 3, ()

    def __call__(self, images):
        mean = images.mean((1, 2)).astype(np.float32) + 1
        return [Description(vector / np.linalg.norm(vector)) for vector in mean]


class TwoScales:
    """A global descriptor and local features of two scales from one pass."""

    image_size, interpolation, batch_size, vector_size = SIFT.image_size, SIFT.interpolation, 3, 3
    recipe = "two scales"

    def __init__(self, weight=0.5):
        self.scales = (Scale(128, 60), Scale(128, 30, weight=weight))

    def __call__(self, images):
        local = [description.features for description in SIFT(images)]
        return [
            Description(mean.vector, (features, every_second(features)))
            for mean, features in zip(Mean()(images), local, strict=True)
        ]


def every_second(features):
    """Every second feature of an image."""
    return jax.tree.map(lambda values: values if values.shape == (2,) else values[::2], features)
