"""Makes mixvpr.npz: what the public code computes with random weights. `python -m tests.golden mixvpr CLONE`

CLONE is a clone of https://github.com/amaralibey/MixVPR, whose aggregator is run, on top of a ResNet-50 in plain torch;
both in float64, so that the file holds no rounding errors but its own.
"""

from collections.abc import Mapping

import numpy as np

from tests.golden.make_netvlad import samples
from tests.random_checkpoints import mixvpr_shapes, random_checkpoint

SIZES = ((1024, 4), (256, 2), (64, 2))  # channels and rows of the published networks


def images() -> np.ndarray:
    """`[2, 320, 320, 3]` uint8: stripes, circles and steps, by integer arithmetic alone."""
    row, column, channel = np.indices((320, 320, 3))
    circles = (row - 90) ** 2 + (column - 200) ** 2
    first = circles // (150 + 60 * channel) + 40 * ((row // 32 + column // 24) % 3)
    second = row * column // (70 + 11 * channel) + 5 * (row % 7) + 90 * (circles < 4900)
    return (np.stack([first, second]) % 256).astype(np.uint8)


def faint_maps() -> np.ndarray:
    """`[1, 20, 20, 1024]` float32: maps of so little contrast that the epsilon of a normalization shows."""
    row, column, channel = np.indices((20, 20, 1024))
    return ((row * (channel % 13 + 1) + column * (channel % 7 + 2)) % 17).astype(np.float32)[None] / 8192


def main(_: str) -> dict[str, np.ndarray]:
    import torch

    golden = {}
    with torch.inference_mode():
        for channels, rows in SIZES:
            checkpoint = random_checkpoint(mixvpr_shapes(channels, rows))
            golden |= _computed(channels, rows, {key: torch.tensor(array) for key, array in checkpoint.items()})
    return {name: array.astype(np.float32) for name, array in golden.items()}


def _computed(channels: int, rows: int, checkpoint: Mapping) -> dict[str, np.ndarray]:
    import torch
    from models.aggregators.mixvpr import MixVPR as Aggregator

    from experiments.benchmark.torch_networks import resnet

    aggregator = Aggregator(in_channels=1024, in_h=20, in_w=20, out_channels=channels, mix_depth=4, out_rows=rows)
    prefix = "aggregator."
    aggregator.load_state_dict({key.removeprefix(prefix): checkpoint[key] for key in checkpoint if prefix in key})
    aggregator.double().eval()
    pixels = torch.from_numpy(images()).double().permute(0, 3, 1, 2)
    maps = resnet(lambda key: checkpoint[key].double(), pixels)
    faint = torch.from_numpy(faint_maps()).double().permute(0, 3, 1, 2)
    width = channels * rows
    golden = {f"{width}/descriptors": aggregator(maps), f"{width}/faint": aggregator(faint)}
    if channels == SIZES[0][0]:
        mixed = maps.flatten(2)
        golden |= {"backbone": samples(maps.permute(0, 2, 3, 1).numpy()), "backbone/means": maps.mean((2, 3))}
        for place, mixer in enumerate(aggregator.mix):
            mixed = mixer(mixed)
            golden[f"mixer{place}"] = samples(mixed.numpy())
    return {name: np.asarray(array) for name, array in golden.items()}
