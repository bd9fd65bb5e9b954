"""What a recall refers to: which ground truth, what still counts as right, and how that is written."""

from collections.abc import Mapping
from typing import Any

from mfvpr.data.datasets import Dataset
from mfvpr.data.ground_truth import Truth

WORDS = {"order": "file order", "utm": "positions in the names", "none": "none", "drawn": "drawn with the images"}


def thresholds(settings: Mapping[str, Any], truth: Truth | None) -> list[float]:
    """What counts as right, in the unit of the ground truth, ascending; none without ground truth."""
    if truth is None:
        return []
    recall = settings["recall"]
    return sorted(set(recall["tolerances"])) if truth.unit == "frames" else [recall["radius"]]


def label(k: int | str, threshold: float, unit: str) -> str:
    """Of a recall: `R@1 ±2`, `R@1 25 m`."""
    return f"R@{k} ±{threshold:g}" if unit == "frames" else f"R@{k} {threshold:g} {unit}"


def described(settings: Mapping[str, Any], dataset: Dataset) -> dict[str, Any]:
    """Kind, file, unit and thresholds of the ground truth, as results keep them."""
    chosen, truth = settings["dataset"], dataset.truth
    kind = {"kind": chosen.get("ground_truth", "drawn"), "file": chosen.get("index_file")}
    return kind if truth is None else kind | {"unit": truth.unit, "thresholds": thresholds(settings, truth)}


def in_words(settings: Mapping[str, Any], dataset: Dataset) -> str:
    """The same for a heading."""
    found = described(settings, dataset)
    if dataset.truth is None:
        return "no ground truth: rankings only"
    within = ", ".join(f"{threshold:g}" for threshold in found["thresholds"])
    return f"recall in %, within {within} {found['unit']} of the ground truth ({_source(found)})"


def _source(found: Mapping[str, Any]) -> str:
    return str(found["file"] or WORDS.get(found["kind"], found["kind"]))
