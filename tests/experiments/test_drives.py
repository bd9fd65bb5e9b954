"""The tables of confidences, sequences, shifts and unusable images, on data whose answer is known."""

import numpy as np
import pytest

from experiments import absent, shifts, unusable
from experiments.drives import datasets_of
from experiments.sequences import ANY, STEADY, drives_along, standardized, trajectories
from mfvpr import InputError
from mfvpr.datasets.streets import TRUTH
from mfvpr.evaluation import Confidence
from mfvpr.localization import Alternative, Prediction


def test_shares_are_those_of_the_queries():
    confidence = Confidence((0.0,), (1.0,), (1.0,), 0.0)
    sure, unsure = 4.0, -4.0  # 0.98 and 0.02
    present = np.array([[sure], [sure], [unsure], [np.nan]]), np.array([True, False, True, False])
    elsewhere = np.array([[sure], [unsure], [unsure], [np.nan]]), np.zeros(4, bool)
    error, answered, of_present = absent.row(confidence, [present], [elsewhere])
    assert (answered, of_present) == ("25", "50")
    # Three answers, one of them correct; three refused, one of them correct; two without a prediction.
    assert error == f"{100 * (3 * abs(0.982 - 1 / 3) + 5 * abs(0.018 * 3 / 5 - 1 / 5)) / 8:.0f}"


def similarities(places, rows, seed=0):
    """A similarity matrix in which each image's place stands out from noise, but not always."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(len(places), rows))
    values[np.arange(len(places)), places] += 2.0
    return values


def test_drives_are_of_the_images_that_their_names_say():
    by_name = drives_along(100)
    assert by_name["as they are"].tolist() == [*range(100)]
    assert by_name["every fourth"].tolist() == [*range(0, 100, 4)]
    assert by_name["every second, backwards"].tolist() == [*range(99, 0, -2)]
    assert sorted({*by_name["with stops"].tolist()}) == [*range(100)]
    assert sorted(by_name["clips"].tolist()) == [*range(100)]
    assert by_name["clips"][:2].tolist() == [50, 51]


def test_trajectories_find_a_drive_at_their_speeds_only():
    for speed, finds, loses in ((1, STEADY, None), (4, ANY, STEADY), (-3, ANY, STEADY)):
        places = np.arange(40) * speed if speed > 0 else 199 + np.arange(40) * speed
        values = standardized(similarities(places, 200))
        correct = trajectories(values, finds, 10).argmax(axis=1) == places
        assert correct[10:].mean() > 0.95
        assert (values.argmax(axis=1) == places).mean() < 0.8
        if loses is not None:
            assert (trajectories(values, loses, 10).argmax(axis=1) == places).mean() < 0.2


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


def test_images_are_what_their_names_say():
    image, rng = np.full((48, 64, 3), 20.0), np.random.default_rng(0)
    image[:, 32:] = 30
    changed = {name: unusable.to_image(change(image, rng)) for name, change in unusable.CHANGES.items()}
    assert {each.shape for each in changed.values()} == {image.shape}
    assert [changed[name].mean() for name in ("black", "gray", "white")] == [0, 128, 255]
    assert changed["noise, 10"].std() < changed["noise, 40"].std() < changed["random pixels"].std()
    assert changed["blur over 16 %"][0, 30].mean() > changed["blur over 4 % of the width"][0, 30].mean() >= 20
    assert set(np.unique(changed["4 times as bright"])) == {80, 120}


def test_a_line_counts_refusals_and_correct_predictions():
    candidate = lambda row: (Alternative(row, "", "", 1.0),)  # noqa: E731
    predictions = [Prediction("", candidate(row), 1.0, None, None, None) for row in (0, 9)]
    predictions.append(Prediction(None, (), 0.0, None, None, None, "too few matches"))
    assert unusable.row("blur", [2, 3, 4], predictions) == ["blur", "3", "33", "1 too few matches", "50"]


def test_drives_without_folders_are_refused():
    for drive in ("park", "park=database", "database:queries"):
        with pytest.raises(InputError, match="expected NAME=DATABASE:QUERIES"):
            datasets_of([drive])
