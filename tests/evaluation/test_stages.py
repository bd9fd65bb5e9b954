"""The way over a data set, stage by stage, on a synthetic street and on broken images."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from PIL import Image

import mfvpr
from mfvpr.datasets import image_folder
from mfvpr.evaluation import rankings, stages
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.matchers import match_set as match_sets
from mfvpr.retrieval import Retrieval
from mfvpr.retrieval.search import EXACT
from mfvpr.storage import FeatureCache
from mfvpr.storage.cache_files import MatchStore
from mfvpr.tuning.sweeps import rank_settings
from tests.scorers import FOREIGN, OWN, one_of_each_class, title
from tests.storage.synthetic_features import assert_same_match_sets
from tests.tuning.test_sweep import make_set

pytestmark = pytest.mark.thorough

SIFT = Sift(max_keypoints=400)


@pytest.fixture(scope="module")
def features(dataset):
    return [FeatureCache().local(folder, SIFT)[0] for folder in (dataset.database, dataset.queries)]


@pytest.fixture(scope="module")
def candidates(dataset):
    vlad = Retrieval(Aggregated(SIFT, VladFitting(num_words=8)))
    return vlad.shortlist(dataset.only, dataset.database, 6, FeatureCache()).candidates


@pytest.fixture(scope="module")
def matches(features, candidates):
    return stages.match(features[1], features[0], candidates)


def open_store(folder, num_queries=10):
    return MatchStore(folder / "store", {"name": "street"}, num_queries)


@pytest.mark.slow
def test_a_store_gives_what_was_matched_and_is_read_ever_after(features, candidates, matches, tmp_path, monkeypatch):
    first, store = stages.match(features[1], features[0], candidates, store=open_store(tmp_path)), open_store(tmp_path)
    runtime = mfvpr.Runtime(progress=lambda label: lambda *_: pytest.fail("again"))
    again = stages.match(features[1], features[0], candidates, store=store, runtime=runtime)
    alone, stored = stages.stored_matches(store)
    read_again, _ = stages.stored_matches(store, memory=1e-5)
    assert isinstance(read_again.matches, MatchStore)
    assert len(read_again.matches) == len(first)
    assert_same_match_sets(first, matches)
    assert ((first[0].ratio > 0) == first[0].mask).all()
    for later in (again, alone, read_again, read_again.take(range(10))):
        assert_same_match_sets(later, first)
        np.testing.assert_array_equal(later.image_sizes, first.image_sizes)
    jax.tree.map(np.testing.assert_array_equal, stored, candidates)
    scorers = {"h": mfvpr.HistogramOfShifts(), "a": mfvpr.AnchorPoints(), "s": mfvpr.AggregatedScore()}
    fresh = stages.score(scorers, matches, candidates)
    for stored_matches in (alone, read_again):
        jax.tree.map(np.testing.assert_array_equal, stages.score(scorers, stored_matches, candidates), fresh)
    monkeypatch.setattr(match_sets, "BLOCK_BYTES", 1)  # a query at a time
    one_by_one = stages.score(scorers, read_again, candidates)
    jax.tree.map(np.testing.assert_array_equal, one_by_one, fresh)
    rows = [rank_settings(scorers["h"], [{"sigma": 9.0}], match_set, candidates) for match_set in (matches, read_again)]
    np.testing.assert_array_equal(*rows)


def test_matches_of_another_shortlist_or_that_are_damaged_are_made_again(features, candidates, matches, tmp_path):
    store, other = open_store(tmp_path), replace(candidates, indices=candidates.indices[:, ::-1].copy())
    stages.match(features[1], features[0], candidates, store=store)
    stages.match(features[1], features[0], other, store=store)
    np.testing.assert_array_equal(stages.stored_matches(store)[1].indices, other.indices)
    assert_same_match_sets(stages.match(features[1], features[0], candidates, store=store), matches)
    next(store.folder.rglob("*3.npz")).write_bytes(b"damaged")
    assert stages.stored_matches(store) is None
    assert_same_match_sets(stages.match(features[1], features[0], candidates, store=store), matches)


def test_skipped_images_are_listed_and_never_shortlisted(small_street, tmp_path):
    """A good image, an empty one, a truncated one, one without keypoints, and the good one again."""
    good = Image.open(small_street / "database" / "0000.png")
    good.save(tmp_path / "0.png")
    (tmp_path / "1.png").write_bytes(b"")
    good.save(tmp_path / "2.jpg")
    (tmp_path / "2.jpg").write_bytes((tmp_path / "2.jpg").read_bytes()[:900])
    Image.new("RGB", (50, 40), (9, 9, 9)).save(tmp_path / "3.png")
    good.save(tmp_path / "4.png")
    mixed, cache = image_folder(tmp_path), FeatureCache(skip_bad=True)
    vlad = Aggregated(SIFT, VladFitting(num_words=4))
    [features] = cache.local(mixed, SIFT)
    assert sorted(features.bad) == [1, 2]
    assert not features.counts[[1, 2, 3]].any()
    descriptors = cache.vectors(mixed, vlad, mixed).values
    candidates = EXACT.shortlist(descriptors, descriptors, 5)
    np.testing.assert_array_equal(candidates.indices[0], [0, 4, 3, -1, -1])
    np.testing.assert_array_equal(candidates.indices[1], [-1] * 5)
    matches = stages.match(features, features, candidates)
    store = open_store(tmp_path, 5)
    assert_same_match_sets(stages.match(features, features, candidates, store=store), matches)
    np.testing.assert_array_equal(stages.stored_matches(store)[1].mask, candidates.mask)
    scores = stages.score({"h": mfvpr.HistogramOfShifts(), "a": mfvpr.AnchorPoints()}, matches, candidates)
    for values in scores.values():
        assert values[0, 0] == values[0, 1] > 0
        assert values[0, 2] == 0.0  # no keypoints, no matches
        assert np.isnan(values[0, 3:]).all()
        np.testing.assert_array_equal(rankings.rank_shortlist(candidates, values)[0], range(5))


def test_numbers_cost_no_compilation_within_a_capacity(features, candidates, matches, compilations):
    def scores(sigma, bin_size, window, tolerance):
        scorers = {
            "histogram": mfvpr.HistogramOfShifts(sigma=sigma, bin_size=bin_size),
            "anchor": mfvpr.AnchorPoints(window=window, tolerance=tolerance),
        }
        return stages.score(scorers, matches, candidates)

    first = scores(22.5, 15.0, 10, 3.0)  # 672 px in 45 bins: a capacity of 48
    compilations.reset()
    second = scores(10, 14.5, 4, 1)
    assert compilations.count == 0
    assert all((first[name] != second[name]).any() for name in first)
    scores(10, 13.0, 4, 1)  # 52 bins: the next capacity, one program more
    assert compilations.count == 1


@pytest.mark.first_case
@pytest.mark.parametrize("scorer", one_of_each_class([*OWN, *FOREIGN]), ids=title)
def test_every_scorer_on_images_of_two_sizes_with_a_confidence(scorer):
    match_set, listed = make_set()
    got = stages.score({"it": scorer}, match_set, listed)["it"]
    for query, mask in enumerate(listed.mask):
        expected = np.where(mask, mfvpr.score_candidates(scorer, match_set[query]), np.nan)
        np.testing.assert_allclose(got[query], expected, rtol=2e-6)
    assert np.isfinite(got[listed.mask]).all()
    assert got[listed.mask].any()
