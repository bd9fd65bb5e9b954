"""The least evidence for a prediction: enough keypoints, and enough matches.

A confidence compares the scores of one query with each other, so a black image can look certain. The two tests here are
absolute. The strength of an image is the sum of its detection scores; the strength of a query is compared with the mean
strength of the map's images.

The tests refuse lens caps, plain images, very dark or blurred images and weak noise. They do not refuse strong noise,
which has as many keypoints as a photograph, nor images of places that the map does not show. Noise counts as strong
sooner if images are enlarged for the detector, or if the map's images have few keypoints.
"""

import numpy as np

from mfvpr.storage.maps import MapRows
from mfvpr.types import Features

# Round numbers, not fitted. They were chosen with two real sets in view, a park path and a corridor: results on those
# sets are no independent test. The darkest night query of the synthetic street has 0.20 of the mean strength (SIFT).
LEAST_STRENGTH = 0.05  # of the mean strength of the map's images
LEAST_MATCHES = 8  # of a query with its best candidate
_SAMPLE = 32  # images; a sample has up to twice as many


def strength(features: Features) -> float:
    """Sum of the detection scores of one image's unpadded features; negative scores count as 0."""
    return float(np.maximum(features.scores, 0).sum())


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
