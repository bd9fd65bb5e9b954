"""Data sets by name: list them, and check what a folder holds. `python -m experiments.data --help`."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.errors import Parser, refuse, run_command

if TYPE_CHECKING:
    from mfvpr.datasets import Dataset, ImageFolder, QuerySequence
    from mfvpr.datasets.contents import Contents

# Functions import what they need: --help and wrong usage need not wait for JAX.
_UNPUBLISHED = {
    "grief_season": "a park path in summer, and in snow (Krajnik et al., ECMR 2015): database/ and queries/",
    "corridor": "an indoor corridor, 111 + 111 frames, as VPR-Bench has it: ref/ and query/",
    "streets_seasons": "drawn: a street by day, and on seven other days; it needs no folder",
}
_TOLERANCE, _RADIUS = 5, 25.0  # frames, meters: the widest that the paper takes


def main() -> None:
    """Run the command line's command."""
    description = "Nothing is downloaded: each data set has its place and its license."
    run_command("python -m experiments.data", description, _add_commands)


def _add_commands(parser: Parser) -> None:
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    command = commands.add_parser("list", help="the published data sets, their sizes, and what their folders hold")
    command.add_argument("names", metavar="NAME", nargs="*", help="by default a table of all")
    command.set_defaults(run=list_data)
    command = commands.add_parser("check", help="what a folder holds beside what is published; draws pairs of images")
    command.add_argument("name", metavar="NAME", help="as in dataset=NAME")
    command.add_argument("settings", metavar="root=DIR", nargs="*", help="settings of the data set, without `dataset.`")
    command.add_argument("--sheet", metavar="FILE", type=Path, help="where to draw them, by default NAME.png")
    command.set_defaults(run=check)


def list_data(names: list[str]) -> None:
    """Print a table of all data sets, or details of those that are named."""
    from mfvpr.datasets.published import PUBLISHED
    from mfvpr.report import Table
    from mfvpr.utils import InputError

    for name in names:
        if name not in PUBLISHED and name not in _UNPUBLISHED:
            raise InputError(f"{name}: expected one of {', '.join((*PUBLISHED, *_UNPUBLISHED))}")
    if names:
        for name in (name for name in names if name in _UNPUBLISHED):
            print(f"{name}: {_UNPUBLISHED[name]}")
        for entry in (PUBLISHED[name] for name in names if name in PUBLISHED):
            layout = "\n".join(f"  {line}" for line in entry.layout.splitlines())
            print(f"{entry.name}: {entry.title}\n{layout}\nfrom {entry.source}")
        return
    rows = [
        [entry.name, entry.title, f"{entry.database:,}", f"{sum(entry.queries.values()):,}"]
        for entry in PUBLISHED.values()
    ]
    print(Table(["name", "what it is", "database", "queries"], rows, text_columns=2).text(), end="")
    for name, description in _UNPUBLISHED.items():
        print(f"{name}: {description}")


def check(name: str, settings: list[str], sheet: Path | None) -> None:
    """Print image counts beside the published ones and the ground truth's extent; draw image pairs."""
    from experiments import data_sets
    from experiments.stages import dataset_of
    from mfvpr.datasets.published import differences
    from mfvpr.report import Table
    from mfvpr.report.contact_sheets import contact_sheet
    from mfvpr.storage import FeatureCache

    [chosen] = data_sets.composed("check", ":".join([name, *settings]))
    dataset = dataset_of(chosen)
    cache = FeatureCache(None)
    database, *contents = map(cache.contents, [dataset.database, *(part.images for part in dataset.sequences)])
    counts, unreadable = list(_counts(dataset)), list(_unreadable(dataset))
    rows = [[*row, f"{len(reasons):,}"] for row, reasons in zip(counts, unreadable, strict=True)]
    print(Table(["images of", "there", "published", "unreadable"], rows).text())
    for reason in (reason for reasons in unreadable for reason in reasons[:3]):
        print(f"unreadable: {reason}")
    for sequence, queries in zip(dataset.sequences, contents, strict=True):
        for line in _truth_lines(sequence, queries, database):
            print(f"{sequence.name}: {line}")
    target = sheet or Path(f"{dataset.name}.png")
    contact_sheet(target, dataset)
    print(f"pairs of images: {target}")
    bad = sum(map(len, unreadable))
    if wrong := [*differences(dataset), *([f"{bad:,} images cannot be read"] if bad else [])]:
        refuse(f"{dataset.name}: {'; '.join(wrong)}")


def _counts(dataset: "Dataset") -> Iterator[list[str]]:
    """Rows of side, number of images, and published number."""
    from mfvpr.datasets.published import PUBLISHED

    entry = PUBLISHED.get(dataset.name)
    published = "-" if entry is None else f"{entry.database:,}"
    yield ["database", f"{len(dataset.database):,}", published]
    for sequence in dataset.sequences:
        number = None if entry is None else entry.queries.get(sequence.name)
        side = f"queries {sequence.name}" if len(dataset.sequences) > 1 else "queries"
        yield [side, f"{len(sequence.images):,}", "-" if number is None else f"{number:,}"]


def _unreadable(dataset: "Dataset") -> Iterator[list[str]]:
    """Error messages of the images that cannot be read, by side."""
    from experiments import console
    from mfvpr.utils import InputError
    from mfvpr.utils.numerics import available_cpus
    from mfvpr.utils.threads import ordered_map

    for side, folder in [("database", dataset.database), *((part.name, part.images) for part in dataset.sequences)]:

        def read_error(row: int, folder: "ImageFolder" = folder) -> str | None:
            try:
                folder.read(row)
            except InputError as error:
                return str(error)
            return None

        reasons = ordered_map(read_error, range(len(folder)), workers=available_cpus())
        yield [reason for reason in console.track(f"reading {side}")(reasons, len(folder)) if reason]


def _truth_lines(sequence: "QuerySequence", queries: "Contents", database: "Contents") -> Iterator[str]:
    """Extent of a sequence's ground truth, and number of queries that are database images."""
    import numpy as np

    from mfvpr.datasets.sequences import own_rows
    from mfvpr.datasets.truth import threshold_words

    if sequence.truth is None:
        yield "no ground truth"
    else:
        [threshold] = sequence.truth.thresholds(tolerances=[_TOLERANCE], radius=_RADIUS)
        counts = sequence.truth.positives(threshold).counts
        within = threshold_words(sequence.truth.unit, threshold).strip()
        yield (f"right images of a query{f' ({within})' if within else ''}: {counts.min()} to {counts.max()}, median "
               f"{np.median(counts):g}; {(counts == 0).sum():,} queries have none")  # fmt: skip
    if num_same := sum(map(bool, own_rows(queries, database))):
        yield f"{num_same:,} queries are images of the database"


if __name__ == "__main__":
    main()
