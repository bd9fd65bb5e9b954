"""LightGlue as a matcher: what becomes of an assignment, alone and in batches, in evaluations and in stores."""

from dataclasses import replace
from functools import cache, partial

import jax
import numpy as np
import pytest

import mfvpr
from mfvpr import InputError, LightGlueMatcher, NearestNeighborMatcher
from mfvpr.core.types import per_keypoint, per_match
from mfvpr.evaluation import Pipeline, stages
from mfvpr.features import FeatureSet, Scale, Sift
from mfvpr.matchers.match_set import split_rows
from mfvpr.networks.lightglue import assignment
from mfvpr.retrieval import ShortlistFiles
from mfvpr.storage.cache_files import MatchStore
from mfvpr.utils import recipe_of
from tests.builders import make_shortlist, stack
from tests.golden.make_lightglue import SIZES, SMALL, pair
from tests.networks.test_lightglue import match_one, padded, small_network

pytestmark = pytest.mark.thorough

INPUTS = SMALL["inputs"]
COUNTS = SIZES[0]
OPTIONS = {"filter_threshold": 1e-3}  # random weights are sure of little


@cache
def matcher(sure=None, seed=0, **options):
    return LightGlueMatcher.of(small_network(seed, sure), **OPTIONS | options)


def empty(features):
    """The image without a single slot."""
    return replace(features, **{name: values[:0] for name, values in per_keypoint(features).items()})


def rows(matches):
    """The real matches, field by field."""
    real = np.asarray(matches.mask)
    return {name: np.asarray(values)[real] for name, values in per_match(matches).items()}


def assert_same_rows(actual, expected):
    assert actual.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_allclose(actual[name], values, rtol=0, atol=1e-5, err_msg=name)


@pytest.mark.optimized
def test_matches_are_the_largest_of_their_row_and_column_and_above_the_threshold():
    features0, features1 = pair(COUNTS, INPUTS, 0)
    matches = match_one(matcher(), features0, features1)
    assigned = np.exp(np.asarray(jax.jit(assignment)(matcher().weights, features0, features1)))
    expected = [
        (row, column)
        for row, column in np.ndindex(assigned.shape)
        if assigned[row, column] == max(assigned[row].max(), assigned[:, column].max()) and assigned[row, column] > 1e-3
    ]
    matched_rows = rows(matches)
    assert len(expected) > 3
    assert [*zip(matched_rows["index0"], matched_rows["index1"], strict=True)] == expected
    row, column = np.array(expected).T
    np.testing.assert_allclose(matched_rows["confidence"], assigned[row, column], rtol=1e-6)
    np.testing.assert_array_equal(matched_rows["points1"], features1.keypoints[column])
    np.testing.assert_array_equal(matched_rows["scores0"], features0.scores[row])
    difference = features0.descriptors[row] - features1.descriptors[column]
    np.testing.assert_allclose(matched_rows["distance"], np.linalg.norm(difference, axis=1), atol=1e-6)
    alone = jax.jit(partial(mfvpr.match, with_ratio=True))(features0, features1)
    np.testing.assert_array_equal(matches.ratio, alone.ratio)
    fewer = rows(
        match_one(matcher(filter_threshold=float(np.median(matched_rows["confidence"]))), features0, features1)
    )
    assert 0 < len(fewer["index0"]) < len(expected)


@pytest.mark.optimized
@pytest.mark.slow
@pytest.mark.parametrize("chunk_size", [None, 3])
def test_a_pair_depends_neither_on_its_batch_nor_on_its_padding(chunk_size):
    """Also where some pairs of a chunk stop early, and what is padding holds NaN."""
    images = [side for counts in (COUNTS, (9, 30), (24, 1)) for side in pair(counts, INPUTS, 4)]
    numbers = np.array([(0, 1), (2, 3), (4, 5), (0, 3), (2, 1), (4, 1), (0, 5)], np.int32)
    sure = matcher(0, depth_confidence=0.95, chunk_size=chunk_size)
    for capacity, garbage in ((31, np.nan), (64, np.inf)):
        batch = stack([padded(image, capacity, garbage) for image in images])
        matches = mfvpr.match_pairs(batch, batch, numbers, 6, sure)
        assert matches.mask.sum() > 10
        assert not matches.mask[6].any()
        for place, (query, candidate) in enumerate(numbers[:6]):
            alone = rows(match_one(sure, padded(images[query], 40, -1e9), padded(images[candidate], 40, 0)))
            image = jax.tree.map(lambda leaf, place=place: np.asarray(leaf)[place], matches)
            assert_same_rows(rows(image), alone)
            assert (image.count0, image.count1) == (len(images[query].mask), len(images[candidate].mask))


