"""The settings of each program as dataclasses, and of data sets and clusters; Hydra composes them with `conf/`."""

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from mfvpr.evaluation.drives import Method
from mfvpr.evaluation.protocol import Split
from mfvpr.systems.assembly import GROUPS, KEYS, SystemSettings, by_choice, choices_of, without
from mfvpr.utils.cluster import Cluster
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import (
    COUNT,
    FLAG,
    INDEX,
    PATH,
    POSITIVE,
    REQUIRED,
    TEXT,
    Rule,
    Setting,
    check_fields,
    check_values,
    default_values,
    group,
    list_of,
    number,
    one_of,
    or_list,
    setting,
    settings_of,
    text,
    whole,
    word_of,
)

_SHARE = number(0, 1) | None
_SEQUENCE = word_of(Method)
_QUERIES = list_of(Rule(lambda value: INDEX.holds(value) or TEXT.holds(value), "a row or a name of a query"))
_NUMBER_OR_QUERIES = "how many (at most 1000000), or a list of rows or names of queries"
_FIGURES = Rule(lambda value: INDEX.holds(value) or _QUERIES.holds(value), _NUMBER_OR_QUERIES)
_A_DATA_SET = "a data set, such as streets or {corridor: {root: DIR}}"
_DATA_SETS = list_of(Rule(lambda each: TEXT.holds(each) or (isinstance(each, Mapping) and len(each) == 1), _A_DATA_SET))
_GRID = Rule(lambda value: isinstance(value, Mapping), "lists of values by parameter, such as {sigma: [10, 22.5]}")


def _folder() -> str:
    return os.environ.get("MFVPR_CACHE") or "~/.cache/mfvpr"


def _is_compiled() -> bool:
    return (os.environ.get("MFVPR_COMPILED") or "true").lower() == "true"


@dataclass(frozen=True)
class RecallSettings:
    """Which predictions count as correct."""

    tolerances: list[int] = setting((1, 2, 5), list_of(INDEX), "frames")
    radius: float = setting(25.0, POSITIVE, "meters, where the ground truth has positions")
    ks: list[int] = setting((1, 5, 10), list_of(COUNT))

    __post_init__ = check_fields


@dataclass(frozen=True)
class Resources:
    """Settings that change no result."""

    memory: float | None = setting(None, POSITIVE | None, "GB of features in matching; null = a third of what is free")
    compiled: bool = setting(_is_compiled, FLAG, "keep compiled programs on disk: the next process starts fast")


@dataclass(frozen=True)
class Shared(Resources):
    """Settings of all programs that evaluate."""

    devices: int | str = setting(1, COUNT | "all", "that share the queries: how many, or all")
    cache: str | None = setting(lambda: f"{_folder()}/features", PATH | None, "of features and matches; null = none")


@dataclass(frozen=True)
class Common(SystemSettings, Shared):
    """Settings that evaluate, sweep and learn share, and how the job was started."""

    dataset: Mapping[str, Any] = group()
    cluster: Mapping[str, Any] = group()
    recall: RecallSettings = field(default=RecallSettings())
    on_bad_image: str = setting("fail", one_of("fail", "skip"))
    out: str | None = setting(None, PATH | None, "run folder; null = runs/<data set>/<time>")
    command: str | None = None
    multirun: Mapping[str, Any] | None = None  # folder, number and overrides of the job
    workers: Cluster | None = None  # the cluster, once it is started

    def __post_init__(self) -> None:
        super().__post_init__()
        check_data_set(self.dataset)
        check_values(settings_of(_Workers), self.cluster, "cluster.")
        if self.cluster and self.cache is None:
            raise InputError("cluster: expected cache=DIR as well, a folder that all workers share")


