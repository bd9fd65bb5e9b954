"""Data sets that others published, each read from the folders it is published in, and their numbers of images."""

import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product, zip_longest
from pathlib import Path, PurePosixPath

import numpy as np
import scipy  # its subpackages are imported at their first use

from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence, image_folder
from mfvpr.datasets.ground_truth import FrameTruth, RadiusTruth, Truth, truth_from_file
from mfvpr.datasets.positives import FARTHEST, positives_within, require_positions
from mfvpr.io.containers import parse_number, reading
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import read_yaml

SEASONS = ("fall", "spring", "summer", "winter")
REFERENCE = "overcast-summer"  # the paper's figure; its text says overcast-reference, whose images are 6,954
CONDITIONS = ("dawn", "dusk", "night", "night-rain", "overcast-winter", "rain", "snow")
CITIES = ("cph", "sf")

Content = tuple[ImageFolder, ImageFolder, Truth]  # database, queries and ground truth of one sequence


@dataclass(frozen=True)
class Published:
    """A published data set."""

    name: str  # of the choice `dataset=`
    title: str
    layout: str  # contents of its folder, in lines
    database: int  # published number of database images
    queries: Mapping[str, int]  # published numbers of queries, by sequence
    read: Callable[..., Content | Dataset]  # `read(folder)`, with the keyword `seasons` if it has seasons
    source: str
    folders: tuple[str, ...]  # possible names of its folder below a folder of data sets: its own, its archive's
    seasons: tuple[str, str] | None = None  # default (database, queries) if seasons can be chosen


def published_dataset(name: str, root: Path | str, *, seasons: tuple[str, str] | None = None) -> Dataset:
    """The data set `name` of `PUBLISHED`, from its folder `root`; `seasons` of Nordland are (database, queries).

    An `InputError` says which files and images are missing, damaged, or of another layout.
    """
    if name not in PUBLISHED:
        raise InputError(f"{name}: expected a published data set, of {', '.join(PUBLISHED)}")
    entry, root = PUBLISHED[name], Path(root)
    if not root.is_dir():
        got = "a file" if root.exists() else "nothing"
        raise InputError(f"{root}: expected the folder of {name}, got {got}; it is to be had at {entry.source}")
    if seasons is not None and not (entry.seasons and len({*seasons}) == 2 and {*seasons} <= {*SEASONS}):
        raise InputError(f"seasons={list(seasons)}: expected two of {', '.join(SEASONS)}")
    options = {} if entry.seasons is None else {"seasons": seasons or entry.seasons}
    try:
        result = entry.read(root, **options)
    except InputError as error:
        raise InputError(f"{error} (layout: mfvpr data list {name})") from error
    if isinstance(result, Dataset):
        return result
    database, queries, truth = result
    return Dataset(name, database, (QuerySequence(name, queries, truth),))


def published_differences(dataset: Dataset) -> Iterator[str]:
    """Differences from the published numbers of images, in words; none for data sets that are not published."""
    entry = PUBLISHED.get(dataset.name)
    if entry is None:
        return
    if len(dataset.database) != entry.database:
        yield f"{len(dataset.database):,} database images where {entry.database:,} are published"
    for sequence in dataset.sequences:
        got, number = len(sequence.images), entry.queries.get(sequence.name)
        if number is None:
            yield f"queries in {sequence.name}, which is none of its sequences"
        elif got != number:
            yield f"{got:,} queries in {sequence.name} where {number:,} are published"


def ssm_vpr(root: Path) -> Content:
    """A data set of SSM-VPR (Camara and Preucil, 2020), which the paper uses as well: two folders and a table."""
    database, queries = image_folder(root / "Reference"), image_folder(root / "Live")
    for images in (database, queries):
        for row, image in enumerate(images.names):  # the table has the numbers at the ends of the names
            if not re.search(rf"(^|\D)0*{row}$", PurePosixPath(image).stem):
                raise InputError(f"{images.root}: expected images numbered from 0 without gaps, got {image}; get all")
    return database, queries, truth_from_file(root / "GroundTruth.csv", queries.names, database.names, widened=True)


