"""Matchers that run on the host: programs of users, and files of other programs."""

import h5py
import jax.numpy as jnp
import numpy as np
import pytest

import mfvpr
from mfvpr.datasets import Dataset, ImageFolder
from mfvpr.evaluation.dataset_ranking import match_sequence
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.retrieval import MatchFiles, Retrieval
from mfvpr.retrieval.precomputed import File
from mfvpr.storage import FeatureCache
from mfvpr.utils.runtime import Runtime
from tests.io.checks import one_line_error

SIFT = Sift(image_size=(160, 120))
SCORERS = {"histogram": mfvpr.HistogramOfShifts(), "count": mfvpr.MatchCount()}


def pipeline(matcher, candidates=4):
    return mfvpr.Pipeline(SIFT, Retrieval(Aggregated(SIFT, VladFitting(num_words=4))), matcher, candidates)


def few(dataset, count=3):
    """The first queries, against all of the database."""
    [sequence] = dataset.sequences
    images = ImageFolder(sequence.images.root, sequence.images.names[:count])
    return Dataset("few", dataset.database, (mfvpr.datasets.QuerySequence("few", images, None),))


def matched(data, matcher, root=None, log=None):
    runtime = Runtime(log=log) if log else Runtime()
    return match_sequence(data, data.only, pipeline(matcher), cache=FeatureCache(root), runtime=runtime)


def mutual_neighbors(first, second):
    """Nearest neighbors by NumPy."""
    products = first.descriptors @ second.descriptors.T
    best0, best1 = products.argmax(1), products.argmax(0)
    mutual = np.flatnonzero(best1[best0] == np.arange(len(best0)))
    return mutual, best0[mutual]


class Counting:
    """A function of two images that remembers its calls; matches are the corners of a square."""

    def __init__(self, shift=3.0, stop_after=None):
        self.calls, self.shift, self.stop_after = [], shift, stop_after

    def __call__(self, first, second):
        assert first.dtype == second.dtype == np.uint8
        if len(self.calls) == self.stop_after:
            raise KeyboardInterrupt
        self.calls.append((first.shape, second.shape))
        points = np.array([[8.0, 8], [20, 8], [8, 20], [20, 20]])
        return points, points + self.shift, np.array([0.5, 1, 1, 0.25])


def test_a_function_of_features_gives_the_matches_of_the_same_matcher_in_jax(dataset):
    data = few(dataset)
    matchers = mfvpr.NearestNeighborMatcher(), mfvpr.HostMatcher(mutual_neighbors, "neighbors", inputs="features")
    ours, theirs = (matched(data, matcher) for matcher in matchers)
    np.testing.assert_array_equal(theirs.matches[0].counts, ours.matches[0].counts)
    assert ours.matches[0].counts.min() > 5
    for query in range(len(data.queries)):
        first, second = ours.matches[0].matches[query], theirs.matches[0].matches[query]
        for name in ("points0", "points1", "scores0", "scores1", "index0", "index1", "image_size0", "image_size1"):
            np.testing.assert_array_equal(getattr(second, name), getattr(first, name), err_msg=name)
        np.testing.assert_array_equal(second.count1, first.count1)
        assert len(np.unique(first.count1)) > 1
        np.testing.assert_allclose(second.distance, first.distance, atol=1e-5)
        assert (second.confidence == 1).all()


@pytest.mark.parametrize("kind", ["pair", "mapping", "jax"])
def test_a_function_of_images_gives_points_in_the_images_that_it_sees(dataset, kind):
    function, data = Counting(), few(dataset, 2)
    wrappers = {
        "pair": function,
        "mapping": lambda *pair: dict(
            zip(("matched_kpts0", "matched_kpts1", "matched_confidences"), function(*pair), strict=True)
        ),
        "jax": lambda *pair: [jnp.asarray(part) for part in function(*pair)],
    }
    result = matched(data, mfvpr.HostMatcher(wrappers[kind], "square", image_size=(80, 60)))
    assert set(function.calls) == {((60, 80, 3), (60, 80, 3))}
    matches = result.matches[0].matches[1]
    np.testing.assert_array_equal(matches.points1 - matches.points0, np.full((16, 2), 3))
    np.testing.assert_array_equal(matches.confidence[:4], np.float32([0.5, 1, 1, 0.25]))
    assert matches.image_size1.tolist() == [[80, 60]] * 4
    score = np.asarray(mfvpr.score_candidates(SCORERS["count"], result.matches[0][1]))
    np.testing.assert_allclose(score, np.full(4, 2.75))  # the sum of the confidences


