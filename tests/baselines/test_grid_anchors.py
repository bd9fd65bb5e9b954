"""SSM-VPR's grid anchors against loops, cell by cell."""

from dataclasses import replace

import numpy as np
import pytest

from mfvpr.baselines import GridAnchors
from mfvpr.testing import check_scorer
from mfvpr.utils import InputError
from tests import oracles
from tests.builders import make_matches, per_match
from tests.scorers import score

pytestmark = pytest.mark.thorough


def cells(index, side, *, matched=None):
    """Matches of every cell of the candidate, or of those that are `matched`."""
    index, count = np.asarray(index).reshape(-1), side**2
    rows = np.arange(count) if matched is None else np.flatnonzero(matched)
    return cell_matches(index[rows], rows, count, capacity=count)


def cell_matches(index0, index1, count, **options):
    points = np.zeros((len(index0), 2))
    return make_matches(points, points, index0=index0, index1=index1, count0=count, count1=count, **options)


def random_index(rng, side, *, noise=0.4):
    """Query cells: most are a few cells further than those of the candidate, flat numbers wrapping around."""
    index = (np.arange(side**2) + rng.integers(-2 * side, 2 * side)) % side**2
    return np.where(rng.random(side**2) < noise, rng.integers(0, side**2, side**2), index)


@pytest.mark.parametrize("outside", ["unequal", "zero"])
@pytest.mark.parametrize(("side", "patch"), [(1, 1), (2, None), (5, None), (5, 5), (8, None), (12, 3), (12, None)])
def test_agrees_with_the_loop(side, patch, outside):
    scorer = GridAnchors(side, patch, outside)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        index = random_index(rng, side, noise=0.4 * seed)
        matched = np.ones(side**2, bool) if seed < 2 else rng.random(side**2) < 0.7
        grid = np.where(matched, index, None).reshape(side, side).tolist()
        expected = oracles.grid_anchors(grid, side, patch=patch, outside=-1000 if outside == "unequal" else 0)
        order = rng.permutation(side**2)
        got = score(scorer, per_match(cells(index, side, matched=matched), lambda rows: rows[order]))  # noqa: B023
        assert got.dtype == np.float32
        assert got == expected


@pytest.mark.slow
def test_minus_1000_may_be_a_number_that_is_expected():
    """At a side of 54 patches reach 19 rows up: cell 10 of the query should be 10 - 19 * 54 + 16 there."""
    index = np.full((54, 54), 10)
    assert score(GridAnchors(54), cells(index, 54)) == oracles.grid_anchors(index.tolist(), 54)


def test_of_several_matches_of_one_cell_the_lowest_counts():
    pair, alone = cell_matches([0, 7, 4, 5], [0, 4, 4, 4], 9), cell_matches([0, 4], [0, 4], 9)
    for matches in (pair, per_match(pair, lambda rows: rows[::-1]), alone):
        assert score(GridAnchors(3, 3), matches) == 4


def test_keeps_the_contract_of_scorers():
    check_scorer(GridAnchors(9), num_keypoints=81)


@pytest.mark.parametrize("change", [{"count0": 48}, {"count1": 50}, {"index0": 49}, {"index1": -1}])
def test_other_keypoints_than_the_cells_of_the_grid_score_nan(change):
    pair = cells(np.arange(49), 7)
    for name, number in change.items():
        if name.startswith("index"):
            getattr(pair, name)[3] = number
        else:
            pair = replace(pair, **{name: np.int32(number)})
    assert np.isnan(score(GridAnchors(7), pair))
    assert score(GridAnchors(7), replace(pair, mask=np.zeros(49, bool))) == 0


def test_matches_without_indices_and_impossible_grids_raise():
    pair = replace(cells(np.arange(9), 3), index1=None)
    with pytest.raises(InputError, match="expected matches with index0 and index1"):
        GridAnchors(3)(pair)
    for options, line in (
        ({"side": 0}, "side=0: expected a whole number from 1"),
        ({"side": 9, "patch": 4}, "patch=4: expected an odd number"),
        ({"side": 74, "patch": 57}, "side . patch up to 4096"),
    ):
        with pytest.raises(InputError, match=line):
            GridAnchors(**options)
