"""Convert the tensors of published checkpoints to the parameters of our networks, by one table of names per network.

The conversion is strict: each key is used once or listed as ignored, each parameter is set once, and all types and
shapes are checked.
"""

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mfvpr.io.containers import shorten
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import read_yaml

# Axes of the source in our order, by their number: OIHW -> HWIO; (out, in) -> (in, out), also of 1 x 1 convolutions.
_OF_KERNELS = {4: (2, 3, 1, 0), 2: (1, 0)}
_PARAMETERS = {  # name in the checkpoint -> in our modules, the first one that the module has
    "weight": ("kernel", "scale"),
    "weights": ("kernel",),
    "bias": ("bias",),
    "running_mean": ("mean",),
    "running_var": ("var",),
    "0": ("kernel",),  # MATLAB's cells
    "1": ("bias",),
}


@dataclass(frozen=True)
class Table:
    """Names of a network's checkpoint, by regular expressions that match in full.

    Attributes:
        names: modules, or whole keys -> our dotted paths, with the groups of the expression.
        ignored: keys that the network does not need -> their shapes if these identify the checkpoint, or None.
        axes: our paths -> order of the source's axes; by default, kernels have PyTorch's layout.
        changes: our paths -> function of the tensor, before its axes are ordered.
    """

    names: Mapping[str, str]
    ignored: Mapping[str, tuple[int, ...] | None] = field(default_factory=dict)
    axes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    changes: Mapping[str, Callable[[np.ndarray], np.ndarray]] = field(default_factory=dict)

    def path_of(self, key: str, paths: Collection[str]) -> str:
        """The one of these paths that a key of the checkpoint sets; "" if there is none."""
        module, _, name = key.rpartition(".")
        forms = [(key, ""), *((module, f".{parameter}") for parameter in _PARAMETERS.get(name, ()))]
        for pattern, target in self.names.items():
            for form, ending in forms:
                if (match := re.fullmatch(pattern, form)) and (path := match.expand(target) + ending) in paths:
                    return path
        return ""

    def axes_of(self, path: str, num_axes: int) -> tuple[int, ...]:
        """Axes of the source in the order of the parameter's; () = they have the same order."""
        for pattern, axes in self.axes.items():
            if re.fullmatch(pattern, path):
                return axes
        return _OF_KERNELS[num_axes] if path.endswith(".kernel") else ()


def convert(
    source: Mapping[str, np.ndarray], table: Table, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """Convert a checkpoint's tensors to parameters by dotted path, float32 (float64 is rounded).

    `source` has the tensors by their keys, `shapes` those of the network's parameters by dotted path.

    Raises:
        InputError: keys are missing or unknown, or a tensor has another shape or type.
    """
    parameters: dict[str, np.ndarray] = {}
    problems: list[str] = []
    for key, value in source.items():
        ignored = [shape for pattern, shape in table.ignored.items() if re.fullmatch(pattern, key)]
        if ignored or key.endswith(".num_batches_tracked"):
            if any(shape not in (None, value.shape) for shape in ignored):
                problems.append(f"{key} of another shape: expected {ignored[0]}, got {value.shape}")
            continue
        path = table.path_of(key, shapes)
        if not path or path in parameters:
            problems.append(f"{shorten(key)} {'twice' if path else 'unknown'}")
            continue
        parameters[path], problem = _convert_tensor(value, table, path, shapes[path])
        problems += [f"{key} {problem}"] if problem else []
    problems += [f"{path} missing" for path in shapes if path not in parameters]
    if problems:
        raise InputError(f"keys do not fit the network in {len(problems)} places: {'; '.join(problems[:3])}")
    return parameters


def _convert_tensor(value: np.ndarray, table: Table, path: str, shape: tuple[int, ...]) -> tuple[np.ndarray, str]:
    """The parameter of this shape, and what does not fit in a tensor; axes of length 1 do not count."""
    if value.dtype not in (np.float32, np.float64):
        return value, f"of another type: expected float32 or float64, got {value.dtype}"
    try:
        ordered = table.changes.get(path, np.asarray)(value)
        if axes := table.axes_of(path, len(shape)):
            ordered = ordered.reshape(ordered.shape[: len(axes)]).transpose(axes)
        if [side for side in ordered.shape if side != 1] == [side for side in shape if side != 1]:
            return np.array(ordered, np.float32, order="C").reshape(shape), ""
    except (ValueError, IndexError):  # another number of axes
        pass
    return value, f"of another shape: {value.shape} does not give {shape}"


RUNTIME = Table({"(.*)": r"\1"}, axes={".*": ()})  # runtime files have the networks' paths and layouts
_CHANGES = {"negative": np.negative, "first_pixel": lambda image: image[0, 0]}


def _tables() -> Iterator[tuple[str, Table]]:
    """The tables of keys.yaml, which says what its values are, by name."""
    content = read_yaml(Path(__file__).with_name("keys.yaml"))
    for name, about in content["tables"].items():
        names = dict[str, str]()
        for pattern, target in about["names"].items():
            if isinstance(target, str):
                names[pattern] = target
                continue
            [(layers, path)] = target.items()
            for key, layer in content["layers"][layers].items():
                names[pattern.replace("{}", key)] = path.replace("{}", layer)
        ignored = {key: shape and tuple(shape) for key, shape in about.get("ignored", {}).items()}
        axes = {path: tuple(order) for path, order in about.get("axes", {}).items()}
        changes = {path: _CHANGES[change] for path, change in about.get("changes", {}).items()}
        yield name, Table(names, ignored, axes, changes)


TABLES = dict(_tables())  # by name
