"""Which store belongs to what; stores half done, or of something else, as the pipeline and the programs meet them."""

from dataclasses import fields, replace

import numpy as np
import pytest

from experiments import prepare, stores
from mfvpr import InputError, Shortlist, pipeline
from mfvpr.data.contents import contents
from mfvpr.data.datasets import image_folder
from mfvpr.features.sift import Sift
from mfvpr.sources import FeatureSet
from mfvpr.stores.manifest import store_path
from mfvpr.stores.matches import open_match_store
from mfvpr.types import Matches
from mfvpr.weights import files
from tests.programs import composed
from tests.stores.made_up import digests, features_of

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


def assert_same(got, expected, *, ratio=True):
    np.testing.assert_array_equal(got.counts, expected.counts)
    for one, other in zip(got.matches, expected.matches, strict=True):
        for part in fields(Matches):
            if ratio or part.name != "ratio":
                np.testing.assert_array_equal(getattr(one, part.name), getattr(other, part.name))


class Interrupted(Exception):
    pass


def _interrupting(after):
    def track(rows, _):
        for number, row in enumerate(rows):
            if number == after:
                raise Interrupted
            yield row

    return track


def test_another_shortlist_is_refused_before_anything_is_written(drawn, candidates, opened, monkeypatch):
    monkeypatch.setattr(pipeline, "STORE_BATCH", 2)
    with opened() as store, pytest.raises(Interrupted):
        pipeline.match(drawn, drawn, candidates, store=store, track=_interrupting(5))
    others = [
        replace(candidates, indices=candidates.indices[:, ::-1]),
        replace(candidates, indices=np.where(np.arange(QUERIES)[:, None] == 3, 0, candidates.indices)),
        Shortlist(*(values[:, :3] for values in (candidates.indices, candidates.scores, candidates.mask))),
        Shortlist(*(values[:2] for values in (candidates.indices, candidates.scores, candidates.mask))),
    ]
    for other in others:
        with opened() as store:
            assert store.done.tolist() == [True] * 4 + [False] * 2
            before = digests(store.folder)
            with pytest.raises(InputError, match=r"s: expected matches of these candidates, .*another shortlist"):
                pipeline.match(drawn, drawn, other, store=store)
            assert digests(store.folder) == before
    with opened() as store:
        assert_same(
            pipeline.match(drawn, drawn, candidates, store=store),
            pipeline.match(drawn, drawn, candidates, with_ratio=True),
        )
        np.testing.assert_array_equal(pipeline.stored_matches(store)[1].indices, candidates.indices)


def test_matching_without_a_store_is_the_same(drawn, candidates, opened):
    """To the last bit; the ratio where it is asked for."""
    plain = pipeline.match(drawn, drawn, candidates)
    assert plain.matches[0].ratio is None
    asked = pipeline.match(drawn, drawn, candidates, with_ratio=True)
    for _ in range(2):
        with opened() as store:
            kept = pipeline.match(drawn, drawn, candidates, store=store)
        assert_same(kept, asked)
        assert_same(kept, plain, ratio=False)


# The programs' stores


def settings_of(folder, *changes):
    return composed(
        "dataset=folder", f"dataset.database={folder}/database", f"dataset.queries={folder}/queries",
        "dataset.ground_truth=order", "candidates=3", "features.max_keypoints=40",
        "features.image_size=[160,120]", "retrieval.num_words=4", *changes,
        config="sweep",
    )  # fmt: skip


def matches_path(settings, images=None):
    images = images or prepare.images(settings).fingerprints
    return stores.matches_path(settings["store"], stores.matches_recipe(settings, images, 3))


def test_a_store_belongs_to_images_whatever_their_data_set_is_called(small_street, tmp_path, capsys):
    folder, extractor = image_folder(small_street / "database"), Sift(max_keypoints=40)
    settings, images = {"name": "sift", "max_keypoints": 40}, contents(folder).fingerprint
    for name in ("summer database", "winter queries"):
        with stores.opened(str(tmp_path), name, folder, extractor, settings, images, wait=False) as store:
            assert store.done.all() == (name != "summer database")
            pipeline.extract(folder, extractor, store=store)
    [path] = tmp_path.iterdir()
    assert path.name.startswith("sift-")
    told = capsys.readouterr().err.splitlines()
    assert told[0].startswith("summer database: 10 of 10 images to do")
    assert told[-1] == f"winter queries: all 10 images from {path}"


def test_matches_belong_to_images_whatever_their_data_set_is_called(small_street, tmp_path):
    paths = {
        matches_path(settings_of(small_street, f"store={tmp_path}", f"dataset.name={name}")) for name in ("one", "two")
    }
    [path] = paths
    assert path.name.startswith("sift_matches-")


def test_matches_of_runs_that_skip_bad_images_are_kept_apart(small_street):
    """Else a run that stops at a bad image would find all matches, and not stop."""
    images = {"database": "0", "query": "1"}
    paths = {matches_path(settings_of(small_street, f"on_bad_image={word}"), images) for word in ("fail", "skip")}
    assert len(paths) == 2


def test_features_belong_to_the_weights_whatever_they_are_called(tmp_path, monkeypatch):
    """Weights that are installed anew under the same name make other features, descriptors and matches."""
    monkeypatch.setenv("MFVPR_WEIGHTS", str(tmp_path))
    source, settings, paths = tmp_path / "source", {"name": "mixvpr", "weights": "mixvpr_128"}, []
    source.write_text("not published")
    for value in (0, 1):
        files.save("mixvpr_128", {"a": np.full(3, value, np.float32)}, source, parameters=3)
        recipe = stores.features_recipe(settings, "images")
        assert recipe["extractor"]["weights_sha256"] == files.fingerprint("mixvpr_128")
        paths.append(store_path(tmp_path, "mixvpr", recipe))
    assert paths[0] != paths[1]
