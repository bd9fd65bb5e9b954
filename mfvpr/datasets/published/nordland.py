"""Nordland (Suenderhauf et al., 2013): a train journey in four seasons. Its variants are different data sets."""

from pathlib import Path, PurePosixPath

from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence, image_folder
from mfvpr.datasets.ground_truth import FrameTruth
from mfvpr.datasets.published.lists import expected_file, listed_images, read_lines
from mfvpr.utils.errors import InputError

SEASONS = ("fall", "spring", "summer", "winter")
EACH = 10  # database frames per query in VPR-Bench

LAYOUT_27592 = """summer/images-00202.png, ...  the database (or another of dataset.seasons)
winter/images-00202.png, ...  the queries: the same names
nordland_imageNames_index.txt, nordland_imageNames_query.txt  Patch-NetVLAD's lists, where the folders hold more"""
LAYOUT_3450 = """summer_images_test/section1/*.png, section2/*.png  the database (or another of dataset.seasons)
winter_images_test/section1/*.png, section2/*.png  the queries: the same names"""
LAYOUT_VPRBENCH = """ref/0000000.jpg, ...    the database, in winter
query/0000000.jpg, ...  the queries, in summer: query i shows database image 10 i"""


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
