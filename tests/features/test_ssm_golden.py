"""SSM-VPR against its public program's numbers (tests/golden/make_ssm.py), stage by stage, and the whole way."""

import jax
import numpy as np
import pytest

import mfvpr
from mfvpr import GridAnchors, Shortlist
from mfvpr.datasets import resize
from mfvpr.evaluation import FrameCorrelation
from mfvpr.features import WindowFitting
from mfvpr.features.extractor import local_features
from mfvpr.features.ssm_features import SsmMaps, whiten_windows
from mfvpr.features.whitening import Windows, kernels
from mfvpr.networks.layers import of_unit_length
from mfvpr.retrieval.retriever import vote
from tests.baselines.test_grid_anchors import cells
from tests.golden import make_ssm
from tests.golden.make_ssm import CANDIDATES, DIMENSIONS, IMAGES, MAPS, made_up_map, picture
from tests.networks.test_ssm_maps import published
from tests.scorers import score

pytestmark = [pytest.mark.optimized, pytest.mark.thorough]

FITTINGS = WindowFitting(DIMENSIONS[0]), WindowFitting(DIMENSIONS[1], zero_row=True, dtype="float64")
SIZES = 9, 3
project = jax.jit(whiten_windows, static_argnames="stride")
match = jax.jit(mfvpr.match, static_argnames="cross_check")


def described(maps, stage, num_database):
    """Whitened windows `[V, D']` of maps, learned from the first, those of the database."""
    positions, how = Windows(maps.shape[1:], SIZES[stage - 1]), FITTINGS[stage - 1]
    learned = how.fit([dict(enumerate(maps[:num_database]))], positions, how.sample_rows(num_database))
    vectors = np.asarray(project(maps, *kernels(learned, positions), stride=1))
    return vectors[:num_database], vectors[num_database:]


def rows_of(num_database, num_queries):
    """(row, whether it is a query) of all images."""
    return [*((row, False) for row in range(num_database)), *((row, True) for row in range(num_queries))]


def of_maps(case, stage):
    """Whitened windows of the made-up maps."""
    maps = [made_up_map(MAPS[case], stage, *row) for row in rows_of(make_ssm.DATABASE, make_ssm.QUERIES)]
    return described(np.asarray(of_unit_length(np.stack(maps))), stage, make_ssm.DATABASE)


def of_images(case, stage):
    """Whitened windows of the pictures by a network with random weights."""
    seed, pixels, *counts = IMAGES[case]
    size = (224, 224) if stage == 1 else (pixels, pixels)
    maps = SsmMaps(published(seed), size, stage=stage)
    computed = maps(np.stack([resize(picture(*row), size) for row in rows_of(*counts)]))
    return described(np.stack([result.vector.reshape(maps.shape) for result in computed]), stage, counts[0])


def assert_same_space(got, expected, tolerance):
    """But for the signs of its axes."""
    got, expected = (vectors.reshape(-1, vectors.shape[-1]).astype(np.float64) for vectors in (got, expected))
    signs = np.sign((got * expected).sum(axis=0))
    np.testing.assert_allclose(got, signs * expected, atol=tolerance * np.abs(expected).max())


def assert_votes(shortlist, votes, candidates):
    """As listed there; images of equal votes, which the program's sort does not order, by row here."""
    expected = np.argsort(-votes, axis=1, kind="stable")[:, : candidates.shape[1]]
    np.testing.assert_array_equal(shortlist.indices, expected)
    np.testing.assert_array_equal(shortlist.scores, np.take_along_axis(votes, expected, axis=1))
    np.testing.assert_array_equal(np.take_along_axis(votes, candidates.astype(int), axis=1), shortlist.scores)


@pytest.mark.parametrize("case", MAPS)
def test_windows_and_their_votes(golden, case):
    database, queries = of_maps(case, 1)
    assert_same_space(database, golden[f"{case}/windows"], 2e-4)  # which sums in float32
    assert_votes(vote(queries, database, CANDIDATES), golden[f"{case}/votes"], golden[f"{case}/candidates"])


@pytest.mark.parametrize("case", MAPS)
def test_cells_and_their_matches(golden, case):
    database, queries = of_maps(case, 2)
    assert_same_space(database, golden[f"{case}/cells"], 1e-6)
    for place, row in np.ndenumerate(golden[f"{case}/candidates"]):
        matches = match(image(queries[place[0]]), image(database[row]), cross_check="candidate")
        np.testing.assert_array_equal(matches.index0, golden[f"{case}/index"][place].reshape(-1))
        np.testing.assert_array_equal(matches.index1, np.arange(len(database[row])))
        assert int(score(GridAnchors(10), matches)) == golden[f"{case}/scores"][place]


def image(vectors):
    """Features of cells."""
    return local_features(np.zeros((len(vectors), 2)), vectors, (100, 100))


@pytest.mark.parametrize("case", [*MAPS, *IMAGES])
def test_scores_are_equal_as_whole_numbers(golden, case):
    """For the program's own matches, with its padding on a CPU, and on a GPU."""
    index = golden[f"{case}/index"]
    side = index.shape[-1]
    for place in np.ndindex(index.shape[:2]):
        pair = cells(index[place], side)
        assert int(score(GridAnchors(side), pair)) == golden[f"{case}/scores"][place]
        assert int(score(GridAnchors(side, outside="zero"), pair)) == golden[f"{case}/zero_scores"][place]


@pytest.mark.parametrize("case", [*MAPS, *IMAGES])
def test_frame_correlation_weighs_as_published(golden, case):
    """The program rounds the scores that it looks back at to two digits."""
    rows, scores = golden[f"{case}/candidates"].astype(np.int32), golden[f"{case}/scores"].astype(np.float32)
    got = FrameCorrelation(2)(Shortlist(rows, scores, rows >= 0), scores)
    np.testing.assert_allclose(got / scores, golden[f"{case}/weights"], rtol=1e-5)
    assert (got[2:] > scores[2:]).all()


@pytest.mark.slow
@pytest.mark.parametrize("case", IMAGES)
def test_images_get_the_votes_of_the_public_program(golden, case):
    database, queries = of_images(case, 1)
    assert_same_space(database, golden[f"{case}/windows"], 1e-4)
    shortlist = vote(queries, database, min(CANDIDATES, len(database)))
    assert_votes(shortlist, golden[f"{case}/votes"], golden[f"{case}/candidates"])


@pytest.mark.slow
@pytest.mark.parametrize("case", IMAGES)
def test_images_get_the_matches_of_the_public_program(golden, case):
    """None differs where this was written; elsewhere rounding may choose the other of two that are as near."""
    database, queries = of_images(case, 2)
    side = golden[f"{case}/index"].shape[-1]
    for place, row in np.ndenumerate(golden[f"{case}/candidates"]):
        matches = match(image(queries[place[0]]), image(database[row]), cross_check="candidate")
        equal = np.asarray(matches.index0) == golden[f"{case}/index"][place].reshape(-1)
        assert equal.mean() > 0.999
        if equal.all():
            assert int(score(GridAnchors(side), matches)) == golden[f"{case}/scores"][place]
