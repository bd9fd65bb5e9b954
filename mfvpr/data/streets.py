"""A drawn street for demonstrations and tests: the same places by day and again at night or in snow.

World axes: x to the right, y down, z along the street, in meters; the ground is y = 0. A pinhole camera drives
along z and sees flat panels (facades, roofs, trees, cars) in true perspective, painted from far to near.
"""

from __future__ import annotations

import csv
import os
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mfvpr.data._street_scene import CAMERA_HEIGHT, NEAR, Camera, Facade, Floats, Panel, Prop, Scene, build_scene, move
from mfvpr.data._street_textures import DAY, NIGHT, SNOW, Image, Rng, Weather

VERSION = 1  # of the drawings: raise it when they change, so that old caches are not taken for new ones
SPACING = 1.75  # between frames, meters
SIGHT = 100.0  # panels farther away are not drawn, meters
LANE = 1.8  # x of the driving lane, meters
NIGHT_MOTION = 0.4  # motion blur per unit of trouble (see `expose`), px of an image 448 px wide
SNOW_BLUR = 0.08  # further blur per unit of trouble, px of an image 448 px wide
SNOW_FLAKES = 130  # mean number per image
OVERSAMPLING = 1.5  # the canvas is that much larger than the image, against jagged edges
# Where cars may be: x, smallest and largest distance ahead of the camera (meters), whether oncoming.
TRAFFIC = (
    (LANE, 7, 25, False), (-LANE, 5, 22, True), (-LANE, 25, 50, True),
    (4.0, 5, 18, False), (4.0, 25, 50, False), (-4.0, 5, 18, True),
)  # fmt: skip


@dataclass(frozen=True)
class Shot:
    """One image to draw: where to, from where, in what weather, with which random numbers."""

    path: Path
    camera: Camera
    weather: Weather
    seed: tuple[int, ...]


# --- painting --------------------------------------------------------------------------------------------------


def clip_outline(homography: Floats) -> Floats | None:
    """Corners (n, 2), in px, of the unit square's image, cut off in front of the camera; None if not in front."""
    corners = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1.0]]) @ homography.T
    if np.all(corners[:, 2] > NEAR):
        return corners[:, :2] / corners[:, 2:]
    kept = []
    for here, after in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if here[2] > NEAR:
            kept.append(here)
        if (here[2] > NEAR) != (after[2] > NEAR):
            kept.append(here + (after - here) * (NEAR - here[2]) / (after[2] - here[2]))
    return np.array([p[:2] / p[2] for p in kept]) if kept else None


def haze_table(weather: Weather, depth: float) -> Image:
    """Lookup table (1, 256, 4) that mixes the haze of `depth` meters of air into a color."""
    share = 1 - np.exp(-((depth / weather.haze) ** 2))
    levels = np.arange(256, dtype=np.float64)[:, None]
    table = levels + share * (np.array((*weather.horizon, 0)) - levels) * (1, 1, 1, 0)
    return table.astype(np.uint8)[None]


def paint_panel(canvas: Image, projection: Floats, panel: Panel, weather: Weather) -> None:
    """Paint one panel over the canvas (RGBA), unless it is out of view or shows its back."""
    frame = np.column_stack([panel.right, panel.down, panel.corner])
    homography = projection @ np.vstack([frame, (0, 0, 1)])
    outline = clip_outline(homography)
    if outline is None:
        return
    x, y = outline.T
    if x @ np.roll(y, -1) - y @ np.roll(x, -1) <= 1:  # twice the area: negative from behind
        return
    low = np.maximum(np.floor(outline.min(0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(outline.max(0)).astype(int) + 2, canvas.shape[1::-1])
    width, height = (high - low).tolist()
    if width <= 0 or height <= 0:
        return
    depth = float(homography[2] @ (0.5, 0.5, 1))
    texture = cv2.LUT(shrink(panel.textures[weather], np.ptp(outline, 0)), haze_table(weather, depth))
    texels = np.diag([1 / texture.shape[1], 1 / texture.shape[0], 1])
    warp = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]]) @ homography @ texels
    patch = cv2.warpPerspective(texture, warp, (width, height), borderMode=cv2.BORDER_REPLICATE)
    mask = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(mask, np.rint((outline - low) * 16).astype(np.int32), 255, shift=4)
    mask[patch[..., 3] < 128] = 0
    cv2.copyTo(patch, mask, canvas[low[1] : high[1], low[0] : high[0]])


