"""Rows of stores of features and of matches: their order, their files, and what is refused."""

import errno
import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.storage import rows
from mfvpr.storage.features import forecast_bytes, open_store
from mfvpr.storage.manifest import recipe_fingerprint, store_path
from mfvpr.storage.matches import open_match_store
from mfvpr.storage.rows import require_space
from tests.io.checks import one_line_error
from tests.storage.synthetic_features import (
    FEATURES,
    MATCH_RECIPE,
    MATCHES,
    RECIPE,
    assert_same,
    digests,
    features_of,
    fill,
    matches_of,
    of_both_kinds,
    read_all,
)


@of_both_kinds
def test_rows_come_in_the_order_asked_for(tmp_path, subject):
    fill(tmp_path / "s", 40, batch=20, subject=subject)
    with subject.open(tmp_path / "s", 40) as store:
        assert [row for row, _ in store.read([39, 0, 17])] == [39, 0, 17]
        assert [row for row, _ in store.read()] == list(range(40))
        for row, item in store.read(reversed(range(40))):
            assert_same(item, subject.round_as_stored(subject.row_of(row)))


def test_the_working_directory_may_change(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    with open_store(Path("ünï code/s @1%20?#|"), RECIPE, num_images=3) as store:
        monkeypatch.chdir(tmp_path / "elsewhere")
        store.write({0: features_of(0)})
        assert len(list(store.read())) == 1
    assert not any((tmp_path / "elsewhere").iterdir())
    assert list(read_all(tmp_path / "ünï code/s @1%20?#|")) == [0]


def changed_features(**changes):
    features = features_of(0)
    for name, value in changes.items():
        getattr(features, name).flat[3] = value
    return features


OTHER_LENGTH = r'row 1: descriptors="float16\[32\]", expected "float16\[16\]" as in the other'


@pytest.mark.parametrize(
    ("subject", "row", "item", "message"),
    [
        (FEATURES, 0, features_of(0), "row 0 is done"),
        (FEATURES, 3, features_of(3), "does not exist"),
        (FEATURES, -1, features_of(3), "does not exist"),
        (FEATURES, 1, changed_features(descriptors=np.nan), "finite"),
        (FEATURES, 1, changed_features(keypoints=np.inf), "finite"),
        (FEATURES, 1, changed_features(scores=np.nan), "finite"),
        (FEATURES, 1, features_of(1, dimension=32), OTHER_LENGTH),
        (MATCHES, 1, matches_of(1, mask=np.arange(60) < 50), "real matches"),
        (MATCHES, 1, replace(matches_of(1), counts=np.array([30, 0, 25, 4], np.int32)), "as many as counted"),
        (MATCHES, 1, matches_of(1, (3, 4, 5)), "expected 4 candidates"),
    ],
)
def test_rows_that_cannot_be_stored_are_refused_before_anything_is_written(tmp_path, subject, row, item, message):
    with subject.open(tmp_path / "s", 3) as store:
        store.write({})
        store.write({0: subject.row_of(0)})
        before = digests(tmp_path / "s")
        with pytest.raises(ValueError, match=message):
            store.write({2: subject.row_of(2), row: item})
        assert digests(tmp_path / "s") == before
        assert store.done.tolist() == [True, False, False]
        with pytest.raises(ValueError, match="row 2 is not done"):
            list(store.read([0, 2]))


# Size


def test_the_size_of_a_store_is_known_while_others_write(tmp_path, monkeypatch):
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        store.write({0: features_of(0)})
        size, walk = store.size_bytes, os.walk
        (tmp_path / "s" / ".unfinished").write_bytes(bytes(10**5))

        def walk_while_others_rename(folder):
            for entries in walk(folder):
                (tmp_path / "s" / ".unfinished").unlink()
                yield entries

        monkeypatch.setattr(os, "walk", walk_while_others_rename)
        assert store.size_bytes == size


def test_a_full_disk_lacks_the_rows_that_are_not_written_yet(tmp_path, monkeypatch):
    written = []

    def write(path, *arguments, **options):
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "full")
        written.append(path)

    monkeypatch.setattr(rows, "write_arrays", write)
    monkeypatch.setattr(rows, "THREADS", 1)
    needed = f"{forecast_bytes(1, 700, 512) / 1e6:.1f} MB"
    with (
        pytest.raises(InputError, match=f"expected about {needed} of free disk space"),
        open_store(tmp_path / "s", RECIPE, num_images=1000) as store,
    ):
        store.write({row: features_of(row, 700, 512) for row in range(3)})


