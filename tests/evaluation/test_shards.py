"""Shards: many machines fill one cache, in any order, and a run without shards gives the results."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr import datasets
from mfvpr.datasets import IndexFile
from mfvpr.evaluation import FrameCorrelation, Fusion, Pipeline, Shard, System, fill_shard, rank_dataset
from mfvpr.evaluation.shards import shard_of
from mfvpr.features import Aggregated, VladFitting
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
from mfvpr.utils import InputError
from tests.storage.extractors import SIFT, Counted, Mean, TwoScales

pytestmark = pytest.mark.thorough

SCORERS = {"histogram": mfvpr.HistogramOfShifts(), "count": mfvpr.MatchCount()}


def system_of(extractor, retriever=None, candidates=4):
    """Frame correlation looks at the queries before."""
    retriever = retriever or Retrieval(Aggregated(extractor, VladFitting(num_words=8)))
    ways = {"histogram": Fusion("zscore")}, {"count": FrameCorrelation(1)}
    return System(Pipeline(extractor, retriever, candidates=candidates), SCORERS, *ways)


def row_hashes(root):
    """Hashes of rows; those of features are named by image."""
    return {
        (path.relative_to(root).parts[0], path.name): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in root.rglob("[0-9a-f]*.npz")
    }


def assert_same(result, expected):
    for name, ranked in expected.systems.items():
        for ranking, expected_ranking in zip(result.systems[name], ranked, strict=True):
            np.testing.assert_array_equal(ranking.rows, expected_ranking.rows, err_msg=name)
            np.testing.assert_array_equal(ranking.scores, expected_ranking.scores, err_msg=name)


def share(dataset, system, root, count, **options):
    """Start every shard twice, and return the lines and the result of a run without shards."""
    order = [*range(count)][::-1]
    lines = [fill_shard(dataset, system, FeatureCache(root, **options), Shard(index, count)) for index in 2 * order]
    return lines, rank_dataset(dataset, system, cache=FeatureCache(root, **options))


@pytest.mark.parametrize("count", [1, 3])
def test_shards_give_what_one_machine_gives(dataset, tmp_path, count):
    expected = rank_dataset(dataset, system_of(SIFT), cache=FeatureCache(tmp_path / "plain"))
    extractor = Counted()
    lines, result = share(dataset, system_of(extractor), tmp_path / "s", count)
    assert_same(result, expected)
    assert {name for _, name in row_hashes(tmp_path / "s")} == {name for _, name in row_hashes(tmp_path / "plain")}
    assert extractor.seen == len(dataset.database) + len(dataset.queries)  # each image once
    waiting = [line for line in lines if "are not; start it again" in line]
    assert len(waiting) == count - 1
    assert all("are done" in line for line in lines[count:])


def test_matches_are_made_by_shards_alone(dataset, tmp_path):
    """The run without shards finds and matches nothing, even if its retrieval would rank otherwise."""
    system = system_of(SIFT, Retrieval(Mean()))
    _, result = share(dataset, system, tmp_path, 2)
    assert "matches read" in result.seconds
    assert "matching" not in result.seconds


@pytest.mark.slow
def test_several_sequences_and_scales_and_more_shards_than_images(small_street, split, tmp_path):
    several = datasets.folder(small_street / "database", split, ground_truth=IndexFile("truth.csv", True))
    extractor = TwoScales()
    system = system_of(extractor, Retrieval(extractor), candidates=3)
    expected = rank_dataset(several, system, cache=FeatureCache(tmp_path / "plain"))
    assert_same(share(several, system, tmp_path / "s", 17)[1], expected)


def test_a_bad_image_of_one_shard_is_bad_for_all(dataset, small_street, tmp_path):
    root = tmp_path / "queries"
    root.mkdir()
    for path in sorted((small_street / "queries").glob("*.png")):
        (root / path.name).write_bytes(path.read_bytes())
    (root / "0004.png").write_bytes(b"no image")
    [sequence] = dataset.sequences
    images = replace(sequence.images, root=root)
    damaged, system = replace(dataset, sequences=(replace(sequence, images=images),)), system_of(SIFT)
    _, result = share(damaged, system, tmp_path / "s", 3, skip_bad=True)
    assert [*result.matched[0].bad_queries] == [4]
    assert_same(result, rank_dataset(damaged, system, cache=FeatureCache(tmp_path / "plain", skip_bad=True)))


@pytest.mark.parametrize("text", ["2/2", "-1/2", "1", "0/0", "0/10000", "x/2", "٣/8"])
def test_what_is_no_shard_is_refused(text):
    with pytest.raises(InputError, match="expected i/n"):
        Shard.parse(text)


def test_a_shard_needs_a_folder(dataset):
    with pytest.raises(InputError, match="cache with a root"):
        fill_shard(dataset, system_of(SIFT), FeatureCache(), Shard(0, 2))


def test_names_decide_whatever_their_order():
    names = [f"{number}.png" for number in range(100)]
    parts = [Shard(index, 7).rows(names) for index in range(7)]
    assert sorted(row for part in parts for row in part) == [*range(100)]
    assert {names[row] for row in parts[3]} == {names[::-1][row] for row in Shard(3, 7).rows(names[::-1])}
    assert (shard_of("0000.png", 7), shard_of("ü/1.jpg", 7)) == (5, 3)  # another hash would orphan half-filled caches