def test_batches_of_pairs(dataset):
    sizes, alone = [], Counting()

    def match(firsts, seconds):
        sizes.append((len(firsts), len(seconds)))
        return [Counting()(*pair) for pair in zip(firsts, seconds, strict=True)]

    data = few(dataset, 2)
    batched = matched(data, mfvpr.HostMatcher(match, "square", batch_size=3))
    single = matched(data, mfvpr.HostMatcher(alone, "square"))
    assert set(alone.calls) == {((240, 320, 3), (240, 320, 3))}  # images keep their size by default
    assert sizes == [(3, 3), (1, 1)] * 2
    np.testing.assert_array_equal(batched.matches[0].matches[0].points1, single.matches[0].matches[0].points1)
    with one_line_error("a list of the matches of 3 pairs"):
        matched(data, mfvpr.HostMatcher(lambda firsts, seconds: [], "square", batch_size=3))


def test_a_cache_calls_the_function_once_and_goes_on_after_an_interruption(dataset, tmp_path):
    data, first, second = few(dataset, 3), Counting(stop_after=9), Counting()
    with pytest.raises(KeyboardInterrupt):
        matched(data, mfvpr.HostMatcher(first, "square"), tmp_path)
    result = matched(data, mfvpr.HostMatcher(second, "square"), tmp_path)
    assert len(second.calls) == 4  # two of three queries were done
    again, other = Counting(), Counting(shift=5)
    same = matched(data, mfvpr.HostMatcher(again, "square"), tmp_path)
    assert not again.calls
    np.testing.assert_array_equal(same.matches[0].matches[2].points1, result.matches[0].matches[2].points1)
    changed = matched(data, mfvpr.HostMatcher(other, "square, version 2"), tmp_path)
    assert len(other.calls) == 12
    assert not np.array_equal(changed.matches[0].matches[0].points1, result.matches[0].matches[0].points1)


def test_pairs_without_matches_score_0(dataset):
    nowhere = mfvpr.HostMatcher(lambda first, second: (np.zeros((0, 2)), np.zeros((0, 2))), "nowhere")
    lines = []
    runtime = Runtime(log=lines.append)
    result = mfvpr.evaluate(few(dataset, 1), mfvpr.System(pipeline(nowhere), SCORERS), runtime=runtime)
    assert any("4 of 4 pairs have no matches" in line for line in lines)
    assert (result.only.systems["count"][0].scores == 0).all()


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (None, "two arrays"),
        ((np.zeros((4, 2)), np.zeros((3, 2))), "as many points"),
        ((np.full((4, 2), 1e6), np.zeros((4, 2))), "in an image of"),
        ((np.zeros((4, 2)), np.zeros((4, 2)), np.full(4, 3.0)), "0 to 1"),
        (([[1.0], [2.0, 3.0]], np.zeros((2, 2))), "expected dense arrays"),
        ((np.zeros((4, 2)), np.ma.masked_equal(np.eye(4, 2), 1.0)), "masked"),
    ],
)
def test_wrong_results_of_a_function(dataset, result, message):
    with one_line_error(message, "square: query 0 and database image"):
        matched(few(dataset, 1), mfvpr.HostMatcher(lambda first, second: result, "square"))


