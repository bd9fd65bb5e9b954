"""Networks of torch, and modules in place of those that public code imports, for the programs of this folder."""

import sys
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
