"""Losses of one query's ranking: scores, which candidates are right, which are there -> a number, smaller = better.

A query without a right candidate teaches nothing: its loss and its gradient are 0. Bind a temperature with
`functools.partial` to get what `mean_loss` takes.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from mfvpr.types import Array
from mfvpr.utils.numerics import as_float, masked, masked_mean, positive

Loss = Callable[[Array, Array, Array], Array]


def cross_entropy(scores: Array, positives: Array, mask: Array) -> Array:
    """-log of the probability that softmax(scores) gives to all positives together, `[]`, in nats.

    Args:
        scores: `[C]`; padding may hold anything.
        positives: `[C]` bool, the right candidates.
        mask: `[C]` bool.
    """
    scores, positives, real, teaches = _usable(scores, positives, mask)
    # From the highest score: else a small loss is lost in the rounding of scores in the thousands.
    scores = scores - jax.lax.stop_gradient(jnp.max(scores, where=real, initial=-jnp.inf))
    loss = jax.nn.logsumexp(scores, where=real) - jax.nn.logsumexp(scores, where=positives)
    return jnp.where(teaches, loss, 0.0)


def smooth_recall_at_1(scores: Array, positives: Array, mask: Array, temperature: float | Array) -> Array:
    """1 - the probability that softmax(scores / temperature) gives to the positives, `[]` in [0, 1].

    It tends to 1 - R@1 as the temperature tends to 0.

    Args:
        scores: `[C]`; padding may hold anything.
        positives: `[C]` bool, the right candidates.
        mask: `[C]` bool.
        temperature: above 0, in units of the scores; else the loss is NaN.
    """
    scores, positives, real, teaches = _usable(scores, positives, mask)
    probability = jax.nn.softmax(scores / positive(temperature, scores.dtype), where=real)
    return jnp.where(teaches, jnp.sum(masked(probability, ~positives)), 0.0)


def smooth_average_precision(scores: Array, positives: Array, mask: Array, temperature: float | Array) -> Array:
    """1 - Smooth-AP (Brown et al., ECCV 2020, equation 4), `[]` in [0, 1].

    A candidate's rank is 1 + the sum over all others of sigmoid(their lead / temperature). The loss tends to
    1 - average precision as the temperature tends to 0, where a tie counts half.

    Args:
        scores: `[C]`; padding may hold anything.
        positives: `[C]` bool, the right candidates.
        mask: `[C]` bool.
        temperature: above 0, in units of the scores; else the loss is NaN.
    """
    scores, positives, real, teaches = _usable(scores, positives, mask)
    lead = jax.nn.sigmoid((scores[None] - scores[:, None]) / positive(temperature, scores.dtype))  # [i, j] of j over i
    others = real[None] & ~jnp.eye(len(real), dtype=bool)
    rank = 1 + jnp.sum(masked(lead, others), axis=1)
    rank_among_positives = 1 + jnp.sum(masked(lead, others & positives[None]), axis=1)
    return jnp.where(teaches, 1 - masked_mean(rank_among_positives / rank, positives), 0.0)


LOSSES: dict[str, Loss] = {
    "cross_entropy": cross_entropy,
    "recall": partial(smooth_recall_at_1, temperature=1.0),
    "average_precision": partial(smooth_average_precision, temperature=1.0),
}
"""Losses that programs know, by name."""


def mean_loss(loss: Loss, scores: Array, positives: Array, mask: Array) -> Array:
    """Mean of `loss` over the queries that have a positive, `[]`; 0 where none has.

    Args:
        loss: of one query.
        scores: `[B, C]`; padding may hold anything.
        positives: `[B, C]` bool.
        mask: `[B, C]` bool.
    """
    return masked_mean(jax.vmap(loss)(scores, positives, mask), jnp.any(positives & mask, axis=-1))


def _usable(scores: Array, positives: Array, mask: Array) -> tuple[Array, Array, Array, Array]:
    """Scores, positives, real candidates, and whether the query teaches.

    One that does not is all zeros and all positive, so that nothing is divided by 0, in gradients neither.
    """
    positives = positives & mask
    teaches = jnp.any(positives)
    return masked(as_float(scores), mask & teaches), positives | ~teaches, mask | ~teaches, teaches
