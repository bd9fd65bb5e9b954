"""Losses of one query's ranking: scores, positives and mask of the candidates -> a number, smaller = better.

Positives are the correct candidates. Scores of padding may be anything. A query without a positive has the loss 0 and
the gradient 0. For `mean_loss`, set a temperature with `functools.partial`. A temperature is in units of the scores; a
temperature not above 0 makes the loss NaN.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Num

from mfvpr.core.types import Array
from mfvpr.utils.numerics import as_float, masked, masked_mean, positive

Loss = Callable[[Array, Array, Array], Array]


def cross_entropy(
    scores: Num[Array, " candidates"], positives: Bool[Array, " candidates"], mask: Bool[Array, " candidates"]
) -> Float[Array, ""]:
    """-log of the probability that softmax(scores) gives to all positives together, in nats."""
    scores, positives, real, teaches = _usable(scores, positives, mask)
    # The highest score is subtracted first: else scores in the thousands round a small loss away.
    scores = scores - jax.lax.stop_gradient(jnp.max(scores, where=real, initial=-jnp.inf))
    loss = jax.nn.logsumexp(scores, where=real) - jax.nn.logsumexp(scores, where=positives)
    return jnp.where(teaches, loss, 0.0)


def smooth_recall_at_1(
    scores: Num[Array, " candidates"],
    positives: Bool[Array, " candidates"],
    mask: Bool[Array, " candidates"],
    temperature: float | Float[Array, ""],
) -> Float[Array, ""]:
    """1 - the probability that softmax(scores / temperature) gives to the positives, in [0, 1].

    It tends to 1 - R@1 as the temperature tends to 0.
    """
    scores, positives, real, teaches = _usable(scores, positives, mask)
    probability = jax.nn.softmax(scores / positive(temperature, scores.dtype), where=real)
    return jnp.where(teaches, jnp.sum(masked(probability, ~positives)), 0.0)


def smooth_average_precision(
    scores: Num[Array, " candidates"],
    positives: Bool[Array, " candidates"],
    mask: Bool[Array, " candidates"],
    temperature: float | Float[Array, ""],
) -> Float[Array, ""]:
    """1 - Smooth-AP (Brown et al., ECCV 2020, equation 4), in [0, 1].

    The rank of a candidate is 1 + the sum of sigmoid(lead / temperature) over all other candidates, where lead is how
    far their score is above its own. The loss tends to 1 - average precision as the temperature tends to 0; a tie
    counts half.
    """
    scores, positives, real, teaches = _usable(scores, positives, mask)
    lead = jax.nn.sigmoid((scores[None] - scores[:, None]) / positive(temperature, scores.dtype))  # [i, j] of j over i
    is_other = real[None] & ~jnp.eye(len(real), dtype=bool)
    rank = 1 + jnp.sum(masked(lead, is_other), axis=1)
    rank_among_positives = 1 + jnp.sum(masked(lead, is_other & positives[None]), axis=1)
    return jnp.where(teaches, 1 - masked_mean(rank_among_positives / rank, positives), 0.0)


LOSSES: dict[str, Loss] = {
    "cross_entropy": cross_entropy,
    "recall": partial(smooth_recall_at_1, temperature=1.0),
    "average_precision": partial(smooth_average_precision, temperature=1.0),
}
"""Losses of the programs, by name."""


def mean_loss(
    loss: Loss,
    scores: Num[Array, "queries candidates"],
    positives: Bool[Array, "queries candidates"],
    mask: Bool[Array, "queries candidates"],
) -> Float[Array, ""]:
    """Mean of the loss of one query over the queries with a positive; 0 if there are none."""
    return masked_mean(jax.vmap(loss)(scores, positives, mask), jnp.any(positives & mask, axis=-1))


def _usable(scores: Array, positives: Array, mask: Array) -> tuple[Array, Array, Array, Array]:
    """Scores, positives, real candidates, and whether the query has a positive; without one, no loss divides by 0."""
    positives = positives & mask
    teaches = jnp.any(positives)
    return masked(as_float(scores), mask & teaches), positives | ~teaches, mask | ~teaches, teaches
