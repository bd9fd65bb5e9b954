"""Ground truth of a recall: its source, its thresholds, and their words in results."""

from collections.abc import Mapping
from typing import Any

from mfvpr.datasets import Dataset

_FILES = ("index_file", "query_labels", "database_labels")
_WORDS = {"order": "file order", "utm": "positions in the names", "drawn": "drawn with the images",
          "published": "as published"}  # fmt: skip


def describe(choice: Mapping[str, Any], recall: Mapping[str, Any], dataset: Dataset) -> dict[str, Any]:
    """Kind, files, unit and thresholds of the ground truth, as results store them, from `dataset` and `recall`."""
    truth = dataset.sequences[0].truth
    entries = {
        "kind": choice.get("ground_truth", "drawn" if "cache" in choice else "published"),
        "files": [choice[name] for name in _FILES if choice.get(name)],
        "exclude_neighbors": choice.get("exclude_neighbors"),
    }
    if truth is None:
        return entries
    thresholds = truth.thresholds(tolerances=recall["tolerances"], radius=recall["radius"])
    return entries | {"unit": truth.unit, "thresholds": thresholds}


def in_words(*descriptions: Mapping[str, Any]) -> str:
    """The ground truth in a heading, from descriptions of data sets with the same thresholds."""
    first = descriptions[0]
    if "unit" not in first:
        return "no ground truth: rankings only"
    source = ", ".join(dict.fromkeys(map(_source, descriptions)))
    if first["unit"] == "exact":
        return f"recall in %, ground truth: {source}"
    within = ", ".join(f"{threshold:g}" for threshold in first["thresholds"])
    return f"recall in %, within {within} {first['unit']} of the ground truth: {source}"


def _source(description: Mapping[str, Any]) -> str:
    kind, files = description["kind"], ", ".join(dict.fromkeys(description["files"]))
    return ("labels in " if kind == "label" else "") + (files or _WORDS.get(kind, kind))