def test_space_is_checked_before_a_run(tmp_path):
    require_space(tmp_path / "not" / "there", 1000)
    with pytest.raises(InputError, match=r"not/there: .*1000000000\.0 MB .*got .* MB; "):
        require_space(tmp_path / "not" / "there", 10**15)


# Recipes, and files of other programs


def test_path_names_the_recipe(tmp_path):
    path = store_path(tmp_path, "../a b/ü", RECIPE)
    assert path == tmp_path / f".._a_b__-{recipe_fingerprint(RECIPE)}"
    assert len(path.name.rpartition("-")[2]) == 16
    assert recipe_fingerprint(dict(reversed(RECIPE.items()))) == recipe_fingerprint(RECIPE)
    assert recipe_fingerprint({**RECIPE, "weights": None}) != recipe_fingerprint(RECIPE)
    assert store_path(tmp_path, "s", RECIPE, MATCHES.kind).name == f"s-{recipe_fingerprint(RECIPE, MATCHES.kind)}"
    assert recipe_fingerprint(RECIPE, MATCHES.kind) != recipe_fingerprint(RECIPE)


def _other_extractor(**settings):
    return {**RECIPE, "extractor": {**RECIPE["extractor"], **settings}}


WITHOUT_WEIGHTS = {name: part for name, part in RECIPE.items() if name != "weights"}
OPEN_OTHER_FEATURES = [
    ({"num_images": 4}, "num_images=3, expected 4"),
    ({"recipe": _other_extractor(max_keypoints=400)}, "recipe.extractor.max_keypoints=800, expected 400"),
    ({"recipe": _other_extractor(image_size=[336, 240])}, r"recipe.extractor.image_size\[1\]=336, expected 240"),
    ({"recipe": _other_extractor(clip=3)}, "recipe.extractor.clip=nothing, expected 3"),
    ({"recipe": {**RECIPE, "weights": None}}, 'recipe.weights={"sha256": "(ab)+"}, expected null'),
    ({"recipe": {**RECIPE, "images": RECIPE["images"][:2]}}, r"recipe.images\[2\]=.*, expected nothing"),
    ({"recipe": WITHOUT_WEIGHTS}, "recipe.weights=.*, expected nothing"),
]
OPEN_OTHER_MATCHES = [
    ({"num_queries": 4}, "num_queries=3, expected 4"),
    ({"num_candidates": 5}, "num_candidates=4, expected 5"),
    ({"recipe": {**MATCH_RECIPE, "features": "4567"}}, 'recipe.features="0123", expected "4567"'),
]
OPEN_FEATURES = partial(open_store, recipe=RECIPE, num_images=3)
OPEN_MATCHES = partial(open_match_store, recipe=MATCH_RECIPE, num_queries=3, num_candidates=4)


@pytest.mark.parametrize(
    ("subject", "open_other", "difference"),
    [
        *((FEATURES, partial(OPEN_FEATURES, **change), difference) for change, difference in OPEN_OTHER_FEATURES),
        *((MATCHES, partial(OPEN_MATCHES, **change), difference) for change, difference in OPEN_OTHER_MATCHES),
    ],
)
def test_stores_of_another_recipe_are_refused(tmp_path, subject, open_other, difference):
    fill(tmp_path / "s", subject=subject)
    with one_line_error(rf"s/manifest\.json: .*{difference}; .*delete"):
        open_other(tmp_path / "s")
    assert fill(tmp_path / "s", subject=subject) == []


