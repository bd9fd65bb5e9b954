"""The folders of the synthetic street: images and ground truth, complete or absent."""

import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mfvpr.datasets.streets.camera import SPACING, Camera, plan_drives, plan_return, write_ground_truth
from mfvpr.datasets.streets.cars import traffic
from mfvpr.datasets.streets.painting import paint
from mfvpr.datasets.streets.scene import Scene, build_scene, sky_prop
from mfvpr.datasets.streets.weather import WEATHERS, expose
from mfvpr.utils.numerics import available_cpus

VERSION = 1  # of the images: raise it when they change, so that old caches are not used for new ones
SIGHT = 100.0  # panels farther away are not drawn, meters
CONDITIONS = ("dawn", "dusk", "night", "night-rain", "winter", "rain", "snow")  # those of RobotCar Seasons
TRUTH = "ground_truth.csv"
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Drive:
    """The images of one folder: a camera and the name of a weather per frame, and the seed of the images.

    `ground_truth` is the file with the shifts to the database's frames; None = this is the database.
    """

    folder: Path
    cameras: list[Camera]
    weathers: list[str]
    seed: tuple[int, ...]
    ground_truth: Path | None = None


def draw_streets(
    folder: Path | str,
    *,
    seasons: bool = False,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Progress | None = None,
) -> None:
    """Draw the synthetic street into `folder`.

    The folder gets

    * database/0000.png ...: a summer day,
    * queries/0000.png ...: the same places with another lane, other headings and other cars; the first half of the
      frames at night, the second half in snow,
    * ground_truth.csv: columns query, database (file names), shift_x and shift_y: candidate minus query position in px
      of the image, x to the right, y down. The shift is the median, per axis, over facade points that are visible in
      both images (trees, signs and cars disregarded); see `image_shift`.

    With `seasons`, a folder per condition replaces the queries. Each has its own drive, between the frames of the
    database, and its own ground_truth.csv.

    The files depend on the arguments only, to the bit.

    Args:
        folder: must not exist yet.
        seasons: whether the queries are drives in seven conditions.
        seed: of the street, its cars and the drives.
        num_frames: number of places, 1.75 m apart; there are twice as many images, with `seasons` eight times.
        image_size: (width, height) in px.
        progress: `progress(done, total)` is called in the caller's thread after every image.

    Raises:
        FileExistsError: the folder exists.
    """
    folder = Path(folder)
    database, queries = plan_drives(seed, num_frames, image_size)
    key = (seed, 10, 0) if seasons else (seed, 7)
    drives = [Drive(folder / "database", database, ["day"] * num_frames, key)]
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
    progress: Progress | None = None,
) -> Path:
    """The folder of the synthetic street inside `cache`, drawn if it is missing; options as in `draw_streets`.

    It is renamed when complete, so that a killed run leaves nothing that looks complete.
    """
    kind = "seasons" if seasons else "streets"
    folder = Path(cache) / f"{kind}-v{VERSION}-seed{seed}-{num_frames}x{image_size[0]}x{image_size[1]}"
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".drawing-") as temporary:
            drawing = Path(temporary) / folder.name
            draw_streets(
                drawing, seasons=seasons, seed=seed, num_frames=num_frames, image_size=image_size, progress=progress
            )
            try:
                os.replace(drawing, folder)
            except OSError:
                if not folder.exists():  # otherwise another process was faster, with the same result
                    raise
    return folder


def draw_drives(drives: Sequence[Drive], seed: int, length: float, progress: Progress | None) -> None:
    """Draw the images of several drives, the database first, down the first `length` meters of one street."""
    drives[0].folder.parent.mkdir(parents=True)
    scene = build_scene(seed, length + SIGHT)
    for drive in drives:
        drive.folder.mkdir()
        if drive.ground_truth is not None:
            write_ground_truth(drive.ground_truth, scene.facades, drive.cameras, drives[0].cameras)
    # All drives in turn, so that threads rarely need the textures of one weather at the same time.
    shots = [(drive, row) for row in range(len(drives[0].cameras)) for drive in drives]
    pool = ThreadPoolExecutor(available_cpus())  # more would only wait for each other
    try:
        futures = [pool.submit(draw_frame, scene, drive, row) for drive, row in shots]
        for done, future in enumerate(as_completed(futures), start=1):
            future.result()
            if progress is not None:
                progress(done, len(shots))
    finally:
        pool.shutdown(cancel_futures=True)


def draw_frame(scene: Scene, drive: Drive, row: int) -> None:
    """Draw one image of a drive and write it."""
    rng, camera, weather = np.random.default_rng((*drive.seed, row)), drive.cameras[row], WEATHERS[drive.weathers[row]]
    cars = scene.cars[1::2] if drive.ground_truth is None else scene.cars[::2]  # no query meets a car of the database
    # Objects on the street are never behind a house, hence houses are painted first.
    layers = (scene.ground, scene.houses, (*scene.street, *traffic(cars, camera, rng)))
    near = ([prop for prop in layer if prop.z < camera.z + SIGHT] for layer in layers)
    image = expose(paint(([sky_prop(scene.sky, camera)], *near), camera, weather), weather, rng)
    path = drive.folder / f"{row:04d}.png"
    if not cv2.imwrite(str(path), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"cannot write {path}")
