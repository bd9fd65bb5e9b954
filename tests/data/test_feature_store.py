"""The feature store: what comes back, and what happens to it when processes, disks and users misbehave."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from mfvpr import Features, InputError
from mfvpr.data.feature_store import forecast_bytes, open_store, require_space
from mfvpr.data.store_manifest import recipe_fingerprint, store_path
from tests.builders import make_features

ROOT = Path(__file__).parents[2]
RECIPE = {
    "weights": {"sha256": "ab" * 32},
    "extractor": {"name": "d2net", "max_keypoints": 800, "image_size": (336, 336), "sigma": 1.6},
    "images": [{"name": f"{row}.png", "sha256": f"{row:064x}"} for row in range(3)],
}
ARRAYS = ("descriptors", "keypoints", "scores", "image_size", "count")


def features_of(row: int, count: int = 40, dimension: int = 16) -> Features:
    return make_features(np.random.default_rng(row), count, dimension=dimension)


def assert_same(got: Features, expected: Features) -> None:
    for part in fields(Features):
        np.testing.assert_array_equal(getattr(got, part.name), getattr(expected, part.name))


def fill(folder: Path, num_images: int = 3, batch: int = 2) -> list[int]:
    """Do what is not done; the rows that were not."""
    with open_store(folder, RECIPE, num_images=num_images) as store:
        todo = np.flatnonzero(~store.done).tolist()
        for start in range(0, len(todo), batch):
            store.write({row: features_of(row) for row in todo[start : start + batch]})
    return todo


def read_all(folder: Path, num_images: int = 3) -> dict[int, Features]:
    with open_store(folder, RECIPE, num_images=num_images) as store:
        return dict(store.read())


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file; leftovers of tensorstore's would be seen."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def run_here(call: str, *, prefix: tuple[str, ...] = ()) -> str:
    """Standard output of a call of this module's functions in a process of its own."""
    command = [*prefix, sys.executable, "-c", f"from tests.data.test_feature_store import *; {call}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


# What comes back


@pytest.mark.parametrize("count", [0, 1, 40, 1024, 2500])
def test_all_but_the_descriptors_is_exact(tmp_path, count):
    original = features_of(7, count)
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        store.write({1: original})
        assert store.counts.tolist() == [-1, count, -1]
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        [(row, found)] = store.read()
    assert row == 1
    for name in ("keypoints", "scores", "mask", "image_size"):
        np.testing.assert_array_equal(getattr(found, name), getattr(original, name))
    assert {getattr(found, part.name).dtype.name for part in fields(Features)} == {"float32", "bool"}
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=2e-7)
    assert np.linalg.norm(found.descriptors - original.descriptors, axis=1).max(initial=0) < 5e-4


def test_first_and_later_runs_read_the_same_bits(tmp_path):
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        store.write({row: features_of(row) for row in range(3)})
        first = dict(store.read())
    later = read_all(tmp_path / "s")
    assert list(first) == list(later) == [0, 1, 2]
    for row in later:
        assert_same(first[row], later[row])


def test_zero_descriptors_stay_zero_and_padding_is_left_out(tmp_path):
    padded = make_features(np.random.default_rng(0), 5, capacity=9)
    padded.descriptors[2] = 0
    padded.scores[:5] = 0
    with open_store(tmp_path / "s", RECIPE, num_images=1) as store:
        store.write({0: padded})
        [(_, found)] = store.read()
    assert found.mask.shape == (5,)
    np.testing.assert_array_equal(found.descriptors[2], 0)
    np.testing.assert_array_equal(found.scores, 0)


def test_rows_come_in_the_order_asked_for(tmp_path):
    fill(tmp_path / "s", 40)
    with open_store(tmp_path / "s", RECIPE, num_images=40) as store:
        assert [row for row, _ in store.read([39, 0, 17])] == [39, 0, 17]
        assert [row for row, _ in store.read()] == list(range(40))
        for row, found in store.read(reversed(range(40))):
            np.testing.assert_array_equal(found.keypoints, features_of(row).keypoints)


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
        (1, _with(descriptors=70000.0), "unit length"),
        (1, features_of(1, dimension=32), r"several dimensions: \[16, 32\]"),
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
    assert apparent <= size < 0.5 * 2064 * sum(counts)
    assert 0.95 * size < forecast_bytes(len(counts), np.mean(counts), 512) < 1.2 * size


