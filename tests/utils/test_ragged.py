"""Rows of their own length, padded and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr.utils import ragged


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
    arrays, mask = ragged.pad_rows(rows, capacity, total=total)
    assert arrays["points"].shape == (total, capacity, 2)
    assert arrays["points"].dtype == np.float32
    assert arrays["index"].shape == mask.shape == (total, capacity)
    assert arrays["index"].dtype == np.int32
    assert mask.sum(axis=1).tolist() == [*counts, *[0] * more_rows]
    for place, row in enumerate(rows):
        for name, values in row.items():
            np.testing.assert_array_equal(arrays[name][place, : counts[place]], values)
            np.testing.assert_array_equal(arrays[name][place][mask[place]], values)
    assert not any(values[~mask].any() for values in arrays.values())


@given(COUNTS)
def test_rows_that_are_joined_are_split_again(counts):
    rows = rows_of(counts)
    flat = ragged.join_rows(rows)
    assert len(flat["points"]) == sum(counts)
    for got, expected in zip(ragged.split(flat, np.array(counts)), rows, strict=True):
        for name, values in expected.items():
            np.testing.assert_array_equal(got[name], values)


def test_a_row_longer_than_the_capacity_is_an_error():
    with pytest.raises(ValueError, match="broadcast"):
        ragged.pad_rows(rows_of([3]), 2)


@given(st.lists(st.integers(0, 500), max_size=40), st.sampled_from([8, 32]))
def test_capacities_are_few_and_hold_every_row(counts, step):
    counts = np.array(counts, int)
    capacities = ragged.sizes(counts, (0.25, 0.5, 1.0), step)
    assert 1 <= len(capacities) <= 3
    assert (capacities % step == 0).all()
    assert (np.diff(capacities) > 0).all()
    assert capacities[0] > 0
    fitting = ragged.fitting(capacities, counts)
    for count, capacity in zip(counts, fitting, strict=True):
        assert capacity == min(size for size in capacities if size >= count)
    if counts.any():
        assert capacities[-1] < counts.max() + step


def test_a_capacity_is_worth_what_it_saves():
    capacities, counts = np.array([8, 16]), np.array([8, 7, 0, 16, 5])
    assert ragged.worthwhile(capacities, counts, 3 * 8).tolist() == [8, 16]
    assert ragged.worthwhile(capacities, counts, 3 * 8 + 1).tolist() == [16]


def test_empty_rows_make_no_capacity_smaller():
    counts = np.array([100, 100, 200])
    assert ragged.sizes(np.array([0] * 50 + [100, 100, 200]), (0.5, 1.0), 32).tolist() == [128, 224]
    assert ragged.sizes(counts, (0.5, 1.0), 32).tolist() == [128, 224]


def test_filled_repeats_the_last():
    np.testing.assert_array_equal(ragged.repeat_last(np.array([[1, 2], [3, 4]]), 4), [[1, 2], [3, 4], [3, 4], [3, 4]])
    np.testing.assert_array_equal(ragged.repeat_last(np.array([5]), 1), [5])


in_front = jax.jit(ragged.in_front, static_argnums=2)


@given(st.lists(st.booleans(), min_size=12, max_size=12), st.sampled_from([1, 5, 14]))
def test_what_is_set_comes_to_the_front(mask, capacity):
    values = np.arange(12, dtype=np.float32) + 1
    [got] = jax.tree.leaves(in_front({"a": values}, np.array(mask), capacity))
    expected = values[np.array(mask)][:capacity]
    assert got.shape == (capacity,)
    np.testing.assert_array_equal(got[: len(expected)], expected)


def test_nothing_can_be_indexed():
    [got] = jax.tree.leaves(ragged.in_front({"a": np.zeros((0, 2), np.float32)}, jnp.zeros(0, bool), 3))
    assert got.shape == (3, 2)
