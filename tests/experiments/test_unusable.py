"""The table of refusals: what is drawn, and what a line counts."""

import numpy as np

from experiments import unusable
from mfvpr.localization import Alternative, Prediction


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
    assert unusable.row("blur", [2, 3, 4], predictions) == "| blur | 3 | 33 | 1 too few matches | 50 |"
