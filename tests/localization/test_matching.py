"""Matches and scores of a query with its candidates."""

import numpy as np

import mfvpr
from mfvpr.localization.map import match_and_score
from tests.builders import make_features


def test_a_pair_is_padded_by_its_own_keypoints_and_is_the_same_alone():
    rng, sizes = np.random.default_rng(0), set()

    def matcher(query, candidate):
        sizes.add((len(query.mask), len(candidate.mask)))
        return mfvpr.match(query, candidate, with_ratio=True)

    query, scorers = make_features(rng, 40), {"it": mfvpr.MatchCount()}
    images = [make_features(rng, count) for count in (600, *[300] * 9)]
    matches, scores = match_and_score(query, images, matcher, scorers, 300)
    assert sizes == {(256, 320), (256, 1024)}
    for number in (0, 1, 9):
        [alone], alone_scores = match_and_score(query, [images[number]], matcher, scorers, 300)
        np.testing.assert_array_equal(alone.points1, matches[number].points1)
        np.testing.assert_array_equal(alone_scores["it"], scores["it"][[number]])
        assert matches[number].mask.any()
