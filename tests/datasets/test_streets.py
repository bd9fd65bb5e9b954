"""The synthetic street: reproducible, complete or absent, and with a ground truth that follows the geometry."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mfvpr.datasets.streets import draw_streets, streets_folder
from mfvpr.datasets.streets.camera import Camera, plan_drives
from mfvpr.datasets.streets.exposure import expose
from mfvpr.datasets.streets.ground_truth import Facade, image_shift, visible_points
from mfvpr.datasets.streets.sheets import Sheet, texture
from mfvpr.datasets.streets.weather import WEATHERS, Exposure

pytestmark = pytest.mark.thorough

FRAMES = 4
SIZE = (96, 72)
CAMERA = Camera(x=0.0, z=0.0, heading=0.0, pitch=0.0, image_size=(448, 336))
WALLS = (Facade(-8.0, 0.0, 60.0, 9.0), Facade(8.0, 0.0, 60.0, 9.0))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("streets") / "drawn"
    draw_streets(folder, num_frames=FRAMES, image_size=SIZE)
    return folder


@pytest.mark.slow
def test_same_seed_gives_same_bytes(drawn: Path, tmp_path: Path) -> None:
    draw_streets(tmp_path / "again", num_frames=FRAMES, image_size=SIZE)
    assert contents(drawn) == contents(tmp_path / "again")


def test_other_seed_gives_other_images(drawn: Path, tmp_path: Path) -> None:
    draw_streets(tmp_path / "other", seed=1, num_frames=FRAMES, image_size=SIZE)
    first, other = contents(drawn), contents(tmp_path / "other")
    assert first.keys() == other.keys()
    assert all(first[name] != other[name] for name in first)


def test_files_and_rows(drawn: Path) -> None:
    names = [f"{i:04d}.png" for i in range(FRAMES)]
    for part in ("database", "queries"):
        assert sorted(p.name for p in (drawn / part).iterdir()) == names
    with (drawn / "ground_truth.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["query", "database", "shift_x", "shift_y"]
    assert [row["query"] for row in rows] == names
    assert [row["database"] for row in rows] == names
    assert all(np.isfinite([float(row["shift_x"]), float(row["shift_y"])]).all() for row in rows)


def test_images_show_something(drawn: Path) -> None:
    for path in drawn.rglob("*.png"):
        image = cv2.imread(str(path))
        assert image is not None
        assert image.shape == (SIZE[1], SIZE[0], 3)
        assert image.std() > 5


def test_queries_are_dark_at_night_and_bright_in_snow(drawn: Path) -> None:
    day, night, snow = (
        np.mean([cv2.imread(str(drawn / part / f"{i:04d}.png")) for i in frames])
        for part, frames in (("database", range(4)), ("queries", (0, 1)), ("queries", (2, 3)))
    )
    assert night < 0.7 * day
    assert night < 0.7 * snow


@pytest.mark.parametrize(
    "effect, size",
    [("noise", 3), ("motion", 50), ("bloom", 1), ("defocus", 1), ("defocus_spread", 2), ("drops", 20), ("flakes", 50)],
)
def test_without_effects_the_image_stays_and_each_effect_changes_it(effect: str, size: float) -> None:
    image = np.zeros((72, 96, 3), np.uint8)
    image[20:50, 30:60] = 240
    quiet = Exposure(noise=0.0)

    def exposed(exposure: Exposure) -> np.ndarray:
        return expose(image, replace(WEATHERS["day"], exposure=exposure), np.random.default_rng(0))

    np.testing.assert_array_equal(exposed(quiet), image)
    assert (exposed(replace(quiet, **{effect: size})) != image).any()


def test_light_and_snow_of_a_weather_follow_its_row() -> None:
    sheet = Sheet(1.0, 1.0, (100, 80, 60))
    sheet.rect(0, 0, 1.0, 0.5, (100, 80, 60), glow=(200, 150, 90), snow=255)
    day = replace(WEATHERS["day"], horizon=(100, 100, 100))
    seen = texture(sheet, lamp_light=0.5, sun=1.2)
    upper, lower = (0, 0, slice(3)), (-1, -1, slice(3))
    np.testing.assert_array_equal(seen(day)[lower], (120, 96, 72))
    np.testing.assert_array_equal(seen(replace(day, sun=0.5))[lower], (110, 88, 66))
    np.testing.assert_array_equal(seen(replace(day, sun=0.0, lamp=(1, 0.5, 0)))[lower], (150, 100, 60))
    np.testing.assert_array_equal(seen(replace(day, sun=0.0, glow=1.0))[upper], (200, 150, 90))
    np.testing.assert_array_equal(seen(replace(day, snow=1.0))[upper], (114, 114, 114))  # 1.15 times the horizon


def test_existing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileExistsError):
        draw_streets(tmp_path, num_frames=1, image_size=SIZE)


def test_interrupted_drawing_leaves_nothing_and_the_cache_is_used_afterwards(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        streets_folder(tmp_path, num_frames=FRAMES, image_size=SIZE, progress=interrupt)
    assert list(tmp_path.iterdir()) == []

    calls: list[tuple[int, int]] = []
    folder = streets_folder(
        tmp_path, num_frames=FRAMES, image_size=SIZE, progress=lambda *done_total: calls.append(done_total)
    )
    assert calls == [(i + 1, 2 * FRAMES) for i in range(2 * FRAMES)]
    assert list(tmp_path.iterdir()) == [folder]

    times = {p: p.stat().st_mtime_ns for p in folder.rglob("*")}
    assert streets_folder(tmp_path, num_frames=FRAMES, image_size=SIZE) == folder
    assert {p: p.stat().st_mtime_ns for p in folder.rglob("*")} == times


@pytest.mark.parametrize("degrees", [-4.0, 0.0, 2.5])
def test_heading_alone_shifts_by_the_tangent(degrees: float) -> None:
    ahead = np.array([[x, -1.6 + y, 1000.0] for x in (-5.0, 0.0, 5.0) for y in (-5.0, 0.0, 5.0)])
    query = replace(CAMERA, heading=np.radians(degrees))
    shift = image_shift(ahead, query, CAMERA)
    assert shift == pytest.approx((CAMERA.focal * np.tan(np.radians(degrees)), 0.0), abs=1.0)


def test_pitch_alone_shifts_by_the_tangent() -> None:
    ahead = np.array([[0.0, -1.6, 1000.0]])
    shift = image_shift(ahead, replace(CAMERA, pitch=np.radians(2.0)), CAMERA)
    assert shift == pytest.approx((0.0, -CAMERA.focal * np.tan(np.radians(2.0))), abs=1.0)


def test_heading_on_facades_follows_each_points_angle() -> None:
    turn = np.radians(3.0)
    query = replace(CAMERA, heading=turn)
    points = visible_points(WALLS, query)
    angle = np.arctan2(points[:, 0], points[:, 2])
    moved = CAMERA.focal * (np.tan(angle) - np.tan(angle - turn))
    inside = CAMERA.project(points)[1]
    assert image_shift(points, query, CAMERA)[0] == pytest.approx(np.median(moved[inside]), abs=1.0)


def test_lane_alone_shifts_by_the_parallax() -> None:
    wall = np.array([[x, y, 20.0] for x in (-4.0, 0.0, 4.0) for y in (-4.0, -2.0)])
    shift = image_shift(wall, replace(CAMERA, x=1.0), CAMERA)
    assert shift == pytest.approx((CAMERA.focal * 1.0 / 20.0, 0.0), abs=1e-6)


def test_visible_points_lie_on_the_nearest_facade_in_view() -> None:
    hidden = Facade(12.0, 0.0, 60.0, 9.0)
    points = visible_points((*WALLS, hidden), CAMERA)
    assert len(points) > 100
    assert CAMERA.project(points)[1].all()
    np.testing.assert_allclose(np.abs(points[:, 0]), 8.0)
    assert points[:, 1].min() >= -9.0
    assert points[:, 1].max() <= 0.0


def test_drives_differ_in_lane_and_heading_only() -> None:
    database, queries = plan_drives(0, 100, CAMERA.image_size)
    lane = np.array([q.x - d.x for q, d in zip(queries, database, strict=True)])
    assert [q.z for q in queries] == [d.z for d in database]
    assert 0.3 <= np.abs(lane).min() <= np.abs(lane).max() <= 1.2 + 1e-9
    assert np.abs([q.heading for q in queries]).max() < np.radians(9.0)
