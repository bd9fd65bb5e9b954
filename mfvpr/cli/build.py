"""Turn checked settings into a data set, a cache and a runtime; `mfvpr.systems.assembly` has the parts of a system."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from mfvpr import datasets
from mfvpr.cli import console
from mfvpr.datasets import Dataset, IndexFile, LabelFiles
from mfvpr.datasets.ground_truth import CHOICES
from mfvpr.datasets.published import published_dataset
from mfvpr.datasets.streets import CONDITIONS, TRUTH, streets_folder
from mfvpr.storage import FeatureCache
from mfvpr.utils import Cluster, Runtime
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import expand_user


def dataset(settings: Mapping[str, Any], progress: Callable[[int, int], None]) -> Dataset:
    """The data set; the synthetic street is drawn first if the cache does not have it."""
    if "cache" in settings:
        seasons = settings["name"] == "streets_seasons"
        root = expand_user(settings["cache"])
        root = streets_folder(root, seasons=seasons, seed=settings["seed"], progress=progress)
        queries = [root / name for name in CONDITIONS] if seasons else root / "queries"
        truth = IndexFile(TRUTH if seasons else root / TRUTH, is_widened=True)
        return datasets.folder(root / "database", queries, ground_truth=truth, name=settings["name"])
    if "ground_truth" not in settings:
        return published_dataset(
            settings["name"],
            expand_user(settings["root"]),
            seasons=settings.get("seasons") and tuple(settings["seasons"]),
        )
    if settings["ground_truth"] is None:
        raise InputError(f"dataset.ground_truth: nothing is assumed of your own images; set it to one of {CHOICES}")
    database, queries, several = settings["database"], settings["queries"], isinstance(settings["queries"], list)
    if several == ("database_labels" in settings):  # only a single sequence has labels
        expected = "DIR, or [DIR,...] with dataset=sequences" if several else "[DIR,...], or DIR with dataset=folder"
        raise InputError(f"dataset.queries: expected {expected}, got {queries}")
    queries = [expand_user(path) for path in queries] if several else expand_user(queries)
    options = {name: settings[name] for name in ("name", "orient", "bits")}
    return datasets.folder(expand_user(database), queries, ground_truth=_ground_truth(settings), **options)


def _ground_truth(settings: Mapping[str, Any]) -> IndexFile | LabelFiles | str:
    """The ground truth of folders of images, whose files must be those that it needs."""
    kind = settings["ground_truth"]
    for option, reader in {"index_file": "index", "database_labels": "label", "query_labels": "label"}.items():
        path = settings.get(option)
        if path is not None and kind != reader:
            raise InputError(f"{path}: given as dataset.{option}, but dataset.ground_truth={kind}; "
                                f"set it to {reader}")  # fmt: skip
        if path is None and kind == reader:
            raise InputError(f"dataset.ground_truth={kind}: expected a file; give dataset.{option}=FILE as well")
    if kind == "index":
        return IndexFile(expand_user(settings["index_file"]), settings["widen_index"])
    if kind == "label":
        return LabelFiles(expand_user(settings["query_labels"]), expand_user(settings["database_labels"]))
    return kind


def cache(folder: str | None, runtime: Runtime, *, on_bad_image: str) -> FeatureCache:
    """The cache of features, matches and all else that is computed from images."""
    root = None if folder is None else expand_user(folder)
    return FeatureCache(root, skip_bad=on_bad_image == "skip", runtime=runtime)


@contextmanager
def cluster(settings: Mapping[str, Any] | None) -> Iterator[Cluster | None]:
    """Connect to the cluster that the settings name, or start it, until the block ends."""
    if settings is None:
        yield None
        return
    starts = {"address": Cluster.connect, "local": Cluster.local, "slurm": Cluster.slurm}
    options = {name: value for name, value in settings.items() if name != "name"}
    with starts[settings["name"]](**options) as started:
        console.tell(f"cluster: {started}")
        yield started


def runtime(number: int | str, memory: float | None, cluster: Cluster | None) -> Runtime:
    """Number of devices, memory, progress, messages, and the cluster that `command_line` started."""
    import jax

    devices = jax.local_devices()
    if not isinstance(number, str) and number > len(devices):
        raise InputError(f"devices={number}: expected at most {len(devices)}, as many as there are here, or all")
    devices = devices if isinstance(number, str) else devices[:number]
    return Runtime(devices, memory, console.track, console.tell, cluster)
