"""A whole evaluation in one call: sequences, what is kept, and files of other programs in place of our own stages."""

import itertools
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mfvpr
from mfvpr import datasets
from mfvpr.datasets import IndexFile, Positives
from mfvpr.evaluation import Fusion, match_sequence
from mfvpr.evaluation.dataset_ranking import KS
from mfvpr.evaluation.statistics import path_test
from mfvpr.features import Aggregated, VladFitting
from mfvpr.io import write_features, write_global_descriptors, write_shortlist
from mfvpr.report.evaluations import EvaluationReport, recall_table
from mfvpr.report.run_files import write_gains
from mfvpr.report.runs import read_csv
from mfvpr.retrieval import DescriptorFiles, FeatureFiles, Retrieval, ShortlistFiles
from mfvpr.retrieval.precomputed import File
from mfvpr.storage import FeatureCache
from mfvpr.utils import runtime
from mfvpr.utils.fingerprints import fingerprint
from tests.builders import evaluate_parts
from tests.evaluation.conftest import SCORERS, SIFT, VLAD
from tests.programs import typed
from tests.storage.extractors import Mean

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def several(split, small_street):
    return datasets.folder(small_street / "database", split, ground_truth=IndexFile("truth.csv", is_widened=True))


@pytest.fixture(scope="module")
def result(dataset):
    return evaluate_parts(
        dataset, SIFT, VLAD, SCORERS, candidates=5, fused={"histogram": Fusion(c=10.0)}, final="count"
    )


def test_systems_and_their_recall(dataset, result):
    assert list(result.systems) == ["retrieval", "histogram", "count", "histogram + retrieval"]
    [matched] = result.matched
    for ranked in (ranked for [ranked] in result.systems.values()):
        assert ranked.rows.shape == (10, 5)
        assert (np.diff(ranked.scores, axis=1) <= 0).all()
        np.testing.assert_array_equal(np.sort(ranked.rows), np.sort(matched.candidates.indices))
    recall = result.recall([0, 1], [1, 5])["histogram"]
    [ranked] = result.systems["histogram"]
    expected = [[mfvpr.recall_at_k(ranked.rows, dataset.truth.positives(t), [k])[0] for k in (1, 5)] for t in (0, 1)]
    np.testing.assert_allclose(recall.by_sequence, [expected])
    np.testing.assert_array_equal(recall.mean, recall.pooled)
    assert result.recall([])["histogram"].by_sequence.shape == (1, 0, len(KS))


def test_sequences_are_evaluated_by_themselves_with_their_means(several, result, tmp_path):
    parts = evaluate_parts(several, SIFT, VLAD, SCORERS, candidates=5, final="count")
    [joint] = result.systems["count"]
    rows = np.concatenate([ranked.rows for ranked in parts.systems["count"]])
    np.testing.assert_array_equal(rows, joint.rows)
    recall = parts.recall([0, 1], [1])["count"]
    np.testing.assert_allclose(recall.pooled, result.recall([0, 1], [1])["count"].pooled)
    np.testing.assert_allclose(recall.mean, recall.by_sequence.mean(axis=0))
    evaluation = EvaluationReport(parts, [0, 1], [1])
    table = recall_table(evaluation.rows())
    assert [line[:2] for line in table.rows[:4]] == [
        ["retrieval", name] for name in ("first", "second", "mean", "pooled")
    ]
    write_gains(tmp_path, evaluation)
    gains = [(tmp_path / "sequences" / name / "gains.csv").read_text().splitlines() for name in ("first", "second")]
    assert list(map(len, gains)) == [4, 8]
    places = [line.split(",")[1] for lines in gains for line in lines[1:]]
    assert places == list(map(str, range(10)))  # the two ends of one path, so that tests know what is next to what
    hits = {name: evaluation.hits(name) for name in parts.systems}
    for line in read_csv(tmp_path / "differences.csv"):
        first, second, only_first, _, _, *path = line.values()
        assert int(only_first) == (hits[first] > hits[second]).sum()
        assert [float(value) for value in path] == pytest.approx(path_test(hits[first], hits[second]), rel=1e-6)


def test_only_candidates_are_extracted(dataset, tmp_path):
    few = replace(dataset.only, images=replace(dataset.queries, names=dataset.queries.names[:2]), truth=None)
    lines = []
    cache = FeatureCache(tmp_path, runtime=mfvpr.Runtime(log=lines.append))
    matched = match_sequence(dataset, few, mfvpr.Pipeline(SIFT, Retrieval(Mean()), candidates=3), cache=cache)
    wanted = np.unique(matched.candidates.indices)
    assert len(wanted) < 7
    [counts] = FeatureCache(tmp_path).counts(dataset.database, SIFT)
    assert np.flatnonzero(counts >= 0).tolist() == wanted.tolist()
    assert f"database features: {len(wanted)} of 10 images to do" in "\n".join(lines)


def test_matches_are_kept_and_read_without_features(dataset, result, tmp_path):
    first = evaluate_parts(dataset, SIFT, VLAD, SCORERS, candidates=5, cache=FeatureCache(tmp_path))

    def only_scores(label):
        assert label == "scores"
        return runtime.no_progress

    again = evaluate_parts(
        replace(dataset, name="again"), SIFT, VLAD, SCORERS, candidates=5,
        cache=FeatureCache(tmp_path), runtime=mfvpr.Runtime(memory=1e-5, progress=only_scores),
    )  # fmt: skip
    for name, system in itertools.product(again.systems, (first, again)):
        [ranked], [expected] = system.systems[name], result.systems[name]
        np.testing.assert_array_equal(ranked.rows, expected.rows)
    np.testing.assert_array_equal(first.matched[0].candidates.indices, again.matched[0].candidates.indices)


