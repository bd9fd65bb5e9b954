"""Scores of whole data sets: on several devices, and of several scales."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr.evaluation import rankings, stages
from mfvpr.matchers import MatchSet, Scales
from mfvpr.matchers import match_set as match_sets
from mfvpr.tuning import sweeps
from tests import oracles
from tests.programs import ROOT
from tests.scorers import plain
from tests.tuning.test_sweep import CANDIDATES, QUERIES, make_set, rank

pytestmark = pytest.mark.thorough

SCORERS = {"sum": mfvpr.AggregatedScore(), "histogram": mfvpr.HistogramOfShifts(bin_size=40.0)}
WEIGHTS = (0.7, 0.3)


@pytest.fixture(scope="module")
def data():
    return make_set()


def select(matches, slots):
    entries = {name: values[slots] for name, values in match_sets.per_match(matches).items()}
    return replace(matches, **entries, mask=matches.mask[slots])


@pytest.fixture(scope="module")
def two_scales(data):
    """The second scale has fewer matches of its own, and a query that it says nothing of."""
    match_set, candidates = data
    keep = [np.arange(len(matches.mask)) % 3 > 0 for matches in match_set.matches]
    keep[1][:] = False
    ends = np.cumsum(match_set.counts, axis=1)
    counts = np.array([[part.sum() for part in np.split(k, e)[:-1]] for k, e in zip(keep, ends, strict=True)])
    fewer = [select(matches, slots) for matches, slots in zip(match_set.matches, keep, strict=True)]
    return Scales([match_set, MatchSet(fewer, counts, 64)], WEIGHTS), candidates


def devices_agree():
    """Runs in a process with 8 devices."""
    import jax

    from mfvpr.evaluation import stages

    match_sets.PAIRS_STEP = match_sets.BATCH_SLOTS = 2  # pairs of a batch
    match_set, candidates = make_set()
    devices = jax.devices()
    assert len(devices) == 8
    placed = []

    def program(matches):
        placed.append((matches.mask.shape, *matches.mask.devices()))
        return matches.mask.sum(axis=1)

    batches = stages.all_batches(match_set, range(QUERIES), settings=1)
    counts = stages.pair_scores(program, (), batches, (1, 1, QUERIES, CANDIDATES), devices, iter(()))
    np.testing.assert_array_equal(counts[0, 0], match_set.counts)
    assert {device for _, device in placed} == {*devices}
    assert {shape for shape, _ in placed} == {(2, 96)}

    runtimes = mfvpr.Runtime(), mfvpr.Runtime(devices[3:5])
    alone, shared = (stages.score({"a": plain}, match_set, candidates, runtime=runtime)["a"] for runtime in runtimes)
    np.testing.assert_array_equal(alone, shared, strict=True)
    assert len(np.unique(alone)) > CANDIDATES
    settings = [{"max_distance": limit, "c": 0.1} for limit in (0.8, 1.5)]
    alone, shared = (rank(plain, settings, match_set, candidates, runtime=on) for on in runtimes)
    np.testing.assert_array_equal(alone, shared)


def test_devices_share_the_batches_and_change_no_bit():
    code = "from tests.evaluation.test_batched_scoring import devices_agree; devices_agree()"
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, timeout=100, check=True)


def test_scores_of_scales_are_fused_over_the_candidates_of_a_query(two_scales):
    scales, candidates = two_scales
    fused = stages.score(SCORERS, scales, candidates)
    by_scale = [stages.score(SCORERS, match_set, candidates) for match_set in scales.match_sets]
    for name in SCORERS:
        assert not by_scale[1][name][1].any()
        assert fused[name].dtype == np.float32
        for query in range(QUERIES):
            scores = np.stack([scale_scores[name][query] for scale_scores in by_scale], axis=-1)
            expected = oracles.fuse_scales(scores, candidates.mask[query], WEIGHTS)
            np.testing.assert_allclose(fused[name][query], expected, rtol=1e-4, atol=1e-5)


def test_sweeps_fuse_scales_over_the_ranked_candidates(two_scales, tmp_path):
    scales, candidates = two_scales
    view = np.random.default_rng(1).random(candidates.mask.shape) < 0.7
    settings = sweeps.grid({"mean": ["unweighted", "median"], "c": [None, 0.5]})
    got = rank(
        SCORERS["sum"], settings, scales, candidates, views=[candidates.mask, view], ks=[CANDIDATES],
        queries_per_block=3, settings_per_block=1, folder=tmp_path,
    )  # fmt: skip
    for seen, by_setting in zip((candidates.mask, view & candidates.mask), got, strict=True):
        listed = replace(candidates, mask=seen)
        for rows, setting in zip(by_setting, settings, strict=True):
            scores = stages.score({"sum": mfvpr.AggregatedScore(mean=setting["mean"])}, scales, listed)["sum"]
            order = rankings.rank_shortlist(
                listed, np.asarray(rankings.fuse(listed.scores, scores, listed.mask, setting["c"]))
            )
            indices = np.where(seen, candidates.indices, -1)
            np.testing.assert_array_equal(rows, np.take_along_axis(indices, order, axis=1))
