"""Strength of the images of a map, see `mfvpr.evaluation.evidence`."""

import numpy as np

from mfvpr.evaluation.evidence import strength
from mfvpr.storage.maps import MapRows

_SAMPLE = 32  # images; a sample has up to twice as many


class MapStrength:
    """Mean strength of a map's images, estimated from rows that are spread evenly over the map."""

    def __init__(self, rows: MapRows) -> None:
        self._rows, self._strengths = rows, {}

    def __call__(self, end: int) -> float:
        """Mean strength of a sample of the rows before `end`, which depends on `end` alone; 0 if there are none."""
        step = 1 << max(0, (end // _SAMPLE).bit_length() - 1)
        sample = range(0, end, step)
        present = [row for row, count in zip(sample, self._rows.counts(sample), strict=True) if count >= 0]
        unread = [row for row in present if row not in self._strengths]
        self._strengths |= {row: strength(features) for row, features in self._rows.features(unread)}
        return float(np.mean([self._strengths[row] for row in present])) if present else 0.0
