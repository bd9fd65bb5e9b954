"""Shards: many machines fill one store, in any order, and a run without shards gives the results."""

import hashlib
import json
import random
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mfvpr
from mfvpr import datasets
from mfvpr.datasets import IndexFile
from mfvpr.features import Aggregated, VladFitting
from mfvpr.reranking import FrameCorrelation, Fusion
from mfvpr.retrieval import Retrieval, RetrievalResult
from mfvpr.storage import FeatureCache, NotYet, Shard
from mfvpr.storage.shards import indices, shard_of, together
from mfvpr.storage.vectors import open_vector_store
from mfvpr.types import Shortlist
from mfvpr.utils import InputError
from mfvpr.utils.arrays import read_arrays
from tests.builders import evaluate_parts
from tests.storage.extractors import SIFT, Counted, Mean, TwoScales

pytestmark = pytest.mark.thorough

VLAD = Retrieval(Aggregated(SIFT, VladFitting(num_words=8)))
SCORERS = {"histogram": mfvpr.HistogramOfShifts(), "count": mfvpr.MatchCount()}
HOW = {"candidates": 4, "fused": {"histogram": Fusion("zscore")}, "cohort": 1,
       "correlated": {"count": FrameCorrelation(1)}}  # fmt: skip


def run_of(dataset, extractor=SIFT, retriever=VLAD, *, skip_bad=False, **how):
    """A function of a cache: the evaluation."""
    return lambda cache: evaluate_parts(
        dataset, extractor, retriever, SCORERS, cache=replace(cache, skip_bad=skip_bad), **how
    )


def counted_run(dataset):
    """The evaluation with all options, and the extractor that counts its images."""
    extractor = Counted()
    return run_of(dataset, extractor, Retrieval(Aggregated(extractor, VladFitting(num_words=8))), **HOW), extractor


@pytest.fixture(scope="module")
def plain(dataset, tmp_path_factory):
    """The result without shards, and the hashes of its rows."""
    root = tmp_path_factory.mktemp("plain")
    return counted_run(dataset)[0](FeatureCache(root)), row_hashes(root)


def row_hashes(root):
    return {
        (path.relative_to(root).parts[0], path.name): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in root.rglob("[0-9]*-*.npz")
    }


def shared(root, count, run, seed=0):
    """Start shards in a random order until all are complete; the result of a run without shards, and the lines."""
    random.seed(seed)
    incomplete, lines = {*range(count)}, []
    while incomplete:
        for index in random.sample(range(count), count):
            with pytest.raises(NotYet) as end:
                run(FeatureCache(root, shard=Shard(index, count)))
            incomplete -= {index} if end.value.is_complete else set()
            lines.append(str(end.value))
        assert len(lines) < 8 * count
    return run(FeatureCache(root)), lines


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
    run, extractor = counted_run(dataset)
    result, lines = shared(tmp_path, count, run)
    assert_same(result, plain[0])
    assert row_hashes(tmp_path) == plain[1]
    assert extractor.seen == len(dataset.database) + len(dataset.queries)  # each image once
    assert lines[-1] == "its images and queries are done"
    missing = [line for line in lines if line != lines[-1]]
    assert bool(missing) == (count > 1)
    assert all(re.search(r"of \d+ are missing, of shards \d", line) for line in missing)
    folders = {path.parent for path in tmp_path.rglob("[0-9]*-*.npz")}
    assert {path.parent.name for path in folders} == {"shards"}
    for folder in folders:
        assert folder.name in [f"{index}-of-{count}" for index in range(count)]
        assert json.loads((folder / "manifest.json").read_text())["format"].startswith("mfvpr ")


def test_local_features_are_those_of_candidates_only(dataset, tmp_path):
    """With a retrieval of its own descriptors, as for a single machine."""
    run = run_of(dataset, retriever=Retrieval(Mean()), candidates=2)
    expected = run(FeatureCache(tmp_path / "plain"))
    result, _ = shared(tmp_path / "s", 3, run)
    assert_same(result, expected)
    assert row_hashes(tmp_path / "s") == row_hashes(tmp_path / "plain")


