"""Makes dinov2.npz: what DINOv2's code gives with random weights, in float64.

`python -m tests.golden dinov2 CLONE` with a clone of https://github.com/facebookresearch/dinov2.
"""

from collections.abc import Iterator

import numpy as np

from tests.golden.make_netvlad import name, normalized, samples
from tests.golden.torch_networks import fill, vision_transformer
from tests.random_checkpoints import dinov2_shapes, random_checkpoint

WIDTH, HEADS = 64, 4
# Blocks, registers, image size (width, height), index of the block, seed.
CASES = (
    (3, 0, (98, 56), -2, 0),
    (3, 0, (98, 56), -1, 0),
    (2, 4, (42, 70), 0, 1),
    (2, 0, (518, 518), -2, 2),
    (1, 0, (14, 14), -1, 3),
)


def main(_: str) -> dict[str, np.ndarray]:
    import torch

    with torch.inference_mode():
        golden = dict(_outputs())
    return {key: array.astype(np.float32) for key, array in golden.items()}


def _outputs() -> Iterator[tuple[str, np.ndarray]]:
    """Class tokens, patch tokens, queries, keys, values, and attention of the class token to the patches by head."""
    import torch

    for case in CASES:
        depth, registers, size, index, seed = case
        public = vision_transformer("dinov2.layers", "dinov2.models.vision_transformer", WIDTH, depth, HEADS, registers)
        model = fill(public, random_checkpoint(dinov2_shapes(WIDTH, depth, registers), seed))
        projected = []
        model.blocks[index].attn.qkv.register_forward_hook(lambda *call, into=projected: into.append(call[-1]))
        images, key = normalized(size), name(*case[:2], *size, index, seed)
        yield f"{key}/class", model.double()(images).numpy()[0]
        [tokens] = model.get_intermediate_layers(images, [index % depth])
        yield f"{key}/token", samples(tokens.numpy())
        first = 1 + registers
        for facet, values in zip(("query", "key", "value"), projected[0].split(WIDTH, dim=2), strict=True):
            yield f"{key}/{facet}", samples(values[:, first:].numpy())
        queries, keys = (
            values.reshape(-1, HEADS, WIDTH // HEADS).transpose(0, 1)
            for values in projected[0][0].split(WIDTH, dim=1)[:2]
        )
        identity = torch.eye(queries.shape[1], dtype=queries.dtype).expand(HEADS, -1, -1)
        attention = torch.nn.functional.scaled_dot_product_attention(queries, keys, identity)
        yield f"{key}/attention", attention[:, 0, first:].mean(dim=0).numpy()
