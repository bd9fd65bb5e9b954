"""Figures: nothing is cut off or shrunk by long names, images keep their shape, systems their colors."""

import numpy as np
import pytest
from PIL import Image

from mfvpr import InputError
from mfvpr.evaluation import precision_recall, reliability
from mfvpr.report import figures, plots
from mfvpr.report.pages.charts import line_chart

SYSTEMS = ["retrieval", *(f"histogram + anchor + sum + retrieval {number}" for number in range(10))]
QUERY = np.zeros((90, 90, 3), np.uint8)
P, RIGHT = np.linspace(0, 1, 20), np.arange(20) % 3 > 0


def pixels(path):
    return np.asarray(Image.open(path).convert("L"))


def draw(path, name, **options):
    prediction = figures.Candidate(QUERY, f"incorrect: {name}, rank 1")
    figures.histogram_figure(path, QUERY, [prediction], title=f"histogram: {name} -> {name}", **options)
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
    aspect = figures.pixel_aspect_of(np.zeros((384, 1024, 3)), QUERY)
    assert aspect == 384 / 1024
    rows, columns = np.nonzero(draw(tmp_path / "a.png", "name", pixel_aspect=aspect) == 0)
    half = columns[columns < np.mean(columns)]  # the two images stand side by side
    rows_of_images = [row for row in np.unique(rows) if (rows == row).sum() > 100]
    assert len(rows_of_images) / (half.max() - half.min()) == pytest.approx(aspect, rel=0.1)


def test_titles_of_panels_are_not_cut_off(tmp_path):
    plots.reliability_figure(tmp_path / "a.png", {name: reliability(P, RIGHT) for name in SYSTEMS[:4]})
    image = pixels(tmp_path / "a.png")
    assert {*np.concatenate([image[:, 0], image[:, -1], image[0], image[-1]]).tolist()} == {255}


def test_systems_have_the_same_colors_in_figures_and_pages(tmp_path, monkeypatch):
    curve = precision_recall(P, RIGHT, np.ones(20, bool))
    saved = []
    monkeypatch.setattr(plots, "save_figure", lambda figure, path, **_: saved.append(figure))
    plots.precision_recall_figure(tmp_path / "a.png", {name: {"score": curve} for name in SYSTEMS})
    plots.shares_figure(tmp_path / "b.png", [0, 1], {name: np.zeros(2) for name in SYSTEMS[1:]})
    chart = line_chart("name", "title", {name: [(0, 0), (1, 1)] for name in SYSTEMS}, axes=("x", "y"))
    expected = [trace["line"]["color"] for trace in chart.figure["data"]]
    colors = [[line.get_color() for line in figure.axes[0].lines] for figure in saved]
    assert colors == [expected, expected[1:]]
    styles = [line.get_linestyle() for line in saved[0].axes[0].lines]
    assert len({*zip(expected, styles, strict=True)}) == len(SYSTEMS)
