"""Rows of the tables and the evaluations that give them, of systems.yaml; and the data sets at hand."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mfvpr.checkpoints import REGISTRY, is_installed
from mfvpr.checkpoints.networks import Entry
from mfvpr.cli.command_line import override
from mfvpr.cli.schema import DATA_SET_NAME, Evaluate
from mfvpr.datasets.published import PUBLISHED
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import expand_user, read_yaml

DRAWN = "streets_seasons"
REAL = {"grief_season": ("database", "queries"), "corridor": ("ref", "query")}  # data sets, and their folders

LeftOut = tuple[str, str]  # name of a data set or an evaluation, and why it is left out


@dataclass(frozen=True)
class Row:
    """A row of the tables: its name (as in the printed numbers), its title, and the name of its evaluation.

    `ranking` is the evaluation's system; None = the headline.
    """

    name: str
    title: str
    run: str
    ranking: str | None = None

    @property
    def leads(self) -> bool:
        """Whether it is the first score of its evaluation, which is timed and compared with others."""
        return self.ranking in (None, "histogram")


@dataclass(frozen=True)
class Place:
    """A data set at hand, and its settings of `mfvpr evaluate`."""

    name: str
    settings: tuple[str, ...]


_SYSTEMS: Mapping[str, Any] = read_yaml(Path(__file__).with_name("systems.yaml"))
ROWS = tuple(Row(name, **{"run": name, **values}) for name, values in _SYSTEMS["rows"].items())


def overrides(run: str, dataset: str) -> tuple[str, ...]:
    """Settings of `mfvpr evaluate` that make an evaluation, without its data set."""
    chosen = _SYSTEMS["evaluations"].get(run, [f"system={run}"])
    return (*chosen, *_SYSTEMS["data_sets"].get(dataset, {}).get(run, ()))


def chosen_rows(names: Sequence[str] | None) -> tuple[Row, ...]:
    """Rows by name, in the order of the tables; all for None."""
    chosen = _chosen("systems", names, [row.name for row in ROWS])
    return tuple(row for row in ROWS if row.name in chosen)


def _chosen(setting: str, names: Sequence[str] | None, known: Sequence[str]) -> list[str]:
    if unknown := [name for name in names or () if name not in known]:
        raise InputError(f"{setting}=[{unknown[0]}]: expected some of {', '.join(known)}")
    return [name for name in known if names is None or name in names]


def places(data: str | None, names: Sequence[str] | None) -> tuple[list[Place], list[LeftOut]]:
    """The data sets that are at hand, and those that are not, with the reason."""
    root = None if data is None else expand_user(data)
    if root is not None and not root.is_dir():
        raise InputError(f"data={data}: expected a folder with a folder per data set; check the path")
    located = {place.name: place for place in _places_by_coordinates(root)} if root else {}
    available, left_out = list[Place](), list[LeftOut]()
    for name in _chosen("datasets", names, list(dict.fromkeys((DRAWN, *REAL, *PUBLISHED, *located)))):
        folders = PUBLISHED[name].folders if name in PUBLISHED else (name,)
        present = [root / folder for folder in folders if root and folder not in located and (root / folder).is_dir()]
        if name == DRAWN:
            available.append(Place(name, (f"dataset={name}",)))
        elif name in located and (name in (*REAL, *PUBLISHED) or not DATA_SET_NAME.holds(name)):
            expected = f"{DATA_SET_NAME.expected}, and not that of a published data set"
            left_out.append((name, f"expected a name of {expected}, for a folder of images with positions; rename it"))
        elif name in located:
            available.append(located[name])
        elif present:
            available.append(Place(name, (f"dataset={name}", override("dataset.root", present[0]))))
        else:
            needs = f"with {' and '.join(REAL[name])}" if name in REAL else f"({PUBLISHED[name].source})"
            left_out.append((name, f"needs {data or 'data=DIR'}/{name} {needs}"))
    return available, left_out


def _places_by_coordinates(root: Path) -> Iterator[Place]:
    """Folders of images whose names `@easting@northing@...` hold coordinates, as VPR-datasets-downloader makes them."""
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        for inside in (folder, folder / "images" / "test"):
            sides = {side: inside / side for side in ("database", "queries")}
            if all(any(path.is_file() for path in side.glob("@*")) for side in sides.values()):
                chosen = {"name": folder.name, **sides, "ground_truth": "utm"}
                settings = (override(f"dataset.{name}", value) for name, value in chosen.items())
                yield Place(folder.name, ("dataset=folder", *settings))
                break


def missing_weights(settings: Evaluate) -> list[Entry]:
    """Networks of the settings without installed weights."""
    names = [group.get("weights") for group in (settings.features, settings.retrieval, settings.matching)]
    return [REGISTRY[name] for name in dict.fromkeys(names) if name in REGISTRY and not is_installed(REGISTRY[name])]
