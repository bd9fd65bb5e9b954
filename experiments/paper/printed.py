"""The numbers that the paper prints, and averages that follow from them."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

BERLIN = ("berlin_a100", "berlin_kudamm", "berlin_halenseestrasse")
OTHERS = ("gardens_point", "nordland_1415", "robotcar_seasons")


@cache
def printed_tables() -> Mapping[str, Any]:
    """Tables by their names in printed.yaml, which describes them."""
    return yaml.safe_load((Path(__file__).parent / "printed.yaml").read_text(encoding="utf-8"))


def average(recalls: Mapping[str, Sequence[float]]) -> Float[np.ndarray, " tolerances"] | None:
    """The paper's average recall: Berlin's three count as one data set; None if one of six is missing.

    `recalls` are by data set and tolerance.
    """
    if not {*BERLIN, *OTHERS} <= recalls.keys():
        return None
    berlin = np.mean([recalls[name] for name in BERLIN], axis=0)
    return np.mean([berlin, *(recalls[name] for name in OTHERS)], axis=0)


def printed_recall(row: str, dataset: str, sequence: str | None = None) -> Sequence[float] | None:
    """Recall of a system within 1, 2, 5 frames in %, on a data set or a sequence of RobotCar's; None = not printed."""
    if sequence is None:
        return printed_tables()["recall"].get(row, {}).get(dataset)
    return printed_tables()["sequences"].get(row, {}).get(sequence) if dataset == "robotcar_seasons" else None


def printed_settings(row: str) -> Mapping[str, Any]:
    """Sizes of images and candidates of a system, by column; empty = not printed."""
    families = (family for family in printed_tables()["settings"] if row.startswith(family))
    return printed_tables()["settings"].get(max(families, key=len, default=""), {})
