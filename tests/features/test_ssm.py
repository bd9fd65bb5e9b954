"""SSM-VPR's windows and cells: what they are, how they are learned from a database, and that they are of no other."""

import shutil
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

import mfvpr
from mfvpr import datasets
from mfvpr.baselines import GridAnchors
from mfvpr.datasets import ImageFolder
from mfvpr.evaluation import match_sequence
from mfvpr.features import Aggregated, Sift, SsmCells, SsmWindows, VladFitting, WindowFitting
from mfvpr.features.ssm_features import SsmMaps, whiten_windows
from mfvpr.features.whitening import Whitening, Windows, fit_whitening, kernels
from mfvpr.matchers import NearestNeighborMatcher
from mfvpr.retrieval import Retrieval, SsmVoting, fit_to_database
from mfvpr.retrieval.retriever import whitening_recipe
from mfvpr.storage import FeatureCache
from mfvpr.utils import InputError, runtime
from mfvpr.utils.fingerprints import fingerprint
from tests.builders import evaluate_parts, local
from tests.networks.test_ssm_maps import published

pytestmark = pytest.mark.thorough

SMALL = (48, 40)  # px: 4 x 3 cells
RETRIEVAL = Retrieval(Aggregated(Sift(max_keypoints=60, image_size=(160, 120)), VladFitting(num_words=8)))
CANDIDATE = NearestNeighborMatcher(cross_check="candidate")


@pytest.fixture(scope="module")
def model():
    return published(0)


@pytest.fixture(scope="module")
def cells(model):
    return SsmCells(model, SMALL, whitening=WindowFitting(6, seed=1))


@pytest.fixture(scope="module")
def learned(cells, dataset):
    """The cells with a whitening of the database."""
    return fit_to_database(cells, dataset.database, FeatureCache())


# Windows


@pytest.mark.parametrize(("shape", "size", "stride"), [((5, 7, 2), 3, 1), ((8, 5, 3), 3, 2), ((4, 4, 1), 4, 1)])
def test_windows_are_those_of_the_loops(shape, size, stride):
    image_map, positions = np.random.default_rng(0).normal(size=shape), Windows(shape, size, stride)
    expected = [
        image_map[row : row + size, column : column + size].reshape(-1)
        for row in range(0, shape[0] - size + 1, stride)
        for column in range(0, shape[1] - size + 1, stride)
    ]
    assert positions.count == len(expected) == np.prod(positions.grid)
    np.testing.assert_array_equal(positions.take(image_map, np.arange(positions.count)), expected)
    places = np.array([1, 0]) % positions.count
    np.testing.assert_array_equal(positions.take(image_map, places), np.take(expected, places, 0))


def test_a_convolution_is_the_whitening_of_every_window():
    rng = np.random.default_rng(1)
    maps, positions = rng.normal(size=(2, 6, 7, 4)).astype(np.float32), Windows((6, 7, 4), 3, 2)
    sample = np.concatenate([positions.take(image_map, np.arange(positions.count)) for image_map in maps])
    learned = fit_whitening(np.concatenate([sample, rng.normal(size=(40, 36))]), 5)
    got = jax.jit(partial(whiten_windows, stride=2))(maps, *kernels(learned, positions))
    expected = (sample - learned.mean) @ learned.components.T
    np.testing.assert_allclose(np.reshape(got, (-1, 5)), expected, atol=1e-5)


@pytest.mark.parametrize(("windows_at_most", "zero_row"), [(None, False), (None, True), (30, False), (30, True)])
def test_the_whitening_is_that_of_the_windows_that_are_drawn(windows_at_most, zero_row):
    rng, positions = np.random.default_rng(3), Windows((6, 6, 2), 3)
    how = WindowFitting(4, 5, windows_at_most, zero_row, "float64", seed=7)
    rows = how.sample_rows(9)
    assert rows == sorted(set(rows))
    assert len(rows) == 5
    maps = {row: rng.normal(size=(6, 6, 2)) for row in rows}
    learned = how.fit([{rows[0]: maps[rows[0]]}, {row: maps[row] for row in rows[1:]}], positions, rows)
    every = np.concatenate([positions.take(maps[row], np.arange(16)) for row in rows])
    chosen = np.arange(80) if windows_at_most is None else np.random.default_rng([7, 1]).choice(80, 30, replace=False)
    sample = np.concatenate([every[np.sort(chosen)], np.zeros((int(zero_row), 18))])
    expected = fit_whitening(sample, 4)
    np.testing.assert_array_equal(learned.components, expected.components)
    np.testing.assert_array_equal(learned.mean, expected.mean)
    assert replace(how, max_images=None).sample_rows(9) == [*range(9)]
    assert replace(how, seed=8).sample_rows(9) != rows


