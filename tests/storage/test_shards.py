"""Shards: many machines that share an evaluation without a word between them, whatever order they come in."""

import hashlib
import json
import random
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr.datasets import folder_dataset, sequences_dataset
from mfvpr.evaluation import match_sequence
from mfvpr.features import Aggregated, VladFitting
from mfvpr.reranking import FrameCorrelation, Fusion
from mfvpr.retrieval import Filtered, Retrieval
from mfvpr.storage import FeatureCache, NotYet, Shard
from mfvpr.storage.shards import shard_of
from mfvpr.storage.vectors import open_vector_store
from mfvpr.types import Shortlist
from mfvpr.utils import InputError
from mfvpr.utils.arrays import read_arrays, write_arrays
from tests.storage.extractors import SIFT, Counted, Mean, TwoScales

pytestmark = pytest.mark.thorough

VLAD = Retrieval(Aggregated(SIFT, VladFitting(num_words=8)))
SCORERS = {"histogram": mfvpr.HistogramOfShifts(), "count": mfvpr.MatchCount()}
HOW = {"candidates": 4, "fused": {"histogram": Fusion("zscore")}, "cohort": 1,
       "correlated": {"count": FrameCorrelation(1)}}  # fmt: skip


@pytest.fixture(scope="module")
def dataset(small_street):
    return folder_dataset(small_street / "database", small_street / "queries", ground_truth="order")


@pytest.fixture(scope="module")
def plain(dataset, tmp_path_factory):
    return mfvpr.evaluate(dataset, SIFT, VLAD, SCORERS, cache=FeatureCache(tmp_path_factory.mktemp("plain")), **HOW)


def shared(root, count, run, seed=0):
    """Shards in a random order, again and again, as schedulers start them; the result of whichever comes last."""
    random.seed(seed)
    waits, results = [], []
    while not results:
        for index in random.sample(range(count), count):
            try:
                results.append(run(FeatureCache(root, shard=Shard(index, count))))
            except NotYet as wait:
                waits.append(str(wait))
        assert len(waits) < 8 * count
    return results, waits


def assert_same(report, expected):
    for name, ranked in expected.systems.items():
        for ranking, expected_ranking in zip(report.systems[name], ranked, strict=True):
            np.testing.assert_array_equal(ranking.rows, expected_ranking.rows, err_msg=name)
            np.testing.assert_array_equal(ranking.scores, expected_ranking.scores, err_msg=name)
    for threshold in (0, 1):
        for name, recall in expected.recall([threshold]).items():
            np.testing.assert_array_equal(report.recall([threshold])[name].by_sequence, recall.by_sequence)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_shards_give_what_one_machine_gives(dataset, plain, tmp_path, count):
    """Frame correlation, which looks at the queries before, and a cohort, which looks at all images, among it."""
    extractor = Counted()
    filter = Retrieval(Aggregated(extractor, VladFitting(num_words=8)))

    def run(cache):
        return mfvpr.evaluate(dataset, extractor, filter, SCORERS, cache=cache, **HOW)

    results, waits = shared(tmp_path, count, run)
    for result in results:
        assert_same(result, plain)
    assert extractor.seen == len(dataset.database) + len(dataset.queries)  # each image once, by whomever
    assert bool(waits) == (count > 1)
    assert all(re.search(r"of \d+ are missing, of shards \d", wait) for wait in waits)
    again = mfvpr.evaluate(dataset, extractor, filter, SCORERS, cache=FeatureCache(tmp_path), **HOW)
    assert_same(again, plain)  # of anybody who is no shard: nothing is done again
    assert extractor.seen == len(dataset.database) + len(dataset.queries)


def test_local_features_are_those_of_candidates_only(dataset, tmp_path):
    """With a filter of its own descriptors, as for a single machine."""
    filter, plain_root = Retrieval(Mean()), tmp_path / "plain"
    expected = mfvpr.evaluate(dataset, SIFT, filter, SCORERS, candidates=2, cache=FeatureCache(plain_root))
    results, _ = shared(
        tmp_path / "s", 3, lambda cache: mfvpr.evaluate(dataset, SIFT, filter, SCORERS, candidates=2, cache=cache)
    )
    assert_same(results[0], expected)

    def files(root):
        return sorted(path.name for path in root.rglob("*-*.npz") if path.name[0].isdigit() and "Sift" in str(path))

    assert files(tmp_path / "s") == files(plain_root)


