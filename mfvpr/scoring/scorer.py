"""The contract of a scorer: matches of one pair -> a score."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.types import Array, Matches
from mfvpr.utils.errors import InputError

Scorer = Callable[[Matches], Array]
"""Maps the Matches of ONE pair, slots `[K]`, to a score `[]` float32: larger = more likely the same place, exactly 0
for a pair without matches, and the same whatever the order of the matches, how much is padding, and what that holds.

Any callable will do. A class decorated with `mfvpr.value` gets more than a plain function: its numbers may be swept,
traced and learned, and its programs are kept. A class that `jax.tree_util.register_dataclass` registered gets the
same; see `mfvpr.value` for its limits. `mfvpr.testing.check_scorer` checks all of this.

What JAX cannot compute, such as another library's score, has a method `score_pairs(matches) -> [P]` as well, NumPy,
of pairs `[P, K, ...]`, by which it is scored outside of `jit`; its class is a value.
"""


def on_host(scorer: Any) -> bool:
    """Whether pairs are scored by `score_pairs`, outside of `jit`."""
    return callable(getattr(type(scorer), "score_pairs", None))


def check_host(scorer: Any) -> None:
    """Raise an InputError where a scorer of the host is no value: what programs hold of it has no `score_pairs`."""
    if on_host(scorer) and jax.tree_util.all_leaves([scorer]):
        raise InputError(f"{type(scorer).__name__}: expected a class with score_pairs that is a value; decorate it "
                         "with @mfvpr.value")  # fmt: skip


def score_pairs(scorer: Any, matches: Matches) -> np.ndarray:
    """Scores `[P]` float32 of pairs `[P, K, ...]` by a scorer of the host.

    Raises:
        InputError: it gives anything but a number for each pair.
    """
    scores, name = np.asarray(scorer.score_pairs(matches)), f"{type(scorer).__name__}.score_pairs"
    if scores.shape != (len(matches.mask),):
        raise InputError(f"{name}: expected a number for each of {len(matches.mask)} pairs, got an array "
                         f"{list(scores.shape)}")  # fmt: skip
    require_real(name, scores)
    return scores.astype(np.float32)


def require_real(name: str, scores: Array | np.ndarray) -> None:
    """Raise an InputError unless scores can be ranked."""
    if scores.dtype.kind not in "fiub" and scores.dtype != jnp.bfloat16:
        raise InputError(f"{name}: expected real numbers as scores, got {scores.dtype}")
