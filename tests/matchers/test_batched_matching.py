"""Matching of whole shortlists: every pair as it is matched alone, bit for bit, whatever the way it went."""

import gc
import json
import os
import subprocess
import sys
import weakref
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import jax
import numpy as np
import pytest

import mfvpr
from mfvpr import Matches
from mfvpr.core import filter_matches
from mfvpr.core.types import Shortlist, per_match
from mfvpr.evaluation import stages
from mfvpr.evaluation.rankings import rank_shortlist
from mfvpr.features import FeatureSet, InMemory
from mfvpr.matchers import NearestNeighborMatcher
from mfvpr.matchers.match_set import QUERIES, batches, shapes, slots, split_rows
from mfvpr.storage.cache_files import round_as_stored
from tests.builders import make_features, make_shortlist
from tests.features.test_feature_set import Counting

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).parents[2]
COUNTS0 = [20, 30, 20, 0] * 5
COUNTS1 = [20, 20, 0, 100] * 20  # two capacities, and images without keypoints
CANDIDATES = 12
SMALL = 1e-9  # GB: as few slots as there may be


def images_of(counts, seed, *, longest=1.0):
    """Images with descriptors around common centers, so that many match; of lengths up to `longest`."""
    rng = np.random.default_rng(seed)
    centers = np.random.default_rng(0).normal(size=(60, 16))
    images = []
    for number, count in enumerate(counts):
        values = centers[rng.integers(0, 60, count)] + rng.normal(0, 0.3, (count, 16))
        values *= rng.uniform(1, longest, (count, 1)) / np.linalg.norm(values, axis=1, keepdims=True)
        image = make_features(rng, count, size=300 + 100 * seed + number)  # no two images have the same size
        images.append(replace(image, descriptors=values.astype(np.float32)))
    return images


def shortlist_of(seed=0, queries=20, database=80):
    """Rows in any order; the second query has no candidates, the fourth fewer, the fifth one of them twice."""
    rng = np.random.default_rng(seed)
    indices = np.array([rng.permutation(database)[:CANDIDATES] for _ in range(queries)], np.int32)
    indices[1:2] = -1
    indices[3:4, 5:] = -1
    indices[4:5, 1] = indices[4:5, 0] = 3
    return Shortlist(indices, rng.random(indices.shape, np.float32), indices >= 0)


@cache
def sets(longest=1.0):
    sides = (images_of(counts, seed, longest=longest) for seed, counts in enumerate((COUNTS0, COUNTS1)))
    return tuple(FeatureSet.of(images, unit_length=False) for images in sides)


alone = jax.jit(mfvpr.match, static_argnames=("cross_check", "with_ratio"))


def expected_of(queries, database, candidates, *, max_distance=None, max_matches=None, **options):
    """Rows of matches of the two images by themselves, by query and candidate."""
    rows = {}
    for query, row in np.ndindex(candidates.indices.shape):
        index = candidates.indices[query, row]
        if index >= 0 and queries.counts[query] and database.counts[index]:
            matches = alone(queries[query], database[index], with_ratio=True, **options)
            matches = filter_matches(matches, max_distance=max_distance, max_matches=max_matches)
            real = np.asarray(matches.mask)
            rows[query, row] = {name: np.asarray(values)[real] for name, values in per_match(matches).items()}
    return rows


def assert_as_alone(match_set, queries, database, candidates, expected):
    assert len(match_set) == len(queries)
    assert match_set.counts.shape == candidates.indices.shape
    for query, flat in enumerate(match_set.matches):
        rows = split_rows(per_match(flat), match_set.counts[query])
        for place, index in enumerate(candidates.indices[query]):
            row = expected.get((query, place))
            if row is None:
                assert match_set.counts[query, place] == 0
            else:
                assert rows[place].keys() == row.keys()
                for name, values in row.items():
                    np.testing.assert_array_equal(rows[place][name], values, err_msg=name)
                np.testing.assert_array_equal(flat.image_size0, queries[query].image_size)
                np.testing.assert_array_equal(flat.image_size1[place], database[index].image_size)
            assert flat.count1[place] == (database.counts[index] if index >= 0 else 0)
        assert flat.count0 == queries.counts[query]
        assert flat.mask.all()


