"""Commands of `mfvpr data`: list data sets, and check what a folder holds."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml

from mfvpr.cli import console
from mfvpr.cli.command_line import compose_data_set
from mfvpr.cli.console import refuse
from mfvpr.cli.inputs import dataset_of
from mfvpr.datasets import Dataset, ImageFolder, QuerySequence
from mfvpr.datasets.contents import Contents, own_rows
from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.datasets.published import PUBLISHED, published_differences
from mfvpr.report import Table
from mfvpr.report.figures import contact_sheet
from mfvpr.storage import FeatureCache
from mfvpr.utils import InputError
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.runtime import ordered_map

_UNPUBLISHED = {
    "grief_season": "a park path in summer, and in snow (Krajnik et al., ECMR 2015): database/ and queries/",
    "corridor": "an indoor corridor, 111 + 111 frames, as VPR-Bench has it: ref/ and query/",
    "streets_seasons": "drawn: a street by day, and on seven other days; it needs no folder",
}
_TOLERANCE, _RADIUS = 5, 25.0  # frames, meters: the widest that the paper takes


def list_data(names: list[str]) -> None:
    """Print a table of all data sets, or details of those that are named."""
    for name in names:
        if name not in PUBLISHED and name not in _UNPUBLISHED:
            raise InputError(f"{name}: expected one of {', '.join((*PUBLISHED, *_UNPUBLISHED))}")
    for name in (name for name in names if name in _UNPUBLISHED):
        print(f"{name}: {_UNPUBLISHED[name]}")
    for entry in (PUBLISHED[name] for name in names if name in PUBLISHED):
        layout = "\n".join(f"  {line}" for line in entry.layout.splitlines())
        print(f"{entry.name}: {entry.title}\n{layout}\nfrom {entry.source}")
    if names:
        return
    rows = [
        [entry.name, entry.title, f"{entry.database:,}", f"{sum(entry.queries.values()):,}"]
        for entry in PUBLISHED.values()
    ]
    print(Table(["name", "what it is", "database", "queries"], rows, text_columns=2).text(), end="")
    for name, description in _UNPUBLISHED.items():
        print(f"{name}: {description}")


def check_data_set(name: str, settings: list[str], sheet: Path | None) -> None:
    """Print image counts beside the published ones and the ground truth's extent; draw image pairs."""
    if wrong := [each for each in settings if "=" not in each]:
        raise InputError(f"{wrong[0]}: expected name=value")
    values = {key: yaml.safe_load(value) for key, value in (each.split("=", 1) for each in settings)}
    dataset = dataset_of(compose_data_set("check", name, values))
    cache = FeatureCache(None)
    database, *contents = map(cache.recipes.contents, [dataset.database, *(part.images for part in dataset.sequences)])
    sides = list(_sides(dataset))
    unreadable = [_unreadable(side, folder) for side, folder, _ in sides]
    rows = [
        [side, f"{len(folder):,}", "-" if published is None else f"{published:,}", f"{len(reasons):,}"]
        for (side, folder, published), reasons in zip(sides, unreadable, strict=True)
    ]
    print(Table(["images of", "there", "published", "unreadable"], rows).text())
    for reason in (reason for reasons in unreadable for reason in reasons[:3]):
        print(f"unreadable: {reason}")
    for sequence, queries in zip(dataset.sequences, contents, strict=True):
        for line in _truth_lines(sequence, queries, database):
            print(f"{sequence.name}: {line}")
    target = sheet or Path(f"{dataset.name}.png")
    contact_sheet(target, dataset)
    print(f"pairs of images: {target}")
    unread = [f"{bad:,} images cannot be read"] if (bad := sum(map(len, unreadable))) else []
    if wrong := [*published_differences(dataset), *unread]:
        refuse(f"{dataset.name}: {'; '.join(wrong)}")


def _sides(dataset: Dataset) -> Iterator[tuple[str, ImageFolder, int | None]]:
    """Name, folder and published number of images of the database and of each sequence."""
    entry = PUBLISHED.get(dataset.name)
    yield "database", dataset.database, entry and entry.database
    for sequence in dataset.sequences:
        name = f"queries {sequence.name}" if len(dataset.sequences) > 1 else "queries"
        yield name, sequence.images, entry and entry.queries.get(sequence.name)


def _unreadable(side: str, folder: ImageFolder) -> list[str]:
    """Error messages of the images that cannot be read."""

    def read_error(row: int) -> str | None:
        try:
            folder.read(row)
        except InputError as error:
            return str(error)
        return None

    reasons = ordered_map(read_error, range(len(folder)), workers=available_cpus())
    return [reason for reason in console.track(f"reading {side}")(reasons, len(folder)) if reason]


def _truth_lines(sequence: QuerySequence, queries: Contents, database: Contents) -> Iterator[str]:
    """Extent of a sequence's ground truth, and number of queries that are database images."""
    if sequence.truth is None:
        yield "no ground truth"
    else:
        [threshold] = sequence.truth.thresholds(tolerances=[_TOLERANCE], radius=_RADIUS)
        counts = sequence.truth.positives(threshold).counts
        within = threshold_words(sequence.truth.unit, threshold).strip()
        yield (f"correct images of a query{f' ({within})' if within else ''}: {counts.min()} to {counts.max()}, median "
               f"{np.median(counts):g}; {(counts == 0).sum():,} queries have none")  # fmt: skip
    if num_same := sum(map(bool, own_rows(queries, database))):
        yield f"{num_same:,} queries are images of the database"
