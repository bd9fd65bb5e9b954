"""Figures: nothing is cut off or shrunk by long names, images keep their shape, systems their colors."""

import numpy as np
import pytest
from PIL import Image

from mfvpr import InputError
from mfvpr.report import figures

QUERY = np.zeros((90, 90, 3), np.uint8)


def pixels(path):
    return np.asarray(Image.open(path).convert("L"))


def draw(path, name, original=QUERY):
    prediction = figures.Candidate(QUERY, f"incorrect: {name}, rank 1")
    figures.histogram_figure(path, QUERY, [prediction], title=f"histogram: {name} -> {name}", original=original)
    return pixels(path)


def test_a_long_name_leaves_the_figure_as_large(tmp_path):
    short, long = (draw(tmp_path / f"{len(name)}.png", name) for name in ("x" * 30, "x" * 200))
    assert (short < 20).sum() == pytest.approx((long < 20).sum(), rel=0.1)  # of the images
    assert long.shape[1] == pytest.approx(short.shape[1], rel=0.1)


def test_a_figure_replaces_only_a_figure(tmp_path):
    assert draw(tmp_path / "a.png", "name").shape == draw(tmp_path / "a.png", "name").shape
    Image.fromarray(QUERY).save(tmp_path / "query.png")
    with pytest.raises(InputError, match=r"query\.png: expected a new file"):
        draw(tmp_path / "query.png", "name")
    np.testing.assert_array_equal(Image.open(tmp_path / "query.png"), QUERY)


def test_images_are_drawn_in_the_shape_they_were_taken_in(tmp_path):
    rows, columns = np.nonzero(draw(tmp_path / "a.png", "name", original=np.zeros((384, 1024, 3))) == 0)
    half = columns[columns < np.mean(columns)]  # the two images stand side by side
    rows_of_images = [row for row in np.unique(rows) if (rows == row).sum() > 100]
    assert len(rows_of_images) / (half.max() - half.min()) == pytest.approx(384 / 1024, rel=0.1)