def test_matches_of_other_excluded_images_are_not_taken(dataset, tmp_path):
    without = replace(dataset, sequences=(replace(dataset.only, excluded=Positives(np.eye(10, dtype=bool))),))
    for data in (dataset, without, dataset):
        result = evaluate_parts(data, SIFT, VLAD, SCORERS, candidates=3, cache=FeatureCache(tmp_path))
        assert (result.systems["count"][0].rows == np.arange(10)[:, None]).any() == (data is dataset)


@pytest.fixture(scope="module")
def files(dataset, tmp_path_factory):
    """Files of another program with the same features, descriptors and candidates."""
    root, feature_cache = tmp_path_factory.mktemp("files"), FeatureCache()
    for side, folder in (("database", dataset.database), ("queries", dataset.queries)):
        names = [f"{side}/{name}" for name in folder.names]
        [features] = feature_cache.local(folder, SIFT)
        write_features(root / f"{side}.npz", names, features.read(range(len(folder))))
        vectors = feature_cache.vectors(folder, VLAD.describer, dataset.database).values
        write_global_descriptors(root / f"{side}_vectors.npz", names, vectors)
    candidates = VLAD.shortlist(dataset.only, dataset.database, 5, feature_cache).candidates
    write_shortlist(root / "pairs.npz", candidates, dataset.queries.names, dataset.database.names)
    return root


def at(dataset, root, suffix):
    sides = (("database", dataset.database), ("queries", dataset.queries))
    return {folder.root: File(root / f"{side}{suffix}", f"{side}/") for side, folder in sides}


def test_files_of_other_programs_stand_in_for_every_stage(dataset, files, result):
    local = FeatureFiles(at(dataset, files, ".npz"))
    retrievers = {
        "aggregated": Retrieval(Aggregated(local, VladFitting(num_words=8))),
        "descriptors": DescriptorFiles(at(dataset, files, "_vectors.npz")),
        "pairs": ShortlistFiles({dataset.queries.root: File(files / "pairs.npz")}),
    }
    for name, chosen in retrievers.items():
        imported_result = evaluate_parts(dataset, local, chosen, SCORERS, candidates=5)
        for system in ("retrieval", "histogram", "count"):
            [got], [expected] = imported_result.systems[system], result.systems[system]
            np.testing.assert_array_equal(got.rows, expected.rows, err_msg=name)
            np.testing.assert_allclose(got.scores, expected.scores, rtol=1e-5)


def test_queries_without_candidates_are_told(dataset, tmp_path):
    """Also where matches are kept from before, and nothing else is read."""
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("0000.png 0001.png\n0004.png 0003.png\n")
    listed = ShortlistFiles({dataset.queries.root: File(pairs)})
    for _ in range(2):
        lines = []
        runtime = mfvpr.Runtime(log=lines.append)
        evaluate_parts(
            dataset, SIFT, listed, SCORERS, candidates=2, cache=FeatureCache(tmp_path / "s"), runtime=runtime
        )
        [line] = [line for line in lines if "no candidates" in line]
        assert "0001.png: no candidates (8 such queries of 10)" in line


def test_what_is_read_of_files_is_part_of_the_recipe(dataset, files, tmp_path):
    """Which file belongs to which folder, and the prefixes; also within an aggregation."""
    feature_cache, sides = FeatureCache(tmp_path), at(dataset, files, ".npz")
    (folder, first), (other_folder, second) = sides.items()
    changed = [sides, {folder: second, other_folder: first}, sides | {folder: replace(first, prefix="other/")}]
    readers = FeatureFiles, DescriptorFiles, lambda at: Retrieval(Aggregated(FeatureFiles(at), VladFitting()))
    for read in readers:
        assert len({fingerprint(feature_cache.recipes.of(read(at))) for at in changed}) == len(changed)
    moved = Path(shutil.copytree(files, tmp_path / "elsewhere"))
    recipes = [feature_cache.recipes.of(FeatureFiles(at(dataset, root, ".npz"))) for root in (files, moved)]
    assert recipes[0] == recipes[1]  # by content


@pytest.mark.slow
def test_programs_take_sequences_and_files(split, small_street, files, tmp_path, monkeypatch, capsys):
    imported = (f"dataset.database={small_street}/database", "candidates=5", "cache=null", "features=import",
                f"features.database={files}/database.npz", f"features.queries={files}/queries.npz",
                "features.database_prefix=database/", "features.query_prefix=queries/")  # fmt: skip
    common = (*imported, "dataset=sequences", "dataset.ground_truth=index", "dataset.index_file=truth.csv",
              f"dataset.queries=[{split[0]},{split[1]}]", "dataset.widen_index=true", "recall.tolerances=[0,1]",
              "recall.ks=[1,5]", "retrieval=vlad", "retrieval.num_words=8", "scorer=count", "devices=all",
              "memory=0.5")  # fmt: skip
    code, stdout, stderr = typed(monkeypatch, capsys, "evaluate", *common, "figures=2", f"out={tmp_path}/out")
    assert code == 0, stderr
    assert "sequences: 10 queries in 2 sequences, 10 database images, 5 candidates (vlad), import features" in stdout
    names = {path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.csv")}
    assert {"sequences/first/predictions.csv", "sequences/second/predictions/count_retrieval.csv", "table.csv"} <= names
    table = (tmp_path / "out" / "table.csv").read_text().splitlines()
    assert [line.split(",")[1] for line in table[1:5]] == ["first", "second", "mean", "pooled"]