def test_space_is_checked_before_a_run(tmp_path):
    require_space(tmp_path / "not" / "there", 1000)
    with pytest.raises(InputError, match=r"not/there: expected about 1000000000\.0 MB of free disk space, got .* MB; "):
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
        pytest.raises(InputError, match=rf"s/zarr\.json: these features were made with {difference}; .*delete") as told,
        open_store(tmp_path / "s", recipe, num_images=num_images),
    ):
        pass
    assert "\n" not in str(told.value)
    assert fill(tmp_path / "s") == []


def test_manifest_is_plain_text_and_names_that_are_no_unicode_survive(tmp_path):
    recipe = {**RECIPE, "images": ["a\udcff.png", "日本.png"]}
    for _ in range(2):
        with open_store(tmp_path / "s", recipe, num_images=2):
            pass
    stored = json.loads((tmp_path / "s" / "zarr.json").read_text())["attributes"]["mfvpr"]
    assert stored["fingerprint"] == recipe_fingerprint(recipe)
    assert stored["recipe"]["images"] == recipe["images"]


def test_a_path_that_is_no_unicode_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"cannot hold features .*surrogates not allowed"):
        fill(tmp_path / "a\udcff")
    assert not any(tmp_path.iterdir())


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
    (folder / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group", "attributes": {}}')


def _no_json(folder):
    folder.mkdir()
    (folder / "zarr.json").write_bytes(b"\xff\x00")


@pytest.mark.parametrize(
    "spoil, message",
    [
        (_file, "expected a folder of features, got a file"),
        (_foreign, 'without zarr.json that holds "holiday.jpg"'),
        (_below_a_file, r"\(Not a directory\)"),
        (_other_json, "expected the manifest of a feature store, got something else"),
        (_no_json, "expected the manifest of a feature store, got something else"),
    ],
)
def test_what_is_no_store_is_refused_and_left_alone(tmp_path, spoil, message):
    (tmp_path / "below").mkdir()
    spoil(tmp_path / "below" / "s")
    with (
        pytest.raises(InputError, match=rf"below/s.*{message}.*; \w+") as told,
        open_store(tmp_path / "below" / "s", RECIPE, num_images=3),
    ):
        pass
    assert "\n" not in str(told.value)
    assert {path.name for path in tmp_path.rglob("*")} <= {"below", "s", "holiday.jpg", "zarr.json", "lock"}


def test_a_start_that_was_killed_is_taken_up(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "lock").write_text("123")
    (tmp_path / "s" / ".zarr-x1y2.json").write_text('{"zarr')
    assert fill(tmp_path / "s") == [0, 1, 2]
    assert not (tmp_path / "s" / ".zarr-x1y2.json").exists()


# Two processes


def hold(folder: str) -> None:
    """Open a store, say so, and wait to be killed."""
    with open_store(Path(folder), RECIPE, num_images=3) as store:
        store.write({0: features_of(0)})
        print("open", flush=True)
        time.sleep(60)


def test_a_second_process_is_told_and_a_killed_one_leaves_no_lock(tmp_path):
    call = f"from tests.data.test_feature_store import *; hold({str(tmp_path / 's')!r})"
    with subprocess.Popen([sys.executable, "-c", call], cwd=ROOT, stdout=subprocess.PIPE) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == b"open\n"
            with pytest.raises(InputError, match=rf"s: in use by process {holder.pid}; wait until it ends"):
                fill(tmp_path / "s")
        finally:
            holder.kill()
    assert fill(tmp_path / "s") == [1, 2]


def test_the_lock_holds_within_a_process_and_ends_with_an_error(tmp_path):
    def fail():
        with open_store(tmp_path / "s", RECIPE, num_images=3):
            with pytest.raises(InputError, match=f"in use by process {os.getpid()}"):
                fill(tmp_path / "s")
            raise KeyError("of the caller")

    with pytest.raises(KeyError, match="of the caller"):
        fail()
    assert fill(tmp_path / "s") == [0, 1, 2]
    assert (tmp_path / "s" / "lock").read_text() == ""


# Damage


def _chunk(folder: Path, name: str, row: int = 1) -> Path:
    [path] = (folder / name).glob(f"c.{row}*")
    return path


def _flip(path: Path, position: int) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 1 << position % 8
    path.write_bytes(content)


DAMAGE = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "short": lambda path: path.write_bytes(path.read_bytes()[:-3]),
    "long": lambda path: path.write_bytes(path.read_bytes() + b"abc"),
    "flipped": lambda path: _flip(path, path.stat().st_size // 2),
    "swapped": lambda path: shutil.copy(path.parent.parent / "image_size" / "zarr.json", path),
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", ARRAYS)
def test_a_damaged_image_is_told_and_extracted_anew(tmp_path, name, damage):
    folder = tmp_path / "s"
    fill(folder)
    before = digests(folder)
    DAMAGE[damage](_chunk(folder, name))
    if name != "count":  # without its count an image is not done, and that is that
        with open_store(folder, RECIPE, num_images=3) as store:
            assert store.done.all()
            found = store.read()
            assert [next(found)[0], next(found)[0]] == [0, 2]
            with pytest.raises(InputError, match=r"s: features of 1 images are damaged.*row 1 .*; run again") as told:
                next(found)
            assert "\n" not in str(told.value)
            assert store.done.tolist() == [True, False, True]
    assert fill(folder) == [1]
    assert digests(folder) == before
    assert len(read_all(folder)) == 3


@pytest.mark.parametrize("name", ARRAYS)
def test_every_flipped_bit_is_noticed(tmp_path, name):
    folder = tmp_path / "s"
    with open_store(folder, RECIPE, num_images=1) as store:
        store.write({0: features_of(0, 3, 4)})
    path = _chunk(folder, name, 0)
    whole = path.read_bytes()
    flag = _chunk(folder, "count", 0)
    counted = flag.read_bytes()
    for position in range(len(whole)):
        flag.write_bytes(counted)
        path.write_bytes(whole)
        _flip(path, position)
        with open_store(folder, RECIPE, num_images=1) as store:
            assert store.done.all() == (name != "count")
            if name != "count":
                with pytest.raises(InputError, match="damaged"):
                    list(store.read())


@pytest.mark.parametrize("content", [b"", b"{", b"{}", b"[]"])
@pytest.mark.parametrize("name", ARRAYS)
def test_damaged_descriptions_of_arrays_are_told(tmp_path, name, content):
    fill(tmp_path / "s")
    (tmp_path / "s" / name / "zarr.json").write_bytes(content)
    with pytest.raises(InputError, match=r"s.*: damaged.*; delete .*s.* and run again") as told:
        fill(tmp_path / "s")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("name", ARRAYS)
def test_a_missing_array_is_made_again(tmp_path, name):
    folder = tmp_path / "s"
    fill(folder)
    before = digests(folder)
    shutil.rmtree(folder / name)
    if name not in ("descriptors", "count"):
        with pytest.raises(InputError, match="features of 3 images are damaged"):
            read_all(folder)
    assert fill(folder) == [0, 1, 2]
    assert digests(folder) == before


# Kill -9

NUM_IMAGES = 60


def _extract(folder: Path, log: Path, ready: int) -> None:
    """A child process: do what is not done, noting each row, and saying so before the first is written."""
    with open_store(folder, RECIPE, num_images=NUM_IMAGES) as store:
        todo = np.flatnonzero(~store.done).tolist()
        for start in range(0, len(todo), 4):
            batch = {row: features_of(row, 200, 64) for row in todo[start : start + 4]}
            with log.open("a") as file:
                file.writelines(f"{row}\n" for row in batch)
            os.write(ready, b".")
            store.write(batch)


def _child(folder: Path, log: Path, delay: float | None, *, from_first_write: bool) -> int:
    """Exit status of a child that is killed after `delay` s; None = not at all."""
    reading, writing = os.pipe()
    if (pid := os.fork()) == 0:
        os.close(reading)
        _extract(folder, log, writing)
        os._exit(0)
    os.close(writing)
    if delay is not None:
        if from_first_write:
            os.read(reading, 1)
        time.sleep(delay)
        os.kill(pid, signal.SIGKILL)
    status = os.waitpid(pid, 0)[1]
    os.close(reading)
    return status


def _rows(folder: Path, name: str) -> set[int]:
    return {int(path.name.split(".")[1]) for path in folder.glob(f"{name}/c.*") if not path.name.endswith("__lock")}


def kill_rounds(root: str, rounds: int) -> None:
    """Kill `rounds` extractions at random times, finish them all, and print what happened.

    Forks before tensorstore starts its threads, which saves a second of imports per round.
    """
    rng = np.random.default_rng(0)
    told = {"killed": 0, "torn": 0, "twice": 0, "failed": 0, "stores": 0, "different": 0}
    _child(Path(root, "whole"), Path(root, "log"), None, from_first_write=False)
    expected = digests(Path(root, "whole"))
    while told["killed"] < rounds:
        folder, told["stores"] = Path(root, str(told["stores"])), told["stores"] + 1
        while len(_rows(folder, "count")) < NUM_IMAGES:
            done, log = _rows(folder, "count"), Path(root, "log")
            log.write_text("")
            finish = told["killed"] == rounds
            early = rng.random() < 0.3  # while the store is made or opened
            delay = None if finish else rng.uniform(0, 0.02 if early else 0.03)
            status = _child(folder, log, delay, from_first_write=not early)
            told["killed"] += status == signal.SIGKILL
            told["failed"] += status not in (0, signal.SIGKILL)
            told["twice"] += len(done.intersection(map(int, log.read_text().split())))
            leftovers = any(folder.rglob("*__lock")) or any(folder.glob(".zarr-*"))
            told["torn"] += leftovers or any(_rows(folder, name) != _rows(folder, "count") for name in ARRAYS)
        told["different"] += digests(folder) | {"lock": ""} != expected | {"lock": ""}
    print(json.dumps(told))


def test_killed_extractions_end_in_the_same_files(tmp_path):
    told = json.loads(run_here(f"kill_rounds({str(tmp_path)!r}, 50)"))
    assert told["killed"] == 50
    assert told["torn"] >= 20  # kills in the middle of writing, as the files show
    assert (told["failed"], told["twice"], told["different"]) == (0, 0, 0)


# Disks


def _mount(folder: Path, *options: str) -> None:
    subprocess.run(["mount", "-t", "tmpfs", *options, "none", str(folder)], check=True, capture_output=True)


def full_disk(root: str) -> None:
    """A store on a disk of 5 MB, which then grows: what is told, and what is left. Prints JSON."""
    disk, told = Path(root), {}
    _mount(disk, "-o", "size=5m")

    def extract() -> list[int]:
        with open_store(disk / "s", RECIPE, num_images=12) as store:
            todo = np.flatnonzero(~store.done).tolist()
            for row in todo:
                store.write({row: features_of(row, 700, 512)})
        return todo

    for name in ("first", "second"):
        try:
            extract()
        except InputError as error:
            told[name] = str(error)
    kept = read_all(disk / "s", 12)
    told["kept"] = [row for row, found in kept.items() if (found.scores == features_of(row, 700, 512).scores).all()]
    _mount(disk, "-o", "remount,size=12m")
    told["resumed"] = extract()
    told["all"] = len(read_all(disk / "s", 12))
    (disk / "ballast").write_bytes(bytes(shutil.disk_usage(disk).free))
    told["read_when_full"] = len(read_all(disk / "s", 12))
    _mount(disk, "-o", "remount,ro")
    for name in ("s", "new"):
        try:
            read_all(disk / name, 12)
        except InputError as error:
            told[f"read-only {name}"] = str(error)
    print(json.dumps(told))


def test_a_full_disk_is_told_and_extraction_goes_on_when_it_is_not(tmp_path):
    unshare = ("unshare", "--map-root-user", "--mount")
    possible = (
        shutil.which("unshare")
        and not subprocess.run(
            [*unshare, "mount", "-t", "tmpfs", "none", str(tmp_path)], capture_output=True
        ).returncode
    )
    if not possible:
        pytest.skip("the kernel does not let this user mount a small disk")
    told = json.loads(run_here(f"full_disk({str(tmp_path)!r})", prefix=unshare))
    done = told["kept"]
    assert 5 <= len(done) <= 8
    for name in ("first", "second"):
        needed = forecast_bytes(12 - len(done), 700, 512) / 1e6
        assert told[name].startswith(f"{tmp_path}/s: expected about {needed:.1f} MB of free disk space, got 0.")
        assert told[name].endswith(" MB; free some space and run again, which goes on from here")
    assert told["resumed"] == [row for row in range(12) if row not in done]
    assert told["all"] == told["read_when_full"] == 12
    for name in ("s", "new"):
        assert f"{tmp_path}/{name}: cannot hold features (Read-only file system)" in told[f"read-only {name}"]


def test_importing_the_library_does_not_import_tensorstore():
    call = "import sys, mfvpr; assert 'tensorstore' not in sys.modules"
    subprocess.run([sys.executable, "-c", call], cwd=ROOT, check=True)
