"""The folders of the synthetic street: drives of a pinhole camera past panels in true perspective, and ground truth."""

import os
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from mfvpr.datasets.streets.scene import LANE, Facade, Scene, build_scene, traffic
from mfvpr.datasets.streets.sheets import WEATHERS, Floats, Image, Panel, Prop, Rng, Weather
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.runtime import Track, no_progress

VERSION = 1  # of the images: raise it when they change, so that old caches are not used for new ones
NEAR = 0.5  # objects that are nearer to the camera are invisible, meters
SIGHT = 100.0  # panels farther away are not drawn, meters
CAMERA_HEIGHT = 1.6  # meters
SPACING = 1.75  # between frames, meters
STEP = 8  # px between the points that shifts are measured at
OVERSAMPLING = 1.5  # size of the canvas per size of the image, against jagged edges
CONDITIONS = ("dawn", "dusk", "night", "night-rain", "winter", "rain", "snow")  # those of RobotCar Seasons
TRUTH = "ground_truth.csv"
_DEGREE = np.pi / 180


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at (x, -CAMERA_HEIGHT, z), in meters; angles in radians, heading to the right, pitch up."""

    x: float
    z: float
    heading: float
    pitch: float
    image_size: tuple[int, int]  # width, height in px

    @property
    def focal(self) -> float:
        """Focal length in px."""
        return 0.7 * self.image_size[0]

    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Rows: the camera's right, down and forward axes in the world."""
        sin_h, cos_h, sin_p, cos_p = (f(a) for a in (self.heading, self.pitch) for f in (np.sin, np.cos))
        forward = np.array([sin_h * cos_p, -sin_p, cos_h * cos_p])
        right = np.array([cos_h, 0.0, -sin_h])
        return np.stack([right, np.cross(forward, right), forward])

    def center(self) -> Float[np.ndarray, "3"]:
        return np.array([self.x, -CAMERA_HEIGHT, self.z])

    def projection(self) -> Float[np.ndarray, "3 4"]:
        """The matrix from world points (x, y, z, 1) to homogeneous px; the last row gives the depth in m."""
        width, height = self.image_size
        intrinsics = np.array([[self.focal, 0, width / 2], [0, self.focal, height / 2], [0, 0, 1]])
        rotation = self.rotation()
        return intrinsics @ np.column_stack([rotation, -rotation @ self.center()])

    def project(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "points 2"], Bool[np.ndarray, " points"]]:
        """World points to px, and which of them lie inside the image."""
        homogeneous = np.column_stack([points, np.ones(len(points))]) @ self.projection().T
        pixels = homogeneous[:, :2] / np.maximum(homogeneous[:, 2:], NEAR)
        inside = (homogeneous[:, 2] > NEAR) & np.all((pixels >= 0) & (pixels < self.image_size), axis=1)
        return pixels, inside


@dataclass(frozen=True)
class Drive:
    """The images of one folder, with a camera and the name of a weather per frame."""

    folder: Path
    cameras: list[Camera]
    weathers: list[str]
    seed: tuple[int, ...]
    ground_truth: Path | None = None  # file with the shifts to the database's frames; None = this is the database


