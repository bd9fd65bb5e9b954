"""Gradients of all scores, hard and soft: central differences in double precision, and degenerate pairs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mfvpr import (
    AggregatedScore,
    AnchorPoints,
    DescriptorDistanceWeight,
    HistogramOfShifts,
    LostScore,
    MatchCount,
    RapidSpatialScore,
    RatioWeight,
    VisualPhrases,
    soft_match,
)
from tests.builders import SIZE, double, make_features, make_matches, random_matches
from tests.scorers import each_scorer

pytestmark = pytest.mark.thorough

HARD = [
    HistogramOfShifts(bin_size=20.0, max_bins=36),
    HistogramOfShifts(bin_size=17.0, sigma=300.0, sigma_is_variance=True, shift_range=(100.0, 50.0), max_bins=14),
    HistogramOfShifts(bin_size=20.0, align="zero_center", weight=DescriptorDistanceWeight(), max_bins=36),
    HistogramOfShifts(bin_size=20.0, weight=RatioWeight(1.5), max_bins=36),
    AnchorPoints(6, 4.0, 2.5),
    AnchorPoints(6, 4.0, 2.5, first="candidate", cell_weight="cell_sum", include_self=False),
    AggregatedScore(),
    AggregatedScore(mean="weighted", clamp=True),
    AggregatedScore(mean="median", clamp=True),
    MatchCount(),
]
SOFT = [
    replace(HARD[0], temperature=0.3),
    replace(HARD[1], temperature=0.05),
    replace(HARD[2], temperature=0.5),
    replace(HARD[4], temperature=0.1),
    replace(HARD[5], temperature=0.5),
    replace(HARD[4], temperature=1.5, cell_weight="ones", weight=DescriptorDistanceWeight()),
    replace(HARD[6], temperature=20.0),
    replace(HARD[7], temperature=5.0),
    replace(HARD[8], temperature=20.0),
]
RELATIVES = [
    RapidSpatialScore(),
    RapidSpatialScore(reach="largest_coordinate"),
    RapidSpatialScore(reach="largest_shift"),
    VisualPhrases(length=1),
    VisualPhrases(length=3, cell_size=90.0),
    LostScore(),
    LostScore(form="unweighted", mirrored=True),
]
NUMBERS = ("bin_size", "sigma", "tolerance", "temperature", "weight")  # the window moves whole cells
PER_MATCH = ("points0", "points1", "distance", "scores0", "scores1", "ratio", "confidence")
PER_KEYPOINT = ("keypoints", "descriptors", "scores")


def fields_of(value, names):
    """Fields of a value by name, without None."""
    return {name: getattr(value, name) for name in names if getattr(value, name, None) is not None}


def check_gradients(value_and_grad, tree, rng, step=1e-6):
    """Every leaf's gradient along a random direction is the central difference, and 0 where the leaf is NaN."""
    value, gradients = value_and_grad(tree)
    leaves, structure = jax.tree.flatten(tree)
    for place, (leaf, gradient) in enumerate(zip(leaves, jax.tree.leaves(gradients), strict=True)):
        assert np.isfinite(gradient).all()
        assert (np.asarray(gradient)[np.isnan(leaf)] == 0).all()
        direction = jnp.asarray(rng.uniform(-1, 1, np.shape(leaf)))
        behind, ahead = (
            value_and_grad(structure.unflatten([*leaves[:place], leaf + way * direction, *leaves[place + 1 :]]))[0]
            for way in (-step, step)
        )
        numeric = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(jnp.sum(gradient * direction), numeric, rtol=1e-5, atol=1e-8 * abs(float(value)))


@each_scorer(HARD + SOFT + RELATIVES)
def test_gradients_are_central_differences(scorer):
    rng = np.random.default_rng(0)
    matches = random_matches(rng, 20, capacity=24)
    points1 = matches.points1 + rng.uniform(-0.1, 0.1, (24, 2)).astype(np.float32)  # no two shifts are equal
    confidence = np.where(matches.mask, rng.uniform(0.1, 0.9, 24), np.nan).astype(np.float32)
    with jax.enable_x64(True):
        matches = double(replace(matches, points1=points1, confidence=confidence))
        tree = double(fields_of(scorer, NUMBERS)), fields_of(matches, PER_MATCH)
        score = lambda tree: replace(scorer, **tree[0])(replace(matches, **tree[1]))  # noqa: E731
        check_gradients(jax.jit(jax.value_and_grad(score)), tree, rng)


