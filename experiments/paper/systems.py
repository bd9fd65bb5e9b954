"""Rows of the tables, the evaluations that give them, and the data sets at hand."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mfvpr.checkpoints import REGISTRY, is_installed
from mfvpr.checkpoints.networks import Entry
from mfvpr.cli.command_line import override
from mfvpr.cli.schema import DATA_SET_NAME, Evaluate
from mfvpr.datasets.published import PUBLISHED
from mfvpr.evaluation.rankings import RETRIEVAL
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import expand_user

DRAWN = "streets_seasons"
REAL = {"grief_season": ("database", "queries"), "corridor": ("ref", "query")}  # data sets, and their folders
_SIDES = ("database", "queries")
_POSITIONS = "@"  # begins image names that hold coordinates: @easting@northing@...
COMBINED = f"histogram + {RETRIEVAL}"


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
    """A data set at hand, its settings of `mfvpr evaluate`, and its folder (None = it is synthetic)."""

    name: str
    settings: tuple[str, ...]
    root: Path | None = None


_SSM = {"hist": "hist", "anchor": "anchor", "sum": "sum", "ran_8": "RAN 8 px", "ran_24": "RAN 24 px"}
_MIX = {"hist_10": "hist 10", "hist_50": "hist 50", "hist_comb_10": "hist-comb 10", "hist_comb_50": "hist-comb 50"}
_PAPER = (
    Row("patch_netvlad_performance", "Patch-NV perf.", "patch_netvlad_performance"),
    Row("patch_netvlad_speed", "Patch-NV speed", "patch_netvlad_speed"),
    Row("mixvpr", "MixVPR", "mix_hist_50", RETRIEVAL),
    Row("selavpr_pitts_stage_1", "SelaVPR pits. stage 1", "selavpr_pitts", RETRIEVAL),
    Row("selavpr_pitts", "SelaVPR pits.", "selavpr_pitts"),
    Row("selavpr_msls_stage_1", "SelaVPR msls stage 1", "selavpr_msls", RETRIEVAL),
    Row("selavpr_msls", "SelaVPR msls", "selavpr_msls"),
    Row("ssm_vpr", "SSM-VPR", "ssm_vpr"),
    *(Row(f"ssm_{name}", f"SSM-{title}", f"ssm_{name}") for name, title in _SSM.items()),
    *(Row(f"mix_{name}", f"Mix-{title}", f"mix_{name}") for name, title in _MIX.items()),
    Row("mix_hist_aliked_50", "Mix-hist 50, ALIKED", "mix_hist_aliked_50"),
)
_SCORES = {name: name for name in ("count", "rapid", "sum", "anchor")} | {
    "histogram": "hist 50",
    "homography_8": "RAN 8 px",
    "homography_24": "RAN 24 px",
    COMBINED: "hist-comb 50",
}
_NAMES = {"histogram": "hist_50", "homography_8": "ran_8", "homography_24": "ran_24", COMBINED: "hist_comb_50"}


def _stand_ins(features: str, title: str) -> Iterator[Row]:
    """The methods with features whose weights are here, after VLAD of the same features."""
    yield Row(f"{features}_vlad", f"VLAD of {title}", f"{features}_50", RETRIEVAL)
    for ranking, words in _SCORES.items():
        yield Row(f"{features}_{_NAMES.get(ranking, ranking)}", f"{title}-{words}", f"{features}_50", ranking)
    yield Row(f"{features}_hist_10", f"{title}-hist 10", f"{features}_10", "histogram")
    yield Row(f"{features}_hist_comb_10", f"{title}-hist-comb 10", f"{features}_10", COMBINED)
    yield Row(f"{features}_mfvpr", f"{title}, system=mfvpr", f"{features}_mfvpr")


ROWS = (*_PAPER, *_stand_ins("sift", "SIFT"), *_stand_ins("aliked", "ALIKED"))

_SIFT = ("features=sift", "retrieval=vlad")
_ALIKED = ("features=aliked", "features.weights=aliked-n32", "retrieval=vlad")
_ALL, _FEW = ("scorer=compared", "candidates=50"), ("scorer=histogram", "candidates=10")
_RUNS = {
    "sift_50": (*_SIFT, *_ALL),
    "sift_10": (*_SIFT, *_FEW),
    "sift_mfvpr": ("system=mfvpr", "features=sift"),
    "aliked_50": (*_ALIKED, *_ALL),
    "aliked_10": (*_ALIKED, *_FEW),
    "aliked_mfvpr": ("system=mfvpr",),
}


def overrides(run: str, dataset: str) -> tuple[str, ...]:
    """Settings of `mfvpr evaluate` that make an evaluation, without its data set."""
    chosen = _RUNS.get(run, (f"system={run}",))
    if run.startswith("selavpr"):
        return (*chosen, "candidates=50")
    if run.startswith("patch_netvlad") and dataset == "robotcar_seasons":
        size = ("scorer.size=[400,400]",) if run == "patch_netvlad_speed" else ()  # of the patches' grid
        return (*chosen, "features.image_size=[480,480]", *size)
    return chosen


def chosen_rows(names: Sequence[str] | None) -> tuple[Row, ...]:
    """Rows by name, in the order of the tables; all for None."""
    _check_names("systems", names, [row.name for row in ROWS])
    return tuple(row for row in ROWS if names is None or row.name in names)


def _check_names(setting: str, names: Sequence[str] | None, known: Sequence[str]) -> None:
    if unknown := [name for name in names or () if name not in known]:
        raise InputError(f"{setting}=[{unknown[0]}]: expected some of {', '.join(known)}")


def places(data: str | None, names: Sequence[str] | None) -> tuple[list[Place], dict[str, str], list[str]]:
    """The data sets that are at hand, a line by name for those that are absent, and for each folder that is refused."""
    root = None if data is None else expand_user(data)
    if root is not None and not root.is_dir():
        got = "a file" if root.exists() else "nothing"
        raise InputError(f"data={data}: expected a folder with a folder per data set, got {got}; check the path")
    located = {place.name: place for place in _places_by_coordinates(root)} if root else {}
    known = list(dict.fromkeys((DRAWN, *REAL, *PUBLISHED, *located)))
    _check_names("datasets", names, known)
    available, absent, refused = list[Place](), dict[str, str](), list[str]()
    for name in known if names is None else [name for name in known if name in names]:
        folders = PUBLISHED[name].folders if name in PUBLISHED else (name,)
        present = [root / folder for folder in folders if root and folder not in located and (root / folder).is_dir()]
        if name == DRAWN:
            available.append(Place(name, (f"dataset={name}",)))
        elif name in located and name in (*REAL, *PUBLISHED):
            refused.append(f"{name}: expected another layout than that of names with positions; rename the folder")
        elif name in located and not DATA_SET_NAME.holds(name):
            refused.append(f"{name}: expected a folder's name of {DATA_SET_NAME.expected}; rename it")
        elif name in located:
            available.append(located[name])
        elif present:
            available.append(Place(name, (f"dataset={name}", override("dataset.root", present[0])), present[0]))
        else:
            needs = f"with {' and '.join(REAL[name])}" if name in REAL else f"({PUBLISHED[name].source})"
            absent[name] = f"{name}: needs {data or 'data=DIR'}/{name} {needs}"
    return available, absent, refused


def _places_by_coordinates(root: Path) -> Iterator[Place]:
    """Folders of images whose names hold coordinates, as VPR-datasets-downloader makes them."""
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        for inside in (folder, folder / "images" / "test"):
            sides = {side: inside / side for side in _SIDES}
            if all(any(path.is_file() for path in side.glob(f"{_POSITIONS}*")) for side in sides.values()):
                chosen = {"name": folder.name, **sides, "ground_truth": "utm"}
                settings = (override(f"dataset.{name}", value) for name, value in chosen.items())
                yield Place(folder.name, ("dataset=folder", *settings), folder)
                break


def missing_weights(settings: Evaluate) -> list[Entry]:
    """Networks of the settings without installed weights."""
    names = [group.get("weights") for group in (settings.features, settings.retrieval, settings.matching)]
    return [REGISTRY[name] for name in dict.fromkeys(names) if name in REGISTRY and not is_installed(REGISTRY[name])]