def draw_streets(
    folder: Path | str,
    *,
    seasons: bool = False,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Track = no_progress,
) -> None:
    """Draw the synthetic street into `folder`.

        draw_streets("street", seed=3, num_frames=4, image_size=(160, 120))

    `database/` is a summer day. `queries/` are the same places with another lane, other headings and other cars, the
    first half at night, the second half in snow. `ground_truth.csv` has query and database (file names), and shift_x
    and shift_y: candidate minus query position in px, see `image_shift`. With `seasons`, a folder per condition
    replaces the queries. Each has its own drive, between the frames of the database, and its own ground_truth.csv. The
    files depend on the arguments only, to the bit.

    Args:
        folder: must not exist yet (`FileExistsError`).
        seasons: whether the queries are drives in seven conditions.
        seed: of the street, its cars and the drives.
        num_frames: number of places, 1.75 m apart; there are twice as many images, with `seasons` eight times.
        image_size: (width, height) in px.
        progress: over the images, in the caller's thread.
    """
    folder = Path(folder)
    database, queries = plan_drives(seed, num_frames, image_size)
    drives = [Drive(folder / "database", database, ["day"] * num_frames, (seed, 10, 0) if seasons else (seed, 7))]
    if not seasons:
        weathers = ["night"] * (num_frames // 2) + ["snow"] * (num_frames - num_frames // 2)
        drives.append(Drive(folder / "queries", queries, weathers, (seed, 8), folder / TRUTH))
    for number, condition in enumerate(CONDITIONS if seasons else ()):
        cameras, place = plan_return(seed, number, num_frames, image_size), folder / condition
        drives.append(Drive(place, cameras, [condition] * num_frames, (seed, 10, number + 1), place / TRUTH))
    draw_drives(drives, seed, SPACING * (num_frames + seasons), progress)


def streets_folder(
    cache: Path | str,
    *,
    seasons: bool = False,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Track = no_progress,
) -> Path:
    """The folder of the synthetic street inside `cache`, drawn if it is missing; options as in `draw_streets`.

    It is renamed when complete, so that a killed run leaves nothing that looks complete.
    """
    kind, (width, height) = "seasons" if seasons else "streets", image_size
    folder = Path(cache) / f"{kind}-v{VERSION}-seed{seed}-{num_frames}x{width}x{height}"
    if folder.exists():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    options = {"seasons": seasons, "seed": seed, "num_frames": num_frames, "image_size": image_size}
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".drawing-") as temporary:
        drawing = Path(temporary) / folder.name
        draw_streets(drawing, **options, progress=progress)
        try:
            os.replace(drawing, folder)
        except OSError:
            if not folder.exists():  # otherwise another process was faster, with the same result
                raise
    return folder


def plan_drives(seed: int, count: int, image_size: tuple[int, int]) -> tuple[list[Camera], list[Camera]]:
    """The `count` cameras of the database and of the queries, in driving order; `image_size` is (width, height), px.

    The database keeps to the lane; the queries shift by 0.3 to 1.2 m to either side and turn by up to 9 degrees.
    """
    rng = np.random.default_rng([seed, 6])
    queries = _weave(rng, count, image_size)
    poses = zip(queries, *(0.3 * _DEGREE * rng.standard_normal((2, count))), strict=True)
    return [Camera(LANE, query.z, heading, pitch, image_size) for query, heading, pitch in poses], queries


def plan_return(seed: int, number: int, count: int, image_size: tuple[int, int]) -> list[Camera]:
    """The cameras of drive `number` on another day, with another lane, other headings and positions between frames.

    Frame i is at most 0.4 of the database's spacing away from the database's frame i.
    """
    rng = np.random.default_rng([seed, 9, number])
    cameras = _weave(rng, count, image_size)
    places = SPACING * (np.arange(count) + rng.uniform(-0.2, 0.2) + 0.2 * _smooth_walk(rng, count))
    return [replace(camera, z=z) for camera, z in zip(cameras, places, strict=True)]


def _weave(rng: Rng, count: int, image_size: tuple[int, int]) -> list[Camera]:
    """Cameras that leave the lane and the direction of the street."""
    shift = _smooth_walk(rng, count)
    lane = LANE + np.where(shift < 0, -1, 1) * (0.3 + 0.9 * np.abs(shift))
    heading = _DEGREE * (7.5 * _smooth_walk(rng, count) + np.clip(0.5 * rng.standard_normal(count), -1, 1))
    pitch = _DEGREE * (1.0 * _smooth_walk(rng, count) + 0.3 * rng.standard_normal(count))
    places = SPACING * np.arange(count)
    return [Camera(*pose, image_size) for pose in zip(lane, places, heading, pitch, strict=True)]


def _smooth_walk(rng: Rng, count: int) -> Floats:
    """Smooth random values `[count]` in [-1, 1], similar over 8 frames."""
    steps = np.arange(-30, 31)
    kernel = np.exp(-0.5 * (steps / 8.0) ** 2)
    walk = np.convolve(rng.standard_normal(count + len(steps) - 1), kernel, mode="valid")
    return np.clip(1.3 * walk / np.sqrt(np.sum(kernel**2)) / 2, -1, 1)


