"""Turn checked settings into a data set, a cache and a runtime; `mfvpr.systems.assembly` has the parts of a system."""

from collections.abc import Callable
from typing import Any

from mfvpr.cli import console
from mfvpr.datasets import Dataset, folder_dataset, sequences_dataset
from mfvpr.datasets.ground_truth import CHOICES
from mfvpr.datasets.published import published_dataset
from mfvpr.datasets.streets import seasons_folder, streets_folder
from mfvpr.datasets.streets.seasons import CONDITIONS, TRUTH
from mfvpr.storage import FeatureCache
from mfvpr.systems.settings import SettingsError
from mfvpr.utils import Runtime
from mfvpr.utils.files import expand_user


def dataset(settings: dict[str, Any], progress: Callable[[int, int], None]) -> Dataset:
    """The data set; `streets` is drawn first if the cache does not have it."""
    if settings["name"] == "streets_seasons":
        root = seasons_folder(expand_user(settings["cache"]), seed=settings["seed"], progress=progress)
        return sequences_dataset(
            root / "database", [root / name for name in CONDITIONS], name="streets_seasons", ground_truth="index",
            index_file=TRUTH, widen_index=True,
        )  # fmt: skip
    if "cache" in settings:
        root = streets_folder(expand_user(settings["cache"]), seed=settings["seed"], progress=progress)
        return folder_dataset(
            root / "database", root / "queries", name="streets", ground_truth="index",
            index_file=root / "ground_truth.csv", widen_index=True,
        )  # fmt: skip
    if "ground_truth" not in settings:
        return published_dataset(
            settings["name"],
            expand_user(settings["root"]),
            seasons=settings.get("seasons") and tuple(settings["seasons"]),
        )
    if settings["ground_truth"] is None:
        raise SettingsError(f"dataset.ground_truth: nothing is assumed of your own images; set it to one of {CHOICES}")
    options = {name: value for name, value in settings.items() if name not in ("root", "exclude_neighbors")}
    several = isinstance(options["queries"], list)
    if several == ("database_labels" in options):  # only a single sequence has labels
        expected = "DIR, or [DIR,...] with dataset=sequences" if several else "[DIR,...], or DIR with dataset=folder"
        raise SettingsError(f"dataset.queries: expected {expected}, got {settings['queries']}")
    if several:
        queries, images = [expand_user(path) for path in options.pop("queries")], expand_user(options.pop("database"))
        return sequences_dataset(images, queries, **options)
    for name in ("database", "queries", "index_file", "database_labels", "query_labels"):
        options[name] = expand_user(options[name]) if options[name] else None
    return folder_dataset(**options)


def cache(settings: dict[str, Any]) -> FeatureCache:
    """The cache of features, matches and all else that is computed from images."""
    root = None if settings["cache"] is None else expand_user(settings["cache"])
    skip_bad, wait = settings["on_bad_image"] == "skip", settings.get("multirun", False)
    return FeatureCache(root, skip_bad=skip_bad, wait=wait, runtime=runtime(settings))


def runtime(settings: dict[str, Any]) -> Runtime:
    """Devices, memory, progress and messages."""
    import jax

    devices, number = jax.local_devices(), settings["devices"]
    if number != "all" and number > len(devices):
        raise SettingsError(f"devices={number}: expected at most {len(devices)}, as many as there are here, or all")
    return Runtime(devices if number == "all" else devices[:number], settings["memory"], console.track, console.tell)