def shrink(texture: Image, extent: Floats) -> Image:
    """The texture with no more texels than its image has px, against aliasing; extent is (width, height) in px."""
    rows, columns = texture.shape[:2]
    size = (int(np.clip(np.ceil(extent[0]), 1, columns)), int(np.clip(np.ceil(extent[1]), 1, rows)))
    return texture if size == (columns, rows) else cv2.resize(texture, size, interpolation=cv2.INTER_AREA)


def backdrop_prop(scene: Scene, camera: Camera) -> Prop:
    """The sky, so far away that it moves along with the camera."""
    z = camera.z + 4.0
    return Prop(z, (Panel(scene.backdrop, (camera.x - 8, -CAMERA_HEIGHT - 3.9, z), (16, 0, 0), (0, 4.0, 0)),))


def traffic(scene: Scene, shot: Shot, rng: Rng) -> list[Prop]:
    """Cars ahead, cars that come along and parked cars; database and queries draw from different cars."""
    models = scene.cars[shot.weather is DAY :: 2]
    props = []
    for x, nearest, farthest, oncoming in TRAFFIC:
        model = models[int(rng.integers(len(models)))][oncoming]
        if rng.random() < 0.7:
            props.append(move(model, x + rng.uniform(-0.2, 0.2), shot.camera.z + rng.uniform(nearest, farthest)))
    return props


def paint(scene: Scene, shot: Shot, rng: Rng) -> Image:
    """The image (RGB) before the sensor and the falling snow."""
    camera, weather = shot.camera, shot.weather
    width, height = camera.image_size
    size = (round(width * OVERSAMPLING), round(height * OVERSAMPLING))
    canvas = np.empty((size[1], size[0], 4), np.uint8)
    canvas[:] = (*weather.horizon, 255)
    projection = np.diag([size[0] / width, size[1] / height, 1.0]) @ camera.projection()
    # Nothing on the street can hide behind a house, hence houses first, then all that stands on the street.
    layers = (scene.ground, scene.houses, (*scene.street, *traffic(scene, shot, rng)))
    paint_far_to_near(canvas, projection, [backdrop_prop(scene, camera)], weather, np.inf)
    for layer in layers:
        paint_far_to_near(canvas, projection, layer, weather, camera.z + SIGHT)
    return cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)[..., :3]


def paint_far_to_near(canvas: Image, projection: Floats, props: Iterable[Prop], weather: Weather, end: float) -> None:
    """Paint the props of one layer up to z = `end`."""
    for prop in sorted((p for p in props if p.z < end), key=lambda p: -p.z):
        for panel in prop.panels:
            paint_panel(canvas, projection, panel, weather)


def bloom(image: Floats) -> Floats:
    """The glow around bright lights, as a lens spreads it."""
    small = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    bright = np.maximum(small - 150, 0)
    spread = 0.6 * cv2.GaussianBlur(bright, (0, 0), 2) + 0.9 * cv2.GaussianBlur(bright, (0, 0), 7)
    return image + cv2.resize(spread, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)


def fall_snow(image: Floats, count: int, rng: Rng) -> Floats:
    """`count` flakes of several sizes over the image."""
    height, width = image.shape[:2]
    flakes = np.zeros((height, width), np.uint8)
    for x, y, radius in rng.uniform((0, 0, width / 1100), (width, height, width / 240), (count, 3)):
        center = (round(x * 16), round(y * 16))
        cv2.circle(flakes, center, round(radius * 16), int(rng.integers(70, 180)), -1, cv2.LINE_AA, 4)
    share = cv2.GaussianBlur(flakes, (0, 0), 0.8).astype(np.float32)[..., None] / 255
    return image + share * (245 - image)


