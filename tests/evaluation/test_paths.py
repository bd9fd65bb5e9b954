"""Places in the order of the map: the same whatever the names of files are sorted by."""

import numpy as np
import pytest

from mfvpr.datasets import Positives
from mfvpr.evaluation.protocol import places_along_path
from mfvpr.evaluation.statistics import path_test

PLACES = 60
DRIVES = [*range(PLACES), *reversed(range(0, PLACES, 2))]  # there and back


def shown(seed, tolerance=2):
    """Images within the tolerance of each query's place, whose rows are in any order."""
    row = np.random.default_rng(seed).permutation(PLACES)
    return Positives.from_rows(
        [row[max(place - tolerance, 0) : place + tolerance + 1] for place in DRIVES], PLACES
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
def test_neighbors_follow_whatever_the_rows_of_the_map_are(seed):
    places = places_along_path(shown(seed), "m")
    places = places if places[0] < places[PLACES - 1] else places.max() - places  # in the direction of the first drive
    assert np.abs(places - DRIVES).max() <= 2  # at the ends images are shown by few queries
    assert (np.diff(places[2 : PLACES - 2]) == 1).all()
    np.testing.assert_array_equal(places[PLACES:][::-1], places[:PLACES:2])


def test_frames_are_in_order_and_exact_images_in_that_of_the_first_queries():
    frames = Positives.from_rows([[place] for place in DRIVES], PLACES)
    np.testing.assert_array_equal(places_along_path(frames, "frames"), DRIVES)
    np.testing.assert_array_equal(places_along_path(shown(3, tolerance=0), "exact"), DRIVES)


@pytest.mark.parametrize("unit", ["frames", "m", "exact"])
def test_places_that_the_map_does_not_show_are_none(unit):
    places = places_along_path(Positives.from_rows([[], [3], [3], [], [1], [0], []], 5), unit)
    assert (places == -1).tolist() == [True, False, False, True, False, False, True]
    assert places[1] == places[2]
    assert len({*places[[1, 4, 5]].tolist()}) == 3
    for queries in (0, 2):
        assert places_along_path(Positives.from_rows([[]] * queries, 4), unit).tolist() == [-1] * queries


def test_p_along_the_path_is_rarely_low_without_a_difference_however_the_names_are_sorted():
    """Two systems that are equally good, each with its own weak stretches of the street, which drives share."""
    rng, draws, low = np.random.default_rng(0), 200, {"sorted by chance": 0, "along the path": 0}
    names = rng.permutation(len(DRIVES))  # queries in the order of files
    path = np.argsort(places_along_path(shown(0).take(names), "m"), kind="stable")
    for _ in range(draws):
        hits = []
        for _ in range(2):
            latent = np.convolve(rng.normal(size=PLACES + 14), np.ones(15), "valid") / np.sqrt(15)
            hits.append((latent[DRIVES] > -0.5)[names])
        low["sorted by chance"] += path_test(*hits).p_value <= 0.05
        low["along the path"] += path_test(*np.array(hits)[:, path]).p_value <= 0.05
    assert low["along the path"] <= 0.1 * draws
    assert low["sorted by chance"] >= 0.3 * draws
