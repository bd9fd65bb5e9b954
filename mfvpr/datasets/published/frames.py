"""Published data sets with ground truth in frames: those of SSM-VPR, Nordland, Oxford RobotCar Seasons.

Nordland (Suenderhauf et al., 2013) is a train journey in four seasons. Its variants are different data sets.
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath

import numpy as np

from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence, image_folder
from mfvpr.datasets.ground_truth import FARTHEST, FrameTruth
from mfvpr.datasets.published.lists import expected_file, listed_images, read_lines
from mfvpr.datasets.truth_files import truth_from_file
from mfvpr.io.checks import parse_number
from mfvpr.utils.errors import InputError

SSM_LAYOUT = """Reference/image0000.png (or .jpg), ...  the database, numbered from 0
Live/image0000.png (or .jpg), ...       the queries, numbered from 0
GroundTruth.csv                         Reference,Live and then a line per query: both numbers"""

SEASONS = ("fall", "spring", "summer", "winter")
EACH = 10  # database frames per query in VPR-Bench

LAYOUT_27592 = """summer/images-00202.png, ...  the database (or another of dataset.seasons)
winter/images-00202.png, ...  the queries: the same names
nordland_imageNames_index.txt, nordland_imageNames_query.txt  Patch-NetVLAD's lists, where the folders hold more"""
LAYOUT_3450 = """summer_images_test/section1/*.png, section2/*.png  the database (or another of dataset.seasons)
winter_images_test/section1/*.png, section2/*.png  the queries: the same names"""
LAYOUT_VPRBENCH = """ref/0000000.jpg, ...    the database, in winter
query/0000000.jpg, ...  the queries, in summer: query i shows database image 10 i"""

REFERENCE = "overcast-summer"  # the paper's figure; its text says overcast-reference, whose images are 6,954
CONDITIONS = ("dawn", "dusk", "night", "night-rain", "overcast-winter", "rain", "snow")
_REACH = 5.0  # meters
POSES = "robotcar_v2_train.txt"
_LAST_ROW = 1e-6  # tolerance of the last row of a pose, 0 0 0 1
ROBOTCAR_LAYOUT = f"""images/CONDITION/rear/TIMESTAMP.jpg  of {REFERENCE} (the database),
                                     {", ".join(CONDITIONS)}
{POSES}                per line CONDITION/rear/TIMESTAMP.jpg and 16 numbers, camera to world"""


def ssm_vpr(root: Path, name: str) -> Dataset:
    """A data set of SSM-VPR (Camara and Preucil, 2020), which the paper uses as well: two folders and a table."""
    database, queries = (_numbered_images(root / side) for side in ("Reference", "Live"))
    truth = truth_from_file(root / "GroundTruth.csv", queries.names, database.names, widened=True)
    return Dataset(name, database, (QuerySequence(name, queries, truth),))


def _numbered_images(folder: Path) -> ImageFolder:
    """Images with names that end in 0, 1, ..., the numbers in the table."""
    images = image_folder(folder)
    for row, name in enumerate(images.names):
        digits = re.search(r"(\d+)$", PurePosixPath(name).stem)
        if digits is None or int(digits[1]) != row:
            raise InputError(f"{folder}: expected images numbered from 0 without gaps, got {name} in place {row}; get "
                             "the whole data set")  # fmt: skip
    return images


def nordland_27592(root: Path, name: str, *, seasons: tuple[str, str]) -> Dataset:
    """Patch-NetVLAD's and gmberton's variant: every frame but tunnels and stations; correct within 10 frames."""
    folders = []
    for season, side in zip(seasons, ("index", "query"), strict=True):
        origin = expected_file(root, f"nordland_imageNames_{side}.txt")
        if origin is None:
            folders.append(image_folder(root / season))
        else:  # names begin with other folders
            names = [PurePosixPath(line).name for line in read_lines(origin)]
            folders.append(listed_images(root / season, names, origin))
    return _frame_pairs(name, *folders)


def nordland_3450(root: Path, name: str, *, seasons: tuple[str, str]) -> Dataset:
    """The test part of Olid, Facil and Civera (2018); correct within 2 frames of the same section."""
    return _frame_pairs(name, *(image_folder(root / f"{season}_images_test") for season in seasons))


def nordland_vprbench(root: Path, name: str) -> Dataset:
    """VPR-Bench's variant (Zaffar et al., IJCV 2021): every tenth frame is a query; correct within 1 frame."""
    database, queries = image_folder(root / "ref"), image_folder(root / "query")
    last = EACH * (len(queries) - 1)
    if last >= len(database):
        raise InputError(f"{root}: expected {EACH} database images per query, got {len(database)} for {len(queries)}; "
                         "get the whole data set")  # fmt: skip
    truth = FrameTruth(tuple((EACH * row,) for row in range(len(queries))), len(database))
    return Dataset(name, database, (QuerySequence(name, queries, truth),))


def _frame_pairs(name: str, database: ImageFolder, queries: ImageFolder) -> Dataset:
    """Data set of equal frames of two seasons; each folder of the database is a drive."""
    if len(database) != len(queries):
        raise InputError(f"{queries.root}: expected as many frames as in {database.root}, got {len(queries):,} and "
                         f"{len(database):,}; get the whole data set")  # fmt: skip
    for query, place in zip(queries.names, database.names, strict=True):
        if PurePosixPath(query).with_suffix("") != PurePosixPath(place).with_suffix(""):
            raise InputError(f"{queries.root}: expected the frames of {database.root}, got {query} where that has "
                             f"{place}; a gap in one of them would spoil every number behind it")  # fmt: skip
    folders = [PurePosixPath(place).parent for place in database.names]
    starts = tuple(row for row in range(1, len(folders)) if folders[row] != folders[row - 1])
    truth = FrameTruth(tuple((row,) for row in range(len(queries))), len(database), starts=starts)
    return Dataset(name, database, (QuerySequence(name, queries, truth),))


def robotcar_seasons(root: Path, name: str) -> Dataset:
    """Oxford RobotCar Seasons (Sattler et al., CVPR 2018), version 2, as in the paper.

    Images are those of the rear camera with public positions: summer is the database, seven other conditions are the
    queries, in the order of their timestamps. The database image with the nearest camera is correct, and frames around
    it. Queries without a database image within five meters are left out.
    """
    path = root / POSES
    centers = camera_centers(path)
    database, places = _condition(centers, REFERENCE, path)
    images = listed_images(root / "images", database, path)
    sequences = []
    for condition in CONDITIONS:
        names, positions = _condition(centers, condition, path)
        distances = np.linalg.norm(positions[:, None] - places, axis=-1)
        near = np.flatnonzero(distances.min(axis=1) <= _REACH).tolist()
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
