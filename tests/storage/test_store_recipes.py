"""Which store belongs to what; stores half done, or of something else, as the pipeline and the programs meet them."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from mfvpr import InputError, Pipeline, Runtime, Shortlist
from mfvpr.datasets import Positives
from mfvpr.evaluation import stages
from mfvpr.evaluation.sequence_matching import matches_recipe
from mfvpr.features import FeatureSet
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
from mfvpr.storage.matches import open_match_store
from tests.programs import composed, matches_path
from tests.storage.extractors import SIFT, Mean
from tests.storage.synthetic_features import assert_same_match_sets, digests, features_of, interrupt_after

# Matches of another shortlist

QUERIES, CANDIDATES = 6, 4


@pytest.fixture(scope="module")
def drawn():
    """Features of a few images by chance, as queries and as database."""
    return FeatureSet.of([features_of(row) for row in range(QUERIES)])


@pytest.fixture(scope="module")
def candidates():
    indices = (np.arange(QUERIES)[:, None] + np.arange(CANDIDATES)).astype(np.int32) % QUERIES
    return Shortlist(indices, np.full(indices.shape, 0.5, np.float32), indices >= 0)


@pytest.fixture
def opened(tmp_path):
    sizes = {"num_queries": QUERIES, "num_candidates": CANDIDATES}
    return lambda: open_match_store(tmp_path / "s", {"of": "any"}, **sizes)


def test_another_shortlist_is_refused_before_anything_is_written(drawn, candidates, opened, monkeypatch):
    monkeypatch.setattr(stages, "STORE_BATCH", 2)
    with opened() as store, pytest.raises(KeyboardInterrupt):
        stages.match(drawn, drawn, candidates, store=store, runtime=Runtime(progress=lambda _: interrupt_after(5)))
    shortlists = [
        replace(candidates, indices=candidates.indices[:, ::-1]),
        replace(candidates, indices=np.where(np.arange(QUERIES)[:, None] == 3, 0, candidates.indices)),
        Shortlist(*(values[:, :3] for values in (candidates.indices, candidates.scores, candidates.mask))),
        Shortlist(*(values[:2] for values in (candidates.indices, candidates.scores, candidates.mask))),
    ]
    for shortlist in shortlists:
        with opened() as store:
            assert store.done.tolist() == [True] * 4 + [False] * 2
            before = digests(store.folder)
            with pytest.raises(InputError, match=r"s: .*candidates.*shortlist"):
                stages.match(drawn, drawn, shortlist, store=store)
            assert digests(store.folder) == before
    with opened() as store:
        with pytest.raises(InputError, match=r"s: .*6 queries, got 4"):
            stages.stored_matches(store)
        again = stages.match(drawn, drawn, candidates, store=store)
        assert_same_match_sets(again, stages.match(drawn, drawn, candidates))
        np.testing.assert_array_equal(stages.stored_matches(store)[1].indices, candidates.indices)


# The programs' stores


def settings_of(folder, *changes):
    return composed(
        "dataset=folder", f"dataset.database={folder}/database", f"dataset.queries={folder}/queries",
        "dataset.ground_truth=order", "candidates=3", "features.max_keypoints=40",
        "features.image_size=[160,120]", "retrieval.num_words=4", *changes,
        config="sweep",
    )  # fmt: skip


@pytest.mark.parametrize("changes", [("dataset.name=one", "dataset.name=two"), ("memory=1", "devices=all")])
def test_matches_do_not_depend_on_names_and_devices(small_street, tmp_path, changes):
    paths = {matches_path(settings_of(small_street, f"cache={tmp_path}", change))[0] for change in changes}
    assert len(paths) == 1


def test_matches_of_other_settings_are_kept_apart(small_street, tmp_path):
    """`skip_bad` counts: else a run that stops at a bad image would find all matches, and not stop."""
    changes = ("on_bad_image=skip", "candidates=4", "features.max_keypoints=41", "retrieval.num_words=5",
               "retrieval.whiten=3", "matching.max_distance=1", "dataset.exclude_neighbors=0",
               "dataset.exclude_neighbors=1", "dataset.name=plain")  # fmt: skip
    street = tmp_path / "street"  # whose queries are database images
    for side in ("database", "queries"):
        shutil.copytree(small_street / "database", street / side)
    paths = {matches_path(settings_of(street, f"cache={tmp_path}/s", change))[0] for change in changes}
    assert len(paths) == len(changes)


def test_matches_without_an_image_for_another_query_are_kept_apart(dataset):
    pipeline, recipes = Pipeline(SIFT, Retrieval(Mean()), candidates=3), []
    for query in (0, 1):
        excluded = Positives.from_rows([[3] if row == query else [] for row in range(10)], 10)
        sequence = replace(dataset.sequences[0], excluded=excluded)
        recipes.append(matches_recipe(dataset, sequence, pipeline, FeatureCache()))
    assert recipes[0] != recipes[1]
