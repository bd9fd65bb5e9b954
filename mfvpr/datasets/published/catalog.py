"""The table of published data sets: layouts of their folders, and published numbers of images."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.published import frames, positions
from mfvpr.utils.errors import InputError


@dataclass(frozen=True)
class Published:
    """A published data set."""

    name: str  # of the choice `dataset=`
    title: str
    layout: str  # contents of its folder, in lines
    database: int  # published number of database images
    queries: Mapping[str, int]  # published numbers of queries, by sequence
    read: Callable[..., Dataset]  # `read(folder, name)`, with the keyword `seasons` if it has seasons
    source: str
    folders: tuple[str, ...]  # possible names of its folder below a folder of data sets: its own, its archive's
    seasons: tuple[str, str] | None = None  # default (database, queries) if seasons can be chosen


def _ssm(name: str, title: str, database: int, queries: int, archive: str) -> Published:
    title, source = f"{title}, as SSM-VPR has it", "http://imr.ciirc.cvut.cz/Datasets/Ssm-vpr"
    folders = name, archive
    return Published(name, title, frames.SSM_LAYOUT, database, {name: queries}, frames.ssm_vpr, source, folders)


def _pittsburgh(part: str, queries: int) -> Published:
    name = f"pitts30k_{part}"
    return Published(
        name, f"Pittsburgh30k, {part} part", positions.PITTSBURGH_LAYOUT.format(part=part), 10_000, {name: queries},
        positions.pitts30k, "on request from its authors: https://github.com/Relja/netvlad", (name, "pitts30k"),
    )  # fmt: skip


_ROBOTCAR: Mapping[str, int] = dict(zip(frames.CONDITIONS, (218, 179, 183, 218, 195, 192, 226), strict=True))

PUBLISHED = {
    entry.name: entry
    for entry in (
        _ssm("berlin_a100", "Berlin A100: a motorway from two cars", 85, 81, "BerlinA100_RAS2020"),
        _ssm("berlin_halenseestrasse", "Berlin Halenseestrasse: a road and its bicycle lane", 67, 157, "Halen_RAS2020"),
        _ssm("berlin_kudamm", "Berlin Kudamm: a busy street from a bus and a bicycle", 201, 222, "Kudamm_RAS2020"),
        _ssm("gardens_point", "Gardens Point: a campus by day and at night", 200, 200, "Gardens_point_RAS2020"),
        _ssm("nordland_1415", "Synthesized Nordland, 1415 frames", 1415, 1415, "Nordland_RAS2020"),
        Published(
            "nordland_27592", "Nordland, every frame but tunnels and stations (Patch-NetVLAD's)",
            frames.LAYOUT_27592, 27_592, {"nordland_27592": 27_592}, frames.nordland_27592,
            "https://github.com/QVPR/Patch-NetVLAD", ("nordland_27592", "nordland"), ("summer", "winter"),
        ),
        Published(
            "nordland_3450", "Nordland, the test part of Olid, Facil and Civera", frames.LAYOUT_3450, 3450,
            {"nordland_3450": 3450}, frames.nordland_3450, "http://webdiis.unizar.es/~jmfacil/pr-nordland/",
            ("nordland_3450",), ("summer", "winter"),
        ),
        Published(
            "nordland_vprbench", "Nordland*, VPR-Bench's: winter, every tenth frame of summer", frames.LAYOUT_VPRBENCH,
            27_592, {"nordland_vprbench": 2760}, frames.nordland_vprbench,
            "https://github.com/MubarizZaffar/VPR-Bench", ("nordland_vprbench",),
        ),
        Published(
            "robotcar_seasons", "Oxford RobotCar Seasons v2, rear camera, seven conditions against summer",
            frames.ROBOTCAR_LAYOUT, 220, _ROBOTCAR, frames.robotcar_seasons,
            "https://www.visuallocalization.net/datasets/", ("robotcar_seasons", "RobotCar-Seasons"),
        ),
        _pittsburgh("val", 7608),
        _pittsburgh("test", 6816),
        Published(
            "msls_val", "Mapillary Street-Level Sequences, validation part", positions.MSLS_LAYOUT, 18_871,
            {"msls_val": 740}, positions.msls_val, "https://www.mapillary.com/dataset/places", ("msls_val", "msls"),
        ),
    )
}  # fmt: skip


def published_dataset(name: str, root: Path | str, *, seasons: tuple[str, str] | None = None) -> Dataset:
    """The data set `name` of `PUBLISHED`, from its folder `root`; `seasons` of Nordland are (database, queries).

        data = published_dataset("gardens_point", "DIR")  # DIR has Reference/, Live/ and GroundTruth.csv

    An `InputError` says which files and images are missing, damaged, or of another layout.
    """
    if name not in PUBLISHED:
        raise InputError(f"{name}: expected a published data set, of {', '.join(PUBLISHED)}")
    entry, root = PUBLISHED[name], Path(root)
    if not root.is_dir():
        got = "a file" if root.exists() else "nothing"
        raise InputError(f"{root}: expected the folder of {name}, got {got}; it is to be had at {entry.source}")
    if seasons is not None and not (entry.seasons and len({*seasons}) == 2 and {*seasons} <= {*frames.SEASONS}):
        raise InputError(f"seasons={list(seasons)}: expected two of {', '.join(frames.SEASONS)}")
    options = {} if entry.seasons is None else {"seasons": seasons or entry.seasons}
    try:
        return entry.read(root, name, **options)
    except InputError as error:
        raise InputError(f"{error} (layout: mfvpr data list {name})") from error


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