def expose(image: Image, weather: Weather, rng: Rng) -> Image:
    """What lens, air and sensor make of the painted image: a few frames come out much worse than the rest."""
    seen = image.astype(np.float32)
    # Heavy-tailed: below 1 in six of ten frames, above 10 in one of ten.
    trouble = min(rng.exponential() ** 3, 20.0) * image.shape[1] / 448
    if weather is NIGHT:
        seen = cv2.blur(seen, (1 + int(NIGHT_MOTION * trouble), 1))  # long exposures blur along the turn
        seen = cv2.GaussianBlur(bloom(seen), (0, 0), 0.7 + 0.3 * rng.random())
    elif weather is SNOW:
        seen = cv2.GaussianBlur(seen, (0, 0), 0.3 + SNOW_BLUR * trouble)  # drops on the lens
        seen = fall_snow(seen, int(rng.uniform(0.5, 1.5) * SNOW_FLAKES), rng)
    seen += {DAY: 1.0, NIGHT: 4.0, SNOW: 1.5}[weather] * rng.standard_normal(seen.shape, np.float32)
    return np.clip(seen, 0, 255).astype(np.uint8)


def draw_shot(scene: Scene, shot: Shot) -> None:
    """Draw one image and write it."""
    rng = np.random.default_rng(shot.seed)
    image = expose(paint(scene, shot, rng), shot.weather, rng)
    if not cv2.imwrite(str(shot.path), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"cannot write {shot.path}")


# --- the drive and its ground truth ----------------------------------------------------------------------------


def smooth_walk(rng: Rng, count: int, correlation: float = 8.0) -> Floats:
    """Smooth random values in [-1, 1], alike over `correlation` frames."""
    steps = np.arange(-30, 31)
    kernel = np.exp(-0.5 * (steps / correlation) ** 2)
    walk = np.convolve(rng.standard_normal(count + len(steps) - 1), kernel, mode="valid")
    return np.clip(1.3 * walk / np.sqrt(np.sum(kernel**2)) / 2, -1, 1)


def plan_drives(seed: int, count: int, image_size: tuple[int, int]) -> tuple[list[Camera], list[Camera]]:
    """The cameras of the database and of the queries, in driving order."""
    rng = np.random.default_rng([seed, 6])
    degree = np.pi / 180
    z = SPACING * np.arange(count)
    shift = smooth_walk(rng, count)
    lane = LANE + np.where(shift < 0, -1, 1) * (0.3 + 0.9 * np.abs(shift))
    heading = degree * (7.5 * smooth_walk(rng, count) + np.clip(0.5 * rng.standard_normal(count), -1, 1))
    pitch = degree * (1.0 * smooth_walk(rng, count) + 0.3 * rng.standard_normal(count))
    wobble = 0.3 * degree * rng.standard_normal((2, count))
    database = [Camera(LANE, z[i], wobble[0, i], wobble[1, i], image_size) for i in range(count)]
    queries = [Camera(lane[i], z[i], heading[i], pitch[i], image_size) for i in range(count)]
    return database, queries


def visible_points(facades: Iterable[Facade], camera: Camera, step: int = 8) -> Floats:
    """Facade points (n, 3) that a grid of one px in `step` of the image sees, other facades in front removed."""
    width, height = camera.image_size
    u, v = np.meshgrid(np.arange(step / 2, width, step), np.arange(step / 2, height, step))
    rays = np.stack([(u - width / 2) / camera.focal, (v - height / 2) / camera.focal, np.ones_like(u)], -1)
    rays = rays.reshape(-1, 3) @ camera.rotation()
    nearest = np.full(len(rays), np.inf)
    for facade in facades:
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (facade.x - camera.x) / rays[:, 0]
            points = camera.center() + distance[:, None] * rays
        hit = (distance > 0) & (points[:, 2] >= facade.start) & (points[:, 2] <= facade.end)
        hit &= (points[:, 1] <= 0) & (points[:, 1] >= -facade.height)
        nearest = np.where(hit & (distance < nearest), distance, nearest)
    seen = np.isfinite(nearest)
    return camera.center() + nearest[seen, None] * rays[seen]


