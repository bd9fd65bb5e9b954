"""The matcher against the float64 loop: random, empty, single, tied and duplicated features."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mfvpr
from mfvpr import compact, filter_matches, match, match_candidates, retrieve
from mfvpr.core import matching
from mfvpr.core.types import per_keypoint, per_match, per_pair
from mfvpr.matchers import NearestNeighborMatcher, match_pairs
from tests import oracles
from tests.builders import make_features, random_matches, stack, unit
from tests.shapes import unchecked_shapes

pytestmark = pytest.mark.thorough

MODES = ["mutual", "opencv_legacy", "none", "candidate"]
# Compiled as a whole, not operation by operation: seconds, where every test has its own shapes.
match_once = jax.jit(match, static_argnames=("cross_check", "with_ratio"))
match_candidates_once = jax.jit(match_candidates, static_argnames=("cross_check", "with_ratio", "chunk_size"))
match_pairs_once = jax.jit(match_pairs)
PAIRS = np.array([(0, 1), (0, 0)], np.int32)
compact_once = jax.jit(compact, static_argnames="capacity")


def assert_pairs(matches, expected):
    """The same keypoints are matched, in the same order."""
    index0, index1 = (getattr(matches, name)[matches.mask] for name in ("index0", "index1"))
    assert list(zip(index0, index1, strict=True)) == [(i, j) for i, j, _ in expected]


@st.composite
def feature_pairs(draw):
    """Two images; with `ties` the descriptors are one-hot, so that equal similarities are exactly equal."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    counts = draw(st.tuples(*[st.sampled_from([0, 1, 2, 9, 30])] * 2))
    pair = [make_features(rng, count, capacity=32) for count in counts]
    if draw(st.booleans()):
        for features in pair:
            real = features.mask
            features.descriptors[real] = np.eye(16, dtype=np.float32)[rng.integers(0, 4, real.sum())]
    return pair


@given(feature_pairs(), st.sampled_from(MODES))
def test_agrees_with_the_oracle(pair, mode):
    features0, features1 = pair
    expected = oracles.nearest(features0.descriptors[features0.mask], features1.descriptors[features1.mask], mode)
    matches = match_once(features0, features1, cross_check=mode)
    assert_pairs(matches, expected)
    for side, features in enumerate(pair):
        index = np.array([places[side] for places in expected], int)
        for name, values in (("points", features.keypoints), ("scores", features.scores)):
            np.testing.assert_array_equal(getattr(matches, f"{name}{side}")[matches.mask], values[index])
        assert getattr(matches, f"index{side}").dtype == np.int32
    np.testing.assert_allclose(matches.distance[matches.mask], [d for _, _, d in expected], atol=1e-6)
    assert (matches.count0, matches.count1) == (features0.mask.sum(), features1.mask.sum())


@pytest.mark.parametrize("chunk_size", [None, 1, 2, 3, 5, 50])
def test_every_chunk_size_gives_the_loop(chunk_size):
    rng = np.random.default_rng(2)
    query = make_features(rng, 20, capacity=24)
    candidates = [make_features(rng, count, capacity=30) for count in (30, 0, 7, 1, 22)]
    got = match_candidates_once(query, stack(candidates), with_ratio=True, chunk_size=chunk_size)
    for row, candidate in enumerate(candidates):
        alone = match_once(query, candidate, with_ratio=True)
        np.testing.assert_array_equal(got.mask[row], alone.mask)
        np.testing.assert_allclose(got.distance[row], alone.distance, atol=1e-6)
        np.testing.assert_allclose(got.ratio[row], alone.ratio, rtol=1e-6)
        np.testing.assert_array_equal(got.points1[row][alone.mask], np.asarray(alone.points1)[alone.mask])


@pytest.mark.optimized
def test_similarities_of_all_candidates_never_exist_at_once_on_a_cpu():
    """The compiled program's temporary memory is one similarity matrix or two, not fifty."""
    num, candidates = 256, 50
    image = make_features(np.random.default_rng(0), num, dimension=64)
    batch = stack([image] * candidates)
    compiled = jax.jit(match_candidates).lower(image, batch).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 6 * num * num * 4


@given(st.integers(0, 2**32 - 1), st.sampled_from([None, 0.7, 3]), st.sampled_from([None, 0, 1, 10, 99]))
def test_filter_keeps_the_closest(seed, max_distance, max_matches):
    """Up to a distance, or to the one of match 3, which stays."""
    matches = random_matches(np.random.default_rng(seed), 40, capacity=50)
    max_distance = matches.distance[3] if max_distance == 3 else max_distance
    distance = np.where(matches.mask, matches.distance, np.inf)
    keep = distance <= (np.inf if max_distance is None else max_distance)
    order = np.argsort(np.where(keep, distance, np.inf), kind="stable")
    keep &= np.isin(np.arange(50), order[: 50 if max_matches is None else max_matches]) & matches.mask
    got = filter_matches(matches, max_distance=max_distance, max_matches=max_matches)
    np.testing.assert_array_equal(got.mask, keep)


