"""A small path with its matches, cut in two to learn on."""

import numpy as np

from mfvpr import Shortlist
from mfvpr.datasets import Positives
from mfvpr.evaluation import EvaluationProtocol, halves
from mfvpr.tuning.learning.splits import training_splits
from tests.builders import match_set_of, random_matches

QUERIES = 32
TOLERANCES = (0, 1, 2)  # frames; the middle one decides
SIZES = (96, 200)  # px, of every other image: the first is the smaller


def path(*, sizes=SIZES, only_right=(), seed=0):
    """Protocol, matches, candidates: all frames are those of every query, in an order of its own; of some, one is."""
    rng = np.random.default_rng(seed)
    indices = np.stack([rng.permutation(QUERIES) for _ in range(QUERIES)]).astype(np.int32)
    mask = ~np.isin(np.arange(QUERIES), only_right)[:, None] | (indices == np.arange(QUERIES)[:, None])
    scores = -np.sort(-rng.random(indices.shape).astype(np.float32), axis=1)
    candidates = Shortlist(indices=indices, scores=scores, mask=mask)
    pairs = [
        [random_matches(rng, int(rng.integers(4, 12)), sizes=((sizes[query % 2],) * 2, (sizes[row % 2],) * 2))
         for row in indices[query]]
        for query in range(QUERIES)
    ]  # fmt: skip
    apart = np.abs(np.arange(QUERIES)[:, None] - np.arange(QUERIES))
    positives = [Positives(apart <= tolerance) for tolerance in TOLERANCES]
    protocol = EvaluationProtocol(TOLERANCES, "frames", positives, positives[-1], halves(positives[-1]), split="both")
    return protocol, match_set_of(pairs, 16), candidates


def split(*, half=0, **options):
    """One half of it to learn on."""
    protocol, matches, candidates = path(**options)
    return training_splits(matches, candidates, protocol)[half]
