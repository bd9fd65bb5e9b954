"""The match store: the very same bits come back. Refusals of all stores: test_rows.py."""

from dataclasses import fields, replace

import numpy as np
import pytest

from mfvpr import InputError, Matches
from mfvpr.core.types import per_match, per_pair
from mfvpr.storage.matches import forecast_bytes
from tests.storage.synthetic_features import MATCHES, assert_same, digests, matches_of, read_all


def with_all(row, counts=(30, 0, 25, 5)):
    """Every field that Matches may have, those that it will gain included."""
    rng, present = np.random.default_rng(row), {*per_match(matches_of(row).matches), *per_pair(matches_of(row).matches)}
    optional = [part.name for part in fields(Matches) if part.default is None and part.name not in present]
    return matches_of(row, counts, **{name: rng.random(sum(counts), np.float32) for name in optional})


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
    assert_same(first[1], original)
    assert_same(later[1], original)


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
        assert_same(dict(store.read())[0], original)


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
    assert_same(read_all(folder, subject=MATCHES)[0], stored)


def test_size_on_disk(tmp_path):
    """Points of the query come again with other candidates; all else is random."""
    rng, points = np.random.default_rng(0), np.random.default_rng(1).uniform(0, 336, (800, 3)).astype(np.float32)
    chosen = np.concatenate([np.flatnonzero(rng.random(800) < 0.25) for _ in range(40)])
    fields_of_query = {"points0": points[chosen, :2], "scores0": points[chosen, 2], "index0": chosen.astype(np.int32)}
    query = matches_of(0, (len(chosen), 0, 0, 0), **fields_of_query)
    with MATCHES.open(tmp_path / "s", 5) as store:
        empty = store.size_bytes
        store.write(dict.fromkeys(range(5), query))
        size = store.size_bytes - empty
    assert size < 27 * 5 * len(chosen)
    assert size < forecast_bytes(5, 4, len(chosen) / 4) < 1.15 * 40 * 5 * len(chosen)
