"""A small data set, and the systems that are compared on it."""

import pytest

import mfvpr
from mfvpr.datasets import folder_dataset
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.retrieval import Retrieval

SIFT = Sift(max_keypoints=60, image_size=(160, 120))
VLAD = Retrieval(Aggregated(SIFT, VladFitting(num_words=8)))
SCORERS = {"histogram": mfvpr.HistogramOfShifts(), "count": mfvpr.MatchCount()}


@pytest.fixture(scope="package")
def dataset(small_street):
    return folder_dataset(small_street / "database", small_street / "queries", ground_truth="order")
