"""A folder of drawn images and their ground truth, whole or not there at all."""

import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from mfvpr.datasets.streets.camera import Camera
from mfvpr.datasets.streets.cars import Car, traffic
from mfvpr.datasets.streets.drives import SPACING, plan_drives
from mfvpr.datasets.streets.exposure import expose
from mfvpr.datasets.streets.ground_truth import write_ground_truth
from mfvpr.datasets.streets.painting import paint
from mfvpr.datasets.streets.scene import Scene, build_scene
from mfvpr.datasets.streets.sky import sky_prop
from mfvpr.datasets.streets.weather import WEATHERS, Weather
from mfvpr.utils.numerics import available_cpus

VERSION = 1  # of the drawings: raise it when they change, so that old caches are not taken for new ones
SIGHT = 100.0  # panels farther away are not drawn, meters
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Shot:
    """One image to draw: where to, from where, in what weather, among which cars, with which random numbers."""

    path: Path
    camera: Camera
    weather: Weather
    cars: tuple[Car, ...]
    seed: tuple[int, ...]


def streets_folder(
    cache: Path | str,
    *,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Progress | None = None,
) -> Path:
    """The folder of the drawn street inside `cache`, drawn now if it is not there yet; see `draw_streets`."""
    name = f"streets-v{VERSION}-seed{seed}-{num_frames}x{image_size[0]}x{image_size[1]}"
    draw = partial(draw_streets, seed=seed, num_frames=num_frames, image_size=image_size, progress=progress)
    return kept(Path(cache) / name, draw)


def kept(folder: Path, draw: Callable[[Path], None]) -> Path:
    """A folder that `draw(folder)` makes, unless it is there.

    It is drawn under another name and renamed when complete, so a killed run leaves nothing that looks complete.
    """
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".drawing-") as temporary:
            drawing = Path(temporary) / folder.name
            draw(drawing)
            try:
                os.replace(drawing, folder)
            except OSError:
                if not folder.exists():  # otherwise another process was faster, with the same result
                    raise
    return folder


def draw_streets(
    folder: Path | str,
    *,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Progress | None = None,
) -> None:
    """Draw the street into `folder`.

    It gets database/0000.png ... (a summer day), queries/0000.png ... (the same places, first at night, from half
    of the frames on in snow; other lane, other heading, other cars) and ground_truth.csv with the columns query,
    database (file names), shift_x and shift_y: candidate minus query position in px of the drawn image, x to the
    right, y down. The shift is the median, per axis, over a grid of those facade points that the query's camera
    sees (trees, signs and cars disregarded) and that also lie inside the database image; see `image_shift`.
    The result depends on seed, number and size only, down to the last bit.

    Args:
        folder: which must not exist yet.
        seed: of the street, its cars and the drives.
        num_frames: places, 1.75 m apart; twice as many images.
        image_size: (width, height) in px.
        progress: `progress(done, total)` is called in the caller's thread after every image.

    Raises:
        FileExistsError: the folder exists.
    """
    folder = Path(folder)
    folder.mkdir(parents=True)
    for name in ("database", "queries"):
        (folder / name).mkdir()
    scene = build_scene(seed, SPACING * num_frames + SIGHT)
    database, queries = plan_drives(seed, num_frames, image_size)
    write_ground_truth(folder / "ground_truth.csv", scene.facades, queries, database)
    shots = plan_shots(folder, scene, seed, database, queries)
    draw_shots(scene, shots, progress)


def draw_shots(scene: Scene, shots: Sequence[Shot], progress: Progress | None) -> None:
    """Draw the images on threads."""
    pool = ThreadPoolExecutor(available_cpus())  # more would only wait for each other
    try:
        drawn = [pool.submit(draw_shot, scene, shot) for shot in shots]
        for done, future in enumerate(as_completed(drawn), start=1):
            future.result()
            if progress is not None:
                progress(done, len(shots))
    finally:
        pool.shutdown(cancel_futures=True)


def plan_shots(folder: Path, scene: Scene, seed: int, database: list[Camera], queries: list[Camera]) -> list[Shot]:
    """The images of both drives; no car is met in both."""
    query_cars, database_cars = scene.cars[::2], scene.cars[1::2]
    shots = []
    for i, (query, candidate) in enumerate(zip(queries, database, strict=True)):
        weather, name = WEATHERS["night" if i < len(queries) // 2 else "snow"], f"{i:04d}.png"
        shots.append(Shot(folder / "database" / name, candidate, WEATHERS["day"], database_cars, (seed, 7, i)))
        shots.append(Shot(folder / "queries" / name, query, weather, query_cars, (seed, 8, i)))
    return shots


def draw_shot(scene: Scene, shot: Shot) -> None:
    """Draw one image and write it."""
    rng = np.random.default_rng(shot.seed)
    camera = shot.camera
    # Nothing on the street can hide behind a house, hence houses first, then all that stands on the street.
    layers = (scene.ground, scene.houses, (*scene.street, *traffic(shot.cars, camera, rng)))
    near = ([prop for prop in layer if prop.z < camera.z + SIGHT] for layer in layers)
    image = expose(paint(([sky_prop(scene.sky, camera)], *near), camera, shot.weather), shot.weather, rng)
    if not cv2.imwrite(str(shot.path), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"cannot write {shot.path}")
