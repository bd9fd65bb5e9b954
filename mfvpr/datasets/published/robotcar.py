"""Oxford RobotCar Seasons (Sattler et al., CVPR 2018), version 2, as in the paper.

Images are those of the rear camera with public positions: summer is the database, seven other conditions are the
queries. The database image with the nearest camera is correct, and frames around it. Queries without a database image
within five meters are left out.
"""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.datasets.ground_truth import FARTHEST, FrameTruth
from mfvpr.datasets.published.lists import listed_images, read_lines
from mfvpr.utils.errors import InputError
from mfvpr.utils.numbers import parse_number

REFERENCE = "overcast-summer"  # the paper's figure; its text says overcast-reference, whose images are 6,954
CONDITIONS = ("dawn", "dusk", "night", "night-rain", "overcast-winter", "rain", "snow")
REACH = 5.0  # meters
POSES = "robotcar_v2_train.txt"
_LAST_ROW = 1e-6  # tolerance of the last row of a pose, 0 0 0 1
LAYOUT = f"""images/CONDITION/rear/TIMESTAMP.jpg  of {REFERENCE} (the database),
                                     {", ".join(CONDITIONS)}
{POSES}                per line CONDITION/rear/TIMESTAMP.jpg and 16 numbers, camera to world"""


def robotcar_seasons(root: Path, name: str) -> Dataset:
    """The database, and a sequence per condition, in the order of their timestamps."""
    path = root / POSES
    centers = camera_centers(path)
    database, places = _condition(centers, REFERENCE, path)
    images = listed_images(root / "images", database, path)
    sequences = []
    for condition in CONDITIONS:
        names, positions = _condition(centers, condition, path)
        distances = np.linalg.norm(positions[:, None] - places, axis=-1)
        near = np.flatnonzero(distances.min(axis=1) <= REACH).tolist()
        rows = tuple((int(distances[query].argmin()),) for query in near)
        queries = listed_images(root / "images", [names[query] for query in near], path)
        sequences.append(QuerySequence(condition, queries, FrameTruth(rows, len(database))))
    return Dataset(name, images, tuple(sequences))


def camera_centers(path: Path) -> dict[str, np.ndarray]:
    """Read camera centers `[3]` in meters by image name from a file of poses."""
    centers = {}
    for number, line in enumerate(read_lines(path), start=1):
        name, *texts = line.split()
        numbers = []
        with suppress(ValueError):
            numbers = [parse_number(text) for text in texts]
        center = np.array(numbers[3:12:4])
        is_pose = len(numbers) == 16 and np.allclose(numbers[12:], (0, 0, 0, 1), rtol=0, atol=_LAST_ROW)
        if not is_pose or not np.all(np.abs(center) <= FARTHEST):
            raise InputError(
                f"{path}: line {number}: expected a name and the 16 numbers of a pose by rows, the last 0 0 0 1, got "
                f"{line[:60]!r}; get the file again"
            )
        image = Path(name).with_suffix(".jpg").as_posix()
        if image in centers and not np.array_equal(centers[image], center):
            raise InputError(f"{path}: line {number}: expected one pose of {image}, got another; get the file again")
        centers[image] = center
    return centers


def _condition(centers: Mapping[str, np.ndarray], condition: str, path: Path) -> tuple[list[str], np.ndarray]:
    """Names and camera centers `[n, 3]` of a condition's images."""
    names = sorted(name for name in centers if name.startswith(f"{condition}/rear/"))
    if not names:
        raise InputError(f"{path}: expected poses of {condition}/rear, got none; use the file of the data set")
    return names, np.array([centers[name] for name in names])
