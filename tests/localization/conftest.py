"""A small map."""

import pytest

from mfvpr.localization import Map
from tests.builders import map_system
from tests.localization.test_map import SIFT, VLAD


@pytest.fixture(scope="module")
def folder(dataset, tmp_path_factory):
    """A map of the database, whose places are rows."""
    folder = tmp_path_factory.mktemp("maps") / "map"
    Map(folder, map_system(SIFT, VLAD)).build(dataset.database, list(range(len(dataset.database))))
    return folder
