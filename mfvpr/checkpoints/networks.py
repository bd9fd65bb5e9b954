"""Networks of the published files, and their blueprints, which take the weights."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mfvpr.checkpoints.conversion import Rule, Table, convert, known_share
from mfvpr.checkpoints.registry import REGISTRY, Entry
from mfvpr.checkpoints.tables import (
    ALIKED,
    D2NET,
    DINOV2,
    GEM_RESNET50,
    GEM_VGG16,
    LIGHTGLUE,
    MIXVPR,
    NETVLAD,
    NETVLAD_MATLAB,
    SELAVPR,
    SSM,
)
from mfvpr.io.formats.pickles import excerpt

if TYPE_CHECKING:
    from flax import nnx

    from mfvpr.networks.gem import Backbone

_RUNTIME = Table((Rule("(.*)", r"\1"),))  # runtime files have the networks' paths


class Network(NamedTuple):
    """A network of the package, and the table of its published checkpoints."""

    builder: Callable[[], Callable[..., "nnx.Module"]]  # imports the model, returns its constructor
    table: Table


def _d2net() -> Callable[..., "nnx.Module"]:
    from mfvpr.networks.d2net import D2Net

    return D2Net


def _mixvpr(out_channels: int, out_rows: int) -> Callable[..., "nnx.Module"]:
    from mfvpr.networks.mixvpr import MixVPR

    return partial(MixVPR, out_channels=out_channels, out_rows=out_rows)


def _ssm() -> Callable[..., "nnx.Module"]:
    from mfvpr.networks.ssm import SsmVgg

    return SsmVgg


def _aliked(variant: str) -> Callable[..., "nnx.Module"]:
    from mfvpr.networks.aliked import Aliked

    return partial(Aliked, variant)


def _lightglue() -> Callable[..., "nnx.Module"]:
    from mfvpr.networks.lightglue import LightGlue

    return LightGlue


def _netvlad(clusters: int, outputs: int | None, original: bool = False) -> Callable[..., "nnx.Module"]:
    from mfvpr.networks.netvlad import VggNetVlad

    return partial(VggNetVlad, clusters, outputs, original=original)


def _gem(backbone: "Backbone", outputs: int) -> Callable[..., "nnx.Module"]:
    from mfvpr.networks.gem import Gem

    return partial(Gem, backbone, outputs)


def _dinov2(width: int, depth: int, heads: int) -> Callable[..., "nnx.Module"]:
    from mfvpr.networks.vit import VisionTransformer

    return partial(VisionTransformer, width, depth, heads)


def _selavpr(registers: int) -> Callable[..., "nnx.Module"]:
    from mfvpr.networks.selavpr import SelaVpr

    return partial(SelaVpr, registers=registers)


_ALIKED = ("aliked-t16", "aliked-n16", "aliked-n16rot", "aliked-n32")

_LIKELY_SHARE = 0.5  # of keys that a table knows, if the checkpoint is its network's
_MAX_PREFIX = 4  # parts between dots

# Names in the registry -> networks.
NETWORKS: dict[str, Network] = {
    **{name: Network(_d2net, D2NET) for name in ("d2_tf", "d2_ots", "d2_tf_no_phototourism")},
    "mixvpr_4096": Network(partial(_mixvpr, 1024, 4), MIXVPR),
    "mixvpr_512": Network(partial(_mixvpr, 256, 2), MIXVPR),
    "mixvpr_128": Network(partial(_mixvpr, 64, 2), MIXVPR),
    "vgg16_places365": Network(_ssm, SSM),
    **{name: Network(partial(_aliked, name), ALIKED) for name in _ALIKED},
    "aliked_lightglue": Network(_lightglue, LIGHTGLUE),
    "netvlad_pitts30k": Network(partial(_netvlad, 64, 4096, original=True), NETVLAD_MATLAB),
    "netvlad_tokyotm": Network(partial(_netvlad, 64, 4096, original=True), NETVLAD_MATLAB),
    "netvlad_pytorch": Network(partial(_netvlad, 64, None), NETVLAD),
    **{
        f"patchnetvlad_{training}_{outputs}": Network(partial(_netvlad, clusters, outputs), NETVLAD)
        for training, clusters in (("mapillary", 16), ("pitts", 64), ("landmarks", 64))
        for outputs in ((4096,) if training == "landmarks" else (128, 512, 4096))
    },
    "cosplace_vgg16_512": Network(partial(_gem, "vgg16", 512), GEM_VGG16),
    **{
        f"cosplace_resnet50_{outputs}": Network(partial(_gem, "resnet50", outputs), GEM_RESNET50)
        for outputs in (512, 2048)
    },
    "dinov2_vits14": Network(partial(_dinov2, 384, 12, 6), DINOV2),
    "dinov2_vitb14": Network(partial(_dinov2, 768, 12, 12), DINOV2),
    "dinov2_vitl14": Network(partial(_dinov2, 1024, 24, 16), DINOV2),
    "selavpr_pitts30k": Network(partial(_selavpr, 0), SELAVPR),
    "selavpr_msls": Network(partial(_selavpr, 0), SELAVPR),
    "selavpr_msls_registers": Network(partial(_selavpr, 4), SELAVPR),
}


@dataclass(frozen=True)
class Blueprint:
    """A network without values, made without computing any."""

    shapes: Mapping[str, tuple[int, ...]]  # by dotted path; parameters and running statistics
    parameters: int  # without running statistics
    _graph: Any
    _state: Any

    def filled(self, arrays: Mapping[str, np.ndarray]) -> "nnx.Module":
        """Build the network with these values, in evaluation mode.

        Raises:
            InputError: a path is missing or unknown, or a shape differs.
        """
        import jax
        from flax import nnx

        arrays = convert(arrays, _RUNTIME, self.shapes)
        state = jax.tree.map(lambda leaf: leaf, self._state)  # a copy, which the next line changes
        nnx.replace_by_pure_dict(state, _nest({path: jax.numpy.asarray(array) for path, array in arrays.items()}))
        module = nnx.merge(self._graph, state)
        module.eval()
        return module


def network_of(entry: Entry) -> Network:
    """Network of an entry."""
    return NETWORKS[entry.name]


def resemblance(keys: Sequence[str], expected: Network) -> str | None:
    """Reason why keys do not fit: they are another network's, or have a prefix; None = neither."""
    if known_share(keys, expected.table) > _LIKELY_SHARE:
        return None
    for name, network in NETWORKS.items():
        if network.table is not expected.table and known_share(keys, network.table) > _LIKELY_SHARE:
            return f"expected the keys of another network, got those of {REGISTRY[name].network}"
    *parts, _ = keys[0].split(".", maxsplit=_MAX_PREFIX)
    for prefix in accumulate(f"{part}." for part in parts):
        if known_share([key.removeprefix(prefix) for key in keys], expected.table) > _LIKELY_SHARE:
            return f"its keys begin with {excerpt(prefix)}, which the official file's do not"
    return None