@pytest.mark.parametrize("numbers", [([0, 1], [0, 10_000]), ([0.5], [1.0]), ([-1], [0]), ([0, 1], [0])])
def test_wrong_numbers_of_keypoints(dataset, numbers):
    matcher = mfvpr.HostMatcher(lambda first, second: tuple(map(np.array, numbers)), "numbers", inputs="features")
    with one_line_error("keypoints", "numbers: query 0"):
        matched(few(dataset, 1), matcher)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": ""}, "name"),
        ({"image_size": (100.5, 50)}, "image_size"),
        ({"inputs": "features", "image_size": (64, 64)}, "image_size"),
    ],
)
def test_wrong_settings(options, message):
    with one_line_error(message):
        mfvpr.HostMatcher(Counting(), **{"name": "square", **options})


def test_where_a_matcher_must_be_compiled_it_is_refused(dataset, tmp_path):
    system = mfvpr.System(pipeline(mfvpr.HostMatcher(Counting(), "square")), SCORERS)
    with one_line_error("a map needs a matcher that JAX can compile"):
        mfvpr.Map.create(tmp_path / "map", dataset.database.root, system)


def write_hloc_matches(path, result, sequence, database, skip=()):
    """Matches as hloc writes them, without the pairs in `skip`; names begin with the folders of the images."""
    with h5py.File(path, "w", libver="latest") as file:
        for query, name in enumerate(sequence.names):
            flat, ends = result.matches[0].matches[query], np.cumsum(result.matches[0].counts[query])
            for place, row in enumerate(result.candidates.indices[query]):
                if (query, place) in skip:
                    continue
                part = slice(ends[place] - result.matches[0].counts[query, place], ends[place])
                numbers = np.full(int(flat.count0), -1, np.int16)
                numbers[flat.index0[part]] = flat.index1[part]
                pair = f"{sequence.root.name}-{name}/{database.root.name}-{database.names[row]}"
                file[f"{pair}/matches0"] = numbers
    return path


@pytest.fixture(scope="module")
def files(dataset, tmp_path_factory):
    """hloc's features of all images, and matches by a matcher of this library."""
    root, data = tmp_path_factory.mktemp("hloc"), few(dataset, 3)
    result = matched(data, mfvpr.NearestNeighborMatcher())
    images = {"queries": data.queries, "database": data.database}
    with h5py.File(root / "feats.h5", "w", libver="latest") as file:
        for name, folder in images.items():
            [features] = FeatureCache().local(folder, SIFT)
            for row, image in features.read(range(len(folder))):
                group = file.create_group(f"{name}/{folder.names[row]}")
                group["keypoints"], group["descriptors"] = image.keypoints, image.descriptors.T
                group["scores"], group["image_size"] = image.scores, np.int64(image.image_size)
    write_hloc_matches(root / "matches.h5", result, data.queries, data.database)
    write_hloc_matches(root / "fewer.h5", result, data.queries, data.database, skip={(0, 1), (2, 0)})
    return root, data, result


def match_files(root, data, name):
    features = {folder.root: File(root / "feats.h5") for folder in (data.queries, data.database)}
    return MatchFiles({data.queries.root: File(root / name)}, features=features)


def test_imported_matches_have_the_scores_of_the_matcher_that_made_them(files):
    root, data, result = files
    imported = matched(data, match_files(root, data, "matches.h5"))
    np.testing.assert_array_equal(imported.matches[0].counts, result.matches[0].counts)
    for weight in (mfvpr.FeatureScoreWeight(), mfvpr.DescriptorDistanceWeight()):
        scorer = mfvpr.HistogramOfShifts(weight=weight)
        for query in range(3):
            ours, theirs = (mfvpr.score_candidates(scorer, each.matches[0][query]) for each in (result, imported))
            np.testing.assert_allclose(theirs, ours, rtol=1e-5)


def test_missing_pairs_are_a_warning_of_every_run_and_score_0(files, tmp_path):
    root, data, _ = files
    for _ in range(2):  # the second reads the cache
        lines = []
        imported = matched(data, match_files(root, data, "fewer.h5"), tmp_path, lines.append)
        [line] = [line for line in lines if "no matches of" in line]
        assert "2 of 12 pairs" in line
        assert imported.matches[0].counts[0, 1] == imported.matches[0].counts[2, 0] == 0
        assert (imported.matches[0].counts > 0).sum() == 10