@dataclass(frozen=True)
class Evaluate(Common):
    """Re-rank a data set and print its recall."""

    figures: Any = setting(6, _FIGURES, "queries shown: how many; or which: [42,48] rows, or names")
    previous_queries: int = setting(0, whole(0, 1000), "raise scores near the places of the last N queries of a drive")
    sequence: Any = setting(None, or_list(_SEQUENCE) | None, "rank the queries of a drive together (extra rankings)")
    confidence: str | None = setting(None, PATH | None, "confidence.json of a run on other images; null = fit one here")
    threshold: float | None = setting(None, _SHARE, "of the confidence: below it the prediction is `no place`")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.threshold is not None and self.confidence is None:
            raise InputError(f"threshold={self.threshold}: expected confidence=FILE as well, of a run on other images")


@dataclass(frozen=True)
class ChunkSettings:
    """Sizes of the blocks of a sweep; the results do not depend on them."""

    settings: int | None = setting(None, COUNT | None)
    queries: int | None = setting(None, COUNT | None)

    __post_init__ = check_fields


@dataclass(frozen=True)
class Searched(Common):
    """Settings that sweep and learn share."""

    grid: Mapping[str, Any] = setting(dict, _GRID, "lists of values of the scorer's settings, of max_distance and of c")
    split: Split | None = setting(None, word_of(Split) | None, "choose on one half of the path, report on the other")


@dataclass(frozen=True)
class Sweep(Searched):
    """Search the parameters of the re-ranking over a whole data set."""

    search: str = setting("grid", one_of("grid", "optuna"))
    trials: int = setting(200, whole(1, 100_000), "of optuna")
    seed: int = setting(0, INDEX, "of optuna")
    sequence: Method | None = setting(None, _SEQUENCE | None, "rank the queries of a drive together")
    chunk: ChunkSettings = field(default=ChunkSettings())


@dataclass(frozen=True)
class Learn(Searched):
    """Learn the parameters of a score, and the weights of its matches."""

    also: Any = setting(None, _DATA_SETS | None, "further data sets to learn on, such as [{streets: {seed: 1}}]")
    report: Any = setting(None, _DATA_SETS | None, "data sets to report on; null = the other half of the path")
    split: Split | None = setting("both", word_of(Split) | None, "where to learn")
    loss: str = setting("cross_entropy", one_of("cross_entropy", "recall", "average_precision"))
    steps: int = setting(200, COUNT)
    every: int = setting(5, COUNT, "steps from one validation to the next")
    patience: int = setting(10, COUNT, "validations without gain")
    batch: int = setting(8, whole(1, 1024), "queries of a step")
    learning_rate: float = setting(0.01, POSITIVE)
    inputs: str = setting("relative", one_of("relative", "absolute"), "of weights; relative to the pair's matches")
    hidden: int = setting(16, whole(1, 1024), "width of the network of match weights")
    checkpoints: str | None = setting(None, PATH | None, "folder of unfinished trainings; null = beside the features")
    seed: int = setting(0, INDEX)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.also and not self.report:
            raise InputError("also: expected report=[...] as well, to learn on several data sets and report on others")
        names = {self.features["name"], *by_choice("retrieval", self.retrieval), self.matching["name"]}
        if self.report and names & {"import", "pairs"}:
            raise InputError("report: expected no files of other programs, since they are of one data set")
        if self.report and self.split != "both":
            raise InputError(f"split={self.split}: expected none with report=, since the data sets are it")
        if self.split is None:
            raise InputError("split=null: expected first_half, second_half or both; the rest is reported on")


@dataclass(frozen=True)
class MapBuild(SystemSettings, Resources):
    """Build a map."""

    dataset: Mapping[str, Any] = group()
    map: str = setting(REQUIRED, PATH, "folder of the map")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_data_set(self.dataset)