def blueprint(entry: Entry) -> Blueprint:
    """Blueprint of the entry's network."""
    return planned(network_of(entry).builder())  # imports before tracing, which would trace the module's constants


def planned(build: Callable[..., "nnx.Module"]) -> Blueprint:
    """Blueprint of the network that `build(rngs=...)` makes."""
    import jax
    from flax import nnx

    with jax.numpy_dtype_promotion("standard"):  # Flax's initializers mix types
        module = nnx.eval_shape(lambda: build(rngs=nnx.Rngs(0)))
    graph, state = nnx.split(module)
    shapes = {path: leaf.shape for path, leaf in _leaves(nnx.to_pure_dict(state), "")}
    trained = _leaves(nnx.to_pure_dict(nnx.state(module, nnx.Param)), "")
    return Blueprint(shapes, sum(math.prod(leaf.shape) for _, leaf in trained), graph, state)


def _leaves(tree: Mapping[Any, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _nest(flat: Mapping[str, Any]) -> dict[Any, Any]:
    """Nested dictionaries of values by dotted path; digits are positions in a list."""
    tree: dict[Any, Any] = {}
    for path, value in flat.items():
        *parents, last = (int(part) if part.isdigit() else part for part in path.split("."))
        node = tree
        for part in parents:
            node = node.setdefault(part, {})
        node[last] = value
    return tree
