"""The contract of a scorer: matches of one pair -> a score."""

from functools import partial
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
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

    A scorer that JAX cannot compile, for instance of another library, also has a method `score_pairs(matches) -> [P]`
    that takes pairs `[P, K, ...]` and returns NumPy; it is called outside of `jit`. Its class is a value.
    """

    def __call__(self, matches: Matches, /) -> Array: ...


def on_host(scorer: Any) -> bool:
    """Whether the scorer has a method `score_pairs` and runs outside of `jit`."""
    return callable(getattr(type(scorer), "score_pairs", None))


def check_host(scorer: Any) -> None:
    """Raise an InputError if a scorer with `score_pairs` is no value: `jit` loses the method."""
    if on_host(scorer) and jax.tree_util.all_leaves([scorer]):
        raise InputError(f"{type(scorer).__name__}: expected a class with score_pairs that is a value; decorate it "
                         "with @mfvpr.value")  # fmt: skip


def with_static_functions(scorers: Tree) -> Tree:
    """Scorers with plain functions as static parts, new ones at each call: `compiled` reuses its programs for them."""
    return jax.tree.map(lambda leaf: Partial(partial(leaf)) if callable(leaf) else leaf, scorers)


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
