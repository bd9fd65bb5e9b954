"""The table of shifts, and the streets that it is measured on."""

import numpy as np
import pytest

from experiments import shifts
from mfvpr.datasets.streets import TRUTH


def test_numbers_of_a_row_are_those_of_the_pairs():
    truth = np.array([[0.1, 0.0], [0.2, 0.0], [0.3, 0.1]])
    errors = np.array([[10, 0], [-20, 0], [40, 0]]) / 1024
    half = np.array([[30, 5], [10, 5], [50, 5]]) / 1024
    intervals = np.stack([truth + errors - half, truth + errors + half], axis=1)
    parts = [(values[:2], values[2:]) for values in (truth + errors, intervals, truth)]
    assert shifts.row([*zip(*parts, strict=True)]) == ["20.0", "67", "67", "100", "60"]


@pytest.mark.slow
@pytest.mark.thorough
def test_a_drive_further_beside_the_lane_has_more_parallax(tmp_path, monkeypatch):
    monkeypatch.setattr(shifts, "FRAMES", 4)
    truths = []
    for lane in (1, 2):
        street = shifts.draw(tmp_path, 0, lane, (96, 72))
        assert len([*street.glob("*/*.png")]) == 8
        truths.append(np.loadtxt(street / TRUTH, delimiter=",", skiprows=1, usecols=2))
    assert np.abs(truths[1] - truths[0]).min() > 0.1  # px
