"""The numbers that the paper prints, and those that follow from them."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

BERLIN = ("berlin_a100", "berlin_kudamm", "berlin_halenseestrasse")
OTHERS = ("gardens_point", "nordland_1415", "robotcar_seasons")


@cache
def printed() -> Mapping[str, Any]:
    """Tables by their name in printed.yaml, which says what each holds."""
    return yaml.safe_load((Path(__file__).parent / "printed.yaml").read_text(encoding="utf-8"))


def average(recalls: Mapping[str, Sequence[float]]) -> np.ndarray | None:
    """The paper's average recall `[tolerances]` of a system: Berlin's three count as one data set.

    Args:
        recalls: `[tolerances]` by data set.

    Returns:
        None where one of the six is missing.
    """
    if not {*BERLIN, *OTHERS} <= recalls.keys():
        return None
    berlin = np.mean([recalls[name] for name in BERLIN], axis=0)
    return np.mean([berlin, *(recalls[name] for name in OTHERS)], axis=0)


def printed_recall(row: str, dataset: str, sequence: str | None = None) -> Sequence[float] | None:
    """Of a system, within 1, 2 and 5 frames in %, on a data set or in a sequence of RobotCar's; None = not printed."""
    if sequence is None:
        return printed()["recall"].get(row, {}).get(dataset)
    return printed()["sequences"].get(row, {}).get(sequence) if dataset == "robotcar_seasons" else None


def printed_settings(row: str) -> Mapping[str, Any]:
    """Sizes of images and candidates of a system, by column; empty = not printed."""
    families = (family for family in printed()["settings"] if row.startswith(family))
    return printed()["settings"].get(max(families, key=len, default=""), {})