def test_stores_of_the_other_kind_or_format_are_refused_and_left_alone(tmp_path):
    fill(tmp_path / "features")
    fill(tmp_path / "matches", subject=MATCHES)
    before = digests(tmp_path)
    with pytest.raises(InputError, match='made with format="mfvpr feature store 3", expected "mfvpr match store 3"; '):
        fill(tmp_path / "features", subject=MATCHES)
    with pytest.raises(InputError, match='made with format="mfvpr match store 3", expected "mfvpr feature store 3"; '):
        fill(tmp_path / "matches")
    assert digests(tmp_path) == before
    manifest = tmp_path / "features" / "manifest.json"
    manifest.write_text(manifest.read_text().replace("feature store 3", "feature store 2"))
    with pytest.raises(InputError, match=r'format="mfvpr feature store 2", expected "mfvpr feature store 3"; .*delete'):
        OPEN_FEATURES(tmp_path / "features")


def test_manifest_is_plain_text_and_names_that_are_no_unicode_survive(tmp_path):
    recipe = {**RECIPE, "images": ["a\udcff.png", "日本.png"]}
    for _ in range(2):
        with open_store(tmp_path / "a\udcff", recipe, num_images=2):
            pass
    stored = json.loads((tmp_path / "a\udcff" / "manifest.json").read_text())
    assert stored["fingerprint"] == recipe_fingerprint(recipe)
    assert stored["recipe"]["images"] == recipe["images"]


def test_rows_are_files_that_numpy_reads(tmp_path):
    folder = tmp_path / "a\udcff"  # no unicode
    assert fill(folder) == [0, 1, 2]
    assert {path.name for path in folder.iterdir()} == {
        "lock", "manifest.json", "0-40.npz", "1-40.npz", "2-40.npz",
    }  # fmt: skip
    with np.load(folder / "2-40.npz") as arrays:
        np.testing.assert_array_equal(arrays["keypoints"], features_of(2).keypoints)
    assert len(read_all(folder)) == 3


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("below/s", b"", "expected a folder of {content}, got a file"),
        ("below/s/holiday.jpg", b"", 'expected a folder of {content}.* without manifest.json that holds "holiday.jpg"'),
        ("below", b"", r"\(Not a directory\)"),
        ("below/s/manifest.json", b'{"format_of": "something"}', "manifest of a {store}"),
        ("below/s/manifest.json", b"[]", "manifest of a {store}"),
        ("below/s/manifest.json", b"\xff\x00", "manifest of a {store}"),
    ],
)
@of_both_kinds
def test_files_of_something_else_are_refused_and_left_alone(tmp_path, subject, name, content, message):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_bytes(content)
    before, kind = digests(tmp_path), subject.kind
    message = message.format(content=kind.content, store=kind.store)
    with one_line_error(rf"below/s.*{message}.*; \w+"), subject.open(tmp_path / "below/s", 3):
        pass
    assert digests(tmp_path) == before


def test_a_start_that_was_killed_goes_on(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "lock").write_text("123")
    (tmp_path / "s" / ".manifest-x1y_2.json").write_text('{"form')
    assert fill(tmp_path / "s", num_rows=3, batch=1) == [0, 1, 2]
    (tmp_path / "s" / "1-40.npz").rename(tmp_path / "s" / ".1-40-x1y_2.npz")
    (tmp_path / "s" / ".notes.npz").write_text("not of the store")
    (tmp_path / "s" / ".2-40-abc.npz").write_text("of a process that is writing")
    for path in (tmp_path / "s").glob(".*x1y_2*"):
        os.utime(path, (0, 0))
    assert fill(tmp_path / "s") == [1]
    assert [path.name for path in sorted((tmp_path / "s").glob(".*"))] == [".2-40-abc.npz", ".notes.npz"]
