"""The table of confidences, for places in the map and for absent ones."""

import numpy as np

from experiments import absent
from mfvpr.evaluation import Confidence


def test_shares_are_those_of_the_queries():
    confidence = Confidence((0.0,), (1.0,), (1.0,), 0.0)
    sure, unsure = 4.0, -4.0  # 0.98 and 0.02
    present = np.array([[sure], [sure], [unsure], [np.nan]]), np.array([True, False, True, False])
    elsewhere = np.array([[sure], [unsure], [unsure], [np.nan]]), np.zeros(4, bool)
    error, answered, of_present = absent.row(confidence, [present], [elsewhere])
    assert (answered, of_present) == ("25", "50")
    # Three answers, one of them correct; three refused, one of them correct; two without a prediction.
    assert error == f"{100 * (3 * abs(0.982 - 1 / 3) + 5 * abs(0.018 * 3 / 5 - 1 / 5)) / 8:.0f}"
