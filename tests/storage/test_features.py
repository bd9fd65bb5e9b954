"""The feature store: what comes back, and what is refused."""

import errno
import json
import os
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from mfvpr import Features, InputError
from mfvpr.storage import rows
from mfvpr.storage.features import forecast_bytes, open_store
from mfvpr.storage.manifest import recipe_fingerprint, store_path
from mfvpr.storage.rows import require_space
from tests.builders import make_features
from tests.storage.synthetic_features import RECIPE, assert_same, digests, features_of, fill, read_all

# What comes back


@pytest.mark.parametrize("count", [0, 1, 40, 1024, 2500])
def test_all_but_the_descriptors_is_exact(tmp_path, count):
    original = features_of(7, count)
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        store.write({1: original})
        assert store.counts.tolist() == [-1, count, -1]
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        [(row, features)] = store.read()
    assert row == 1
    for name in ("keypoints", "scores", "mask", "image_size"):
        np.testing.assert_array_equal(getattr(features, name), getattr(original, name))
    assert {getattr(features, part.name).dtype.name for part in fields(Features)} == {"float32", "bool"}
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=2e-7)
    assert np.linalg.norm(features.descriptors - original.descriptors, axis=1).max(initial=0) < 5e-4


def test_first_and_later_runs_read_the_same_bits(tmp_path):
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        store.write({row: features_of(row) for row in range(3)})
        first = dict(store.read())
    later = read_all(tmp_path / "s")
    assert list(first) == list(later) == [0, 1, 2]
    for row in later:
        assert_same(first[row], later[row])


def test_descriptors_keep_their_length(tmp_path):
    """A projected descriptor need not be of unit length; float16 alone would lose or overflow the last of these."""
    lengths = np.array([1, 6.3, 0.1, 1e-9, 70000, 1e12], np.float32)
    original = features_of(0, len(lengths))
    original.descriptors[:] *= lengths[:, None]
    with open_store(tmp_path / "s", RECIPE, num_images=1) as store:
        store.write({0: original})
        [(_, features)] = store.read()
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), lengths, rtol=3e-7)
    assert (np.linalg.norm(features.descriptors - original.descriptors, axis=1) < 5e-4 * lengths).all()


def test_zero_descriptors_stay_zero_and_padding_is_left_out(tmp_path):
    padded = make_features(np.random.default_rng(0), 5, capacity=9)
    padded.descriptors[2] = 0
    padded.scores[:5] = 0
    with open_store(tmp_path / "s", RECIPE, num_images=1) as store:
        store.write({0: padded})
        [(_, features)] = store.read()
    assert features.mask.shape == (5,)
    np.testing.assert_array_equal(features.descriptors[2], 0)
    np.testing.assert_array_equal(features.scores, 0)


def test_rows_come_in_the_order_asked_for(tmp_path):
    fill(tmp_path / "s", 40)
    with open_store(tmp_path / "s", RECIPE, num_images=40) as store:
        assert [row for row, _ in store.read([39, 0, 17])] == [39, 0, 17]
        assert [row for row, _ in store.read()] == list(range(40))
        for row, features in store.read(reversed(range(40))):
            np.testing.assert_array_equal(features.keypoints, features_of(row).keypoints)