def assert_same(first, second):
    np.testing.assert_array_equal(first.counts, second.counts)
    assert first.capacity == second.capacity
    for left, right in zip(first.matches, second.matches, strict=True):
        for part in fields(Matches):
            np.testing.assert_array_equal(getattr(left, part.name), getattr(right, part.name), err_msg=part.name)


# Every pair


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"cross_check": "none"},
        {"max_distance": 0.6, "max_matches": 7},
        {"cross_check": "candidate"},
        {"cross_check": "opencv_legacy", "chunk_size": 3},
    ],
    ids=["mutual", "none", "filtered", "candidate", "chunks"],
)
@pytest.mark.parametrize("memory", [None, SMALL], ids=["all fits", "few slots"])
def test_every_pair_is_matched_as_alone(options, memory):
    queries, database = sets()
    candidates = shortlist_of()
    matcher, runtime = NearestNeighborMatcher(**options), mfvpr.Runtime(memory=memory)
    match_set = stages.match(queries, database, candidates, matcher, runtime=runtime)
    options = {name: value for name, value in options.items() if name != "chunk_size"}
    expected = expected_of(queries, database, candidates, **options)
    assert match_set.counts.sum() > 300
    assert match_set.counts[4, 0] == match_set.counts[4, 1] > 0
    assert_as_alone(match_set, queries, database, candidates, expected)


@pytest.mark.parametrize("longest", [1.0, 3.0])
def test_descriptors_of_any_length_and_queries_of_several_capacities(longest):
    database, queries = sets(longest)
    candidates = shortlist_of(2, len(queries), len(database))
    match_set = stages.match(queries, database, candidates, runtime=mfvpr.Runtime(memory=SMALL))
    assert (max(matches.distance.max(initial=0) for matches in match_set.matches) > 2) == (longest > 1)
    assert_as_alone(match_set, queries, database, candidates, expected_of(queries, database, candidates))


@pytest.mark.optimized
def test_features_that_are_read_on_demand_are_matched_as_those_in_memory():
    """And rows that are there are not read again."""
    candidates, stored, in_memory = shortlist_of(), [], []
    for side in sets():
        images = {row: round_as_stored(image) for row, image in side.source.read() if row % 10 != 4}
        stored.append(FeatureSet(Counting(InMemory(images, len(side))), {4: "bad"}))
        in_memory.append(FeatureSet(InMemory(images, len(side)), {4: "bad"}))
    match_set = stages.match(*stored, candidates, runtime=mfvpr.Runtime(memory=1))
    assert_same(match_set, stages.match(*in_memory, candidates))
    assert_as_alone(match_set, *in_memory, candidates, expected_of(*in_memory, candidates))
    # Each side looks at its first image once more, for the size of a keypoint.
    pairs = candidates.mask & (stored[0].counts > 0)[:, None] & (stored[1].counts[candidates.indices] > 0)
    for side, requested_rows in zip(stored, (np.nonzero(pairs)[0], candidates.indices[pairs]), strict=True):
        requested = set(requested_rows.tolist())
        reads = side.source.reads
        first = int(np.argmax(side.counts > 0))
        assert set(reads) == requested | {first}
        assert sum(reads.values()) == len(requested) + 1
    for side in stored:
        side.source.reads.clear()
    assert_same(stages.match(*stored, candidates, runtime=mfvpr.Runtime(memory=SMALL)), match_set)
    assert max(stored[1].source.reads.values()) > 1


def test_nothing_to_match():
    """Images without keypoints, and queries without candidates."""
    queries, database = sets()
    empty = FeatureSet.of(images_of([0, 0], 0))
    for side0, side1, rows in ((empty, database, [0, 1]), (queries, empty, [1, 0]), (empty, empty, [-1, -1])):
        match_set = stages.match(side0, side1, make_shortlist([rows] * len(side0)))
        assert match_set.counts.shape == (len(side0), 2)
        assert not match_set.counts.any()
        assert match_set[0].mask.shape == (2, 64)


