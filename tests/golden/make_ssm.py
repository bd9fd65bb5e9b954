"""Inputs of ssm.npz: made-up maps and images that SSM-VPR's program has seen, see README.md."""

import numpy as np

DATABASE, QUERIES, CANDIDATES = 5, 4, 4
MAPS = {"maps0": 0, "maps1": 1, "maps2": 2}  # seeds, by case
IMAGES = {"images224": (1, 224, 5, 4), "images336": (0, 336, 2, 1)}  # seed, px of the second stage, database, queries
SIDES, CHANNELS = (14, 12), 16  # of made-up maps, of both stages
DIMENSIONS = (12, 10)


def made_up_map(seed: int, stage: int, row: int, query: bool) -> np.ndarray:
    """`[side, side, CHANNELS]` float32: few patterns of falling strength; queries show database images, moved."""
    side = SIDES[stage - 1]
    basis = np.random.default_rng([seed, stage]).normal(size=(CHANNELS + 1, CHANNELS))
    shown = np.random.default_rng([seed, stage, row]).normal(size=(side, side, CHANNELS))
    if query:
        noise = np.random.default_rng([seed, stage, row, 1]).normal(size=shown.shape)
        shown = 0.8 * np.roll(shown, (1, 1 - row), axis=(0, 1)) + 0.6 * noise
    return ((shown * 0.85 ** np.arange(CHANNELS)) @ basis[1:] + basis[0]).astype(np.float32)


def picture(row: int, query: bool) -> np.ndarray:
    """`[72, 96, 3]` uint8 by integer arithmetic; queries show database images, brighter and moved by 6 px."""
    y, x, channel = np.indices((72, 96, 3))
    if query:
        x = x + 6
    circles = (y - 20 - 9 * row) ** 2 + (x - 70 + 11 * row) ** 2
    stripes = 37 * ((y // (5 + row) + x // (9 - row)) % 4) + (x * y * (row + 2)) // (90 + 30 * channel)
    return ((stripes + 80 * (circles < 300) + 20 * query) % 256).astype(np.uint8)
