"""One map used by several threads or builders, and files of several maps: nobody gets what is another's."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr.datasets import image_folder
from mfvpr.features import VladFitting
from mfvpr.localization import Map
from mfvpr.storage.maps import Entry, MapFile
from mfvpr.utils import InputError
from tests.builders import map_system
from tests.localization.test_map import Constant

pytestmark = pytest.mark.slow


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


def opened(folder, extractor=None, describer=None, **options):
    extractor = extractor or Constant()
    return Map(folder, map_system(extractor, describer or extractor, mfvpr.MatchCount(), candidates=3), **options)


def test_threads_get_the_answers_of_one_thread(images, tmp_path):
    opened(tmp_path / "map").build(images)
    alone = opened(tmp_path / "map")
    expected = [alone.localize(path) for path in images.paths]
    shared, questions = opened(tmp_path / "map"), [*images.paths] * 4
    with ThreadPoolExecutor(4) as threads:
        assert [*threads.map(shared.localize, questions)] == expected * 4
    assert [shared.localize(path) for path in images.paths] == expected


def test_builders_share_one_vocabulary(images, tmp_path):
    def refused_meanwhile(items, total):
        with pytest.raises(InputError, match=f"{tmp_path}/map: another process adds images"):
            other.build(images)
        return items

    other = opened(tmp_path / "map", describer=VladFitting(num_words=2))
    runtime = mfvpr.Runtime(progress=lambda label: refused_meanwhile)
    opened(tmp_path / "map", describer=VladFitting(num_words=2), runtime=runtime).build(first(images, 6))
    vocabulary = MapFile(tmp_path / "map").part("vocabulary")
    other.learn(images)
    assert other.build(images) == 4
    assert MapFile(tmp_path / "map").part("vocabulary") == vocabulary
    again = opened(tmp_path / "map", describer=VladFitting(num_words=2))
    assert again.names == list(images.names)


def test_nothing_is_written_of_rows_that_cannot_be_stored(images, folder):
    known = opened(folder)
    features, vector = known.describing.image(images.paths[6])
    wrong = replace(features, descriptors=features.descriptors[:, :5])
    nan = replace(features, scores=np.full_like(features.scores, np.nan))
    for bad, local, words in (
        (vector[:5], features, r"^bad: expected a descriptor \[36\] of finite numbers, got \[5\]"),
        (vector.astype(str), features, r"^bad: expected a descriptor \[36\] .* <U"),
        (np.append(vector[1:], np.nan), features, "^bad: .* finite"),
        (vector, wrong, "^bad: expected features of 9 dimensions, got 5"),
        (vector, nan, "^bad: features must be finite"),
    ):
        with pytest.raises(InputError, match=words):
            known.add_described([Entry("good", 0, vector), Entry("bad", 1, bad)], [features, local])
    assert opened(folder).names == list(images.names[:6])


def test_an_open_map_whose_file_was_replaced_stays_as_it_is_and_takes_no_images(images, folder):
    known = opened(folder)
    shutil.rmtree(folder)
    opened(folder).build(first(images, 2))
    assert known.localize(images.paths[5]).place == images.names[5]
    with pytest.raises(InputError, match=r"map\.sqlite: cannot be used"):
        known.add(images.paths[7], 7)
    assert opened(folder).names == list(images.names[:2])