def draw_drives(drives: Sequence[Drive], seed: int, length: float, progress: Track = no_progress) -> None:
    """Draw the images of several drives, the database first, down the first `length` meters of one street."""
    drives[0].folder.parent.mkdir(parents=True)
    scene = build_scene(seed, length + SIGHT)
    for drive in drives:
        drive.folder.mkdir()
        if drive.ground_truth is not None:
            lines = ["query,database,shift_x,shift_y"]
            for row, (query, candidate) in enumerate(zip(drive.cameras, drives[0].cameras, strict=True)):
                x, y = image_shift(visible_points(scene.facades, query), query, candidate)
                lines.append(f"{row:04d}.png,{row:04d}.png,{x:.3f},{y:.3f}")
            drive.ground_truth.write_text("\n".join(lines) + "\n", newline="\r\n")
    # All drives in turn, so that threads rarely need the textures of one weather at the same time.
    shots = [(drive, row) for row in range(len(drives[0].cameras)) for drive in drives]
    pool = ThreadPoolExecutor(available_cpus())  # more would only wait for each other
    try:
        futures = [pool.submit(draw_frame, scene, drive, row) for drive, row in shots]
        for future in progress(as_completed(futures), len(shots)):
            future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def visible_points(facades: Iterable[Facade], camera: Camera) -> Float[np.ndarray, "points 3"]:
    """Points on the nearest facades, seen through a grid of every `STEP`-th px of the image."""
    width, height = camera.image_size
    u, v = np.meshgrid(np.arange(STEP / 2, width, STEP), np.arange(STEP / 2, height, STEP))
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
    hits = np.isfinite(nearest)
    return camera.center() + nearest[hits, None] * rays[hits]


def image_shift(points: Float[np.ndarray, "points 3"], query: Camera, database: Camera) -> tuple[float, float]:
    """Shift (x, y) in px that moves the scene of the query image onto the database image.

    It is the median per axis of the position there minus the position here, over the world points inside both images.
    """
    (before, inside_query), (after, inside_database) = query.project(points), database.project(points)
    x, y = np.median((after - before)[inside_query & inside_database], axis=0)
    return float(x), float(y)


def draw_frame(scene: Scene, drive: Drive, row: int) -> None:
    """Draw one image of a drive and write it: panels from far to near, then lens, air and sensor."""
    rng, camera, weather = np.random.default_rng((*drive.seed, row)), drive.cameras[row], WEATHERS[drive.weathers[row]]
    cars = scene.cars[1::2] if drive.ground_truth is None else scene.cars[::2]  # no query meets a car of the database
    z = camera.z + 4.0  # the sky is so far away that it moves along with the camera
    sky = Panel(scene.sky, (camera.x - 8, -CAMERA_HEIGHT - 3.9, z), (16, 0, 0), (0, 4.0, 0))
    # Objects on the street are never behind a house, hence houses are painted first.
    layers = ([Prop(z, (sky,))], scene.ground, scene.houses, (*scene.street, *traffic(cars, camera.z, rng)))
    width, height = camera.image_size
    size = (round(width * OVERSAMPLING), round(height * OVERSAMPLING))
    canvas = np.empty((size[1], size[0], 4), np.uint8)
    canvas[:] = (*weather.horizon, 255)
    projection = np.diag([size[0] / width, size[1] / height, 1.0]) @ camera.projection()
    for layer in layers:
        for prop in sorted(layer, key=lambda prop: -prop.z):
            for panel in prop.panels if prop.z < camera.z + SIGHT else ():
                paint_panel(canvas, projection, panel, weather)
    image = expose(cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)[..., :3], weather, rng)
    path = drive.folder / f"{row:04d}.png"
    if not cv2.imwrite(str(path), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"cannot write {path}")


