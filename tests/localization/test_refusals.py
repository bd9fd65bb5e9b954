"""Images that get no place in a map, whatever their confidence."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mfvpr.evaluation.evidence import LEAST_MATCHES
from mfvpr.evaluation.system import noise_images
from mfvpr.features import Description
from mfvpr.localization import Map, Prediction
from tests.builders import map_system
from tests.localization.test_map import SURE, Constant, opened

pytestmark = pytest.mark.thorough


def without_place(reason, image):
    return Prediction(reason=reason, image_width=image.shape[1])


@pytest.mark.parametrize("kind", ["black", "gray", "dark noise", "lens cap"])
def test_images_of_nothing_have_no_place_whatever_the_confidence(folder, kind):
    rng, values = np.random.default_rng(0), {"black": 0, "gray": 90, "dark noise": 5}
    image = np.full((480, 640, 3), values.get(kind, 0), np.uint8)
    if kind == "dark noise":
        image += rng.integers(0, 5, image.shape, np.uint8)
    if kind == "lens cap":  # with a little light at its rim
        image[:, :40] = np.arange(40, 0, -1)[:, None]
    prediction, _, matches = opened(folder, confidence=replace(SURE, bias=100.0)).localize_with_evidence(image)
    assert (prediction, matches) == (without_place("too few features", image), None)
    assert (prediction.as_json()["reason"], prediction.image_width) == ("too few features", 640)
    assert (prediction.shift_fraction, prediction.shift_angles(60)) == (None, None)


def test_strong_features_with_few_matches_have_no_place(folder):
    image = np.zeros((120, 160, 3), np.uint8)
    image[40:60, 70:95] = 255
    prediction, (features, _), matches = opened(folder, confidence=SURE).localize_with_evidence(image)
    assert 0 < len(features.scores) < LEAST_MATCHES
    assert (prediction, matches) == (without_place("too few matches", image), None)


@pytest.mark.parametrize("grain", [1, 3])
def test_noise_has_no_place_whatever_the_confidence(folder, grain):
    image = noise_images((160, 120), seeds=(7,), grains=(grain,))[0]
    prediction = opened(folder, confidence=replace(SURE, bias=100.0)).localize(image)
    assert prediction == without_place("no better than noise", image)


@dataclass(frozen=True)
class Bright(Constant):
    """Keypoints as strong as the image is bright."""

    def describe(self, image):
        vector, (features,) = super().describe(image)
        return Description(vector, (replace(features, scores=np.full(9, image.max() / 255, np.float32)),))


def test_rows_that_are_left_out_do_not_say_how_strong_a_query_must_be(tmp_path):
    rng, known = np.random.default_rng(0), Map(tmp_path / "map", map_system(Bright(), Bright(), candidates=3))
    images = [rng.integers(0, 2 if row < 3 else 256, (3, 4, 3), np.uint8) for row in range(8)]
    images = [image.repeat(4, axis=0).repeat(4, axis=1) for image in images]
    for row, image in enumerate(images):
        known.add(image, row, name=str(row))
    assert known.localize(images[0]).reason == "too few features"
    assert known.localize_with_evidence(images[0], before=3).prediction.place == 0
