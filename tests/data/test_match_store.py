"""The match store: the very same bits come back, and what is refused. What all stores share: test_store_faults.py."""

import os
from dataclasses import fields, replace

import numpy as np
import pytest

from mfvpr import InputError, Matches
from mfvpr.data.match_store import CHUNK_ROWS, forecast_bytes, open_match_store
from mfvpr.data.store_manifest import MATCHES as KIND
from mfvpr.data.store_manifest import recipe_fingerprint, store_path
from tests.data.stores import (
    DAMAGE,
    MATCH_ARRAYS,
    MATCH_RECIPE,
    MATCHES,
    chunk_of,
    digests,
    fill,
    flip,
    matches_of,
    read_all,
)

PER_MATCH = ("points0", "points1", "distance", "scores0", "scores1", "ratio")


def assert_same_bits(got, expected):
    assert got.matches.confidence is None
    pairs = [
        *((getattr(got.matches, part.name), getattr(expected.matches, part.name)) for part in fields(Matches)[:-1]),
        *((getattr(got, name), getattr(expected, name)) for name in ("counts", "indices", "filter_scores")),
    ]
    for one, other in pairs:
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
        assert one.tobytes() == other.tobytes()


# What comes back


@pytest.mark.parametrize(
    "counts", [(30, 0, 25, 5), (0, 0, 0, 0), (0, 0, 0, 1), (CHUNK_ROWS, 0, 0, 0), (CHUNK_ROWS, 9000, 0, CHUNK_ROWS)]
)
def test_the_very_same_bits_come_back(tmp_path, counts):
    original = matches_of(7, counts)
    with MATCHES.open(tmp_path / "s", 3) as store:
        store.write({1: original})
        assert store.done.tolist() == [False, True, False]
        first = dict(store.read())
    later = read_all(tmp_path / "s", subject=MATCHES)
    assert list(first) == list(later) == [1]
    assert_same_bits(first[1], original)
    assert_same_bits(later[1], original)


def test_any_float_survives(tmp_path):
    """Bits drawn at random: infinities, every NaN, denormal numbers, both zeros."""
    rng, query = np.random.default_rng(0), matches_of(0, (20_000, 0, 1, 2))
    special = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 1e-45], np.float32).view(np.uint32)

    def anything(like):
        bits = rng.integers(0, 2**32, like.shape, np.uint32)
        bits.flat[: len(special)] = special[: bits.size]
        return bits.view(np.float32)

    flat = replace(query.matches, **{name: anything(getattr(query.matches, name)) for name in PER_MATCH})
    original = replace(query, matches=flat, filter_scores=np.full(4, np.nan, np.float32))
    with MATCHES.open(tmp_path / "s", 1) as store:
        store.write({0: original})
        assert_same_bits(dict(store.read())[0], original)


def test_rows_come_in_the_order_asked_for(tmp_path):
    fill(tmp_path / "s", 40, batch=20, subject=MATCHES)
    with MATCHES.open(tmp_path / "s", 40) as store:
        assert [row for row, _ in store.read()] == list(range(40))
        for row, found in store.read(reversed(range(40))):
            assert_same_bits(found, matches_of(row))
        with pytest.raises(ValueError, match="row 3 is done"):
            store.write({3: matches_of(3)})


def _flat(query, **changes):
    return replace(query, matches=replace(query.matches, **changes))


@pytest.mark.parametrize(
    ("row", "query", "message"),
    [
        (0, matches_of(0), "row 0 is done"),
        (3, matches_of(3), "does not exist"),
        (1, _flat(matches_of(1), ratio=None), "with their ratio"),
        (1, _flat(matches_of(1), mask=np.arange(60) < 50), "real matches"),
        (1, replace(matches_of(1), counts=np.array([30, 0, 25, 4], np.int32)), "as many as counted"),
        (1, matches_of(1, (3, 4, 5)), "expected 4 candidates"),
    ],
)
def test_what_cannot_be_stored_is_refused_before_anything_is_written(tmp_path, row, query, message):
    with MATCHES.open(tmp_path / "s", 3) as store:
        store.write({})
        store.write({0: matches_of(0)})
        before = digests(tmp_path / "s")
        with pytest.raises(ValueError, match=message):
            store.write({2: matches_of(2), row: query})
        assert digests(tmp_path / "s") == before
        assert store.done.tolist() == [True, False, False]


def test_size_on_disk(tmp_path):
    """Points of the query come again with other candidates; all else is random."""
    rng, points = np.random.default_rng(0), np.random.default_rng(1).uniform(0, 336, (800, 3)).astype(np.float32)
    chosen = np.concatenate([np.flatnonzero(rng.random(800) < 0.25) for _ in range(40)])
    query = matches_of(0, (len(chosen), 0, 0, 0))
    query = _flat(query, points0=points[chosen, :2], scores0=points[chosen, 2])
    with MATCHES.open(tmp_path / "s", 5) as store:
        empty = store.size_bytes
        store.write(dict.fromkeys(range(5), query))
        size = store.size_bytes - empty
    assert size < 22 * 5 * len(chosen)
    assert size < forecast_bytes(5, 4, len(chosen) / 4) < 1.15 * 32 * 5 * len(chosen)


