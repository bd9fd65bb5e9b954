"""Parts of a system that a map keeps: settings, recipes, the size of images."""

import json
from pathlib import Path
from typing import Any

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.evaluation.system import Note, System
from mfvpr.features.extractor import Extractor
from mfvpr.features.vlad import VladFitting
from mfvpr.matchers.host_matcher import PairSource
from mfvpr.retrieval.retriever import Alternating
from mfvpr.retrieval.search import ExactSearch
from mfvpr.retrieval.standardization import StandardizedSearch
from mfvpr.storage.maps import MapFile
from mfvpr.systems import assembly
from mfvpr.systems.assembly import SystemSettings
from mfvpr.utils.errors import InputError, require_type
from mfvpr.utils.fields import from_values
from mfvpr.utils.fingerprints import fingerprint, recipe_of

_KEPT = ("features", "retrieval", "matching", "scorer", "candidates", "fusion", "final", "ties")  # settings
_ABOUT = 1.5  # relative difference of numbers of pixels: sides are rounded


def retrievals_of(system: System) -> list[Any]:
    """The retrieval of a system, or the two that it asks in turns."""
    retriever = system.pipeline.retriever
    return [retriever.first, retriever.second] if isinstance(retriever, Alternating) else [retriever]


def describers_of(system: System) -> tuple[Extractor, list[Extractor | VladFitting]]:
    """The extractors of features and of global descriptors; an InputError for a system that a map cannot use."""
    pipeline, retrievals = system.pipeline, retrievals_of(system)
    extractor: Any = pipeline.extractor
    describers: list[Any] = [getattr(each, "describer", None) for each in retrievals]
    fitted = [each for each in describers if isinstance(getattr(each, "fitting", None), VladFitting)]
    is_own = [each.extractor is extractor or recipe_of(each.extractor) == recipe_of(extractor) for each in fitted]
    needs = {
        "an extractor of local features of one scale": isinstance(extractor, Extractor) and len(extractor.scales) == 1,
        "a matcher that JAX can compile": not isinstance(pipeline.matcher, PairSource),
        "a number of candidates": pipeline.candidates != "all",
        "single images; mfvpr.Route follows a drive": not (system.correlated or system.sequences),
        "retrieval by global descriptors without whitening": all(
            isinstance(getattr(each, "search", None), ExactSearch | StandardizedSearch) for each in retrievals
        ),
        "descriptors of an extractor, or Aggregated(extractor, VladFitting()) of its own": all(is_own)
        and len(fitted) + sum(isinstance(each, Extractor) for each in describers) == len(describers),
        "at most one vocabulary": len(fitted) < 2,
    }
    for need, is_met in needs.items():
        if not is_met:
            raise InputError(f"a map needs {need}")
    return extractor, [getattr(each, "fitting", each) for each in describers]


def parts_of(system: System) -> dict[str, Any]:
    """What a map keeps of a system: `system`, its settings if it has some, and `recipe`; an InputError without one."""
    extractor, describers = describers_of(system)
    try:
        parts = {"recipe": {"extractor": recipe_of(extractor), "describers": recipe_of(describers)}}
    except TypeError as error:
        fix = "by which a map knows what made its features; see mfvpr.utils.recipe_of"
        raise InputError(f"{error}, {fix}") from None
    if system.settings is not None:
        parts = {"system": {name: system.settings[name] for name in _KEPT}} | parts
    return json.loads(json.dumps(parts))  # tuples become lists


def read_settings(folder: Path) -> dict[str, Any]:
    """The settings of the map in a folder; an InputError without one, or for a system that no settings describe."""
    if content := MapFile(folder).part("system"):
        return json.loads(content)
    fix = "Make one with `mfvpr map build` or `Map.create`"
    open_map = "open a map of a system of your own with `Map(folder, system)`"
    raise InputError(f"{folder}: expected a folder with a map, got none. {fix}, or {open_map}.")


def read_system(folder: Path) -> System:
    """The system that a map was made with; raises as `read_settings`, or if weights are missing."""
    settings = read_settings(folder)
    try:
        return assembly.system(from_values(SystemSettings, settings))
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None


def fit_to_map(folder: Path, system: System, images: ImageFolder | None, note: Note) -> System:
    """The system at the image size of the map in a folder; in a new one, at that of the images, see `System`.

    Raises `InputError` if a new map has no images to take the shape from, or one of images of another size.
    """
    require_type("system", system, System, 'mfvpr.load_system("mfvpr")')
    if system.pipeline.pixels is None:
        return system
    if system.settings is not None and (content := MapFile(folder).part("system")):
        width, height = json.loads(content)["features"]["image_size"]
        if not 1 / _ABOUT < width * height / system.pipeline.pixels < _ABOUT:
            got = f"{system.pipeline.pixels} pixels. Use features.image_size=[{width},{height}]"
            raise InputError(f"{folder}: this map was made with images of {width} x {height} px, got {got}.")
        return system.with_image_size((width, height))
    if images is None:
        fix = "Use `Map.create`, or a system with features.image_size=[WIDTH,HEIGHT]"
        raise InputError(f"image_size: expected the images of a new map, whose shape decides, got none. {fix}.")
    return system.fit_image_size([images], note)


def system_fingerprint(system: System) -> str | None:
    """A hash of everything that scores depend on; None if a part has no recipe."""
    pipeline = system.pipeline
    parts = (pipeline.extractor, pipeline.retriever, pipeline.matcher, pipeline.candidates, dict(system.scorers))
    try:
        return fingerprint(recipe_of([*parts, dict(system.fused), system.ties, system.headline]))
    except TypeError:
        return None