def test_fewer_windows_than_dimensions_are_refused(cells, dataset):
    single_image = ImageFolder(dataset.database.root, dataset.database.names[:1])
    few, enough = (replace(cells, whitening=WindowFitting(dimension)) for dimension in (12, 11))
    with pytest.raises(InputError, match=r"12 descriptors .*got 12 .*4608"):
        fit_to_database(few, single_image, FeatureCache())
    assert np.isfinite(fit_to_database(enough, single_image, FeatureCache()).whitening.components).all()


# Images


def test_cells_are_whitened_windows_at_their_places(model, cells, learned):
    images = np.random.default_rng(0).integers(0, 256, (2, 40, 48, 3), np.uint8)
    maps = [
        image_map.vector.reshape(5, 6, 512).astype(np.float64) for image_map in SsmMaps(model, SMALL, stage=2)(images)
    ]
    windows_of_map = Windows((5, 6, 512), 3)
    whitening = learned.whitening
    assert cells.scales == learned.scales == ((6, 12, 1.0),)
    for features, image_map in zip(local(learned(images)), maps, strict=True):
        expected = (windows_of_map.take(image_map, np.arange(12)) - whitening.mean) @ whitening.components.T
        np.testing.assert_allclose(features.descriptors, expected, atol=1e-4 * np.abs(expected).max())
        assert features.descriptors.dtype == features.keypoints.dtype == np.float32
        # The middle of 8 x 8 px is between two of them.
        np.testing.assert_array_equal(features.keypoints[[0, 1, 4]], [[11.5, 11.5], [19.5, 11.5], [11.5, 19.5]])
        np.testing.assert_array_equal(features.scores, np.ones(12))
        np.testing.assert_array_equal(features.image_size, SMALL)
    np.testing.assert_allclose(np.linalg.norm(maps[0], axis=-1), 1, atol=1e-6)


def test_grids_and_windows_are_the_published_ones(model):
    for pixels, stride, side in ((224, 1, 26), (336, 1, 40), (448, 1, 54), (416, 2, 25)):
        assert SsmCells(model, (pixels, pixels), stride=stride).windows.grid == (side, side)
    assert SsmWindows(model).windows.dimension == 41472
    assert SsmWindows(model).vector_size == 36 * 125
    assert SsmCells(model).scales == ((100, 1600, 1.0),)
    assert [extractor(model).whitening.dtype for extractor in (SsmWindows, SsmCells)] == ["float32", "float64"]


def test_what_has_no_cells_or_has_not_seen_the_database_is_refused(model, cells):
    with pytest.raises(InputError, match=r"3 x 3: .*got 2 x 6"):
        SsmCells(model, (48, 16))
    with pytest.raises(InputError, match="stride=0"):
        SsmCells(model, stride=0)
    with pytest.raises(InputError, match="SsmCells: expected a learned whitening, got settings; call"):
        cells(np.zeros((1, 40, 48, 3), np.uint8))
    with pytest.raises(InputError, match=r"SsmCells: .*whitening .*4608 .*got .*41472"):
        replace(cells, whitening=Whitening(np.zeros(41472), np.zeros((3, 41472))))(np.zeros((1, 40, 48, 3), np.uint8))


# What is learned


def whitening_files(root):
    return sorted(root.glob("*whitening*/*/*.npz"))


def labeled_cache(root, labels):
    """A cache that adds what it computes to the labels."""
    return FeatureCache(root, runtime=mfvpr.Runtime(progress=lambda label: labels.append(label) or runtime.no_progress))


def test_what_is_learned_is_kept_and_made_once(cells, learned, dataset, tmp_path):
    labels = []
    first, again = (fit_to_database(cells, dataset.database, labeled_cache(tmp_path, labels)) for _ in range(2))
    assert labels == ["SsmCells whitening"]
    assert fit_to_database(again, dataset.database, FeatureCache()) is again
    np.testing.assert_array_equal(again.whitening.components, first.whitening.components)
    np.testing.assert_array_equal(learned.whitening.mean, first.whitening.mean)
    [path] = whitening_files(tmp_path)
    assert {*np.load(path).files} == {"mean", "components"}


def test_it_is_of_no_other_data_network_or_settings(model, cells, dataset, tmp_path):
    cache, how, other = FeatureCache(tmp_path), cells.whitening, published(1)
    extractors = [fit_to_database(cells, folder, cache) for folder in (dataset.database, dataset.queries)]
    assert len(whitening_files(tmp_path)) == 2
    assert not np.array_equal(*(extractor.whitening.components for extractor in extractors))
    # A hash of it is part of all that is computed with it.
    recipes = [cache.recipes.of_folder(dataset.database, extractor) for extractor in extractors]
    assert recipes[0] != recipes[1]
    variants = [
        cells,
        replace(cells, model=other),
        replace(cells, preprocessing="caffe"),
        replace(cells, stride=2),
        replace(cells, image_size=(40, 48)),
        replace(cells, interpolation="cv2_area"),
        SsmWindows(model),
    ]
    changes = {"dimension": 5, "seed": 2, "zero_row": True, "max_images": 9, "max_windows": 99, "dtype": "float64"}
    variants += [replace(cells, whitening=replace(how, **{name: value})) for name, value in changes.items()]
    recipes = [whitening_recipe(extractor, extractor.whitening, cache) for extractor in variants]
    assert len({*map(fingerprint, recipes)}) == len(variants)
    assert whitening_recipe(replace(cells, batch_size=1), how, cache) == recipes[0]