@pytest.mark.slow
def test_several_sequences_and_scales_and_more_shards_than_images(small_street, split, tmp_path):
    """On matches that memory does not hold."""
    several = datasets.folder(small_street / "database", split, ground_truth=IndexFile("truth.csv", is_widened=True))
    extractor = TwoScales()
    run = run_of(several, extractor, Retrieval(extractor), candidates=3, runtime=mfvpr.Runtime(memory=1e-4))
    expected = run(FeatureCache(tmp_path / "s"))
    for count in (3, 17):
        assert_same(shared(tmp_path / f"s{count}", count, run)[0], expected)


@pytest.mark.parametrize("store", ["Sift", "matches"])
def test_damaged_rows_of_any_shard_are_made_again(dataset, tmp_path, store):
    def run(cache):
        try:
            return run_of(dataset, candidates=3)(cache)
        except InputError as error:  # the row is removed, and made again
            messages.append(str(error))
            return run(cache)

    messages = []
    expected = run(FeatureCache(tmp_path / "plain"))
    shared(tmp_path / "s", 2, run)
    rows = [path for path in (tmp_path / "s").glob(f"{store}-*/shards/*/[0-9]*-*.npz") if "-0.npz" not in path.name]
    rows[0].write_bytes(b"damaged")
    if store == "Sift":  # which nobody reads again, unless what is made of it is gone
        [matches] = (tmp_path / "s").glob("matches-*")
        shutil.rmtree(matches)
    result, _ = shared(tmp_path / "s", 2, run)
    assert_same(result, expected)
    assert len(messages) == 1
    assert "are damaged on disk, the first in row" in messages[0]


class Drawn:
    """A retriever that draws candidates anew, as machines whose bits differ may."""

    recipe = "drawn"

    def shortlist(self, sequence, database, num_candidates, cache):
        rng = np.random.default_rng()
        indices = np.array([rng.permutation(len(database))[:num_candidates] for _ in sequence.images.names], np.int32)
        return RetrievalResult(Shortlist(indices, np.ones(indices.shape, np.float32), indices >= 0), {}, {})


def test_candidates_are_those_of_the_first_shard(dataset, tmp_path):
    run = run_of(dataset, retriever=Drawn(), candidates=3)
    result, _ = shared(tmp_path, 3, run)
    [path] = tmp_path.glob("matches-*/shortlist.npz")
    expected = read_arrays(path, path.parent.name)["indices"]
    np.testing.assert_array_equal(result.matched[0].candidates.indices, expected)
    for row in path.parent.glob("shards/1-of-3/[0-9]*-*.npz"):  # a run without shards matches what is missing
        row.unlink()
    np.testing.assert_array_equal(run(FeatureCache(tmp_path)).matched[0].candidates.indices, expected)


def test_what_was_bad_once_stays_so(dataset, tmp_path, monkeypatch):
    """An image that one shard could not read, and can be read now: all go on without it."""
    broken = [True]
    read = type(dataset.database).read

    def flaky(folder, row):
        if broken[0] and folder == dataset.database and row == 3:
            raise InputError("not now")
        return read(folder, row)

    monkeypatch.setattr(type(dataset.database), "read", flaky)

    def run(cache):
        try:
            return run_of(dataset, skip_bad=True, candidates=5)(cache)
        finally:
            broken[0] &= cache.shard is None or cache.shard.index != shard_of("0003.png", 2)

    first, _ = shared(tmp_path, 2, run)
    [matches] = tmp_path.glob("matches-*")
    shutil.rmtree(matches)
    for result in (first, run(FeatureCache(tmp_path))):
        assert result.matched[0].bad_database.keys() == {3}
        assert not (result.matched[0].candidates.indices == 3).any()


