"""The synthetic street by day and in seven other conditions, those of RobotCar Seasons."""

from functools import partial
from pathlib import Path

from mfvpr.datasets.streets.camera import SPACING, plan_drives, plan_return
from mfvpr.datasets.streets.drawing import Drive, Progress, draw_drives, streets_folder

CONDITIONS = ("dawn", "dusk", "night", "night-rain", "winter", "rain", "snow")
TRUTH = "ground_truth.csv"  # in the folder of each condition


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
    database, _ = plan_drives(seed, num_frames, image_size)
    drives = [Drive(folder / "database", database, ["day"] * num_frames, (seed, 10, 0))]
    for number, condition in enumerate(CONDITIONS):
        cameras, place = plan_return(seed, number, num_frames, image_size), folder / condition
        drives.append(Drive(place, cameras, [condition] * num_frames, (seed, 10, number + 1), place / TRUTH))
    draw_drives(drives, seed, SPACING * (num_frames + 1), progress)


seasons_folder = partial(streets_folder, kind="seasons", draw=draw_seasons)  # the folder of `draw_seasons` in a cache