def nordland_27592(root: Path, seasons: tuple[str, str]) -> Content:
    """Patch-NetVLAD's and gmberton's: every frame but tunnels and stations, correct within 10 frames."""
    folders = []
    for season, side in zip(seasons, ("index", "query"), strict=True):
        listed = root / f"nordland_imageNames_{side}.txt"
        if listed.exists():  # its names begin with other folders
            with reading(listed, "a list"):
                lines = map(str.strip, listed.read_text(encoding="utf-8-sig").splitlines())
            names = [PurePosixPath(line).name for line in lines if line]
            folders.append(listed_images(root / season, names, listed))
        else:
            folders.append(image_folder(root / season))
    return equal_frames(*folders)


def nordland_3450(root: Path, seasons: tuple[str, str]) -> Content:
    """The test part of Olid, Facil and Civera (PPNIV 2018): two sections, correct within 2 frames of the same."""
    return equal_frames(*(image_folder(root / f"{season}_images_test") for season in seasons))


def equal_frames(database: ImageFolder, queries: ImageFolder) -> Content:
    """Frames of equal names show the same place; each folder of the database is a drive."""
    stems = [[PurePosixPath(image).with_suffix("") for image in folder.names] for folder in (database, queries)]
    if stems[0] != stems[1]:
        pairs = zip_longest(*stems, fillvalue="none")
        differing = next(f"{first} and {second}" for first, second in pairs if first != second)
        got = f"{len(queries):,} and {len(database):,} frames, the first that differ are {differing}"
        raise InputError(f"{queries.root}: expected the frames of {database.root}, got {got}; get the whole data set")
    drives = [stem.parent for stem in stems[0]]
    starts = tuple(row for row in range(1, len(drives)) if drives[row] != drives[row - 1])
    return database, queries, FrameTruth(tuple((row,) for row in range(len(queries))), len(database), starts=starts)


def nordland_vprbench(root: Path) -> Content:
    """VPR-Bench's variant (Zaffar et al., IJCV 2021): every tenth frame is a query; correct within 1 frame."""
    database, queries = image_folder(root / "ref"), image_folder(root / "query")
    if 10 * (len(queries) - 1) >= len(database):
        raise InputError(f"{root}: expected 10 images per query, got {len(database)} for {len(queries)}; get them all")
    return database, queries, FrameTruth(tuple((10 * row,) for row in range(len(queries))), len(database))


def robotcar_seasons(root: Path) -> Dataset:
    """Oxford RobotCar Seasons (Sattler et al., CVPR 2018), version 2, as in the paper.

    Images are those of the rear camera with public positions: summer is the database, seven other conditions are the
    queries, in the order of their timestamps. The database image with the nearest camera is correct, and frames around
    it. Queries without a database image within five meters are left out.
    """
    path = root / "robotcar_v2_train.txt"
    with reading(path, "a list", "expected lines of a name and the 16 numbers of a pose by rows, the last 0 0 0 1"):
        lines = [words for line in path.read_text(encoding="utf-8-sig").splitlines() if (words := line.split())]
        poses = np.array([words[1:] for words in lines], np.float64).reshape(len(lines), 4, 4)
        if not np.allclose(poses[:, 3], (0, 0, 0, 1), rtol=0, atol=1e-6) or not (np.abs(poses) <= FARTHEST).all():
            raise ValueError("numbers that are no pose")
    images = (PurePosixPath(name).with_suffix(".jpg").as_posix() for name, *_ in lines)
    centers: dict[str, np.ndarray] = {}
    for image, center in zip(images, poses[:, :3, 3], strict=True):
        if not np.array_equal(centers.setdefault(image, center), center):
            raise InputError(f"{path}: expected one pose of {image}, got another; get the file again")
    sides = {
        condition: sorted(image for image in centers if image.startswith(f"{condition}/rear/"))
        for condition in (REFERENCE, *CONDITIONS)
    }
    if empty := [condition for condition, names in sides.items() if not names]:
        raise InputError(f"{path}: expected poses of {empty[0]}/rear, got none; use the file of the data set")
    database = listed_images(root / "images", sides.pop(REFERENCE), path)
    places = np.array([centers[image] for image in database.names])
    sequences = []
    for condition, names in sides.items():
        distances = np.linalg.norm(np.array([centers[image] for image in names])[:, None] - places, axis=-1)
        near = np.flatnonzero(distances.min(axis=1) <= 5.0).tolist()
        truth = FrameTruth(tuple((int(distances[query].argmin()),) for query in near), len(database))
        queries = listed_images(root / "images", [names[query] for query in near], path)
        sequences.append(QuerySequence(condition, queries, truth))
    return Dataset("robotcar_seasons", database, tuple(sequences))


