"""A small network with one of everything, registered beside the published ones; runtime files go to a test's folder."""

from dataclasses import replace

import numpy as np
import pytest
from flax import nnx

from mfvpr.checkpoints import networks
from mfvpr.checkpoints.conversion import Table
from tests.needs import skip_without


class Tiny(nnx.Module):
    def __init__(self, rngs: nnx.Rngs) -> None:
        self.conv = nnx.Conv(3, 4, (3, 3), rngs=rngs)
        self.bn = nnx.BatchNorm(4, rngs=rngs)
        self.mix = nnx.List([nnx.Linear(4, 5, rngs=rngs), nnx.Linear(5, 2, rngs=rngs)])


TABLE = Table({r"net\.(conv|bn|mix\.\d)": r"\1"})
_BN = ("bias", "mean", "scale", "var")
SOURCE_SHAPES = {
    "net.conv.weight": (4, 3, 3, 3),
    "net.conv.bias": (4,),
    **{f"net.bn.{name}": (4,) for name in ("weight", "bias", "running_mean", "running_var")},
    "net.bn.num_batches_tracked": (),
    "net.mix.0.weight": (5, 4),
    "net.mix.0.bias": (5,),
    "net.mix.1.weight": (2, 5),
    "net.mix.1.bias": (2,),
}
SHAPES = {
    "conv.kernel": (3, 3, 3, 4),
    "conv.bias": (4,),
    **{f"bn.{name}": (4,) for name in _BN},
    "mix.0.kernel": (4, 5),
    "mix.0.bias": (5,),
    "mix.1.kernel": (5, 2),
    "mix.1.bias": (2,),
}
PARAMETERS = 157


def tiny_entry(name: str = "tiny", **changes: object) -> networks.Entry:
    source, licenses = (f"{name}.pth", "https://example.org/tiny.pth", None, None), ("MIT", "none stated")
    return replace(networks.Entry(name, "tiny", *source, *licenses, lambda: Tiny, TABLE), **changes)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Folder of the weights; `tiny` is registered, not installed."""
    monkeypatch.setenv("MFVPR_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setitem(networks.REGISTRY, "tiny", tiny_entry())
    return tmp_path / "weights"


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    return {path: rng.uniform(0.5, 1, shape).astype(np.float32) for path, shape in SHAPES.items()}


@pytest.fixture
def torch():
    skip_without("torch")
    import torch

    return torch
