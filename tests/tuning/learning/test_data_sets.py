"""Learned on some data sets, reported on others: what is whose, and that each counts as it would alone."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from mfvpr import HistogramOfShifts, InputError
from mfvpr.core.types import per_match
from mfvpr.tuning.learning import models as comparison
from mfvpr.tuning.learning.models import Options
from mfvpr.tuning.learning.splits import VALIDATION, Part, join_data_sets, training_splits
from mfvpr.tuning.sweeps import Axes
from tests.tuning.learning.paths import QUERIES, TOLERANCES, path


def part(name, seed, width=QUERIES):
    """A data set with the best `width` candidates of every query; the last query has one less."""
    protocol, matches, candidates = path(seed=seed)
    protocol = replace(protocol, halves=(), split=None)
    keep = [int(ends[width - 1]) for ends in np.cumsum(matches.counts, axis=1)]
    flat = [
        replace(flat_matches, image_size1=flat_matches.image_size1[:width], count1=flat_matches.count1[:width],
                **{n: values[:end] for n, values in per_match(flat_matches).items()},
                mask=flat_matches.mask[:end])
        for flat_matches, end in zip(matches.matches, keep, strict=True)
    ]  # fmt: skip
    matches = replace(matches, matches=flat, counts=matches.counts[:, :width])
    candidates = jax.tree.map(lambda values: values[:, :width], candidates)
    candidates.indices[-1, -1], candidates.mask[-1, -1] = -1, False
    return Part(name, protocol, matches, candidates)


@pytest.fixture(scope="module")
def parts():
    return [part("a", 0), part("b", 1, width=20), part("c", 2, width=25)]


@pytest.fixture(scope="module")
def joined(parts):
    return join_data_sets(parts[:2], parts[2:])


def test_every_query_keeps_its_own(parts, joined):
    assert len(joined.match_set) == 3 * QUERIES
    assert joined.candidates.indices.shape == (3 * QUERIES, QUERIES)
    for number, data_set in enumerate(parts):
        width = data_set.candidates.indices.shape[1]
        for query in (0, 7, QUERIES - 1):
            row = number * QUERIES + query
            indices = data_set.candidates.indices[query]
            expected = np.where(indices >= 0, indices + number * QUERIES, -1)
            np.testing.assert_array_equal(joined.candidates.indices[row, :width], expected)
            assert np.all(joined.candidates.indices[row, width:] == -1)
            assert not joined.candidates.mask[row, width:].any()
            np.testing.assert_array_equal(joined.candidates.scores[row, :width], data_set.candidates.scores[query])
            joined_matches, matches = joined.match_set[row], data_set.match_set[query]
            for name, values in per_match(matches).items():
                np.testing.assert_array_equal(getattr(joined_matches, name)[:width], values)
            assert not joined_matches.mask[width:].any()
            for level, positives in enumerate(joined.protocol.positives):
                correct = data_set.protocol.positives[level].of(query) + number * QUERIES
                np.testing.assert_array_equal(positives.of(row), correct)
    assert joined.protocol.reported_sets == {"c": QUERIES}


def test_the_last_quarter_of_each_set_validates_and_nothing_reported_is_seen(joined):
    [split] = training_splits(joined.match_set, joined.candidates, joined.protocol)
    assert split.name == "other sets"
    assert {*split.half.report} == {*range(2 * QUERIES, 3 * QUERIES)}
    for number in range(2):
        end = QUERIES * (number + 1)
        first = end - round(VALIDATION * QUERIES)
        of_set = range(number * QUERIES, end)
        assert {query for query in split.validation if query in of_set} <= {*range(first, end)}
        assert {query for query in split.train if query in of_set} <= {*range(end - QUERIES, first - TOLERANCES[-1])}
        assert min(sum(query in of_set for query in queries) for queries in (split.train, split.validation)) >= 5
    assert not split.seen[2 * QUERIES :].any()
    assert joined.candidates.indices[split.usable].max() < 2 * QUERIES


def test_what_is_reported_is_what_the_set_has_alone(parts, joined):
    [split] = training_splits(joined.match_set, joined.candidates, joined.protocol)
    scorer = HistogramOfShifts(bin_size=20.0, sigma=20.0)
    compared = comparison.HalfComparison(split, Axes(scorer, {}, {}), Options())
    alone = training_splits(parts[2].match_set, parts[2].candidates, path(seed=2)[0])[0]
    expected = comparison.HalfComparison(alone, Axes(scorer, {}, {}), Options())
    for setting in ({}, {"c": None}, {"c": 3.0}):
        got = compared.evaluate("it", scorer, setting).hits[:, alone.half.report]
        np.testing.assert_array_equal(got, expected.evaluate("it", scorer, setting).hits)


def test_sets_that_do_not_go_together_are_refused(parts):
    a, b, c = parts
    with pytest.raises(InputError, match=r"names, got a, b, a"):
        join_data_sets([a, b], [replace(c, name="a")])
    for changes, words in ({"unit": "m"}, r"unit m"), ({"thresholds": (0, 1, 3)}, r"thresholds \(0, 1, 3\)"):
        with pytest.raises(InputError, match=rf"^c: expected unit frames with .* as a has, got .*{words}"):
            join_data_sets([a], [replace(c, protocol=replace(c.protocol, **changes))])
