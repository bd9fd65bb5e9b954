"""Networks of torch, and modules in place of those that public code imports, for the programs of this folder."""

import sys
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np


def fill(network: Any, checkpoint: dict[str, np.ndarray]) -> Any:
    """The network with these weights, in evaluation mode."""
    import torch

    network.load_state_dict({name: torch.from_numpy(np.array(tensor)) for name, tensor in checkpoint.items()})
    return network.eval()


def replace_module(name: str, **members: Any) -> ModuleType:
    """A module with these members, which `import` gives from now on."""
    sys.modules[name] = module = ModuleType(name)
    vars(module).update(members)
    return module


def vision_transformer(layers: str, network: str, width: int, depth: int, heads: int, registers: int) -> Any:
    """DINOv2's transformer for 518 px, of the classes in two modules of public code."""
    block, attention = (getattr(import_module(layers), name) for name in ("NestedTensorBlock", "MemEffAttention"))
    options = {"img_size": 518, "patch_size": 14, "mlp_ratio": 4, "init_values": 1, "block_chunks": 0}
    options |= {"embed_dim": width, "depth": depth, "num_heads": heads, "num_register_tokens": registers}
    return import_module(network).DinoVisionTransformer(**options, block_fn=partial(block, attn_class=attention))
