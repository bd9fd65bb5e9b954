"""Checked settings -> the library's values. Plain tables of names; nothing of a user's YAML is ever called."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

import mfvpr
from mfvpr.data.datasets import Dataset, folder_dataset
from mfvpr.data.streets import streets_folder
from mfvpr.features import GlobalExtractor, LocalExtractor
from mfvpr.features.sift import Sift
from mfvpr.features.vlad import fit_vlad
from mfvpr.pipeline import Track
from mfvpr.scoring import Scorer
from mfvpr.types import Features

WEIGHTS = {
    "fs": mfvpr.FeatureScoreWeight(),
    "dmf": mfvpr.DescriptorDistanceWeight(),
    "unit": mfvpr.UnitWeight(),
}
SCORERS: dict[str, Callable[..., Scorer]] = {
    "count": mfvpr.MatchCount,
    "sum": mfvpr.AggregatedScore,
    "anchor": mfvpr.AnchorPoints,
    "histogram": mfvpr.HistogramOfShifts,
}


def dataset(settings: dict[str, Any], progress: Callable[[int, int], None]) -> Dataset:
    """The data set; `streets` is drawn first where the cache does not have it."""
    if settings["kind"] == "streets":
        root = streets_folder(Path(settings["cache"]).expanduser(), seed=settings["seed"], progress=progress)
        return folder_dataset(
            root / "database", root / "queries", name="streets", ground_truth="index",
            index_file=root / "ground_truth.csv",
        )  # fmt: skip
    index_file = settings["index_file"]
    return folder_dataset(
        Path(settings["database"]).expanduser(),
        Path(settings["queries"]).expanduser(),
        name=settings["name"],
        ground_truth=settings["ground_truth"],
        index_file=Path(index_file).expanduser() if index_file else None,
    )


def local_extractor(settings: dict[str, Any]) -> LocalExtractor:
    """What finds local features."""
    options = {name: value for name, value in settings.items() if name != "name"}
    options["image_size"] = tuple(options["image_size"])
    return Sift(**options)


def global_extractor(settings: dict[str, Any], database: Sequence[Features]) -> GlobalExtractor:
    """What describes whole images; VLAD learns its vocabulary from the database's features."""
    return fit_vlad(database, **{name: value for name, value in settings.items() if name != "name"})


def scorers(settings: dict[str, Any]) -> dict[str, Scorer]:
    """The chosen scorer, or all of a group, by name."""
    chosen = {settings["method"]: settings} if "method" in settings else settings
    return {name: _scorer(values) for name, values in chosen.items()}


def track(label: str) -> Track:
    """A progress bar with the time left."""
    return lambda items, total: bar(label, total, items)


def bar(label: str, total: int, items: Iterable[Any] | None = None) -> tqdm:
    """The one look of all progress bars."""
    return tqdm(items, total=total, desc=f"{label:<20}", unit="", dynamic_ncols=True)


def _scorer(settings: dict[str, Any]) -> Scorer:
    options = {name: value for name, value in settings.items() if name != "method"}
    if "weight" in options:
        options["weight"] = WEIGHTS[options["weight"]]
    if options.get("shift_range"):
        options["shift_range"] = tuple(map(float, options["shift_range"]))
    return SCORERS[settings["method"]](**options)