@dataclass(frozen=True)
class Localize(Resources):
    """Localize images in a map; a line of JSON for each."""

    map: str = setting(REQUIRED, PATH, "folder of the map")
    images: Any = setting(REQUIRED, or_list(PATH), "image, folder of images, or video; or [PATH,PATH]")
    watch: bool = setting(False, FLAG, "of a folder: localize new images as well, until Ctrl-C")
    every: int = setting(1, COUNT, "of a video: every so many frames")
    mask: str | None = setting(None, PATH | None, "image that is black where pixels are ignored, such as on the hood")
    alternatives: int = setting(5, INDEX, "candidates in each line")
    recent: int = setting(0, INDEX, "newest images to leave out: of a drive that is added, they show the same place")
    confidence: str | None = setting(None, PATH | None, "confidence.json of an evaluation; null = that of the map")
    threshold: float | None = setting(None, _SHARE, "of the confidence: below it there is no place")
    field_of_view: float | None = setting(None, number(5, 179) | None, "horizontal, degrees: adds `shift_angles`")
    route: float | str | None = setting(
        None,
        number(-1000, 1000) | one_of("auto", None),
        "of a map of a drive: add the position estimated from all images so far; a number = map rows per image",
    )
    add: bool = setting(False, FLAG, "add each image, after it is localized, to the end of the map: place = its path")
    figures: Any = setting(0, _FIGURES, "localizations that are drawn: how many, or which rows or names; needs out")
    out: str | None = setting(None, PATH | None, "folder of the figures")
    root: str | None = setting(None, PATH | None, "folder of the map's images, which figures then show")

    def __post_init__(self) -> None:
        check_fields(self)
        if self.figures and self.out is None:
            raise InputError(f"figures={self.figures}: expected out=DIR as well, where they are drawn")


@dataclass(frozen=True)
class Paper(Shared):
    """The paper's evaluation."""

    data: str | None = setting(None, PATH | None, "folder of data sets; null = the synthetic one alone")
    datasets: list[str] | None = setting(None, list_of(TEXT) | None, "null = all in `data`, and the synthetic one")
    systems: list[str] | None = setting(None, list_of(TEXT) | None, "names; null = all with installed weights")
    out: str = setting("runs/paper", PATH)

    __post_init__ = check_fields


DATA_SET_NAME = text(r"[\w-][\w.-]*", "letters, digits, - and _")


@dataclass(frozen=True)
class _Published:
    """A published data set."""

    name: str = setting("", DATA_SET_NAME)
    root: str = setting(REQUIRED, PATH)
    seasons: Any = setting(None, list_of(one_of("fall", "spring", "summer", "winter"), 2), "database, queries")


@dataclass(frozen=True)
class _Images(_Published):
    """Folders of images, which `root` may hold."""

    database: str = setting(REQUIRED, PATH)
    queries: Any = setting(REQUIRED, or_list(PATH))
    ground_truth: str | None = setting(
        None,
        one_of("order", "index", "utm", "none", "label", None),
        "order: query i shows database image i; index: a file of pairs; utm: @easting@northing@ names; label: two csv "
        "files of name,label; none: rankings only",
    )
    index_file: str | None = setting(None, PATH | None, "for index: .csv, .npz or .json")
    widen_index: bool = setting(False, FLAG, "for index: images within recall.tolerances count as well")
    masks: str | None = setting(None, PATH | None, "folder of masks by image name, or one mask; black is ignored")
    among: str | None = setting(None, PATH | None, "file of pairs, as for index: the only candidates of each query")
    exclude_neighbors: int | None = setting(None, INDEX | None, "frames around a query itself to leave out; 0 = itself")
    orient: bool = setting(True, FLAG, "turn images as their EXIF orientation says")
    bits: int | None = setting(16, whole(8, 16) | None, "that 16-bit images use, of which the upper 8 are taken")


@dataclass(frozen=True)
class _Folder(_Images):
    """Two folders of images."""

    database_labels: str | None = setting(None, PATH | None, "for label: .csv with the columns name,label")
    query_labels: str | None = setting(None, PATH | None)


FOLDER_SETTINGS = settings_of(_Folder).keys() - {"name", "root", "seasons", "database", "queries"}


@dataclass(frozen=True)
class _Drawn:
    """Streets that are drawn."""

    name: str = setting("", DATA_SET_NAME)
    seed: int = setting(0, INDEX)
    cache: str = setting(_folder, PATH)