def test_the_working_directory_may_change(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    with open_store(Path("ünï code/s @1%20?#|"), RECIPE, num_images=3) as store:
        monkeypatch.chdir(tmp_path / "elsewhere")
        store.write({0: features_of(0)})
        assert len(list(store.read())) == 1
    assert not any((tmp_path / "elsewhere").iterdir())
    assert list(read_all(tmp_path / "ünï code/s @1%20?#|")) == [0]


def _with(**changes):
    changed = features_of(0)
    for name, value in changes.items():
        getattr(changed, name).flat[3] = value
    return changed


@pytest.mark.parametrize(
    "row, features, message",
    [
        (0, features_of(0), "row 0 is done"),
        (3, features_of(3), "does not exist"),
        (-1, features_of(3), "does not exist"),
        (1, _with(descriptors=np.nan), "finite"),
        (1, _with(keypoints=np.inf), "finite"),
        (1, _with(scores=np.nan), "finite"),
        (
            1,
            features_of(1, dimension=32),
            r'row 1: descriptors="float16\[32\]", expected "float16\[16\]" as in the other',
        ),
    ],
)
def test_what_cannot_be_stored_is_refused_before_anything_is_written(tmp_path, row, features, message):
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        store.write({})
        store.write({0: features_of(0)})
        before = digests(tmp_path / "s")
        with pytest.raises(ValueError, match=message):
            store.write({2: features_of(2), row: features})
        assert digests(tmp_path / "s") == before
        with pytest.raises(ValueError, match="row 2 is not done"):
            list(store.read([0, 2]))


# Size


def test_size_on_disk(tmp_path):
    counts = [650, 700, 750, 700, 690]
    with open_store(tmp_path / "s", RECIPE, num_images=1000) as store:
        store.write({row: features_of(row, count, 512) for row, count in enumerate(counts)})
        size = store.size_bytes
    apparent = sum(path.stat().st_size for path in (tmp_path / "s").rglob("*") if path.is_file())
    assert apparent <= size < 0.52 * 2064 * sum(counts)
    assert 0.95 * size < forecast_bytes(len(counts), np.mean(counts), 512) < 1.2 * size


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


def test_a_full_disk_lacks_what_is_not_written_yet(tmp_path, monkeypatch):
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


def test_a_global_descriptor_takes_the_space_of_one(tmp_path):
    with open_store(tmp_path / "s", RECIPE, num_images=2) as store:
        store.write({row: features_of(row, 1, 8192) for row in range(2)})
    for row in range(2):
        assert 2 * 8192 <= (tmp_path / "s" / f"{row}-1.npz").stat().st_size < 2 * 8192 + 2500
    assert 2 * 2 * 8192 < forecast_bytes(2, 1, 8192) <= 2 * (2 * 8192 + 4096)


def test_space_is_checked_before_a_run(tmp_path):
    require_space(tmp_path / "not" / "there", 1000)
    with pytest.raises(InputError, match=r"not/there: .*1000000000\.0 MB .*got .* MB; "):
        require_space(tmp_path / "not" / "there", 10**15)


# What a store is of


def test_path_names_the_recipe(tmp_path):
    path = store_path(tmp_path, "../a b/ü", RECIPE)
    assert path == tmp_path / f".._a_b__-{recipe_fingerprint(RECIPE)}"
    assert len(path.name.rpartition("-")[2]) == 16
    assert recipe_fingerprint(dict(reversed(RECIPE.items()))) == recipe_fingerprint(RECIPE)
    assert recipe_fingerprint({**RECIPE, "weights": None}) != recipe_fingerprint(RECIPE)


def _changed(**extractor):
    return {**RECIPE, "extractor": {**RECIPE["extractor"], **extractor}}


@pytest.mark.parametrize(
    "recipe, num_images, difference",
    [
        (RECIPE, 4, "num_images=3, expected 4"),
        (_changed(max_keypoints=400), 3, "recipe.extractor.max_keypoints=800, expected 400"),
        (_changed(image_size=[336, 240]), 3, r"recipe.extractor.image_size\[1\]=336, expected 240"),
        (_changed(name="sift"), 3, 'recipe.extractor.name="d2net", expected "sift"'),
        (_changed(clip=3), 3, "recipe.extractor.clip=nothing, expected 3"),
        ({**RECIPE, "weights": None}, 3, 'recipe.weights={"sha256": "(ab)+"}, expected null'),
        ({**RECIPE, "images": RECIPE["images"][:2]}, 3, r"recipe.images\[2\]=.*, expected nothing"),
        ({name: part for name, part in RECIPE.items() if name != "weights"}, 3, "recipe.weights=.*, expected nothing"),
    ],
)
def test_features_made_from_something_else_are_refused(tmp_path, recipe, num_images, difference):
    fill(tmp_path / "s")
    with (
        pytest.raises(InputError, match=rf"s/manifest\.json: .*{difference}; .*delete") as error,
        open_store(tmp_path / "s", recipe, num_images=num_images),
    ):
        pass
    assert "\n" not in str(error.value)
    assert fill(tmp_path / "s") == []


def test_a_store_of_an_earlier_format_is_told(tmp_path):
    fill(tmp_path / "s")
    manifest = tmp_path / "s" / "manifest.json"
    manifest.write_text(manifest.read_text().replace("feature store 3", "feature store 2"))
    with pytest.raises(InputError, match=r'format="mfvpr feature store 2", expected "mfvpr feature store 3"; .*delete'):
        open_store(tmp_path / "s", RECIPE, num_images=3)


def test_manifest_is_plain_text_and_names_that_are_no_unicode_survive(tmp_path):
    recipe = {**RECIPE, "images": ["a\udcff.png", "日本.png"]}
    for _ in range(2):
        with open_store(tmp_path / "s", recipe, num_images=2):
            pass
    stored = json.loads((tmp_path / "s" / "manifest.json").read_text())
    assert stored["fingerprint"] == recipe_fingerprint(recipe)
    assert stored["recipe"]["images"] == recipe["images"]


def test_a_path_may_be_no_unicode(tmp_path):
    assert fill(tmp_path / "a\udcff") == [0, 1, 2]
    assert len(read_all(tmp_path / "a\udcff")) == 3


def test_rows_are_files_that_numpy_reads(tmp_path):
    fill(tmp_path / "s")
    assert {path.name for path in (tmp_path / "s").iterdir()} == {
        "lock", "manifest.json", "0-40.npz", "1-40.npz", "2-40.npz",
    }  # fmt: skip
    with np.load(tmp_path / "s" / "2-40.npz") as arrays:
        np.testing.assert_array_equal(arrays["keypoints"], features_of(2).keypoints)


def _file(folder):
    folder.write_text("")


def _foreign(folder):
    folder.mkdir()
    (folder / "holiday.jpg").write_text("")


def _below_a_file(folder):
    folder.parent.rmdir()
    folder.parent.write_text("")


def _other_json(folder):
    folder.mkdir()
    (folder / "manifest.json").write_text('{"format_of": "something"}')


def _list(folder):
    folder.mkdir()
    (folder / "manifest.json").write_text("[]")


def _old(folder):
    folder.mkdir()
    (folder / "zarr.json").write_text('{"attributes": {"mfvpr": {"format": "mfvpr feature store 1"}}}')


def _no_json(folder):
    folder.mkdir()
    (folder / "manifest.json").write_bytes(b"\xff\x00")


@pytest.mark.parametrize(
    "spoil, message",
    [
        (_file, "expected a folder of features, got a file"),
        (_foreign, 'without manifest.json that holds "holiday.jpg"'),
        (_below_a_file, r"\(Not a directory\)"),
        (_other_json, "manifest of a feature store"),
        (_list, "manifest of a feature store"),
        (_old, "expected 'mfvpr feature store 3', got"),
        (_no_json, "manifest of a feature store"),
    ],
)
def test_what_is_no_store_is_refused_and_left_alone(tmp_path, spoil, message):
    (tmp_path / "below").mkdir()
    spoil(tmp_path / "below" / "s")
    with (
        pytest.raises(InputError, match=rf"below/s.*{message}.*; \w+") as error,
        open_store(tmp_path / "below" / "s", RECIPE, num_images=3),
    ):
        pass
    assert "\n" not in str(error.value)
    assert {path.name for path in tmp_path.rglob("*")} <= {"below", "s", "holiday.jpg", "manifest.json", "zarr.json"}


def test_a_start_that_was_killed_is_taken_up(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "lock").write_text("123")
    (tmp_path / "s" / ".manifest-x1y_2.json").write_text('{"form')
    assert fill(tmp_path / "s", num_rows=3, batch=1) == [0, 1, 2]
    (tmp_path / "s" / "1-40.npz").rename(tmp_path / "s" / ".1-40-x1y_2.npz")
    (tmp_path / "s" / ".notes.npz").write_text("not of the store")
    assert fill(tmp_path / "s") == [1]
    assert [path.name for path in (tmp_path / "s").glob(".*")] == [".notes.npz"]
