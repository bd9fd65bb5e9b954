"""Refusals of unusable images by maps: black frames, noise, blur, overexposure; and of the queries themselves.

    python -m experiments.unusable NAME=DATABASE:QUERIES ... --features aliked

Query i of a drive shows its database image i. A map of the database localizes changed copies of every tenth query, and
all queries as they are. No confidence is involved.
"""

import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy
from jaxtyping import Float, UInt8

from experiments.drives import NEAR, datasets_of, main
from mfvpr.cli.command_line import load_system
from mfvpr.localization import Map, Prediction
from mfvpr.report import Table
from mfvpr.storage import FeatureCache

STEP = 10  # queries

Pixels = Float[np.ndarray, "height width 3"]
Change = Callable[[Pixels, np.random.Generator], Pixels]


def noise(level: float, deviation: float) -> Change:
    """An image of one gray level with Gaussian noise."""
    return lambda image, rng: level + deviation * rng.normal(size=image.shape)


def lens_cap(image: Pixels, rng: np.random.Generator) -> Pixels:
    """A dark image with a little light at its left rim."""
    return np.maximum(40 - np.arange(image.shape[1]), 0)[None, :, None] + rng.normal(4, 1, image.shape)


def coarse_noise(image: Pixels, rng: np.random.Generator) -> Pixels:
    """Noise of spots of a few px."""
    spots = scipy.ndimage.gaussian_filter(rng.normal(size=image.shape), (2, 2, 0))
    return 128 + 50 * spots / spots.std()


def blur(share: float) -> Change:
    """Defocus: the mean over a square with a share of the width."""

    def change(image: Pixels, _: np.random.Generator) -> Pixels:
        side = round(share * image.shape[1])
        return scipy.ndimage.uniform_filter(image, (side, side, 0), mode="nearest")

    return change


CHANGES: dict[str, Change] = {
    **{name: noise(level, 0) for name, level in (("black", 0), ("gray", 128), ("white", 255))},
    "lens cap": lens_cap,
    **{f"noise, {deviation}": noise(128, deviation) for deviation in (2, 10, 40, 80)},
    "random pixels": lambda image, rng: rng.uniform(0, 256, image.shape),
    "coarse noise": coarse_noise,
    "blur over 4 % of the width": blur(0.04),
    "blur over 8 %": blur(0.08),
    "blur over 16 %": blur(0.16),
    **{f"{gain} times as bright": lambda image, _, gain=gain: gain * image for gain in (4, 16, 64)},
    "a 16th as bright": lambda image, _: image / 16,
}


def to_image(pixels: Pixels) -> UInt8[np.ndarray, "height width 3"]:
    """Round and clip brightness."""
    return np.clip(np.round(pixels), 0, 255).astype(np.uint8)


def row(kind: str, rows: list[int], predictions: list[Prediction]) -> list[str]:
    """A line of the table: number of images, share refused, number by reason, and of the rest the correct share."""
    reasons = Counter(prediction.reason for prediction in predictions if prediction.reason is not None)
    rest = [abs(prediction.alternatives[0].row - number) <= NEAR
            for number, prediction in zip(rows, predictions, strict=True) if prediction.reason is None]  # fmt: skip
    refused, correct = 100 * (1 - len(rest) / len(rows)), f"{100 * np.mean(rest):.0f}" if rest else ""
    words = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
    return [kind, f"{len(rows)}", f"{refused:.0f}", words, correct]


def run(drives: list[str], features: str) -> None:
    """Print a table for each drive."""
    datasets, system = datasets_of(drives), load_system("mfvpr", retrieval="vlad", features=features)
    for name, dataset in datasets.items():
        rng, numbers = np.random.default_rng(0), [*range(len(dataset.queries))]
        with tempfile.TemporaryDirectory() as root:
            known = Map.create(Path(root) / "map", dataset.database, system, cache=FeatureCache())
            unchanged = [known.localize(dataset.queries.read(number)) for number in numbers]
            lines, numbers = [row("query as it is", numbers, unchanged)], numbers[::STEP]
            for kind, change in CHANGES.items():
                changed = [to_image(change(dataset.queries.read(number).astype(float), rng)) for number in numbers]
                lines.append(row(kind, numbers, [*map(known.localize, changed)]))
        header = ["image", "number", "refused, %", "reasons", "of the rest correct, %"]
        print(f"\n{name}, {features}\n\n{Table(header, lines).markdown()}", end="", flush=True)


if __name__ == "__main__":
    main("unusable", __doc__)
