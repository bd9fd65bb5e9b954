"""Learned match weight, a small network with measurements of one match as inputs; its files, and weights by name.

The file of a learned weight is JSON with its provenance.
"""

import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import field, fields
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import WEIGHTS, Weight, match_ratio
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file, require_replaceable, write_text
from mfvpr.utils.numerics import as_float, masked, masked_median

RELATIVE = ("ratio", "distance_rank", "relative_distance", "score0_rank", "score1_rank")
ABSOLUTE = ("scores0", "scores1", "distance", "ratio", "x0", "y0", "x1", "y1")
SUFFIX = ".json"
_FORMAT = "mfvpr match weight 1"
_LEARNED = {path.stem: path for path in sorted((Path(__file__).parent / "learned").glob(f"*{SUFFIX}"))}
WORDS = (*WEIGHTS, *_LEARNED)
"""Words for weights: the fixed ones, then those that this library learned."""


@value
class LearnedWeight:
    """Learned match weight w = softplus(z), z = v . tanh(x M + b) + c, above 0, without unit.

    x are the standardized inputs of a match. `center` and `scale` are statistics without gradient; exclude them from
    weight decay with `optax.masked`. The input `ratio` raises an InputError for matches without a ratio.

    `names` are some of `INPUTS`. RELATIVE inputs compare a match with the other matches of its pair, so that they carry
    over to other detectors, cameras and places; ABSOLUTE inputs have their units.
    """

    center: Float[Array, " inputs"]  # mean
    scale: Float[Array, " inputs"]  # standard deviation
    hidden: Float[Array, "inputs hidden"]  # M
    hidden_bias: Float[Array, " hidden"]  # b
    output: Float[Array, " hidden"]  # v
    output_bias: Float[Array, ""]  # c
    names: tuple[str, ...] = field(default=RELATIVE, metadata={"static": True})

    @classmethod
    def create(
        cls, key: Array, matches: Matches, hidden: int = 16, *, names: tuple[str, ...] = RELATIVE
    ) -> "LearnedWeight":
        """Weight that is 1 for every match, with `hidden` units and the statistics of the real matches `[..., K]`.

        Without a real match, inputs are not standardized.
        """
        if not names or isinstance(names, str) or len({*names} & {*INPUTS}) < len(names):
            raise InputError(f"LearnedWeight: expected different names of {', '.join(INPUTS)}, got {names}")
        names = (*names,)
        raw = np.asarray(jax.jit(_raw_inputs, static_argnums=1)(matches, names), np.float64)
        real = raw[np.asarray(matches.mask)]
        shape = (len(names), hidden)
        center, deviation = (real.mean(axis=0), real.std(axis=0)) if len(real) else np.zeros((2, shape[0]))
        varies = deviation > 1e-5 * np.abs(center)  # a constant input deviates by rounding alone
        return cls(
            center=jnp.asarray(center, dtype=float),
            scale=jnp.asarray(np.where(varies, deviation, 1.0), dtype=float),
            hidden=jax.random.normal(key, shape, dtype=float) / shape[0] ** 0.5,
            hidden_bias=jnp.zeros(hidden),
            output=jnp.zeros(hidden),
            output_bias=jnp.asarray(math.log(math.e - 1), dtype=float),  # softplus is 1
            names=names,
        )

    def __call__(self, matches: Matches) -> Float[jax.Array, " slots"]:
        """Weights of one pair; finite on padding."""
        weights = jax.nn.softplus(self.logits(matches))
        return jnp.maximum(weights, jnp.finfo(weights.dtype).tiny)  # softplus may underflow

    def logits(self, matches: Matches) -> Float[jax.Array, " slots"]:
        """z of one pair: log-odds that a match is correct, if the training taught this."""
        exact = jax.lax.Precision.HIGHEST
        hidden = jnp.tanh(jnp.matmul(self.inputs(matches), self.hidden, precision=exact) + self.hidden_bias[None])
        return jnp.matmul(hidden, self.output, precision=exact) + self.output_bias

    def inputs(self, matches: Matches) -> Float[jax.Array, "slots inputs"]:
        """Standardized inputs of every match; `center + scale * inputs` undoes the standardization."""
        center, scale = jax.lax.stop_gradient((jnp.asarray(self.center), jnp.asarray(self.scale)))
        return (_raw_inputs(matches, self.names) - center[None]) / scale[None]


def _raw_inputs(matches: Matches, names: tuple[str, ...]) -> Float[Array, "*batch slots inputs"]:
    columns = [masked(jnp.broadcast_to(INPUTS[name](matches), matches.mask.shape), matches.mask) for name in names]
    return jnp.stack(columns, axis=-1)