def test_compact_moves_real_matches_to_the_front_in_order():
    matches = random_matches(np.random.default_rng(4), 60)
    scattered = filter_matches(matches, max_distance=1.0)
    real_slots = np.flatnonzero(scattered.mask)
    for capacity in (len(real_slots), len(real_slots) + 5, 10):
        tight = compact_once(scattered, capacity)
        real = real_slots[:capacity]
        assert tight.mask.sum() == len(real)
        assert tight.points0.shape == (capacity, 2)
        np.testing.assert_array_equal(tight.points1[: len(real)], matches.points1[real])
        for name in ("distance", "ratio", "confidence"):
            np.testing.assert_array_equal(getattr(tight, name)[: len(real)], getattr(matches, name)[real])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("counts", [(0, 0), (0, 5), (5, 0)])
def test_images_without_a_single_slot(mode, counts):
    features0, features1 = (make_features(np.random.default_rng(6), count) for count in counts)
    batch, matcher = stack([features1] * 5), NearestNeighborMatcher(mode)
    for matches in (
        match_once(features0, features1, cross_check=mode),
        match_candidates_once(features0, batch, cross_check=mode),
        match_candidates_once(features0, batch, cross_check=mode, chunk_size=2),
        match_pairs_once(jax.tree.map(lambda leaf: leaf[None], features0), batch, PAIRS, 2, matcher),
    ):
        assert matches.mask.shape[-1] == counts[mode == "candidate"]
        assert not matches.mask.any()
    assert compact_once(match_once(features0, features1), 4).mask.shape == (4,)


