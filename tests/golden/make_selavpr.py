"""Makes selavpr.npz: what SelaVPR's code gives with random weights, in float64.

`python -m tests.golden selavpr CLONE` with a clone of https://github.com/Lu-Feng/SelaVPR.
"""

import types
from collections.abc import Iterator
from functools import partial

import numpy as np

from tests.golden.make_netvlad import name, normalized, samples
from tests.golden.torch_networks import fill, vision_transformer
from tests.random_checkpoints import dinov2_shapes, random_checkpoint, selavpr_shapes

SIZE = (224, 224)
# Whole networks of the published width, which the code fixes, with few blocks: blocks, registers, seed.
NETWORKS = ((2, 0, 0), (2, 0, 1), (1, 4, 2))
WIDTH = 64
# Narrow backbones: blocks, registers, whether adapted, image size (width, height), seed.
BACKBONES = (
    (3, 0, True, (224, 224), 3),
    (2, 4, True, (70, 42), 4),
    (2, 0, False, (42, 98), 5),
    (1, 0, False, (518, 518), 6),
    (2, 0, False, (28, 14), 7),
)
# Maps that are matched: side, candidates, seed; one position has exactly one match.
MATCHES = ((61, 4, 8), (9, 12, 9), (1, 2, 10))
_transformer = partial(vision_transformer, "backbone.dinov2", "backbone.vision_transformer")


def maps(side: int, candidates: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Local maps of unit length, `[side, side, 128]` of a query and `[C, side, side, 128]`, alike more and more."""
    rng = np.random.default_rng(seed)
    query, similar = rng.normal(size=(side, side, 128)), rng.normal(size=(candidates, side, side, 128))
    share = np.linspace(0, 0.9, candidates)[:, None, None, None]
    similar = share * query.reshape(-1, 128)[rng.permutation(side**2)].reshape(query.shape) + (1 - share) * similar
    query, similar = (values / np.linalg.norm(values, axis=-1, keepdims=True) for values in (query, similar))
    return query.astype(np.float32), similar.astype(np.float32)


def main(_: str) -> dict[str, np.ndarray]:
    import torch

    torch.Tensor.cuda = lambda self: self  # pyright: ignore  (its scores ask for a GPU)
    with torch.inference_mode():
        golden = dict(_networks()) | dict(_backbones()) | dict(_scores())
    return {key: array.astype(np.float32) for key, array in golden.items()}


def _networks() -> Iterator[tuple[str, np.ndarray]]:
    """Both descriptors of an image."""
    import network  # pyright: ignore

    for depth, registers, seed in NETWORKS:
        network.get_backbone = lambda _, depth=depth, registers=registers: _transformer(1024, depth, 16, registers)
        checkpoint = random_checkpoint(selavpr_shapes(1024, depth, registers, prefix=""), seed)
        model = fill(network.GeoLocalizationNet(types.SimpleNamespace()), checkpoint)
        local, global_descriptor = model.double()(normalized(SIZE))
        case = name("network", depth, registers, seed)
        yield f"{case}/global", global_descriptor.numpy()[0]
        yield f"{case}/local", samples(local.numpy())
        yield f"{case}/means", local.numpy()[0].mean(axis=(0, 1))


def _backbones() -> Iterator[tuple[str, np.ndarray]]:
    """Normalized tokens; without adapters theirs add nothing."""
    for depth, registers, adapted, size, seed in BACKBONES:
        model = _transformer(WIDTH, depth, 4, registers)
        checkpoint = random_checkpoint(dinov2_shapes(WIDTH, depth, registers, adapted=adapted), seed)
        adapters = {key: value.shape for key, value in model.state_dict().items() if "adapter" in key}
        zeros = {key: np.zeros(shape, np.float32) for key, shape in adapters.items()}
        tokens = fill(model, zeros | checkpoint).double()(normalized(size))
        case = name("backbone", depth, registers, adapted, *size, seed)
        yield f"{case}/whole", tokens["x_norm_clstoken"].numpy()[0]
        yield f"{case}/maps", samples(tokens["x_norm_patchtokens"].numpy())


def _scores() -> Iterator[tuple[str, np.ndarray]]:
    """`[C]` of all candidates."""
    import torch
    from local_matching import local_sim  # pyright: ignore

    for case in MATCHES:
        query, candidates = (torch.from_numpy(values) for values in maps(*case))
        yield name("scores", *case), local_sim(query, candidates).numpy()
