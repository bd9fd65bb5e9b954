"""The contract of a scorer: a function from the matches of one pair to a score."""

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mfvpr.core.types import Array, Matches
from mfvpr.utils.errors import InputError

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
    owners = [
        next((cls for cls in type(scorer).__mro__ if name in vars(cls)), None)
        for name in ("score_weightings", "__call__")
    ]
    return owners[0] is not None and owners[0] is owners[1]


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


def require_scores(name: str, scores: Array, pairs: int) -> None:
    """Raise an InputError unless the scores are a real number for each pair."""
    if scores.shape != (pairs,):
        raise InputError(f"{name}: expected a number for each of {pairs} pairs, got an array {list(scores.shape)}")
    require_real(name, scores)


def require_real(name: str, scores: Array) -> None:
    """Raise an InputError unless the scores are real numbers."""
    if scores.dtype.kind not in "fiub" and scores.dtype != jnp.bfloat16:
        raise InputError(f"{name}: expected real numbers as scores, got {scores.dtype}")
