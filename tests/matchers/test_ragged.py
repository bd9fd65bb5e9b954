"""Rows of their own length, padded and back."""

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mfvpr.features.feature_set import few_capacities, pad_rows
from mfvpr.matchers.match_set import prune_capacities, split_rows


def rows_of(counts, seed=0):
    rng = np.random.default_rng(seed)
    return [
        {"points": rng.normal(size=(count, 2)).astype(np.float32), "index": rng.integers(0, 9, count, np.int32)}
        for count in counts
    ]


COUNTS = st.lists(st.integers(0, 7), min_size=1, max_size=6)


@given(COUNTS, st.integers(0, 3), st.integers(0, 2))
def test_padding_keeps_every_row_and_holds_zeros(counts, more_slots, more_rows):
    rows, capacity, total = rows_of(counts), max(counts) + more_slots, len(counts) + more_rows
    arrays, mask = pad_rows(rows, capacity, total=total)
    assert arrays["points"].shape == (total, capacity, 2)
    assert arrays["index"].shape == mask.shape == (total, capacity)
    assert [values.dtype for values in arrays.values()] == [np.float32, np.int32]
    assert mask.sum(axis=1).tolist() == [*counts, *[0] * more_rows]
    for place, row in enumerate(rows):
        for name, values in row.items():
            np.testing.assert_array_equal(arrays[name][place][mask[place]], values)
    np.testing.assert_array_equal(mask, np.sort(mask, axis=1)[:, ::-1])
    assert not any(values[~mask].any() for values in arrays.values())


@given(COUNTS)
def test_rows_are_split_where_they_were_joined(counts):
    rows = rows_of(counts)
    flat = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    jax.tree.map(np.testing.assert_array_equal, split_rows(flat, np.array(counts)), rows)


@given(st.lists(st.integers(0, 500), max_size=40), st.sampled_from([8, 32]))
def test_capacities_are_few_and_hold_every_row(counts, step):
    counts = np.array(counts, int)
    capacities = few_capacities(counts, (0.25, 0.5, 1.0), step)
    assert 1 <= len(capacities) <= 3
    assert (capacities % step == 0).all()
    assert (np.diff(capacities) > 0).all()
    assert capacities[0] > 0
    if counts.any():
        assert capacities[-1] < counts.max() + step


def test_a_capacity_is_worth_what_it_saves():
    capacities, counts = np.array([8, 16]), np.array([8, 7, 0, 16, 5])
    assert prune_capacities(capacities, counts, 3 * 8).tolist() == [8, 16]
    assert prune_capacities(capacities, counts, 3 * 8 + 1).tolist() == [16]