def paint_panel(canvas: Image, projection: Floats, panel: Panel, weather: Weather) -> None:
    """Paint one panel over the canvas (RGBA), unless it is out of view or shows its back.

    `projection` `[3, 4]` takes world points to homogeneous px of the canvas.
    """
    frame = np.column_stack([panel.right, panel.down, panel.corner])
    homography = projection @ np.vstack([frame, (0, 0, 1)])
    corners = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1.0]]) @ homography.T
    clipped = []  # the part in front of the camera
    for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if corner[2] > NEAR:
            clipped.append(corner)
        if (corner[2] > NEAR) != (following[2] > NEAR):
            clipped.append(corner + (following - corner) * (NEAR - corner[2]) / (following[2] - corner[2]))
    if not clipped:
        return
    outline = np.array([point[:2] / point[2] for point in clipped])
    (x, y), (next_x, next_y) = outline.T, np.roll(outline, -1, axis=0).T
    if np.sum(x * next_y - y * next_x) <= 1:  # corners run the wrong way around, or enclose less than half a px
        return
    low = np.maximum(np.floor(outline.min(0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(outline.max(0)).astype(int) + 2, canvas.shape[1::-1])
    width, height = (high - low).tolist()
    if width <= 0 or height <= 0:
        return
    depth = float(homography[2] @ (0.5, 0.5, 1))
    texture = panel.texture(weather)
    rows, columns = texture.shape[:2]
    across, down = np.ceil(np.ptp(outline, 0)).tolist()
    size = (int(np.clip(across, 1, columns)), int(np.clip(down, 1, rows)))
    if size != (columns, rows):  # no more texels than px, against aliasing
        texture = cv2.resize(texture, size, interpolation=cv2.INTER_AREA)
    share = 1 - np.exp(-((depth / weather.haze) ** 2))
    levels = np.arange(256, dtype=np.float64)[:, None]
    table = levels + share * (np.array((*weather.horizon, 0)) - levels) * (1, 1, 1, 0)
    texture = cv2.LUT(texture, table.astype(np.uint8)[None])
    texels = np.diag([1 / texture.shape[1], 1 / texture.shape[0], 1])
    warp = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]]) @ homography @ texels
    patch = cv2.warpPerspective(texture, warp, (width, height), borderMode=cv2.BORDER_REPLICATE)
    mask = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(mask, np.rint((outline - low) * 16).astype(np.int32), 255, shift=4)
    mask[patch[..., 3] < 128] = 0
    cv2.copyTo(patch, mask, canvas[low[1] : high[1], low[0] : high[0]])


def expose(image: Image, weather: Weather, rng: Rng) -> Image:
    """The image with all effects of its weather; a few frames are much worse than the rest."""
    seen = image.astype(np.float32)
    # Heavy-tailed: below 1 in six of ten frames, above 10 in one of ten.
    severity = min(rng.exponential() ** 3, 20.0) * image.shape[1] / 448
    if weather.motion:  # long exposures blur along the turn
        seen = cv2.blur(seen, (1 + int(weather.motion * severity), 1))
    if weather.bloom:  # a glow around bright lights, as from a lens
        small = cv2.resize(seen, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        bright = np.maximum(small - 150, 0)
        spread = 0.6 * cv2.GaussianBlur(bright, (0, 0), 2) + 0.9 * cv2.GaussianBlur(bright, (0, 0), 7)
        seen = seen + weather.bloom * cv2.resize(spread, seen.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    defocus = weather.defocus + weather.drops * severity
    if weather.defocus_spread:
        defocus += weather.defocus_spread * rng.random()
    if defocus:
        seen = cv2.GaussianBlur(seen, (0, 0), defocus)
    height, width = seen.shape[:2]
    if weather.flakes:
        fallen = np.zeros((height, width), np.uint8)
        count = int(rng.uniform(0.5, 1.5) * weather.flakes)
        for x, y, radius in rng.uniform((0, 0, width / 1100), (width, height, width / 240), (count, 3)):
            center, gray = (round(x * 16), round(y * 16)), int(rng.integers(70, 180))
            cv2.circle(fallen, center, round(radius * 16), gray, -1, cv2.LINE_AA, 4)
        seen = seen + cv2.GaussianBlur(fallen, (0, 0), 0.8).astype(np.float32)[..., None] / 255 * (245 - seen)
    if weather.streaks:  # all blown to the same side
        fallen = np.zeros((height, width), np.uint8)
        count, slant = int(rng.uniform(0.5, 1.5) * weather.streaks), rng.uniform(-0.3, 0.3)
        for x, y, length in rng.uniform((0, 0, width / 60), (width, height, width / 14), (count, 3)):
            start, end = (round(x * 16), round(y * 16)), (round((x + slant * length) * 16), round((y + length) * 16))
            cv2.line(fallen, start, end, int(rng.integers(40, 120)), 1, cv2.LINE_AA, 4)
        share = cv2.GaussianBlur(fallen, (0, 0), 0.6).astype(np.float32)[..., None] / 255
        seen = seen + share * (seen.mean() + 60 - seen)
    seen += weather.noise * rng.standard_normal(seen.shape, np.float32)
    return np.clip(seen, 0, 255).astype(np.uint8)
