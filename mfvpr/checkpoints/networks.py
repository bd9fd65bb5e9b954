"""Networks of the published files, and their blueprints, which take the weights."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mfvpr.checkpoints import tables
from mfvpr.checkpoints.conversion import Rule, Table, convert
from mfvpr.checkpoints.registry import Entry

if TYPE_CHECKING:
    from flax import nnx

RUNTIME = Table((Rule("(.*)", r"\1"),))  # runtime files have the networks' paths


class Network(NamedTuple):
    """A network of the package, and the table of its published checkpoints."""

    builder: Callable[[], Callable[..., "nnx.Module"]]  # imports the model, returns its constructor
    table: Table


def _network(table: Table, name: str, *arguments: Any, **options: Any) -> Network:
    def builder() -> Callable[..., "nnx.Module"]:
        from mfvpr import networks

        return partial(getattr(networks, name), *arguments, **options)

    return Network(builder, table)


_ALIKED = ("aliked-t16", "aliked-n16", "aliked-n16rot", "aliked-n32")

# Names in the registry -> networks.
NETWORKS: dict[str, Network] = {
    **{name: _network(tables.D2NET, "D2Net") for name in ("d2_tf", "d2_ots", "d2_tf_no_phototourism")},
    "mixvpr_4096": _network(tables.MIXVPR, "MixVPR", out_channels=1024, out_rows=4),
    "mixvpr_512": _network(tables.MIXVPR, "MixVPR", out_channels=256, out_rows=2),
    "mixvpr_128": _network(tables.MIXVPR, "MixVPR", out_channels=64, out_rows=2),
    "vgg16_places365": _network(tables.SSM, "SsmVgg"),
    **{name: _network(tables.ALIKED, "Aliked", name) for name in _ALIKED},
    "aliked_lightglue": _network(tables.LIGHTGLUE, "LightGlue"),
    "netvlad_pitts30k": _network(tables.NETVLAD_MATLAB, "VggNetVlad", 64, 4096, original=True),
    "netvlad_tokyotm": _network(tables.NETVLAD_MATLAB, "VggNetVlad", 64, 4096, original=True),
    "netvlad_pytorch": _network(tables.NETVLAD, "VggNetVlad", 64, None),
    **{
        f"patchnetvlad_{training}_{outputs}": _network(tables.NETVLAD, "VggNetVlad", clusters, outputs)
        for training, clusters in (("mapillary", 16), ("pitts", 64), ("landmarks", 64))
        for outputs in ((4096,) if training == "landmarks" else (128, 512, 4096))
    },
    "cosplace_vgg16_512": _network(tables.GEM_VGG16, "Gem", "vgg16", 512),
    "cosplace_resnet50_512": _network(tables.GEM_RESNET50, "Gem", "resnet50", 512),
    "cosplace_resnet50_2048": _network(tables.GEM_RESNET50, "Gem", "resnet50", 2048),
    "dinov2_vits14": _network(tables.DINOV2, "VisionTransformer", 384, 12, 6),
    "dinov2_vitb14": _network(tables.DINOV2, "VisionTransformer", 768, 12, 12),
    "dinov2_vitl14": _network(tables.DINOV2, "VisionTransformer", 1024, 24, 16),
    "selavpr_pitts30k": _network(tables.SELAVPR, "SelaVpr", registers=0),
    "selavpr_msls": _network(tables.SELAVPR, "SelaVpr", registers=0),
    "selavpr_msls_registers": _network(tables.SELAVPR, "SelaVpr", registers=4),
}


@dataclass(frozen=True)
class Blueprint:
    """A network without values, made without computing any."""

    shapes: Mapping[str, tuple[int, ...]]  # by dotted path; parameters and running statistics
    parameters: int  # without running statistics
    _graph: Any
    _state: Any

    def build(self, arrays: Mapping[str, np.ndarray]) -> "nnx.Module":
        """Build the network with these values, in evaluation mode; InputError if paths or shapes differ."""
        import jax
        from flax import nnx

        arrays = jax.device_put(convert(arrays, RUNTIME, self.shapes))
        leaves = [(keys, leaf.replace(arrays[_path(keys)])) for keys, leaf in nnx.to_flat_state(self._state)]
        module = nnx.merge(self._graph, nnx.from_flat_state(leaves))
        module.eval()
        return module


def blueprint(entry: Entry) -> Blueprint:
    """Blueprint of the entry's network."""
    build = NETWORKS[entry.like or entry.name].builder()  # imports first: tracing would trace the module's constants
    return plan_network(build)


def plan_network(build: Callable[..., "nnx.Module"]) -> Blueprint:
    """Blueprint of the network that `build(rngs=...)` makes."""
    import jax
    from flax import nnx

    with jax.numpy_dtype_promotion("standard"):  # Flax's initializers mix types
        module = nnx.eval_shape(lambda: build(rngs=nnx.Rngs(0)))
    graph, state = nnx.split(module)
    shapes = {_path(keys): leaf.shape for keys, leaf in nnx.to_flat_state(state)}
    parameters = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(nnx.state(module, nnx.Param)))
    return Blueprint(shapes, parameters, graph, state)


def _path(keys: Sequence[Any]) -> str:
    """Dotted path of names of attributes and positions in lists."""
    return ".".join(map(str, keys))