def pitts30k(root: Path, name: str) -> Content:
    """The validation or test part of Pittsburgh30k (Torii et al., CVPR 2013; Arandjelovic et al., CVPR 2016)."""
    path, names, positions = root / f"datasets/{name}.mat", [], []
    path = path if path.exists() else root / f"{name}.mat"
    with reading(path, "the lists of the data set", f"expected the structure dbStruct of {name}"):
        structure = scipy.io.loadmat(path)["dbStruct"][0, 0]
        for images, xy in (("dbImageFns", "utmDb"), ("qImageFns", "utmQ")):
            names.append([str(cell.item()) for cell in structure[images].ravel()])
            positions.append(require_positions(xy, structure[xy].T, len(names[-1])))
    database = listed_images(root, names[0], path)
    queries = listed_images(root, [f"queries_real/{query}" for query in names[1]], path)
    return database, queries, RadiusTruth(positions[1], positions[0])


def msls_val(root: Path) -> Content:
    """The validation part of Mapillary Street-Level Sequences (Warburg et al., CVPR 2020), without panoramas.

    Queries have a database image within 25 m, as in its own code.
    """
    flags = {"True": True, "False": False}
    names, positions = {"database": [], "query": []}, {"database": [], "query": []}
    for side, city in product(names, CITIES):
        folder, tables = root / "train_val" / city / side, []
        for table in ("postprocessed", "raw", "subtask_index"):
            path = folder / f"{table}.csv"
            with reading(path, "a table"), path.open(newline="", encoding="utf-8") as file:
                lines = list(csv.DictReader(file))
                tables.append({line["key"]: line for line in lines})
                if len(tables[-1]) < len(lines) or tables[-1].keys() != tables[0].keys():
                    raise ValueError("expected equal keys in all tables, each once")
        mend = "expected pano and all (True or False), easting, northing"
        with reading(folder / "postprocessed.csv", mend=mend):
            processed, raw, tasks = tables
            for key, line in processed.items():
                if flags[tasks[key]["all"]] and not flags[raw[key]["pano"]]:
                    names[side].append(f"train_val/{city}/{side}/images/{key}.jpg")
                    positions[side].append([parse_number(line["easting"]), parse_number(line["northing"])])
    places = {side: require_positions(f"{root}: {side}", np.reshape(xy, (-1, 2))) for side, xy in positions.items()}
    rows = np.flatnonzero(positives_within(places["query"], places["database"], 25.0).counts)
    database = listed_images(root, names["database"], root / "train_val")
    queries = listed_images(root, [names["query"][row] for row in rows], root / "train_val")
    return database, queries, RadiusTruth(places["query"][rows], places["database"])


def listed_images(root: Path, names: Sequence[str], origin: Path) -> ImageFolder:
    """The images below `root` with the names of a list; `origin` is the list, for messages."""
    if not names or len({*names}) < len(names):
        got = f"{len(names) - len({*names})} twice of {len(names)}"
        raise InputError(f"{origin}: expected every image once, got {got}; get the data set again")
    missing = [name for name in names if not (root / name).is_file()]
    if missing:
        got = f"all but {len(missing):,}, the first of which is {missing[0]}"
        raise InputError(f"{root}: expected {len(names):,} images of {origin.name}, got {got}; get the whole data set")
    return ImageFolder(root, tuple(names))


_READERS = {
    "ssm_vpr": ssm_vpr,
    "nordland_27592": nordland_27592,
    "nordland_3450": nordland_3450,
    "nordland_vprbench": nordland_vprbench,
    "robotcar_seasons": robotcar_seasons,
    "pitts30k_val": partial(pitts30k, name="pitts30k_val"),
    "pitts30k_test": partial(pitts30k, name="pitts30k_test"),
    "msls_val": msls_val,
}


def _published() -> Iterator[Published]:
    """The entries of published.yaml, which says what its values are."""
    for name, about in read_yaml(Path(__file__).with_name("published.yaml")).items():
        queries, seasons = about["queries"], about.get("seasons")
        yield Published(
            name,
            about["title"],
            about["layout"],
            about["database"],
            queries if isinstance(queries, dict) else {name: queries},
            _READERS[about["read"]],
            about["source"],
            (name, about["archive"]) if "archive" in about else (name,),
            seasons and tuple(seasons),
        )


PUBLISHED = {entry.name: entry for entry in _published()}
