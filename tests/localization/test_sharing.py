"""One map used by several threads or builders, and files of several maps: nobody gets what is another's."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

import mfvpr
from mfvpr.datasets import image_folder
from mfvpr.features import VladFitting
from mfvpr.localization import Map
from mfvpr.localization.describing import Describing
from mfvpr.storage import maps as map_store
from mfvpr.storage.features import open_store
from mfvpr.storage.map_entries import Entry, open_entry_store
from mfvpr.storage.rows import RowStore
from mfvpr.utils import InputError, recipe_of
from tests.builders import map_system
from tests.localization.test_map import Constant
from tests.storage.synthetic_features import file_of

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def images(small_street):
    return image_folder(small_street / "database")


@pytest.fixture
def folder(images, tmp_path):
    """A map of the first six images."""
    opened(tmp_path / "map").build(first(images, 6))
    return tmp_path / "map"


def first(images, number):
    return replace(images, names=images.names[:number])


def opened(folder, extractor=None, describer=None):
    extractor = extractor or Constant()
    return Map(folder, map_system(extractor, describer or extractor, mfvpr.MatchCount(), candidates=3))


def test_threads_get_the_answers_of_one_thread(images, tmp_path):
    opened(tmp_path / "map").build(images)
    alone = opened(tmp_path / "map")
    expected = [alone.localize(path) for path in images.paths]
    shared, questions = opened(tmp_path / "map"), [*images.paths] * 4
    with ThreadPoolExecutor(4) as threads:
        assert [*threads.map(shared.localize, questions)] == expected * 4
    assert [shared.localize(path) for path in images.paths] == expected


def test_threads_add_to_one_map(images, tmp_path):
    shared = opened(tmp_path / "map")
    with ThreadPoolExecutor(4) as threads:
        [*threads.map(lambda row: shared.add(images.paths[row], row, name=str(row)), range(len(images)))]
    assert sorted(shared.names) == sorted(map(str, range(len(images))))
    again = opened(tmp_path / "map")
    assert again.names == shared.names
    assert [again.localize(path).place for path in images.paths] == [*range(len(images))]


def test_builders_share_one_vocabulary(images, tmp_path):
    learning, other = (opened(tmp_path / "map", describer=VladFitting(num_words=2)) for _ in range(2))

    def refused_meanwhile(items, total):
        with pytest.raises(InputError, match=f"{tmp_path}/map: in use by process"):
            other.build(images)
        return items

    learning.build(first(images, 6), track=refused_meanwhile)
    vocabulary = (tmp_path / "map/vocabulary.npz").read_bytes()
    other.learn(images)
    assert other.build(images) == 4
    assert (tmp_path / "map/vocabulary.npz").read_bytes() == vocabulary
    again = opened(tmp_path / "map", describer=VladFitting(num_words=2))
    assert again.names == list(images.names)


@dataclass(frozen=True)
class Counting(Constant):
    """Counts the images that it gets."""

    calls: list = field(default_factory=list, compare=False, metadata={"recipe": False})

    def __call__(self, images):
        self.calls.extend(range(len(images)))
        return super().__call__(images)


def test_the_vocabulary_is_learned_from_the_features_that_are_added(images, tmp_path):
    extractor, maps = Counting(), []
    for name in ("at once", "one after the other"):
        maps.append(opened(tmp_path / name, extractor, VladFitting(num_words=2)))
        if name == "one after the other":
            maps[-1].learn(images)
        extractor.calls.clear()
        assert maps[-1].build(images) == len(images)
        assert len(extractor.calls) == len(images)
        assert not (tmp_path / name / "learning").exists()
    predictions = [[known.localize(path) for path in images.paths] for known in maps]
    assert predictions[0] == predictions[1]
    assert maps[0].names == maps[1].names


@pytest.mark.parametrize("parts", [["entries"], ["features"], ["entries", "features"]])
def test_rows_of_a_copy_that_grew_are_refused(images, folder, tmp_path, parts):
    shutil.copytree(folder, tmp_path / "copy")
    for known, row in ((folder, 6), (tmp_path / "copy", 7)):
        opened(known).add(images.paths[row], row, name=str(row))
    for part in parts:
        shutil.copy(file_of(tmp_path / "copy/0000" / part, 6), folder / "0000" / part)
    with pytest.raises(InputError, match="damaged on disk, the first in row 6"):
        opened(folder).localize(images.paths[6])
    assert opened(tmp_path / "copy").localize(images.paths[7]).place == 7


@pytest.mark.parametrize(("part", "other"), [("entries", "features"), ("features", "entries")])
def test_a_file_that_was_removed_is_missed(images, folder, part, other):
    """Unless both of its row were, which leaves the row out."""
    file_of(folder / "0000" / part, 2).unlink()
    with pytest.raises(InputError, match=f"0000/{part}: expected .* row 2, got none .*0000/{other}/2-") as error:
        opened(folder)
    assert "\n" not in str(error.value)
    file_of(folder / "0000" / other, 2).unlink()
    known = opened(folder)
    assert known.there.tolist() == [True, True, False, True, True, True]
    assert known.build(first(images, 6)) == 1
    assert known.row(images.names[2]) == 6


def test_tokens_that_were_removed_are_missed(folder):
    (folder / "0000/tokens").unlink()
    with pytest.raises(InputError, match="0000/tokens: expected a file, got none"):
        opened(folder)


class Killed(BaseException):
    """Ends an add as a signal does."""


def add_killed(monkeypatch, part, folder, images):
    """Add an image, and end where one of the two stores of the segment is written."""
    write = RowStore.write_parts

    def end(store, rows):
        if store.folder.name == part:
            raise Killed
        write(store, rows)

    with monkeypatch.context() as patch:
        patch.setattr(RowStore, "write_parts", end)
        with pytest.raises(Killed):
            opened(folder).add(images.paths[6], "lost", name="lost")


@pytest.mark.parametrize("part", ["features", "entries"])
def test_a_row_without_its_token_is_no_row(images, folder, monkeypatch, part):
    add_killed(monkeypatch, part, folder, images)
    known = opened(folder)
    known.add(images.paths[7], "next", name="next")
    for maps in (known, opened(folder)):
        assert maps.localize(images.paths[7]).place == "next"
        assert maps.row("lost") is None


def test_nothing_is_written_of_rows_that_cannot_be_stored(images, folder):
    known = opened(folder)
    features, vector = known.describing.image(images.paths[6])
    files = sorted(folder.rglob("*"))
    infinite, not_a_number = (np.append(vector[1:], value) for value in (np.inf, np.nan))
    for bad, words in ((vector[:5], r"^bad: .*\[36\], got \[5\]"), (vector.astype(str) + "x", r"row 7: could not"),
                       (infinite, "^bad: .* finite"), (not_a_number, "^bad: .* finite")):  # fmt: skip
        entries = [Entry("good", 0, vector), Entry("bad", 1, bad)]
        with pytest.raises(ValueError, match=words):
            known.add_described(entries, [features] * 2)
        assert sorted(folder.rglob("*")) == files
    assert opened(folder).names == list(images.names[:6])


@pytest.mark.parametrize("segment", [3, 4096])
def test_a_map_that_replaced_the_one_that_is_open_is_refused(images, tmp_path, monkeypatch, segment):
    monkeypatch.setattr(map_store, "SEGMENT", segment)
    folder = tmp_path / "map"
    opened(folder).build(first(images, 6))
    stays, grows = opened(folder), opened(folder)
    shutil.rmtree(folder)
    with pytest.raises(InputError, match=f"^{folder}: .*replaced.* Open the map again"):
        stays.add(images.paths[7], 7)
    opened(folder).build(replace(images, names=images.names[5::-1]))
    for known in (stays, grows):
        for use in (lambda known=known: known.localize(images.paths[0]), lambda known=known: known.build(images)):
            with pytest.raises(InputError, match=f"^{folder}: .*replaced.* Open the map again"):
                use()
    assert opened(folder).localize(images.paths[0]).place == images.names[0]
    assert len(opened(folder)) == 6


def test_a_copy_that_grew_is_refused_in_place_of_the_map_that_is_open(images, folder, tmp_path):
    """Though it has the same first rows."""
    shutil.copytree(folder, tmp_path / "copy")
    known = opened(folder)
    for path, row in ((folder, 6), (tmp_path / "copy", 7)):
        opened(path).add(images.paths[row], row, name=str(row))
    assert known.refresh() == 1
    shutil.rmtree(folder / "0000")
    shutil.copytree(tmp_path / "copy" / "0000", folder / "0000")
    with pytest.raises(InputError, match=r"replaced.* Open the map again"):
        known.localize(images.paths[0])


def test_a_vocabulary_that_replaced_the_one_that_is_open_is_refused(images, tmp_path):
    maps = [opened(tmp_path / "map", describer=VladFitting(num_words=2)) for _ in range(2)]
    for known in maps:
        known.learn(first(images, 4))
    shutil.rmtree(tmp_path / "map")
    opened(tmp_path / "map", describer=VladFitting(num_words=2)).build(images)
    for use in (lambda known: known.localize(images.paths[0]), lambda known: known.add(images.paths[0], 0, name="0")):
        with pytest.raises(InputError, match=r"vocabulary\.npz: .*replaced.* Open the map again"):
            use(maps.pop())


def test_a_map_stays_where_it_is_when_the_working_directory_changes(images, folder, monkeypatch):
    monkeypatch.chdir(folder.parent)
    known = opened(folder.name)
    monkeypatch.chdir("/")
    opened(folder).add(images.paths[6], "new", name="new")
    assert known.localize(images.paths[6]).place == "new"
    known.add(images.paths[7], "newer", name="newer")
    assert opened(folder).names == known.names


@pytest.mark.parametrize("size", [0, 5, 16, 40])
def test_tokens_that_were_cut_are_missed(images, folder, size):
    known, path = opened(folder), folder / "0000/tokens"
    content = path.read_bytes()
    path.write_bytes(content[:size])
    for use in (lambda: opened(folder), lambda: known.localize(images.paths[0]), lambda: known.build(images)):
        with pytest.raises(InputError, match=f"^{path}: expected tokens of rows up to 5, got .* {size} bytes[^\n]+$"):
            use()
    path.write_bytes(content)
    assert opened(folder).localize(images.paths[5]).place == images.names[5]


def test_a_map_can_be_opened_whenever_another_process_is_adding(images, folder, monkeypatch):
    """Between any two of its steps; and after it was killed there."""
    lengths, write, sync = [], RowStore.write_parts, os.fsync

    def look(call):
        def step(*arguments):
            result = call(*arguments)
            lengths.append(len(opened(folder)))
            return result

        return step

    with monkeypatch.context() as patch:
        patch.setattr(RowStore, "write_parts", look(write))
        patch.setattr(os, "fsync", look(sync))
        opened(folder).build(first(images, 8))
    assert set(lengths) == {6, 8}
    assert lengths == sorted(lengths)


def test_rows_are_seen_after_a_killed_add_of_the_same_number(images, folder, monkeypatch):
    """Though the clock of the file of tokens stands still."""
    add_killed(monkeypatch, "features", folder, images)
    path, known = folder / "0000/tokens", opened(folder)
    for row in (6, 7):
        opened(folder).add(images.paths[row], row, name=str(row))
        os.utime(path, ns=(0, 0))
        assert known.localize(images.paths[row]).place == row


def test_a_map_of_format_1_is_read_but_not_added_to(images, tmp_path):
    extractor = Constant()
    recipe, sizes = {"extractor": recipe_of(extractor), "describer": recipe_of(extractor)}, {"num_images": 4096}
    kind, folder = replace(map_store.MAP, version=1), tmp_path / "map/0000"
    with open_store(folder / "features", recipe, **sizes) as features, \
            open_entry_store(folder / "entries", recipe, kind=kind, **sizes) as entries:  # fmt: skip
        for row, path in enumerate(images.paths[:4]):
            local, vector = Describing(extractor, extractor).image(path)
            features.write({row: local})
            entries.write({row: Entry(images.names[row], row, vector)})
    files = sorted(folder.rglob("*"))
    known = opened(tmp_path / "map", extractor)
    assert [known.localize(path).place for path in images.paths[:4]] == [0, 1, 2, 3]
    assert known.build(first(images, 4)) == 0
    with pytest.raises(InputError, match=r"'mfvpr map 2', got 'mfvpr map 1'"):
        known.build(images)
    assert sorted(folder.rglob("*")) == files
    next(folder.glob("features/2-*.npz")).unlink()
    with pytest.raises(InputError, match="expected features of row 2, got none"):
        opened(tmp_path / "map", extractor).localize(images.paths[0])
