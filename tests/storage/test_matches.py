"""The match store: the very same bits come back, and what is refused. What all stores share: test_store_faults.py."""

from dataclasses import fields, replace

import numpy as np
import pytest

from mfvpr import InputError, Matches
from mfvpr.storage.manifest import MATCHES as KIND
from mfvpr.storage.manifest import recipe_fingerprint, store_path
from mfvpr.storage.matches import forecast_bytes, open_match_store
from mfvpr.types import per_match, per_pair
from tests.storage.synthetic_features import MATCH_RECIPE, MATCHES, digests, fill, matches_of, read_all


def with_all(row, counts=(30, 0, 25, 5)):
    """Every field that Matches may have, those that it will gain included."""
    rng, present = np.random.default_rng(row), {*per_match(matches_of(row).matches), *per_pair(matches_of(row).matches)}
    optional = [part.name for part in fields(Matches) if part.default is None and part.name not in present]
    return matches_of(row, counts, **{name: rng.random(sum(counts), np.float32) for name in optional})


def assert_same_bits(got, expected):
    pairs = [
        *((getattr(got.matches, part.name), getattr(expected.matches, part.name)) for part in fields(Matches)),
        *((getattr(got, name), getattr(expected, name)) for name in ("counts", "indices", "filter_scores")),
    ]
    for values, expected_values in pairs:
        assert (values is None) == (expected_values is None)
        if values is not None:
            assert (values.shape, values.dtype) == (expected_values.shape, expected_values.dtype)
            assert values.tobytes() == expected_values.tobytes()


# What comes back


@pytest.mark.parametrize("counts", [(30, 0, 25, 5), (0, 0, 0, 0), (0, 0, 0, 1), (16_000, 9000, 0, 16_000)])
@pytest.mark.parametrize("make", [matches_of, with_all])
def test_the_very_same_bits_come_back(tmp_path, make, counts):
    original = make(7, counts)
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
    rng, query = np.random.default_rng(0), with_all(0, (20_000, 0, 1, 2))
    special = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 1e-45], np.float32).view(np.uint32)

    def anything(like):
        bits = rng.integers(0, 2**32, like.shape, np.uint32)
        bits.flat[: len(special)] = special[: bits.size]
        return bits.view(np.float32)

    floats = {n: v for n, v in per_match(query.matches).items() if np.issubdtype(v.dtype, np.floating)}
    flat = replace(query.matches, **{name: anything(values) for name, values in floats.items()})
    original = replace(query, matches=flat, filter_scores=np.full(4, np.nan, np.float32))
    with MATCHES.open(tmp_path / "s", 1) as store:
        store.write({0: original})
        assert_same_bits(dict(store.read())[0], original)


def test_rows_come_in_the_order_asked_for(tmp_path):
    fill(tmp_path / "s", 40, batch=20, subject=MATCHES)
    with MATCHES.open(tmp_path / "s", 40) as store:
        assert [row for row, _ in store.read()] == list(range(40))
        for row, matches in store.read(reversed(range(40))):
            assert_same_bits(matches, matches_of(row))
        with pytest.raises(ValueError, match="row 3 is done"):
            store.write({3: matches_of(3)})


@pytest.mark.parametrize(
    ("stored", "other", "message"),
    [
        (matches_of(0), with_all(1), r'confidence="float32\[\]", expected nothing'),
        (with_all(0), matches_of(1), r'confidence=nothing, expected "float32\[\]"'),
        (matches_of(0), matches_of(1, ratio=None), r'ratio=nothing, expected "float32\[\]"'),
    ],
)
def test_matches_that_tell_other_things_are_told_apart(tmp_path, stored, other, message):
    folder = tmp_path / "s"
    for _ in range(2):  # of the same process, and of a later one
        with MATCHES.open(folder, 3) as store:
            if not store.done[0]:
                store.write({0: stored})
            before = digests(folder)
            with pytest.raises(InputError, match=rf"s: row 1: {message} .*delete") as error:
                store.write({1: other})
            assert "\n" not in str(error.value)
            assert digests(folder) == before
    with MATCHES.open(tmp_path / "t", 3) as store:
        with pytest.raises(InputError, match="as in the other queries"):
            store.write({0: stored, 1: other})
        store.write({0: other, 1: other})  # nothing of the refused batch counts
    assert_same_bits(read_all(folder, subject=MATCHES)[0], stored)


def _flat(query, **changes):
    return replace(query, matches=replace(query.matches, **changes))


@pytest.mark.parametrize(
    ("row", "query", "message"),
    [
        (0, matches_of(0), "row 0 is done"),
        (3, matches_of(3), "does not exist"),
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
    query = _flat(query, points0=points[chosen, :2], scores0=points[chosen, 2], index0=chosen.astype(np.int32))
    with MATCHES.open(tmp_path / "s", 5) as store:
        empty = store.size_bytes
        store.write(dict.fromkeys(range(5), query))
        size = store.size_bytes - empty
    assert size < 27 * 5 * len(chosen)
    assert size < forecast_bytes(5, 4, len(chosen) / 4) < 1.15 * 40 * 5 * len(chosen)


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
        pytest.raises(InputError, match=rf"s/manifest\.json: .*{difference}; .*delete") as error,
        open_match_store(tmp_path / "s", recipe, num_queries=num_queries, num_candidates=num_candidates),
    ):
        pass
    assert "\n" not in str(error.value)
    assert fill(tmp_path / "s", subject=MATCHES) == []


def test_stores_of_the_other_kind_are_refused_and_left_alone(tmp_path):
    fill(tmp_path / "features")
    fill(tmp_path / "matches", subject=MATCHES)
    before = digests(tmp_path)
    with pytest.raises(InputError, match='made with format="mfvpr feature store 3", expected "mfvpr match store 3"; '):
        fill(tmp_path / "features", subject=MATCHES)
    with pytest.raises(InputError, match='made with format="mfvpr match store 3", expected "mfvpr feature store 3"; '):
        fill(tmp_path / "matches")
    assert digests(tmp_path) == before


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "holiday.jpg").write_text("")
    with pytest.raises(InputError, match=r'expected a folder of matches.*holds "holiday\.jpg"'):
        fill(tmp_path, subject=MATCHES)
    with pytest.raises(InputError, match="expected a folder of matches, got a file"):
        fill(tmp_path / "holiday.jpg", subject=MATCHES)