def test_gradients_through_soft_matching_are_central_differences():
    rng = np.random.default_rng(1)
    pair = make_features(rng, 9, capacity=12), make_features(rng, 8, capacity=10)
    pair[0].descriptors[2, 0] = np.nan
    pair[1].descriptors[5, 3] = np.inf

    @jax.jit
    @jax.value_and_grad
    def total(tree):
        temperature, *fields = tree
        features = (replace(image, **values) for image, values in zip(pair, fields, strict=True))
        matches = soft_match(*features, temperature=temperature)
        return SOFT[0](matches) + 1e-4 * SOFT[6](matches) + MatchCount()(matches)

    with jax.enable_x64(True):
        pair = double(pair)
        for temperature in (0.02, 0.2):
            tree = jnp.asarray(temperature), *(fields_of(features, PER_KEYPOINT) for features in pair)
            check_gradients(total, tree, rng)


COLD = [replace(HARD[0], temperature=1e-4), replace(HARD[4], temperature=1e-3), replace(HARD[7], temperature=1e-4)]
gradients = jax.jit(jax.value_and_grad(lambda scorer, rows, matches: scorer(replace(matches, **rows)), argnums=(0, 1)))


@each_scorer(HARD[3:9] + SOFT[5:6] + SOFT[8:] + COLD + RELATIVES)  # cold or warm, it is the same program
def test_degenerate_pairs_have_finite_gradients(scorer):
    """Empty, single, all alike, at a corner, without any weight or confidence; in single precision, beside NaN."""
    corners = [[0, 0], [SIZE, SIZE]] * 2, [[SIZE, SIZE], [0, 0]] * 2
    no_weight = {"distance": 0.0, "ratio": 1.0, "scores0": 0.0, "scores1": 0.0, "confidence": 0.0}
    for points0, points1, entries in (
        ([], [], {"confidence": 0.0, "ratio": 0.0}),
        ([[20, 30]], [[20, 30]], {"distance": 0.0, "confidence": 1.0, "ratio": 0.0}),
        ([[20, 30]] * 4, [[50, 60]] * 4, {"distance": 0.0, "confidence": 1.0, "ratio": 1.0}),
        (*corners, no_weight),
        (*corners, {"confidence": 1e-12, "ratio": 0.5}),
    ):
        entries = {name: [number] * len(points0) for name, number in entries.items()}
        matches = make_matches(points0, points1, capacity=6, **entries)
        value, (of_scorer, of_rows) = gradients(jax.tree.map(float, scorer), fields_of(matches, PER_MATCH), matches)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((value, of_scorer, of_rows)))
        assert all((np.asarray(rows)[~matches.mask] == 0).all() for rows in of_rows.values())


def test_a_match_as_near_to_two_keypoints_has_no_gradient_of_its_ratio():
    """Though that of a root is infinite there."""
    matches = make_matches([[1, 1]] * 2, [[2, 2]] * 2, ratio=[1.0, 0.75])
    weight = lambda exponent, ratio: jnp.sum(RatioWeight(exponent)(replace(matches, ratio=ratio)))  # noqa: E731
    of_exponent, of_ratio = jax.grad(weight, argnums=(0, 1))(0.5, jnp.asarray(matches.ratio))
    np.testing.assert_allclose(of_exponent, 0.5 * np.log(0.25), rtol=1e-6)
    np.testing.assert_allclose(of_ratio, [0.0, -1.0], rtol=1e-6)


def test_the_window_moves_in_whole_cells():
    matches = random_matches(np.random.default_rng(2), 20)
    _, (of_scorer, _) = gradients(AnchorPoints(6, 4.0, temperature=0.5), fields_of(matches, PER_MATCH), matches)
    assert of_scorer.window == 0.0
    assert of_scorer.tolerance > 0.0
