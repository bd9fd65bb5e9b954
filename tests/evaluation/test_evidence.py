"""Reasons against images and predictions, without a map."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mfvpr.core.types import Features, Shortlist
from mfvpr.datasets.image_reading import read_image, resize
from mfvpr.evaluation.evidence import evidence_against, reason_against, reason_against_image
from mfvpr.evaluation.rankings import Ranked
from mfvpr.evaluation.system import noise_images
from mfvpr.features.feature_set import strength
from mfvpr.retrieval import FeatureFiles
from tests.builders import make_matches, match_set_of

SIZES = [(320, 320), (160, 120), (512, 192)]


@pytest.mark.parametrize("size", SIZES)
def test_photographs_of_a_street_are_neither_noise_nor_overexposed(small_street, size):
    for path in sorted((small_street / "queries").iterdir()):
        image = resize(read_image(path), size)
        assert reason_against_image(image) is None
        assert reason_against_image(image // 16) is None  # dark
        assert reason_against_image(cv2.blur(image, (size[0] // 10, size[1] // 10))) == "blurred"
        assert reason_against_image(np.clip(image.astype(int) * 64, 0, 255).astype(np.uint8)) == "overexposed"


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("deviation", [2, 40, 200])
def test_noise_of_any_strength_is_noise(size, deviation):
    rng = np.random.default_rng(0)
    for grain in (1, 2):
        image = noise_images(size, seeds=(3,), grains=(grain,))[0].astype(float)
        image = 128 + deviation * (image - 128) / 128
        assert reason_against_image(np.clip(image, 0, 255).astype(np.uint8)) == "no better than noise"
    gray = np.clip(128 + deviation * rng.normal(size=(*size[::-1], 1)), 0, 255).astype(np.uint8)
    assert reason_against_image(np.repeat(gray, 3, axis=2)) == "no better than noise"


def test_negative_detection_scores_have_no_strength():
    scores = np.array([0.5, -3.0, 0.25], np.float32)
    features = Features(np.zeros((3, 2)), np.zeros((3, 4)), scores, np.ones(3, bool), np.ones(2))
    assert strength(features) == 0.75


def test_the_least_evidence_is_enough():
    """Eight matches, and a score of 1.2 times that of noise, which may be unknown."""
    for score, noise in ((12.0, 10.0), (0.0, 0.0), (np.nan, 10.0), (1.0, np.nan)):
        assert (reason_against(8, score, noise), reason_against(7, score, noise)) == (None, "too few matches")
    assert reason_against(8, 11.99, 10.0) == "no better than noise"


def test_the_evidence_is_that_of_the_prediction_whatever_the_order_of_the_retrieval():
    many, few = (make_matches(np.ones((number, 2)), np.ones((number, 2))) for number in (20, 2))
    candidates = Shortlist(np.array([[3, 7]]), np.ones((1, 2), np.float32), np.ones((1, 2), bool))
    matched = SimpleNamespace(sequence=SimpleNamespace(images=range(1)), candidates=candidates, bad_queries={},
                              matches=[match_set_of([[many, few]], 20)])  # fmt: skip
    pipeline = SimpleNamespace(image_source="images are matched", extractor=FeatureFiles({}))
    system = SimpleNamespace(pipeline=pipeline, headline="score")
    for rows, reason in (([3, 7], None), ([7, 3], "too few matches")):
        rankings = {"score": [Ranked(np.array([rows]), np.ones((1, 2)))]}
        ranked = SimpleNamespace(dataset=SimpleNamespace(database=range(9)), system=system, matched=[matched],
                                 systems=rankings)  # fmt: skip
        assert evidence_against(ranked, None) == [[reason]]
