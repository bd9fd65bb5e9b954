"""The synthetic streets: reproducible, complete or absent, and with a ground truth that follows the geometry."""

import csv
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mfvpr.datasets.streets import CONDITIONS, TRUTH, draw_streets, streets_folder
from mfvpr.datasets.streets.drawing import SPACING, Camera, image_shift, plan_drives, plan_return, visible_points
from mfvpr.datasets.streets.scene import LANE, Facade

pytestmark = pytest.mark.thorough

FRAMES, SEASONS_FRAMES = 4, 3
SIZE = (96, 72)
CAMERA = Camera(x=0.0, z=0.0, heading=0.0, pitch=0.0, image_size=(448, 336))
WALLS = (Facade(-8.0, 0.0, 60.0, 9.0), Facade(8.0, 0.0, 60.0, 9.0))


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def streets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("streets") / "drawn"
    draw_streets(folder, num_frames=FRAMES, image_size=SIZE)
    return folder


@pytest.fixture(scope="module")
def seasons(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seasons") / "drawn"
    draw_streets(folder, seasons=True, num_frames=SEASONS_FRAMES, image_size=SIZE)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "num_frames"), [("streets", FRAMES), ("seasons", SEASONS_FRAMES)])
def test_a_seed_decides_all_bytes(request, tmp_path, kind, num_frames):
    """The same seed gives the same bytes, and each file of another seed differs."""
    options = {"seasons": kind == "seasons", "num_frames": num_frames, "image_size": SIZE}
    draw_streets(tmp_path / "again", **options)
    draw_streets(tmp_path / "other", seed=1, **options)
    first, other = contents(request.getfixturevalue(kind)), contents(tmp_path / "other")
    assert first == contents(tmp_path / "again")
    assert first.keys() == other.keys()
    assert all(first[name] != other[name] for name in first)


def check_ground_truth(path, num_frames):
    with path.open(newline="") as file:
        lines = list(csv.DictReader(file))
    names = [f"{row:04d}.png" for row in range(num_frames)]
    assert list(lines[0]) == ["query", "database", "shift_x", "shift_y"]
    assert [line["query"] for line in lines] == [line["database"] for line in lines] == names
    assert all(np.isfinite([float(line["shift_x"]), float(line["shift_y"])]).all() for line in lines)


def test_files_and_ground_truth(streets, seasons):
    names = [f"{row:04d}.png" for row in range(FRAMES)]
    assert sorted(contents(streets)) == [
        *(f"database/{name}" for name in names),
        "ground_truth.csv",
        *(f"queries/{name}" for name in names),
    ]
    check_ground_truth(streets / "ground_truth.csv", FRAMES)
    assert sorted(path.name for path in seasons.iterdir()) == sorted(["database", *CONDITIONS])
    assert len(contents(seasons)) == SEASONS_FRAMES * (1 + len(CONDITIONS)) + len(CONDITIONS)
    for condition in CONDITIONS:
        check_ground_truth(seasons / condition / TRUTH, SEASONS_FRAMES)


def test_existing_folder_is_an_error(tmp_path):
    with pytest.raises(FileExistsError):
        draw_streets(tmp_path, num_frames=1, image_size=SIZE)


@pytest.mark.first_case
@pytest.mark.parametrize("seasons, folders", [(False, 2), (True, 8)])
def test_interrupted_drawing_leaves_nothing_and_the_cache_is_used_afterwards(seasons, folders, tmp_path):
    def interrupt(items, total):
        next(iter(items))
        raise KeyboardInterrupt

    options = {"seasons": seasons, "num_frames": 2, "image_size": (32, 24)}
    with pytest.raises(KeyboardInterrupt):
        streets_folder(tmp_path, **options, progress=interrupt)
    assert list(tmp_path.iterdir()) == []

    totals = []
    folder = streets_folder(tmp_path, **options, progress=lambda items, total: totals.append(total) or items)
    assert totals == [2 * folders]
    assert list(tmp_path.iterdir()) == [folder]

    times = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert streets_folder(tmp_path, **options) == folder
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == times


@pytest.mark.parametrize("degrees", [-4.0, 0.0, 2.5])
def test_heading_or_pitch_alone_shifts_by_the_tangent(degrees):
    ahead = np.array([[x, -1.6 + y, 1000.0] for x in (-5.0, 0.0, 5.0) for y in (-5.0, 0.0, 5.0)])
    angle = np.radians(degrees)
    length = CAMERA.focal * np.tan(angle)
    assert image_shift(ahead, replace(CAMERA, heading=angle), CAMERA) == pytest.approx((length, 0.0), abs=1.0)
    assert image_shift(ahead, replace(CAMERA, pitch=angle), CAMERA) == pytest.approx((0.0, -length), abs=1.0)


def test_heading_on_facades_follows_each_points_angle():
    turn = np.radians(3.0)
    query = replace(CAMERA, heading=turn)
    points = visible_points(WALLS, query)
    angle = np.arctan2(points[:, 0], points[:, 2])
    moved = CAMERA.focal * (np.tan(angle) - np.tan(angle - turn))
    inside = CAMERA.project(points)[1]
    assert image_shift(points, query, CAMERA)[0] == pytest.approx(np.median(moved[inside]), abs=1.0)


def test_visible_points_lie_on_the_nearest_facade_in_view():
    hidden = Facade(12.0, 0.0, 60.0, 9.0)
    points = visible_points((*WALLS, hidden), CAMERA)
    assert len(points) > 100
    assert CAMERA.project(points)[1].all()
    np.testing.assert_allclose(np.abs(points[:, 0]), 8.0)
    assert points[:, 1].min() >= -9.0
    assert points[:, 1].max() <= 0.0


def test_drives_differ_in_lane_and_heading_only():
    database, queries = plan_drives(0, 100, CAMERA.image_size)
    lane = np.array([q.x - d.x for q, d in zip(queries, database, strict=True)])
    assert [q.z for q in queries] == [d.z for d in database]
    assert 0.3 <= np.abs(lane).min() <= np.abs(lane).max() <= 1.2 + 1e-9
    assert np.abs([q.heading for q in queries]).max() < np.radians(9.0)


def test_nights_are_dark_and_all_days_differ(seasons):
    light = {
        condition: np.mean([cv2.imread(str(path)).mean() for path in (seasons / condition).glob("*.png")])
        for condition in ("database", *CONDITIONS)
    }
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
