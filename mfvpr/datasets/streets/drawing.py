"""The folder of the synthetic street: images and ground truth, complete or absent."""

import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
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

VERSION = 1  # of the images: raise it when they change, so that old caches are not used for new ones
SIGHT = 100.0  # panels farther away are not drawn, meters
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Shot:
    """One image to draw: its file, camera, weather, cars and seed."""

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
    """The folder of the synthetic street inside `cache`, drawn if it is missing; see `draw_streets`."""
    return cached_folder(
        cache, "streets", draw_streets, seed=seed, num_frames=num_frames, image_size=image_size, progress=progress
    )


def cached_folder(
    cache: Path | str,
    kind: str,
    draw: Callable[..., None],
    *,
    seed: int,
    num_frames: int,
    image_size: tuple[int, int],
    progress: Progress | None,
) -> Path:
    """The folder inside `cache` that `draw` makes, drawn if it is missing.

    It is drawn under another name and renamed when complete, so that a killed run leaves nothing that looks complete.
    """
    folder = Path(cache) / f"{kind}-v{VERSION}-seed{seed}-{num_frames}x{image_size[0]}x{image_size[1]}"
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".drawing-") as temporary:
            drawing = Path(temporary) / folder.name
            draw(drawing, seed=seed, num_frames=num_frames, image_size=image_size, progress=progress)
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
    """Draw the synthetic street into `folder`.

    The folder gets

    * database/0000.png ...: a summer day,
    * queries/0000.png ...: the same places with another lane, other headings and other cars; the first half of the
      frames at night, the second half in snow,
    * ground_truth.csv: columns query, database (file names), shift_x and shift_y: candidate minus query position in px
      of the image, x to the right, y down. The shift is the median, per axis, over facade points that are visible in
      both images (trees, signs and cars disregarded); see `image_shift`.

    The files depend on `seed`, `num_frames` and `image_size` only, to the bit.

    Args:
        folder: must not exist yet.
        seed: of the street, its cars and the drives.
        num_frames: number of places, 1.75 m apart; there are twice as many images.
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
    shots = []
    for row, (query, candidate) in enumerate(zip(queries, database, strict=True)):  # no car is in both drives
        weather, name = WEATHERS["night" if row < num_frames // 2 else "snow"], f"{row:04d}.png"
        shots.append(Shot(folder / "database" / name, candidate, WEATHERS["day"], scene.cars[1::2], (seed, 7, row)))
        shots.append(Shot(folder / "queries" / name, query, weather, scene.cars[::2], (seed, 8, row)))
    draw_shots(scene, shots, progress)


def draw_shots(scene: Scene, shots: Sequence[Shot], progress: Progress | None) -> None:
    """Draw the images on threads."""
    pool = ThreadPoolExecutor(available_cpus())  # more would only wait for each other
    try:
        futures = [pool.submit(draw_shot, scene, shot) for shot in shots]
        for done, future in enumerate(as_completed(futures), start=1):
            future.result()
            if progress is not None:
                progress(done, len(shots))
    finally:
        pool.shutdown(cancel_futures=True)


def draw_shot(scene: Scene, shot: Shot) -> None:
    """Draw one image and write it."""
    rng, camera = np.random.default_rng(shot.seed), shot.camera
    # Objects on the street are never behind a house, hence houses are painted first.
    layers = (scene.ground, scene.houses, (*scene.street, *traffic(shot.cars, camera, rng)))
    near = ([prop for prop in layer if prop.z < camera.z + SIGHT] for layer in layers)
    image = expose(paint(([sky_prop(scene.sky, camera)], *near), camera, shot.weather), shot.weather, rng)
    if not cv2.imwrite(str(shot.path), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"cannot write {shot.path}")