@pytest.mark.slow
def test_several_sequences_and_scales_and_more_shards_than_images(small_street, split, tmp_path):
    """On matches that memory does not hold."""
    several = sequences_dataset(
        small_street / "database", split, ground_truth="index", index_file="truth.csv", widen_index=True
    )
    extractor = TwoScales()
    how = {"candidates": 3, "memory": 1e-4}
    expected = mfvpr.evaluate(
        several, extractor, Retrieval(extractor), SCORERS, cache=FeatureCache(tmp_path / "s"), **how
    )
    for count in (3, 17):
        results, _ = shared(
            tmp_path / f"s{count}", count,
            lambda cache: mfvpr.evaluate(several, extractor, Retrieval(extractor), SCORERS, cache=cache, **how),
        )  # fmt: skip
        assert_same(results[0], expected)


@pytest.mark.parametrize("store", ["Sift", "matches", "scores"])
def test_damaged_rows_of_any_shard_are_made_again(dataset, tmp_path, store):
    def run(cache):
        try:
            return mfvpr.evaluate(dataset, SIFT, VLAD, SCORERS, candidates=3, cache=cache)
        except InputError as error:  # the row is removed, and its shard makes it again
            messages.append(str(error))
            raise NotYet(str(error)) from None

    messages = []
    expected = run(FeatureCache(tmp_path / "plain"))
    shared(tmp_path / "s", 2, run)
    rows = [path for path in (tmp_path / "s").glob(f"{store}-*/shards/*/[0-9]*-*.npz") if "-0.npz" not in path.name]
    rows[0].write_bytes(b"damaged")
    if store == "Sift":  # which nobody reads again, unless what is made of it is gone
        for path in (tmp_path / "s").glob("[ms]*-*"):
            shutil.rmtree(path)
    elif store == "matches":
        [row] = (tmp_path / "s").glob(f"scores-*/shards/*/{rows[0].name.partition('-')[0]}-*.npz")
        row.unlink()
    results, _ = shared(tmp_path / "s", 2, run)
    assert_same(results[0], expected)
    assert len(messages) == 1
    assert "are damaged on disk, the first in row" in messages[0]


def test_scores_are_known_by_their_scorers_and_candidates(dataset, split, small_street, tmp_path):
    """Whatever the order of the scorers, and the weights of the scales, which no feature depends on."""
    cache = FeatureCache(tmp_path, shard=Shard(0, 1))
    first = mfvpr.evaluate(dataset, SIFT, VLAD, SCORERS, candidates=3, cache=cache)
    turned = mfvpr.evaluate(dataset, SIFT, VLAD, dict(reversed(SCORERS.items())), candidates=3, cache=cache)
    assert [*turned.systems] == ["filter", "count", "histogram"]
    assert_same(turned, first)
    for weight in (1.0, 5.0):
        extractor = TwoScales(weight)
        how = (dataset, extractor, Retrieval(extractor), SCORERS)
        assert_same(mfvpr.evaluate(*how, cache=cache), mfvpr.evaluate(*how, cache=FeatureCache(tmp_path / "plain")))
    for path in tmp_path.glob("matches-*/shortlist.npz"):
        arrays = read_arrays(path, path.parent.name)
        write_arrays(path, arrays | {"indices": np.roll(arrays["indices"], 1, axis=0)}, path.parent.name)
    for path in tmp_path.glob("matches-*/shards/*/*.npz"):
        path.unlink()
    with pytest.raises(InputError, match=r"scores .*candidates.*shortlist"):
        mfvpr.evaluate(dataset, SIFT, VLAD, SCORERS, candidates=3, cache=cache)


class Drawn:
    """A filter that draws candidates anew, as machines whose bits differ may."""

    recipe = "drawn"

    def shortlist(self, sequence, database, num_candidates, cache):
        rng = np.random.default_rng()
        indices = np.array([rng.permutation(len(database))[:num_candidates] for _ in sequence.images.names], np.int32)
        return Filtered(Shortlist(indices, np.ones(indices.shape, np.float32), indices >= 0), {}, {})


def test_candidates_are_those_of_the_first_shard(dataset, tmp_path):
    results, _ = shared(
        tmp_path, 3, lambda cache: mfvpr.evaluate(dataset, SIFT, Drawn(), SCORERS, candidates=3, cache=cache)
    )
    paths = [path for path in tmp_path.glob("matches-*/shortlist.npz")]
    indices = read_arrays(paths[0], paths[0].parent.name)["indices"]
    np.testing.assert_array_equal(results[0].matched[0].candidates.indices, indices)


def test_rows_are_those_of_queries(dataset):
    for wrong in ([-1], [99]):
        with pytest.raises(InputError, match=r"rows: expected rows of 10 queries, got \["):
            match_sequence(dataset, dataset.only, SIFT, VLAD, 3, rows=wrong)


UNKNOWN = {"own": lambda matches: matches.mask.sum() * 1.0}


