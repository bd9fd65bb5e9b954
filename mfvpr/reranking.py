"""One query x C candidates: scores of all candidates, of whole parameter grids, their fusion, and the ranking.

Scorers know one pair; here is where `vmap` (over candidates) and `lax.map` (over the grid) are.
"""

import difflib
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.numerics import is_concrete, masked
from mfvpr.scoring import HistogramOfShifts, Scorer
from mfvpr.types import Array, Matches, Ranking


def score_candidates(scorer: Scorer, matches: Matches) -> Array:
    """Scores `[C]` of matches `[C, K, ...]`."""
    return jax.vmap(_fit(scorer, matches))(matches)


def score_grid(scorer: Any, matches: Matches, **axes: Sequence[float] | Array) -> Array:
    """Scores of every combination of parameter values, `[len(axis1), len(axis2), ..., C]`.

    The grid is one traced computation: other values cost no compilation, other lengths do.

    Args:
        scorer: the scorer whose other parameters stay.
        matches: `[C, K, ...]`.
        **axes: values of the scorer's numeric parameters, e.g. `sigma=[10., 22.5], bin_size=[10., 15.]`.

    Raises:
        ValueError: an axis is empty, not one-dimensional, or names no numeric parameter of the scorer.
    """
    if not axes:
        raise ValueError("score_grid: expected at least one axis, such as sigma=[10.0, 22.5]")
    values = [_axis(scorer, name, axis) for name, axis in axes.items()]
    lengths = [len(axis) for axis in values]
    points = [point.reshape(-1) for point in jnp.meshgrid(*values, indexing="ij")]
    settings = dict(zip(axes, points, strict=True))
    scorer = _fit(replace(scorer, **settings), matches)

    def one(setting: dict[str, Array]) -> Array:
        return score_candidates(replace(scorer, **setting), matches)

    return jax.lax.map(one, settings).reshape(*lengths, -1)


def combine(filter_scores: Array, rerank_scores: Array, *, c: float | Array = 1e6) -> Array:
    """s = c s_f + s_r (paper, section IV-E). `c` is in units of the re-ranking score; 1e6 suits D2-Net's."""
    return c * filter_scores + rerank_scores


def balancing_c(filter_scores: Array, rerank_scores: Array, mask: Array) -> Array:
    """The `c` `[]` that gives both scores the same spread over one query's candidates `[C]`.

    Not from the paper, whose c is a constant by hand; it serves detectors whose scores have other units.
    """

    def spread(scores: Array) -> Array:
        real = mask & jnp.isfinite(scores)
        return jnp.std(masked(scores, real), where=real)

    filter_spread = spread(filter_scores)
    c = spread(rerank_scores) / jnp.where(filter_spread > 0, filter_spread, 1.0)
    return jnp.where((filter_spread > 0) & jnp.isfinite(c), c, 0.0)


def rank(scores: Array, mask: Array | None = None, *, tie_break: Array | None = None) -> Array:
    """Positions `[..., C]` int32 in descending order of `scores` `[..., C]`.

    Stable: ties keep the given order, which is the filter's, or go by ascending `tie_break` `[..., C]`, such as the
    database index. NaN comes after every number, masked last.
    """
    present = jnp.ones(scores.shape, bool) if mask is None else mask
    number = present & ~jnp.isnan(scores)
    group = jnp.where(present, jnp.where(number, 0, 1), 2)
    keys = (-masked(scores, number), group) if tie_break is None else (tie_break, -masked(scores, number), group)
    return jnp.lexsort(keys, axis=-1).astype(jnp.int32)


def rerank(scores: Array, mask: Array | None = None) -> Ranking:
    """The ranking that `scores` `[..., C]` of a shortlist's candidates give."""
    return Ranking(order=rank(scores, mask), scores=scores)


def _fit(scorer: Any, matches: Matches) -> Any:
    """A histogram without a capacity gets the one that concrete values ask for, before vmap hides them."""
    if not isinstance(scorer, HistogramOfShifts) or scorer.max_bins is not None:
        return scorer
    sizes = matches.image_size0, matches.image_size1
    return scorer.with_capacity(*sizes) if is_concrete((scorer, sizes)) else scorer


def _axis(scorer: Any, name: str, axis: Sequence[float] | Array) -> Array:
    """One checked axis of a grid, float `[n]`."""
    numeric = [f.name for f in fields(scorer) if not f.metadata.get("static") and _is_number(getattr(scorer, f.name))]
    if name not in numeric:
        nearest = difflib.get_close_matches(name, numeric, n=1) or numeric
        raise ValueError(
            f"{type(scorer).__name__} has no numeric parameter {name!r}; expected one of {', '.join(numeric)}"
            + (f" (nearest: {nearest[0]})" if numeric else "")
        )
    values = jnp.asarray(axis, dtype=float)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"grid axis {name}: expected at least one value in one dimension, got shape {values.shape}")
    return values


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.ndarray | np.generic | jax.Array) and np.ndim(value) == 0
