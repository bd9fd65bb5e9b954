"""The synthetic street by day and in seven other conditions, those of RobotCar Seasons."""

from pathlib import Path

from mfvpr.datasets.streets.drawing import SIGHT, Progress, Shot, cached_folder, draw_shots
from mfvpr.datasets.streets.drives import SPACING, plan_drives, plan_return
from mfvpr.datasets.streets.ground_truth import write_ground_truth
from mfvpr.datasets.streets.scene import build_scene
from mfvpr.datasets.streets.weather import WEATHERS

CONDITIONS = ("dawn", "dusk", "night", "night-rain", "winter", "rain", "snow")
TRUTH = "ground_truth.csv"  # in the folder of each condition


def seasons_folder(
    cache: Path | str,
    *,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Progress | None = None,
) -> Path:
    """The folder of the synthetic street's seasons inside `cache`, drawn if it is missing; see `draw_seasons`."""
    return cached_folder(
        cache, "seasons", draw_seasons, seed=seed, num_frames=num_frames, image_size=image_size, progress=progress
    )


def draw_seasons(
    folder: Path | str,
    *,
    seed: int = 0,
    num_frames: int = 100,
    image_size: tuple[int, int] = (448, 336),
    progress: Progress | None = None,
) -> None:
    """Draw the synthetic street into `folder`: database/0000.png ... by day, and a folder per condition.

    Each condition has its own drive, in another lane, with other headings and between the frames of the database, and a
    ground_truth.csv as from `draw_streets`: frame i shows the place of the database's frame i. The files depend on
    `seed`, `num_frames` and `image_size` only, to the bit.

    Arguments and errors are those of `draw_streets`; there are eight times as many images as frames.
    """
    folder = Path(folder)
    folder.mkdir(parents=True)
    scene = build_scene(seed, SPACING * (num_frames + 1) + SIGHT)
    database, _ = plan_drives(seed, num_frames, image_size)
    drives = {"database": (database, WEATHERS["day"], scene.cars[1::2])}
    for number, condition in enumerate(CONDITIONS):
        cameras = plan_return(seed, number, num_frames, image_size)
        drives[condition] = (cameras, WEATHERS[condition], scene.cars[::2])
        (folder / condition).mkdir()
        write_ground_truth(folder / condition / TRUTH, scene.facades, cameras, database)
    (folder / "database").mkdir()
    shots = []
    for row in range(num_frames):  # all weathers in turn, so that threads rarely need the same textures
        for number, (name, (cameras, weather, cars)) in enumerate(drives.items()):
            shots.append(Shot(folder / name / f"{row:04d}.png", cameras[row], weather, cars, (seed, 10, number, row)))
    draw_shots(scene, shots, progress)