# What a store is of


def test_a_match_store_has_a_path_of_its_own(tmp_path):
    path = store_path(tmp_path, "street", MATCH_RECIPE, KIND)
    assert path.name == f"street-{recipe_fingerprint(MATCH_RECIPE, KIND)}"
    assert path != store_path(tmp_path, "street", MATCH_RECIPE)


@pytest.mark.parametrize(
    ("recipe", "num_queries", "num_candidates", "difference"),
    [
        (MATCH_RECIPE, 4, 4, "num_queries=3, expected 4"),
        (MATCH_RECIPE, 3, 5, "num_candidates=4, expected 5"),
        ({**MATCH_RECIPE, "features": "4567"}, 3, 4, 'recipe.features="0123", expected "4567"'),
    ],
)
def test_matches_made_from_something_else_are_refused(tmp_path, recipe, num_queries, num_candidates, difference):
    fill(tmp_path / "s", subject=MATCHES)
    with (
        pytest.raises(InputError, match=rf"s/zarr\.json: these matches were made with {difference}; .*delete") as told,
        open_match_store(tmp_path / "s", recipe, num_queries=num_queries, num_candidates=num_candidates),
    ):
        pass
    assert "\n" not in str(told.value)
    assert fill(tmp_path / "s", subject=MATCHES) == []


def test_stores_of_the_other_kind_are_refused_and_left_alone(tmp_path):
    fill(tmp_path / "features")
    fill(tmp_path / "matches", subject=MATCHES)
    before = digests(tmp_path)
    with pytest.raises(InputError, match='made with format="mfvpr feature store 1", expected "mfvpr match store 1"; '):
        fill(tmp_path / "features", subject=MATCHES)
    with pytest.raises(InputError, match='made with format="mfvpr match store 1", expected "mfvpr feature store 1"; '):
        fill(tmp_path / "matches")
    assert digests(tmp_path) == before


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "holiday.jpg").write_text("")
    with pytest.raises(InputError, match=r'expected a folder of matches.*holds "holiday\.jpg"'):
        fill(tmp_path, subject=MATCHES)
    with pytest.raises(InputError, match="expected a folder of matches, got a file"):
        fill(tmp_path / "holiday.jpg", subject=MATCHES)


# Lock and damage


def test_the_lock_holds_and_ends_with_an_error(tmp_path):
    def fail():
        with MATCHES.open(tmp_path / "s", 3):
            with pytest.raises(InputError, match=f"in use by process {os.getpid()}"):
                fill(tmp_path / "s", subject=MATCHES)
            raise KeyError("of the caller")

    with pytest.raises(KeyError, match="of the caller"):
        fail()
    assert fill(tmp_path / "s", subject=MATCHES) == [0, 1, 2]


@pytest.mark.parametrize("damage", ["missing", "short", "flipped"])
@pytest.mark.parametrize("name", MATCH_ARRAYS)
def test_a_damaged_query_is_told_and_matched_anew(tmp_path, name, damage):
    folder = tmp_path / "s"
    fill(folder, subject=MATCHES)
    before = digests(folder)
    DAMAGE[damage](chunk_of(folder, name))
    if name != "count":  # without its count a query is not done, and that is that
        with MATCHES.open(folder, 3) as store:
            found = store.read()
            assert [next(found)[0], next(found)[0]] == [0, 2]
            with pytest.raises(InputError, match=r"s: matches of 1 queries are damaged.*row 1 .*matches them") as told:
                next(found)
            assert "\n" not in str(told.value)
    assert fill(folder, subject=MATCHES) == [1]
    assert digests(folder) == before


@pytest.mark.parametrize("name", MATCH_ARRAYS[:-1])
def test_flipped_bits_are_noticed(tmp_path, name):
    folder = tmp_path / "s"
    fill(folder, 1, subject=MATCHES)
    path, flag = chunk_of(folder, name, 0), chunk_of(folder, "count", 0)
    whole, counted = path.read_bytes(), flag.read_bytes()
    for position in range(0, len(whole), 1 + len(whole) // 24):
        flag.write_bytes(counted)
        path.write_bytes(whole)
        flip(path, position)
        with pytest.raises(InputError, match="damaged"):
            read_all(folder, 1, MATCHES)


@pytest.mark.parametrize("name", MATCH_ARRAYS)
def test_a_missing_array_is_made_again(tmp_path, name):
    folder = tmp_path / "s"
    fill(folder, subject=MATCHES)
    before = digests(folder)
    for path in (folder / name).iterdir():
        path.unlink()
    if name != "count":
        with pytest.raises(InputError, match="matches of 3 queries are damaged"):
            read_all(folder, subject=MATCHES)
    assert fill(folder, subject=MATCHES) == [0, 1, 2]
    assert digests(folder) == before
