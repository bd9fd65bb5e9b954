"""The scores that the paper discusses: as the public codes, as their float64 loops, and in closed form."""

import math
from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import Features, InputError, LostScore, RapidSpatialScore, VisualPhrases, match
from tests import score_oracles as oracles
from tests.builders import SIZE, make_matches, real
from tests.core.test_oracles import certainty, pairs
from tests.golden import make_relatives as public
from tests.scorers import score

pytestmark = pytest.mark.thorough

match_features = jax.jit(match)


def confident(matches):
    """Points, distances and confidences of the matches that are some."""
    points0, points1, distance, *_ = real(matches)
    confidence = certainty(matches)
    return tuple(values[confidence > 0] for values in (points0, points1, distance, confidence))


@pytest.mark.parametrize(
    "options",
    [{"reach": "image_size"}, {"reach": "largest_coordinate"}, {"reach": "largest_shift"}, {"size": (90.0, 40.0)}],
)
@given(matches=pairs(), per_feature=st.booleans())
def test_rapid_agrees_with_the_loop(options, matches, per_feature):
    points0, points1, _, confidence = confident(matches)
    count = max(float(matches.count0), 1) if per_feature else None
    expected = oracles.rapid_spatial_score(points0, points1, confidence, matches.image_size0, count0=count, **options)
    got = score(RapidSpatialScore(per_feature=per_feature, **options), matches)
    np.testing.assert_allclose(got, expected, rtol=2e-5, atol=1e-4)


@given(pairs(), st.integers(1, 3), st.sampled_from([15.0, 42.0, 7.3]), st.sampled_from(["zero_center", "zero_edge"]))
def test_phrases_agree_with_the_loop(matches, length, cell_size, align):
    points0, points1, _, confidence = confident(matches)
    options = {"length": length, "cell_size": cell_size, "align": align}
    expected = oracles.visual_phrases(points0, points1, confidence, **options)
    np.testing.assert_allclose(score(VisualPhrases(**options), matches), expected, rtol=2e-6, atol=0)


@pytest.mark.parametrize("form", ["weighted", "unweighted"])
@given(matches=pairs(), mirrored=st.booleans())
def test_lost_agrees_with_the_loop(matches, form, mirrored):
    expected = oracles.lost_score(*confident(matches), form=form, mirrored=mirrored, width=matches.image_size0[0])
    np.testing.assert_allclose(score(LostScore(form, mirrored), matches), expected, rtol=1e-5, atol=1e-6)


def as_features(points, descriptors):
    return Features(
        points.astype(np.float32),
        descriptors,
        np.ones(len(points), np.float32),
        np.ones(len(points), bool),
        np.array(public.SIZE, np.float32),
    )


def test_rapid_is_that_of_patch_netvlad(golden):
    """In units of the grid, and in pixels, of which a patch is 16."""
    for patch, expected in zip(public.PATCHES, golden["patch_netvlad"], strict=True):
        places, query, reference = public.patches(patch)
        scorer = RapidSpatialScore(size=tuple(places.max(0).tolist()), per_feature=True)
        matches = match_features(as_features(places, query), as_features(places, reference))
        np.testing.assert_allclose(score(scorer, matches), -expected, rtol=2e-6)
        pixels = 16 * places + 8 * (patch - 1) + 7.5
        matches = match_features(as_features(pixels, query), as_features(pixels, reference))
        coarse = replace(scorer, size=tuple((16.0 * places.max(0)).tolist()))
        np.testing.assert_allclose(score(coarse, matches) / 256, -expected, rtol=2e-6)


def test_rapid_is_that_of_re_ranking_for_vpr(golden):
    points0, features0, points1, features1 = public.keypoints()
    matches = match_features(as_features(points0, features0), as_features(points1, features1))
    assert 20 < int(matches.mask.sum()) < 80
    for options in ({"reach": "largest_coordinate"}, {"size": tuple(points0.max(0).tolist())}):
        scorer = RapidSpatialScore(per_feature=True, **options)
        np.testing.assert_allclose(score(scorer, matches), -golden["reranking"], rtol=2e-6)


@pytest.mark.parametrize("form", ["weighted", "unweighted"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_lost_is_that_of_the_public_code(golden, form, mirrored):
    rows, width = public.LAYOUT
    reference, query, dense, other = public.layouts()
    points1, points0 = (np.stack([cells % width, cells // width], axis=1) for cells in (reference, query))
    first, second = dense[reference].astype(float), other[query].astype(float)
    lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    cosine = 1 - np.sum(first * second, axis=1) / lengths
    sizes = ((width, rows), (width, rows))
    matches = make_matches(points0, points1, distance=np.sqrt(2 * cosine), sizes=sizes)
    smallest = 1 / np.expm1(float(score(LostScore(form, mirrored), matches)))
    np.testing.assert_allclose(smallest, golden[f"lost/{form}/{mirrored}"], rtol=1e-5)


def test_rapid_per_feature_needs_the_number_of_keypoints():
    pair = make_matches([[1, 1]], [[2, 2]])
    with pytest.raises(InputError, match=r"per_feature=True: .*count0 .*, got None"):
        RapidSpatialScore(per_feature=True)(pair)
    assert RapidSpatialScore(per_feature=True)(replace(pair, count0=np.int32(4))) == pytest.approx(SIZE**2 / 2)


@pytest.mark.parametrize("length", [1, 2, 5, 8])
def test_phrases_are_binomials(length):
    """Three cells with 6, 9 and 3 matches, in any order."""
    cells, inside = np.repeat([[0, 0], [15, 0], [0, -30]], (6, 9, 3), axis=0), [[-7.25, 7.25], [3, 0], [0, -7]] * 6
    shifts = np.random.default_rng(2).permutation(cells + inside)
    matches = make_matches(np.full((18, 2), 100.0), 100 + shifts, capacity=32)
    assert score(VisualPhrases(length), matches) == sum(math.comb(m, length) for m in (6, 9, 3))


def test_lost_where_there_is_nothing_to_weigh():
    points = np.array([[20, 5], [30, 9], [70, 9.0]])
    for count, other, distance in ((3, points[::-1], 0.7), (1, points[1:2], 0.7), (3, points, 0.0)):
        assert score(LostScore(), make_matches(points[:count], other, distance=[distance] * count)) == 0
    two = make_matches(points[:2], points[1:], distance=[0.6, 0.9], capacity=8)
    assert score(LostScore(), two) > 20  # only the nearer weighs, and is proportional to itself
    origin = make_matches(np.zeros((3, 2)), points, distance=[0.2, 0.4, 0.6])
    d = np.array([0.02, 0.08, 0.18])
    expected = np.log1p(np.linalg.norm(0.18 - d) * 3 / d.sum())
    assert score(LostScore(), origin) == pytest.approx(expected, rel=1e-6)