def test_another_data_set_of_the_same_capacities_compiles_nothing(compilations):
    def matched(seed, change):
        counts0, counts1 = ([max(0, count - change) for count in counts] for counts in (COUNTS0, COUNTS1))
        sides = (FeatureSet.of(images_of(counts, seed)) for counts in (counts0, counts1))
        return stages.match(*sides, shortlist_of(seed), NearestNeighborMatcher(max_distance=1.0 - change / 10))

    matched(0, 0)
    compilations.reset()
    matched(1, 1)
    assert compilations.count == 0


def test_a_plain_function_is_compiled_once_for_all_queries(compilations):
    def near(query, candidate):
        return mfvpr.filter_matches(mfvpr.match(query, candidate), max_distance=0.9)

    for count in (QUERIES, 3 * QUERIES):
        queries, database = (FeatureSet.of(images_of([20] * number, number)) for number in (count, 40))
        candidates = shortlist_of(0, count, 40)
        compilations.reset()
        match_set = stages.match(queries, database, candidates, near)
        compiled = compilations.count
        value = stages.match(queries, database, candidates, NearestNeighborMatcher(max_distance=0.9))
        np.testing.assert_array_equal(match_set.counts, value.counts)
    assert compiled == 1  # all else was compiled for the first queries
    near, alive = None, weakref.ref(near)
    gc.collect()
    assert alive() is None


# Several devices


def for_devices():
    """Queries enough for eight devices, more candidates than there are slots, and few programs to compile."""
    queries, database = (FeatureSet.of(images_of([20] * count, count)) for count in (70, 40))
    return queries, database, shortlist_of(0, 70, 40)


def as_hex(match_set):
    return [np.asarray(leaf).tobytes().hex() for leaf in jax.tree.leaves(list(match_set.matches))]


def on_devices(out):
    """Rankings and matches, with eight devices and with one, as JSON."""
    queries, database, candidates = for_devices()
    results = []
    for devices, memory in ((jax.devices(), SMALL), (jax.devices()[-1:], SMALL), (None, None)):
        match_set = stages.match(queries, database, candidates, runtime=mfvpr.Runtime(devices, memory))
        scores = stages.score({"histogram": mfvpr.HistogramOfShifts()}, match_set, candidates)["histogram"]
        results.append({"ranking": rank_shortlist(candidates, scores).tolist(), "matches": as_hex(match_set)})
    Path(out).write_text(json.dumps({"devices": jax.device_count(), "results": results}))


@pytest.mark.slow
def test_eight_devices_give_what_one_gives(tmp_path):
    call = f"from tests.matchers.test_batched_matching import on_devices; on_devices({str(tmp_path / 'out.json')!r})"
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"
    subprocess.run(
        [sys.executable, "-c", call], cwd=ROOT, env=os.environ | {"XLA_FLAGS": flags}, timeout=120, check=True
    )
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["devices"] == 8
    first, *rest = content["results"]
    assert rest == [first, first]
    assert first["matches"] == as_hex(stages.match(*for_devices()))


# What comes out


@pytest.fixture(scope="module")
def match_set():
    return stages.match(*sets(), shortlist_of())


def test_batches_have_every_pair_with_matches_once(match_set):
    part = range(3, 15)
    counts = match_set.counts[3:15]
    seen = np.zeros(counts.size, int)
    allowed = shapes(match_set)
    for places, matches in batches(match_set, part):
        seen[places] += 1
        pairs, size = matches.mask.shape
        assert allowed[size] == pairs
        assert matches.mask.sum(axis=1).tolist() == [*counts.reshape(-1)[places], *[0] * (pairs - len(places))]
        for number, place in enumerate(places.tolist()):
            query, candidate = divmod(place, CANDIDATES)
            of_query = match_set[query + 3]
            real = matches.mask[number]
            for name, values in per_match(matches).items():
                expected = per_match(of_query)[name][candidate][of_query.mask[candidate]]
                np.testing.assert_array_equal(values[number][real], expected)
            np.testing.assert_array_equal(matches.image_size1[number], of_query.image_size1[candidate])
    np.testing.assert_array_equal(seen, counts.reshape(-1) > 0)
    assert (slots(match_set) >= match_set.counts).all()