def image_shift(points: Floats, query: Camera, database: Camera) -> tuple[float, float]:
    """Where the scene of the query image has to move to fall on the database image, (x, y) in px.

    It is the median, per axis, over the world points (n, 3) inside both images, of the point's position in the
    database image minus its position in the query image.
    """
    (before, inside_query), (after, inside_database) = query.project(points), database.project(points)
    x, y = np.median((after - before)[inside_query & inside_database], axis=0)
    return float(x), float(y)


def write_ground_truth(path: Path, facades: Iterable[Facade], queries: list[Camera], database: list[Camera]) -> None:
    """Write the pairs of frames and their shifts; see `draw_streets`."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("query", "database", "shift_x", "shift_y"))
        for i, (query, candidate) in enumerate(zip(queries, database, strict=True)):
            shift = image_shift(visible_points(facades, query), query, candidate)
            writer.writerow((f"{i:04d}.png", f"{i:04d}.png", *(f"{s:.3f}" for s in shift)))


def draw_streets(
    folder: Path,
    *,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Draw the street into `folder`, which must not exist yet.

    It gets database/0000.png ... (a summer day), queries/0000.png ... (the same places, first at night, from half
    of the frames on in snow; other lane, other heading, other cars) and ground_truth.csv with the columns query,
    database (file names), shift_x and shift_y: candidate minus query position in px of the drawn image, x to the
    right, y down. The shift is the median, per axis, over a grid of those facade points that the query's camera
    sees (trees, signs and cars disregarded) and that also lie inside the database image; see `image_shift`.
    `image_size` is (width, height) in px. `progress(done, total)` is called in the caller's thread after every
    image. The result depends on seed, number and size only, down to the last bit.
    """
    folder.mkdir(parents=True)
    for name in ("database", "queries"):
        (folder / name).mkdir()
    scene = build_scene(seed, SPACING * num_frames + SIGHT)
    database, queries = plan_drives(seed, num_frames, image_size)
    write_ground_truth(folder / "ground_truth.csv", scene.facades, queries, database)
    shots = []
    for i in range(num_frames):
        weather = NIGHT if i < num_frames // 2 else SNOW
        name = f"{i:04d}.png"
        shots.append(Shot(folder / "database" / name, database[i], DAY, (seed, 7, i)))
        shots.append(Shot(folder / "queries" / name, queries[i], weather, (seed, 8, i)))
    pool = ThreadPoolExecutor()
    try:
        drawn = [pool.submit(draw_shot, scene, shot) for shot in shots]
        for done, future in enumerate(as_completed(drawn), start=1):
            future.result()
            if progress is not None:
                progress(done, len(shots))
    finally:
        pool.shutdown(cancel_futures=True)


def streets_folder(
    cache: Path,
    *,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """The folder of the drawn street inside `cache`, drawn now if it is not there yet.

    It is drawn under another name and renamed when complete, so a killed run leaves nothing that looks complete.
    """
    folder = cache / f"streets-v{VERSION}-seed{seed}-{num_frames}x{image_size[0]}x{image_size[1]}"
    if not folder.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache, prefix=".drawing-") as temporary:
            drawing = Path(temporary) / folder.name
            draw_streets(drawing, seed=seed, num_frames=num_frames, image_size=image_size, progress=progress)
            try:
                os.replace(drawing, folder)
            except OSError:
                if not folder.exists():  # otherwise another process was faster, with the same result
                    raise
    return folder