@pytest.mark.parametrize("mode", MODES)
def test_padding_is_not_nearer_than_what_looks_the_opposite(mode):
    """Padding's similarity is taken for 0 at first, which wins over those below."""
    rng = np.random.default_rng(14)
    pair = [make_features(rng, count, capacity=32) for count in (5, 9)]
    for features, sign in zip(pair, (1, -1), strict=True):
        descriptors = sign * np.abs(rng.normal(size=features.descriptors.shape)).astype(np.float32)
        features.descriptors[features.mask] = unit(descriptors)[features.mask]
    real = [features.descriptors[features.mask] for features in pair]
    assert (real[0] @ real[1].T).max() < 0
    matches = match_once(*pair, cross_check=mode, with_ratio=True)
    assert_pairs(matches, oracles.nearest(*real, mode))
    alone = [
        replace(image, **{name: values[image.mask] for name, values in per_keypoint(image).items()}) for image in pair
    ]
    ratio = match_once(*alone, cross_check=mode, with_ratio=True).ratio
    slots = np.flatnonzero(pair[mode == "candidate"].mask)
    np.testing.assert_allclose(np.asarray(matches.ratio)[slots], ratio, atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_broken_descriptor_costs_its_own_matches_only(mode, value):
    rng = np.random.default_rng(7)
    features0, features1 = make_features(rng, 12), make_features(rng, 10)
    unbroken = match_once(features0, features1, cross_check=mode)
    features1.descriptors[4, 2] = value
    features0.descriptors[3, 0] = value
    rest0, rest1 = np.delete(features0.descriptors, 3, axis=0), np.delete(features1.descriptors, 4, axis=0)
    expected = [(i + (i >= 3), j + (j >= 4), d) for i, j, d in oracles.nearest(rest0, rest1, mode)]
    assert_pairs(match_once(features0, features1, cross_check=mode), expected)
    assert unbroken.mask.sum() >= len(expected)


@pytest.mark.optimized
def test_half_precision_gives_what_single_precision_of_the_same_values_gives():
    rng = np.random.default_rng(4)
    pair = [make_features(rng, 60, dimension=64) for _ in range(2)]
    half = jax.tree.map(lambda leaf: leaf if leaf.dtype == bool else leaf.astype(np.float16), pair)
    single = jax.tree.map(lambda leaf: leaf if leaf.dtype == bool else leaf.astype(np.float32), half)
    jax.tree.map(partial(np.testing.assert_array_equal, strict=True), match_once(*half), match_once(*single))
    descriptors = [features.descriptors for features in half]
    lists = [retrieve(*(values.astype(kind) for values in descriptors), num_candidates=9) for kind in ("f2", "f4")]
    np.testing.assert_array_equal(lists[0].indices, lists[1].indices)
    np.testing.assert_array_equal(lists[0].scores, lists[1].scores)


def test_whoever_calls_it_matching_compiles_once(compilations):
    rng = np.random.default_rng(6)
    query, *candidates = (make_features(rng, 20) for _ in range(5))
    batch, matcher = stack(candidates), NearestNeighborMatcher(max_matches=7)
    calls = [
        lambda limit: match_candidates(query, batch),
        lambda limit: match_candidates(query, batch, with_ratio=True),
        lambda limit: match_pairs(batch, batch, PAIRS, int(limit) + 1, replace(matcher, max_distance=limit)),
        lambda limit: retrieve(query.descriptors, batch.descriptors[0], num_candidates=3),
    ]
    for call in calls:
        call(1.0)
    compilations.reset()
    for call in calls:
        call(0.7)
    assert compilations.count == 0


@pytest.mark.optimized
@pytest.mark.parametrize("chunk_size", [None, 1, 2, 3, 9])
def test_pairs_are_matched_as_each_of_them(chunk_size):
    """Whatever their number, and the number of those that are done at a time; pairs beyond the count have none."""
    rng = np.random.default_rng(7)
    queries, candidates = (
        [make_features(rng, count, capacity=20) for count in counts] for counts in ((20, 7), (18, 0, 20))
    )
    pairs = np.array([(0, 0), (1, 2), (0, 1), (1, 0), (0, 2), (0, 0), (1, 1)], np.int32)
    for count in (0, 1, 5, 7):
        matcher = NearestNeighborMatcher(max_distance=1.1, max_matches=3, chunk_size=chunk_size)
        got = match_pairs(stack(queries), stack(candidates), pairs, count, matcher)
        for place, (query, candidate) in enumerate(pairs[:count]):
            alone = match_once(queries[query], candidates[candidate], with_ratio=True)
            expected = filter_matches(alone, max_distance=1.1, max_matches=3)
            mask = np.asarray(expected.mask)
            np.testing.assert_array_equal(got.mask[place], mask)
            for name, values in per_match(expected).items():
                np.testing.assert_array_equal(np.asarray(getattr(got, name))[place][mask], np.asarray(values)[mask])
            for name, value in per_pair(expected).items():
                np.testing.assert_array_equal(getattr(got, name)[place], value)
        assert not got.mask[count:].any()


def test_a_chunk_is_what_fits_where_the_data_are(monkeypatch):
    """On a processor one pair, whose matrix stays in its cache; elsewhere a share of the device's memory."""
    rng = np.random.default_rng(8)
    batch = jax.tree.map(lambda leaf: leaf[None], make_features(rng, 30))
    for memory, expected in ((None, 1), (80 * 2**30, 80 * 2**30 // 256 // (4 * 20 * 30 + 1)), (10**5, 1)):
        monkeypatch.setattr(matching, "device_bytes", lambda tree: memory)  # noqa: B023
        assert matching.pairs_at_once(None, make_features(rng, 20), batch) == expected
        assert matching.pairs_at_once(7, make_features(rng, 20), batch) == 7
    with pytest.raises(ValueError, match=r"chunk_size=0: .*above 0"):
        match_candidates(make_features(rng, 20), batch, chunk_size=0)
    with pytest.raises(ValueError, match="expected one of mutual"):
        match_candidates(make_features(rng, 20), batch, cross_check="mutal")
    with pytest.raises(ValueError, match=r"query \[N0\] .*candidates \[C, N1\]"):
        match_candidates(make_features(rng, 20), make_features(rng, 20))


def test_image_sizes_stay_on_the_host():
    """Scorers need them there; a copy from an accelerator would wait for the matches."""
    rng = np.random.default_rng(0)
    query, candidates = jax.device_put((make_features(rng, 9), stack([make_features(rng, 9) for _ in range(3)])))
    matches = match_candidates(query, candidates)
    assert {type(matches.image_size0), type(matches.image_size1)} == {np.ndarray}
    np.testing.assert_array_equal(matches.image_size0, np.tile(query.image_size, (3, 1)))
    np.testing.assert_array_equal(matches.image_size1, candidates.image_size)
    assert match_candidates(replace(query, image_size=None), candidates).image_size0 is None


def test_image_sizes_stay_known_under_a_callers_jit():
    """So that capacities that follow from them need not be set."""
    rng = np.random.default_rng(0)
    query, candidates = make_features(rng, 9), stack([make_features(rng, 9) for _ in range(3)])
    scorer, pairs = mfvpr.HistogramOfShifts(), np.array([[0, 0], [0, 1], [0, 2]], np.int32)
    several = jax.tree.map(lambda leaf: leaf[None], query)

    def score(keypoints):
        moved = replace(query, keypoints=keypoints)
        in_pairs = mfvpr.match_pairs(replace(several, keypoints=keypoints[None]), candidates, pairs, 3)
        first = jax.tree.map(lambda leaf: leaf[0], candidates)
        batches = mfvpr.match_candidates(moved, candidates), in_pairs
        return *(mfvpr.score_candidates(scorer, matches) for matches in batches), scorer(match(moved, first))

    for got, expected in zip(jax.jit(score)(query.keypoints), score(query.keypoints), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-6)


@pytest.mark.parametrize("pairs", [[[0, 3]], [[0, -1]], [[0, 1, 2]], np.zeros((0, 2), int)])
def test_pairs_of_images_that_are_not_there_are_refused(pairs):
    rng = np.random.default_rng(0)
    queries, candidates = (stack([make_features(rng, 5) for _ in range(count)]) for count in (1, 3))
    with unchecked_shapes(), pytest.raises(mfvpr.InputError, match=r"^pairs: expected rows of [^\n]*$"):
        mfvpr.match_pairs(queries, candidates, np.array(pairs), 1)