def test_a_bad_image_of_one_shard_is_known_to_all(small_street, tmp_path):
    for side in ("database", "queries"):
        (tmp_path / side).mkdir()
        for path in sorted((small_street / side).glob("*.png"))[:6]:
            (tmp_path / side / path.name).write_bytes(path.read_bytes())
    (tmp_path / "database" / "0002.png").write_bytes(b"no image")
    dataset = datasets.folder(tmp_path / "database", tmp_path / "queries", ground_truth="order")

    run = run_of(dataset, skip_bad=True, candidates=3)
    expected = run(FeatureCache(tmp_path / "plain"))
    for count in (2, 4):
        result, _ = shared(tmp_path / f"s{count}", count, run)
        assert_same(result, expected)
        assert result.matched[0].bad_database.keys() == {2}
    [bad] = (tmp_path / "s2").glob("Sift*/shards/*/bad.json")
    bad.write_text("[]")
    [matches] = (tmp_path / "s2").glob("matches-*")
    shutil.rmtree(matches)
    for shard in (Shard(0, 3), None):
        with pytest.raises(InputError, match=r"bad\.json: expected reasons by row"):
            run(FeatureCache(tmp_path / "s2", shard=shard))


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


@given(st.lists(st.text(st.characters(codec="utf-8"), min_size=1), unique=True), st.integers(1, 20), st.randoms())
def test_every_name_is_of_one_shard_whatever_the_order(names, count, rng):
    rows = [Shard(index, count).rows(names) for index in range(count)]
    assert sorted(row for rows_of_shard in rows for row in rows_of_shard) == [*range(len(names))]
    shuffled = [*names]
    rng.shuffle(shuffled)
    for index, rows_of_shard in enumerate(rows):
        assert {shuffled[row] for row in Shard(index, count).rows(shuffled)} == {names[row] for row in rows_of_shard}
    assert Shard(0, count).rows(names, range(len(names))[:1]) == [row for row in rows[0] if row == 0]


def test_names_are_spread_and_assigned_for_ever():
    names = [f"image{row:04d}.jpg" for row in range(8000)]
    sizes = np.array([len(Shard(index, 8).rows(names)) for index in range(8)])
    assert abs(sizes - 1000).max() < 5 * np.sqrt(1000)
    digest = hashlib.sha256(b"image0000.jpg").digest()
    assert shard_of("image0000.jpg", 8) == int.from_bytes(digest[:8], "big") % 8
    assert shard_of("\udcff.jpg", 7) == int.from_bytes(hashlib.sha256(b"\xff.jpg").digest()[:8], "big") % 7


@pytest.mark.parametrize(
    "text", ["", "1", "1/", "/2", "2/2", "-1/2", "0/0", "1.0/2", "0/99999", "0/2/3", " 0/2", "a/b"]
)
def test_what_is_no_shard(text):
    with pytest.raises(InputError, match=r"^shard="):
        Shard.parse(text)


def test_array_expressions():
    assert indices([]) == ""
    assert indices([4, 2, 3, 0, 3]) == "0,2-4"
    assert str(Shard.parse("03/8")) == "3/8"


@pytest.mark.parametrize(
    "ends, message, shards",
    [
        ([("a", {1, 2}), ("done", ()), ("b", {4}), ("a", {1})], "a; b", {1, 2, 4}),
        ([("done", ()), ("done", ())], "done", set()),
    ],
)
def test_what_is_missing_does_not_keep_the_rest(ends, message, shards):
    """A shard is complete if all that it does is."""
    calls = []

    def end(line, shards):
        calls.append(line)
        raise NotYet(line, shards)

    with pytest.raises(NotYet, match=f"^{message}$") as error:
        together(lambda: calls.append("first"), *(lambda of=of: end(*of) for of in ends))
    assert calls == ["first", *(line for line, _ in ends)]
    assert (error.value.shards, error.value.is_complete) == (shards, not shards)
    assert together(lambda: 1, lambda: 2) == [1, 2]
