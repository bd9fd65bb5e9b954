"""The contract of a scorer, a function from the matches of one pair to a score; and its parameters by dotted name.

sigma: float | Array = setting(22.5, POSITIVE, unit="px", learned=True)  # a field of a scorer
parameters_of(HistogramOfShifts)["sigma"].unit              # "px"
with_parameters(scorer, {"inner.sigma": 10.0})              # a field of a part
"""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey
from jaxtyping import Float, Num

from mfvpr.core.types import Array, Matches
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import Setting

SCORE = "units of the score"
Tree = TypeVar("Tree")


class Scorer(Protocol):
    """Function of the Matches of ONE pair, slots `[K]`, that returns a score `[]` float32.

        def near(matches):
            distances = jnp.linalg.norm(mfvpr.match_shifts(matches), axis=-1)
            return jnp.sum((distances < 20.0) & matches.mask).astype(jnp.float32)

        near(matches)                                    # [] of one pair [K, ...]
        mfvpr.score_candidates(near, candidate_matches)  # [C] of pairs [C, K, ...]
        mfvpr.System(pipeline, {"near": near})           # of a data set, or in a map

    A larger score means that both images more likely show the same place. The score is exactly 0 without matches. It
    does not depend on the order of the matches, nor on the amount and content of padding.

    Any callable is a scorer. A class decorated with `mfvpr.value` can do more than a plain function: its numbers may be
    swept, traced and learned, and its compiled programs are reused. `mfvpr.testing.check_scorer` checks this contract.

    Optional methods of such a class:

    - `score_pairs(matches) -> [P]`, for a scorer that JAX cannot compile, for instance of another library: takes pairs
      `[P, K, ...]`, returns NumPy, and is called outside of `jit` in place of the function of one pair.
    - `fit_capacity(image_size0, image_size1, multiple) -> scorer`, for static sizes that follow from image sizes.
    - `score_weightings(matches, weights) -> [C, W]`, for candidates `[C, K, ...]` and weights of their matches
      `[C, W, K]`, that share most of the work, and `pairs_at_once(matches, num_weightings) -> int`, how many pairs to
      work on at the same time. Grids call them.
    """

    def __call__(self, matches: Matches, /) -> Array: ...


def on_host(scorer: Any) -> bool:
    """Whether the scorer has a method `score_pairs` and runs outside of `jit`."""
    return callable(getattr(type(scorer), "score_pairs", None))


def shares_weightings(scorer: Any) -> bool:
    """Whether `score_weightings` is there, and of the class that defines the score: a subclass may score otherwise."""
    for cls in type(scorer).__mro__:
        if "score_weightings" in vars(cls) or "__call__" in vars(cls):
            return {"score_weightings", "__call__"} <= {*vars(cls)}
    return False


class StaticFunction:
    """A plain function as a static part of a scorer: a program is used again for this object alone."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, matches: Matches) -> Any:
        return self.function(matches)


jax.tree_util.register_static(StaticFunction)


def with_static_functions(scorers: Tree) -> Tree:
    """Scorers with plain functions as static parts, for one evaluation, in which they may share programs.

    The next call makes new parts, and compiles again: what a function closes over may have changed.
    """
    return jax.tree.map(lambda leaf: StaticFunction(leaf) if callable(leaf) else leaf, scorers)


def check_host(scorer: Any) -> None:
    """Raise an InputError if a scorer with `score_pairs` is no value: `jit` loses the method."""
    if on_host(scorer) and jax.tree_util.all_leaves([scorer]):
        name = type(scorer).__name__
        raise InputError(f"{name}: expected a class with score_pairs that is a value; decorate it with @mfvpr.value")


def score_pairs(scorer: Any, matches: Matches) -> Float[np.ndarray, " pairs"]:
    """Scores of pairs `[P, K, ...]`, float32, by the method `score_pairs` of a scorer."""
    scores = np.asarray(scorer.score_pairs(matches))
    require_scores(f"{type(scorer).__name__}.score_pairs", scores, len(matches.mask))
    return scores.astype(np.float32)


def require_scores(name: str, scores: Array, pairs: int | None = None) -> None:
    """Raise an InputError unless the scores are real numbers, and one for each of some pairs."""
    if pairs is not None and scores.shape != (pairs,):
        raise InputError(f"{name}: expected a number for each of {pairs} pairs, got an array {list(scores.shape)}")
    if scores.dtype.kind not in "fiub" and scores.dtype != jnp.bfloat16:
        raise InputError(f"{name}: expected real numbers as scores, got {scores.dtype}")


def parameters_of(method: Any) -> dict[str, Setting]:
    """Declared fields of a class, or of an instance, by name."""
    return {f.name: f.metadata["setting"] for f in fields(method) if "setting" in f.metadata}


def check_bounds(method: Any) -> None:
    """Raise an InputError if a field holds a number out of bounds; none may be traced."""
    for name, parameter in parameters_of(method).items():
        parameter.check_numbers(name, getattr(method, name))


def numbers_by_name(scorer: Any) -> dict[str, Any]:
    """Numbers of a scorer by dotted name, which a grid may vary; also a `temperature` of None."""

    def is_number(path: Any, leaf: Any) -> bool:
        if leaf is None:
            return path[-1].name == "temperature"
        scalar = isinstance(leaf, int | float | np.ndarray | np.generic | jax.Array) and np.ndim(leaf) == 0
        return scalar and (jnp.issubdtype(jnp.result_type(leaf), jnp.number) or isinstance(leaf, bool | np.bool_))

    return {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(scorer, is_leaf=lambda leaf: leaf is None)
        if path and all(isinstance(key, GetAttrKey) for key in path) and is_number(path, leaf)
    }


def whole_numbers(scorer: Any) -> set[str]:
    """Names of the numbers that are integers, such as indices, and must remain integers."""
    is_whole = lambda number: jnp.issubdtype(jnp.result_type(number), jnp.integer)  # noqa: E731
    return {name for name, number in numbers_by_name(scorer).items() if number is not None and is_whole(number)}


def with_parameters(scorer: Any, values: Mapping[str, Any]) -> Any:
    """The scorer with parameters replaced by `values`, by dotted name."""
    for name, new in values.items():
        outer, _, inner = name.partition(".")
        part = with_parameters(getattr(scorer, outer), {inner: new}) if inner else new
        scorer = replace(scorer, **{outer: part})
    return scorer


def fit_capacities(
    scorer: Any, image_size0: Num[Array, "*batch0 2"], image_size1: Num[Array, "*batch1 2"], *, multiple: int = 1
) -> Any:
    """The scorer with the capacities that pairs of these image sizes need, before `vmap` or `jit` hide the sizes.

    The method `fit_capacity(image_size0, image_size1, multiple)` of parts at any depth sets them, see
    `HistogramOfShifts`; values up to the same `multiple` share programs.
    """
    has_capacity = lambda part: callable(getattr(part, "fit_capacity", None))  # noqa: E731
    fit = lambda part: part.fit_capacity(image_size0, image_size1, multiple) if has_capacity(part) else part  # noqa: E731
    return jax.tree.map(fit, scorer, is_leaf=has_capacity)