def _rank(name: str, matches: Matches) -> Array:
    """Share of the pair's matches with a smaller value, in (0, 1); equal values count half."""

    def of_pair(values: Float[Array, " slots"], mask: Bool[Array, " slots"]) -> Float[Array, " slots"]:
        ordered = jnp.sort(masked(values, mask, jnp.inf))
        below, up_to = (jnp.searchsorted(ordered, values, side=side) for side in ("left", "right"))
        return (below + up_to).astype(values.dtype) / (2 * jnp.maximum(jnp.sum(mask), 1)).astype(values.dtype)

    values = masked(as_float(getattr(matches, name)), matches.mask)
    return jax.lax.stop_gradient(jnp.vectorize(of_pair, signature="(k),(k)->(k)")(values, matches.mask))


def _relative_distance(matches: Matches) -> Array:
    """Distance over the median distance of the pair."""
    distance = masked(as_float(matches.distance), matches.mask)
    median = jnp.vectorize(masked_median, signature="(k),(k)->()")(distance, matches.mask)[..., None]
    return distance / jnp.where(median > 0, median, 1.0)


def _coordinate(side: int, axis: int, matches: Matches) -> Array:
    """Coordinate relative to the center of the image, in units of half its size."""
    points, size = getattr(matches, f"points{side}"), getattr(matches, f"image_size{side}")
    half = jnp.broadcast_to(as_float(size)[..., None, axis] / 2, matches.mask.shape)
    half = masked(half, matches.mask, 1.0)  # the image of a padded pair may have any size
    return masked(as_float(points)[..., axis], matches.mask, half) / half - 1


INPUTS: Mapping[str, Callable[[Matches], Any]] = {
    "ratio": match_ratio,
    "distance_rank": partial(_rank, "distance"),
    "relative_distance": _relative_distance,
    "score0_rank": partial(_rank, "scores0"),
    "score1_rank": partial(_rank, "scores1"),
    "scores0": lambda matches: as_float(matches.scores0),
    "scores1": lambda matches: as_float(matches.scores1),
    "distance": lambda matches: as_float(matches.distance),
    "x0": partial(_coordinate, 0, 0),
    "y0": partial(_coordinate, 0, 1),
    "x1": partial(_coordinate, 1, 0),
    "y1": partial(_coordinate, 1, 1),
}
"""Inputs of a learned weight, `[..., K]`, by name; their values on padding are arbitrary."""


def write_weight(path: Path | str, weight: LearnedWeight, provenance: Mapping[str, Any]) -> None:
    """Write a weight of finite numbers as JSON, exact to the last bit, with its provenance (JSON values).

    An earlier file of a weight is replaced; an InputError for other files.
    """
    require_replaceable(Path(path), _FORMAT.encode())
    arrays = {f.name: np.asarray(getattr(weight, f.name)).tolist() for f in fields(weight) if f.name != "names"}
    content = {"format": _FORMAT, "made": provenance, "inputs": list(weight.names), **arrays}
    write_text(Path(path), json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_weight(path: Path | str) -> tuple[LearnedWeight, dict[str, Any]]:
    """Weight and provenance from a file of `write_weight`, exact to the last bit; an InputError for other files."""
    path = Path(path)
    require_file(path, "a match weight that mfvpr learn wrote")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        names = (*content["inputs"],)
        arrays = {f.name: jnp.asarray(content[f.name], float) for f in fields(LearnedWeight) if f.name != "names"}
        inputs, hidden = len(names), arrays["output"].size
        shapes = [(inputs,), (inputs,), (inputs, hidden), (hidden,), (hidden,), ()]
        if content["format"] != _FORMAT or not {*names} <= {*INPUTS} or [a.shape for a in arrays.values()] != shapes:
            raise ValueError("it has another format")
        if not all(jnp.isfinite(each).all() for each in arrays.values()) or not (arrays["scale"] > 0).all():
            raise ValueError("its numbers are not finite, or a scale is not above 0")
        return LearnedWeight(**arrays, names=names), dict(content["made"])
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path}: expected a match weight of mfvpr learn ({error}); learn it again") from error


def named_weight(weight: Weight | str) -> Weight:
    """The weight that a word, or the path of a file that `mfvpr learn` wrote, stands for; other weights as they are."""
    if not isinstance(weight, str):
        return weight
    return WEIGHTS[weight] if weight in WEIGHTS else _read_by_name(weight)[0]


def provenance(name: str) -> dict[str, Any]:
    """Provenance of a learned weight, as `write_weight` stored it; empty for a fixed weight."""
    return {} if name in WEIGHTS else _read_by_name(name)[1]


def _read_by_name(name: str) -> tuple[Weight, dict[str, Any]]:
    path = _LEARNED.get(name, Path(os.path.expanduser(name)))
    if path.suffix != SUFFIX:
        raise InputError(f"weight={name!r}: expected one of {', '.join(WORDS)}, or FILE{SUFFIX}")
    return _read(path, path.stat().st_mtime_ns if path.exists() else 0)


@cache
def _read(path: Path, modified_ns: int) -> tuple[Weight, dict[str, Any]]:
    """Contents of a file; `modified_ns` makes a modified file a new entry of the cache."""
    return read_weight(path)
