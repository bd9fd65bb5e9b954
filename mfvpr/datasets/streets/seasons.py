"""The drawn street by day, and again on seven other days: as RobotCar Seasons stands to its seven conditions."""

from functools import partial
from pathlib import Path

from mfvpr.datasets.streets.drawing import SIGHT, VERSION, Progress, Shot, draw_shots, kept
from mfvpr.datasets.streets.drives import SPACING, plan_drives, plan_return
from mfvpr.datasets.streets.ground_truth import write_ground_truth
from mfvpr.datasets.streets.scene import build_scene
from mfvpr.datasets.streets.weather import WEATHERS

CONDITIONS = ("dawn", "dusk", "night", "night-rain", "winter", "rain", "snow")
TRUTH = "ground_truth.csv"  # in the folder of each


def seasons_folder(
    cache: Path | str,
    *,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Progress | None = None,
) -> Path:
    """The folder of the drawn seasons inside `cache`, drawn now if it is not there yet; see `draw_seasons`."""
    name = f"seasons-v{VERSION}-seed{seed}-{num_frames}x{image_size[0]}x{image_size[1]}"
    draw = partial(draw_seasons, seed=seed, num_frames=num_frames, image_size=image_size, progress=progress)
    return kept(Path(cache) / name, draw)


def draw_seasons(
    folder: Path | str,
    *,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Progress | None = None,
) -> None:
    """Draw the street into `folder`: database/0000.png ... by day, and a folder per condition.

    Each is a drive of its own, in another lane, with other headings and between the frames of the database, and has a
    ground_truth.csv as `draw_streets` writes it: frame i shows the place of the database's frame i. The result depends
    on seed, number and size only, down to the last bit.

    Args:
        folder: which must not exist yet.
        seed: of the street, its cars and the drives.
        num_frames: places, 1.75 m apart; eight times as many images.
        image_size: (width, height) in px.
        progress: `progress(done, total)` is called in the caller's thread after every image.

    Raises:
        FileExistsError: the folder exists.
    """
    folder = Path(folder)
    folder.mkdir(parents=True)
    scene = build_scene(seed, SPACING * (num_frames + 1) + SIGHT)
    database, _ = plan_drives(seed, num_frames, image_size)
    drives = {"database": database}
    for number, condition in enumerate(CONDITIONS):
        drives[condition] = plan_return(seed, number, num_frames, image_size)
    for name in drives:
        (folder / name).mkdir()
    shots = []
    for row in range(num_frames):  # all weathers in turn: threads then need not make the same textures at a time
        for number, (name, cameras) in enumerate(drives.items()):
            cars = scene.cars[1::2] if name == "database" else scene.cars[::2]
            weather = WEATHERS["day" if name == "database" else name]
            shots.append(Shot(folder / name / f"{row:04d}.png", cameras[row], weather, cars, (seed, 10, number, row)))
    for condition in CONDITIONS:
        write_ground_truth(folder / condition / TRUTH, scene.facades, drives[condition], database)
    draw_shots(scene, shots, progress)