def test_it_is_refused_by_other_networks_images_and_windows(cells, learned, dataset, tmp_path):
    image = np.zeros((1, 40, 48, 3), np.uint8)
    changes = {"model": published(1), "preprocessing": "caffe", "interpolation": "cv2_area", "stride": 2}
    for name, value in changes.items():
        with pytest.raises(InputError, match=r"SsmCells: .*whitening .*network, images and windows"):
            replace(learned, **{name: value})(image)
    with pytest.raises(InputError, match=r"SsmCells: .*whitening .*network, images and windows"):
        replace(learned, image_size=(40, 48))(image.swapaxes(1, 2))
    with pytest.raises(InputError, match="SsmCells: expected images of 48 x 40 px, got 40 x 48"):
        learned(image.swapaxes(1, 2))
    assert len(replace(learned, batch_size=1)(image)) == 1
    cached = fit_to_database(cells, dataset.database, FeatureCache(tmp_path))
    assert cached.whitening.origin == learned.whitening.origin != ""


def test_images_that_cannot_be_read_are_left_out_only_where_they_may_be(cells, dataset, tmp_path):
    for name in dataset.database.names[:3]:
        shutil.copy(dataset.database.root / name, tmp_path)
    (tmp_path / dataset.database.names[1]).write_bytes(b"no image")
    folder = ImageFolder(tmp_path, dataset.database.names[:3])
    with pytest.raises(InputError, match=r"0001\.png: .*cannot be read .*skip"):
        fit_to_database(cells, folder, FeatureCache(tmp_path / "strict"))
    assert not whitening_files(tmp_path / "strict")
    learned = fit_to_database(cells, folder, FeatureCache(tmp_path / "s", skip_bad=True))
    few = fit_to_database(cells, ImageFolder(tmp_path, (folder.names[0], folder.names[2])), FeatureCache())
    np.testing.assert_array_equal(learned.whitening.components, few.whitening.components)


def test_parts_of_retrievers_are_learned_as_well(cells, model, dataset):
    of_cells = fit_to_database(Retrieval(Aggregated(cells, VladFitting(num_words=4))), dataset.database, FeatureCache())
    assert isinstance(of_cells.describer.extractor.whitening, Whitening)
    assert fit_to_database(RETRIEVAL, dataset.database, FeatureCache()) is RETRIEVAL


# The whole way


def test_the_database_is_looked_at_once_for_all_sequences(cells, small_street, dataset, tmp_path):
    labels, database = [], small_street / "database"
    several = datasets.folder(database, [small_street / "queries", database], ground_truth="none")
    options = {"candidates": 3, "matcher": CANDIDATE, "cache": labeled_cache(tmp_path, labels)}
    report = evaluate_parts(several, cells, RETRIEVAL, {"count": mfvpr.MatchCount()}, **options)
    assert labels.count("SsmCells whitening") == 1
    [first, second] = report.matched
    assert (first.matches[0].counts == 12).all()
    np.testing.assert_array_equal(report.systems["count"][1].scores, np.full((10, 3), 12))
    assert second.matches[0].counts.shape == (10, 3)
    with pytest.raises(InputError, match=r"^grid: .*NaN"):  # of 4 x 3 cells
        evaluate_parts(several, cells, RETRIEVAL, {"grid": GridAnchors(3)}, **options)


@pytest.mark.slow
def test_the_only_votes_of_the_nearest_windows_are_an_images_own(model, dataset, tmp_path):
    few = ImageFolder(dataset.database.root, dataset.database.names[:3])
    sequence = replace(dataset.only, images=ImageFolder(few.root, few.names[1:2]))
    retriever = SsmVoting(SsmWindows(model, whitening=WindowFitting(20)))
    [candidates] = retriever.shortlist(sequence, few, 1, FeatureCache(tmp_path)).candidates.indices
    assert candidates == [1]
    assert len(whitening_files(tmp_path)) == 1
    pipeline = mfvpr.Pipeline(RETRIEVAL.describer.extractor, retriever, candidates=3)
    matched = match_sequence(replace(dataset, database=few), sequence, pipeline)
    np.testing.assert_array_equal(matched.candidates.scores.sum(1), [36 * 3])
