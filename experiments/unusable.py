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

from mfvpr.cli.command_line import load_system
from mfvpr.cli.programs import Parser, run_command
from mfvpr.datasets.datasets import folder
from mfvpr.localization import Map, Prediction
from mfvpr.storage import FeatureCache

STEP = 10  # queries
NEAR = 2  # frames: within them, a prediction is correct

Pixels = Float[np.ndarray, "height width 3"]
Change = Callable[[Pixels, np.random.Generator], Pixels]


def plain(level: float, noise: float = 0) -> Change:
    """An image of one gray level with Gaussian noise of a standard deviation."""
    return lambda image, rng: level + noise * rng.normal(size=image.shape)


def lens_cap(image: Pixels, rng: np.random.Generator) -> Pixels:
    """A dark image with a little light at its left rim."""
    return np.maximum(40 - np.arange(image.shape[1]), 0)[None, :, None] + rng.normal(4, 1, image.shape)


def coarse_noise(image: Pixels, rng: np.random.Generator) -> Pixels:
    """Noise of spots of a few px."""
    noise = scipy.ndimage.gaussian_filter(rng.normal(size=image.shape), (2, 2, 0))
    return 128 + 50 * noise / noise.std()


def blur(share: float) -> Change:
    """Defocus: the mean over a square with a share of the width."""
    side = lambda image: round(share * image.shape[1])  # noqa: E731
    return lambda image, _: scipy.ndimage.uniform_filter(image, (side(image), side(image), 0), mode="nearest")


def expose(gain: float) -> Change:
    """Brightness times a gain, clipped."""
    return lambda image, _: gain * image


CHANGES: dict[str, Change] = {
    "black": plain(0), "gray": plain(128), "white": plain(255), "lens cap": lens_cap,
    "noise, 2": plain(128, 2), "noise, 10": plain(128, 10), "noise, 40": plain(128, 40), "noise, 80": plain(128, 80),
    "random pixels": lambda image, rng: rng.uniform(0, 256, image.shape), "coarse noise": coarse_noise,
    "blur over 4 % of the width": blur(0.04), "blur over 8 %": blur(0.08), "blur over 16 %": blur(0.16),
    "4 times as bright": expose(4), "16 times as bright": expose(16), "64 times as bright": expose(64),
    "a 16th as bright": expose(1 / 16),
}  # fmt: skip


def to_image(pixels: Pixels) -> UInt8[np.ndarray, "height width 3"]:
    """Round and clip brightness."""
    return np.clip(np.round(pixels), 0, 255).astype(np.uint8)


def row(kind: str, rows: list[int], predictions: list[Prediction]) -> str:
    """A line of the table: number of images, share refused, number by reason, and of the rest the correct share."""
    reasons = Counter(prediction.reason for prediction in predictions if prediction.reason is not None)
    rest = [abs(prediction.alternatives[0].row - number) <= NEAR
            for number, prediction in zip(rows, predictions, strict=True) if prediction.reason is None]  # fmt: skip
    refused = 100 * (1 - len(rest) / len(rows))
    words = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
    return f"| {kind} | {len(rows)} | {refused:.0f} | {words} | {f'{100 * np.mean(rest):.0f}' if rest else ''} |"


def run(drives: list[str], features: str) -> None:
    """Print a table for each drive."""
    system = load_system("mfvpr", features=features)
    for drive in drives:
        name, _, paths = drive.partition("=")
        dataset, rng = folder(*paths.split(":"), ground_truth="order"), np.random.default_rng(0)
        print(f"\n{name}, {features}\n\n| image | number | refused, % | reasons | of the rest correct, % |")
        print("| :-- | --: | --: | :-- | --: |")
        with tempfile.TemporaryDirectory() as root:
            known = Map.create(Path(root) / "map", dataset.database, system, cache=FeatureCache())
            rows = [*range(len(dataset.queries))]
            print(row("query as it is", rows, [known.localize(dataset.queries.read(number)) for number in rows]))
            rows = rows[::STEP]
            for kind, change in CHANGES.items():
                changed = [to_image(change(dataset.queries.read(number).astype(float), rng)) for number in rows]
                print(row(kind, rows, [*map(known.localize, changed)]), flush=True)


def add_arguments(parser: Parser) -> None:
    """Declare the command line."""
    parser.add_argument("drives", nargs="+", metavar="NAME=DATABASE:QUERIES", help="drives")
    parser.add_argument("--features", default="aliked", help="of system=mfvpr: aliked or sift")
    parser.set_defaults(run="experiments.unusable:run")


if __name__ == "__main__":
    run_command("python -m experiments.unusable", str(__doc__), add_arguments)