@dataclass(frozen=True)
class _Workers:
    """A cluster that is started or connected to."""

    name: str = setting("", one_of("local", "slurm", "address"))
    workers: int = setting(2, COUNT, "processes; or jobs of Slurm, one worker each")
    options: str = setting("--cpus-per-task=4 --mem=16G --time=240", TEXT | "", "of sbatch for each job")
    address: str = setting(REQUIRED, text(r"(tcp|tls|ucx)://\S+:\d+", "tcp://HOST:PORT"))


OTHERS = (_Folder, _Drawn, _Workers)  # of data sets and clusters
PROGRAMS: dict[str, type] = {
    "evaluate": Evaluate,
    "sweep": Sweep,
    "learn": Learn,
    "map": MapBuild,
    "localize": Localize,
    "paper": Paper,
}


def register() -> None:
    """Give Hydra the settings of all programs and choices; defaults may depend on variables of the environment."""
    # Else Hydra copies the store for each group that --help lists, which takes seconds; what it loads is a copy anyway.
    setattr(ConfigStore, "__deepcopy__", lambda store, memo: store)  # noqa: B010
    store = ConfigStore.instance().store
    for program, owner in PROGRAMS.items():
        node = default_values(settings_of(owner))
        if "grid" in node:  # any axis; `Axes` knows those of the scorer
            node["grid"] = OmegaConf.create({}, flags={"struct": False})
        store(name=f"{program}_settings", node=node)
    for choice in GROUPS:
        for name, known in choices_of(choice).items():
            store(group=choice, name=name, node={KEYS.get(choice, "name"): name, **default_values(known)})
    options = default_values(settings_of(_Workers))["options"]
    store(group="cluster", name="local", node={"name": "local", "workers": 2})
    store(group="cluster", name="slurm", node={"name": "slurm", "workers": 8, "options": options})
    store(group="cluster", name="address", node={"name": "address", "address": REQUIRED})
    for name, owner in {"folder": _Folder, "sequences": _Images, "streets": _Drawn, "streets_seasons": _Drawn}.items():
        defaults = without(default_values(settings_of(owner)), "root", "seasons")
        store(group="dataset", name=name, node=defaults | {"name": name})
    OmegaConf.register_new_resolver("settings", _describe, replace=True)


def check_data_set(settings: Mapping[str, Any]) -> None:
    """Raise an InputError for a setting of a data set that is not allowed."""
    owner = _Drawn if "cache" in settings else _Folder if "database" in settings else _Published
    check_values(settings_of(owner), settings, "dataset.")


def _describe(program: str, *, _root_: Any) -> str:
    """A line for each setting in `--help`, with its value, and what it means."""
    values: Any = OmegaConf.to_container(_root_)
    known: dict[str, Any] = settings_of(PROGRAMS[program]) | {"cluster": settings_of(_Workers)}
    known["dataset"] = settings_of(_Folder) | settings_of(_Drawn)
    for name in GROUPS[:3]:
        known[name] = choices_of(name).get(values.get(name, {}).get("name"), {})
    text = "\n".join(_lines(known, without(values, "hydra")))
    return text.replace("$", "$$")  # Hydra fills in names behind $


def _lines(known: Any, settings: Mapping[str, Any], indent: str = "") -> Iterator[str]:
    known = choices_of("scorer").get(settings.get("method", ""), known)
    for name, value in settings.items():
        about = known.get(name, {}) if isinstance(known, Mapping) else {}
        if isinstance(value, Mapping):
            yield f"{indent}{name}:"
            yield from _lines(about, value, f"{indent}  ")
            continue
        words = [about.unit, about.note, about.rule.expected] if isinstance(about, Setting) else []
        text = "; ".join(filter(None, words)).replace("None", "null")
        shown = json.dumps(value) if isinstance(value, bool | None) else value
        yield f"{indent}{name}: {shown}" + f"  # {text}" * bool(text)
