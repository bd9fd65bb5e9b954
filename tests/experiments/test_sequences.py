"""The comparison of sequence methods: its matrices, on drives whose answer is known."""

import numpy as np

from experiments.sequences import ANY, STEADY, drives, standardized, trajectories


def similarities(places, rows, seed=0):
    """A similarity matrix in which each image's place stands out from noise, but not always."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(len(places), rows))
    values[np.arange(len(places)), places] += 2.0
    return values


def test_drives_are_of_the_images_that_their_names_say():
    by_name = drives(100)
    assert by_name["as they are"].tolist() == [*range(100)]
    assert by_name["every fourth"].tolist() == [*range(0, 100, 4)]
    assert by_name["every second, backwards"].tolist() == [*range(99, 0, -2)]
    assert sorted({*by_name["with stops"].tolist()}) == [*range(100)]
    assert sorted(by_name["clips"].tolist()) == [*range(100)]
    assert by_name["clips"][:2].tolist() == [50, 51]


def test_trajectories_find_a_drive_at_their_speeds_only():
    for speed, finds, loses in ((1, STEADY, None), (4, ANY, STEADY), (-3, ANY, STEADY)):
        places = np.arange(40) * speed if speed > 0 else 199 + np.arange(40) * speed
        values = standardized(similarities(places, 200))
        correct = trajectories(values, finds, 10).argmax(axis=1) == places
        assert correct[10:].mean() > 0.95
        assert (values.argmax(axis=1) == places).mean() < 0.8
        if loses is not None:
            assert (trajectories(values, loses, 10).argmax(axis=1) == places).mean() < 0.2
