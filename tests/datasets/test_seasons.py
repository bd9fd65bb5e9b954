"""The synthetic street in seven more conditions: other drives down one street, reproducible to the bit."""

import csv
import time

import cv2
import numpy as np
import pytest

from mfvpr.datasets.streets import draw_seasons, seasons_folder
from mfvpr.datasets.streets.camera import LANE, SPACING, plan_drives, plan_return
from mfvpr.datasets.streets.exposure import fall_rain
from mfvpr.datasets.streets.seasons import CONDITIONS, TRUTH
from tests.datasets.test_streets import contents

pytestmark = pytest.mark.thorough

FRAMES, SIZE = 3, (96, 72)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seasons") / "drawn"
    draw_seasons(folder, num_frames=FRAMES, image_size=SIZE)
    return folder


@pytest.mark.slow
def test_same_seed_gives_same_bytes_and_another_other_ones(drawn, tmp_path):
    draw_seasons(tmp_path / "again", num_frames=FRAMES, image_size=SIZE)
    draw_seasons(tmp_path / "other", seed=1, num_frames=FRAMES, image_size=SIZE)
    first, other = contents(drawn), contents(tmp_path / "other")
    assert first == contents(tmp_path / "again")
    assert len(first) == FRAMES * (1 + len(CONDITIONS)) + len(CONDITIONS)
    assert all(first[name] != other[name] for name in first)


def test_each_condition_has_its_ground_truth(drawn):
    assert sorted(path.name for path in drawn.iterdir()) == sorted(["database", *CONDITIONS])
    for condition in CONDITIONS:
        with (drawn / condition / TRUTH).open(newline="") as file:
            rows = list(csv.DictReader(file))
        names = [f"{row:04d}.png" for row in range(FRAMES)]
        assert [row["query"] for row in rows] == [row["database"] for row in rows] == names


def test_nights_are_dark_and_all_days_differ(drawn):
    light = {condition: np.mean([cv2.imread(str(path)).mean() for path in (drawn / condition).glob("*.png")])
             for condition in ("database", *CONDITIONS)}  # fmt: skip
    assert max(light["night"], light["night-rain"]) < min(light["dawn"], light["rain"]) < light["winter"]
    assert max(light["dawn"], light["dusk"], light["rain"]) < light["database"]
    assert len({round(value, 3) for value in light.values()}) == len(light)


@pytest.mark.parametrize("seed", range(3))
def test_frames_of_a_return_are_nearest_to_their_own_frame(seed):
    database, _ = plan_drives(seed, 50, SIZE)
    drives = [plan_return(seed, number, 50, SIZE) for number in range(len(CONDITIONS))]
    places = np.array([camera.z for camera in database])
    for drive in drives:
        z = np.array([camera.z for camera in drive])
        assert (np.abs(z[:, None] - places).argmin(axis=1) == np.arange(50)).all()
        assert np.abs(z - places).max() <= 0.4 * SPACING
        assert all(0.3 <= abs(camera.x - LANE) <= 1.2 + 1e-9 for camera in drive)
    assert len({drive[10].heading for drive in drives}) == len(CONDITIONS)


def test_rain_falls_in_lines():
    image = np.zeros((60, 80, 3), np.float32)
    rain = fall_rain(image, 40, np.random.default_rng(0))
    assert rain.max() > 5
    down, across = (np.abs(np.diff(rain[..., 0], axis=axis)).sum() for axis in (0, 1))
    assert across > 1.5 * down
    assert (fall_rain(image, 0, np.random.default_rng(0)) == 0).all()


def test_they_are_kept(tmp_path):
    folder = seasons_folder(tmp_path, num_frames=1, image_size=(32, 24))
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    time.sleep(0.01)
    assert seasons_folder(tmp_path, num_frames=1, image_size=(32, 24)) == folder
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