@pytest.mark.parametrize("scorers, words", [({}, "scorers: expected at least one"), (UNKNOWN, "own: a shard keeps")])
def test_scorers_that_no_store_can_know(dataset, tmp_path, scorers, words):
    with pytest.raises(InputError, match=words):
        mfvpr.evaluate(dataset, SIFT, VLAD, scorers, candidates=3, cache=FeatureCache(tmp_path, shard=Shard(0, 1)))


def test_what_was_bad_once_stays_so(small_street, tmp_path, monkeypatch):
    """An image that one shard could not read, and can be read now: all go on without it."""
    dataset = folder_dataset(small_street / "database", small_street / "queries", ground_truth="order")
    broken = [True]
    read = type(dataset.database).read

    def flaky(folder, row):
        if broken[0] and folder == dataset.database and row == 3:
            raise InputError("not now")
        return read(folder, row)

    monkeypatch.setattr(type(dataset.database), "read", flaky)

    def run(cache):
        try:
            cache = replace(cache, skip_bad=True)
            return mfvpr.evaluate(dataset, SIFT, VLAD, SCORERS, candidates=5, cache=cache)
        finally:
            broken[0] = False if cache.shard.index == shard_of("0003.png", 2) else broken[0]

    results, _ = shared(tmp_path, 2, run)
    for result in results:
        assert result.matched[0].bad_database.keys() == {3}
        assert not (result.matched[0].candidates.indices == 3).any()


def test_stores_of_shards_have_the_same_rows_byte_by_byte(dataset, tmp_path):
    def run(cache):
        return mfvpr.evaluate(dataset, SIFT, VLAD, SCORERS, candidates=3, cache=cache)

    run(FeatureCache(tmp_path / "plain"))
    shared(tmp_path / "shards", 2, run)

    def hashes(root):
        return {
            (path.relative_to(root).parts[0], path.name): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in root.rglob("[0-9]*-*.npz") if not path.relative_to(root).parts[0].startswith("scores")
        }  # fmt: skip

    assert hashes(tmp_path / "shards") == hashes(tmp_path / "plain")
    for path in (tmp_path / "shards").glob("*/shards/*"):
        assert path.name in ("0-of-2", "1-of-2")
        assert json.loads((path / "manifest.json").read_text())["format"].startswith("mfvpr ")


def test_a_bad_image_of_one_shard_is_known_to_all(small_street, tmp_path):
    for side in ("database", "queries"):
        (tmp_path / side).mkdir()
        for path in sorted((small_street / side).glob("*.png"))[:6]:
            (tmp_path / side / path.name).write_bytes(path.read_bytes())
    (tmp_path / "database" / "0002.png").write_bytes(b"no image")
    dataset = folder_dataset(tmp_path / "database", tmp_path / "queries", ground_truth="order")

    def run(cache):
        cache = replace(cache, skip_bad=True)
        return mfvpr.evaluate(dataset, SIFT, VLAD, SCORERS, candidates=3, cache=cache)

    expected = run(FeatureCache(tmp_path / "plain"))
    for count in (2, 4):
        results, _ = shared(tmp_path / f"s{count}", count, run)
        assert_same(results[0], expected)
        assert results[0].matched[0].bad_database.keys() == {2}
    [bad] = (tmp_path / "s2").glob("Sift*/shards/*/bad.json")
    bad.write_text("[]")
    with pytest.raises(InputError, match=r"bad\.json: expected reasons by row"):
        run(FeatureCache(tmp_path / "s2", shard=Shard(0, 3)))


def test_stores_of_two_shards_are_written_at_the_same_time_those_of_one_are_not(tmp_path):
    def opened(index):
        return open_vector_store(tmp_path / "s", {"of": "any"}, num_images=4, shard=Shard(index, 2))

    with opened(0) as first, opened(1) as second:
        first.write({0: np.ones(3)})
        second.write({1: np.zeros(3), 3: np.ones(3)})
        with pytest.raises(InputError, match="0-of-2: in use by process"), opened(0):
            pass
        first.look()
        np.testing.assert_array_equal(first.done, [True, True, False, True])
        assert [row for row, _ in first.read()] == [0, 1, 3]
    with open_vector_store(tmp_path / "s", {"of": "any"}, num_images=4) as alone:  # of no shard
        alone.write({2: np.full(3, 2)})
        np.testing.assert_array_equal([vector[0] for _, vector in alone.read()], [1, 0, 2, 1])
    with pytest.raises(InputError, match=r'recipe\.of="any"'):
        open_vector_store(tmp_path / "s", {"of": "another"}, num_images=4, shard=Shard(0, 2))


def test_a_shard_needs_a_folder():
    with pytest.raises(InputError, match="shard=0/2: expected a root as well"):
        FeatureCache(shard=Shard(0, 2))