def test_images_without_keypoints_have_no_matches():
    features0, features1 = pair(COUNTS, INPUTS, 0)
    nobody = replace(features1, mask=np.zeros(COUNTS[1], bool))
    for unmatchable in (nobody, empty(features1)):
        assert not match_one(matcher(), features0, unmatchable).mask.any()
        assert not match_one(matcher(), unmatchable, features0).mask.any()


# In evaluations and stores


def sets():
    sides = zip(*(pair(counts, INPUTS, 7) for counts in ((20, 31), (12, 25), (30, 8))), strict=True)
    queries, database = ([*side] for side in sides)
    queries.append(empty(queries[0]))
    return FeatureSet.of(queries), FeatureSet.of(database)


SHORTLIST = make_shortlist([[0, 2], [1, 0], [-1, -1], [0, 1]])


@pytest.mark.slow
def test_stores_keep_the_confidence_for_the_scorers(tmp_path):
    queries, database = sets()
    in_memory = stages.match(queries, database, SHORTLIST, matcher())
    stored = stages.match(queries, database, SHORTLIST, matcher(), store=MatchStore(tmp_path, {"of": "any"}, 4))
    for match_set in (in_memory, stored):
        assert match_set.counts[:2].all()
        assert not match_set.counts[2:].any()
        for query, place in np.ndindex(2, 2):
            row = SHORTLIST.indices[query, place]
            alone = rows(match_one(matcher(), padded(queries[query], 32), padded(database[row], 32)))
            in_set = split_rows(per_match(match_set.matches[query]), match_set.counts[query])[place]
            assert_same_rows(in_set, alone)
        sure = replace(match_set, matches=[replace(matches, confidence=None) for matches in match_set.matches])
        scorers = {"histogram": mfvpr.HistogramOfShifts()}
        less, more = (stages.score(scorers, matches, SHORTLIST)["histogram"] for matches in (match_set, sure))
        assert (less[:2] < more[:2]).all()


def test_what_changes_matches_changes_their_recipe():
    changed = matcher(seed=1), matcher(filter_threshold=0.2), matcher(depth_confidence=0.9)
    recipes = [str(recipe_of(matching)) for matching in (NearestNeighborMatcher(), matcher(), *changed)]
    assert len({*recipes}) == len(recipes)
    assert recipes[1] == str(recipe_of(matcher(chunk_size=5)))
    assert recipes[1] == str(recipe_of(LightGlueMatcher.of(small_network(), **OPTIONS)))


class Extractor:
    def __init__(self, *dimensions):
        self.scales = tuple(Scale(dimension, 100) for dimension in dimensions)


def test_features_of_another_kind_are_one_line():
    expected = "^LightGlue: expected ALIKED's features, of 16 dimensions, got {}; "
    retriever = ShortlistFiles({})
    with pytest.raises(InputError, match=expected.format("Sift of 128")):
        Pipeline(Sift(), retriever, matcher())
    Pipeline(Extractor(16), retriever, matcher())
    Pipeline(Extractor(0), retriever, matcher())  # not known before they are read
    with pytest.raises(InputError, match=r"^LightGlue: .*16 dimensions, got 8\b"):
        match_one(matcher(), *pair(COUNTS, 8, 0))
    with pytest.raises(InputError, match=r"^depth_confidence=95: .*0 to 1, or null$"):
        Pipeline(Extractor(16), retriever, matcher(depth_confidence=95))
    with pytest.raises(InputError, match=r"^matcher: .*got <class .*NearestNeighborMatcher.*mfvpr.Matcher"):
        Pipeline(Extractor(16), retriever, NearestNeighborMatcher)
