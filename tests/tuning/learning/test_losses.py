"""Losses of a ranking against explicit loops in float64, their limits, and their gradients."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from mfvpr import rank, recall_at_k
from mfvpr.tuning.learning.models import cross_entropy, mean_loss, smooth_average_precision, smooth_recall_at_1

pytestmark = pytest.mark.thorough

CANDIDATES = 6
LOSSES = {
    "cross_entropy": cross_entropy,
    "recall": partial(smooth_recall_at_1, temperature=0.7),
    "precision": partial(smooth_average_precision, temperature=0.7),
}
losses = pytest.mark.parametrize("name", LOSSES)
COMPILED = {name: jax.jit(jax.value_and_grad(loss)) for name, loss in LOSSES.items()}


def softmax(scores):
    powers = [math.exp(score - max(scores)) for score in scores]
    return [power / sum(powers) for power in powers]


def oracle(name, scores, positives, mask, temperature=0.7):
    """The loss with loops over the real candidates."""
    real = [i for i in range(len(scores)) if mask[i]]
    scores, correct = [float(scores[i]) for i in real], [bool(positives[i]) for i in real]
    if not any(correct):
        return 0.0
    if name == "cross_entropy":
        return -math.log(sum(p for p, is_correct in zip(softmax(scores), correct, strict=True) if is_correct))
    if name == "recall":
        scaled = softmax([score / temperature for score in scores])
        return 1 - sum(p for p, is_correct in zip(scaled, correct, strict=True) if is_correct)
    precisions = []
    for i in range(len(scores)):
        if not correct[i]:
            continue
        ahead = [1 / (1 + math.exp((scores[i] - scores[j]) / temperature)) for j in range(len(scores))]
        rivals = [j for j in range(len(scores)) if j != i]
        among = 1 + sum(ahead[j] for j in rivals if correct[j])
        precisions.append(among / (1 + sum(ahead[j] for j in rivals)))
    return 1 - sum(precisions) / len(precisions)


def average_precision(scores, positives):
    """The exact one: mean over positives of the share of positives down to their place."""
    num_positives, precisions = 0, []
    for place, i in enumerate(sorted(range(len(scores)), key=lambda i: -scores[i]), start=1):
        if positives[i]:
            num_positives += 1
            precisions.append(num_positives / place)
    return sum(precisions) / len(precisions)


def random_queries(seed, queries=200, candidates=CANDIDATES):
    """Scores without ties, NaN on padding; some queries without positives, some without candidates."""
    rng = np.random.default_rng(seed)
    mask = rng.random((queries, candidates)) < 0.8
    positives = rng.random((queries, candidates)) < 0.3  # on padding as well
    mask[:5] = False
    positives[5:10] = False
    scores = rng.permuted(np.tile(np.arange(candidates, dtype=np.float32), (queries, 1)), axis=1)
    return np.where(mask, scores, np.nan).astype(np.float32), positives, mask


@losses
@given(
    scores=st.lists(st.floats(-20, 20, width=32), min_size=CANDIDATES, max_size=CANDIDATES),
    positives=st.lists(st.booleans(), min_size=CANDIDATES, max_size=CANDIDATES),
    mask=st.lists(st.booleans(), min_size=CANDIDATES, max_size=CANDIDATES),
    garbage=st.sampled_from([math.nan, math.inf, -1e30, 0.0]),
)
def test_loss_equals_the_loops_and_padding_never_matters(name, scores, positives, mask, garbage):
    positives, mask = np.array(positives), np.array(mask)
    padded = np.where(mask, scores, garbage).astype(np.float32)
    loss, gradient = COMPILED[name](padded, positives, mask)
    np.testing.assert_allclose(loss, oracle(name, scores, positives, mask), rtol=2e-5, atol=2e-6)
    assert np.all(np.isfinite(gradient))
    assert np.all(np.asarray(gradient)[~mask] == 0)
    if not np.any(positives & mask):
        assert loss == 0
        assert np.all(gradient == 0)


@losses
def test_gradient_equals_finite_differences(name):
    rng = np.random.default_rng(0)
    positives, mask = np.array([0, 1, 0, 1, 0, 1], bool), np.array([1, 1, 1, 1, 0, 0], bool)
    with jax.enable_x64(True):
        scores = jnp.asarray(np.where(mask, rng.normal(size=6), 0.0))
        loss = jax.jit(lambda scores: LOSSES[name](scores, positives, mask))
        check_grads(loss, (scores,), order=1, modes=["rev"])


@pytest.mark.parametrize("loss", [smooth_recall_at_1, smooth_average_precision])
def test_temperature_has_a_gradient_and_must_be_above_0(loss):
    query = np.array([0.3, 0.1, -0.4, 0.9]), np.array([0, 1, 0, 1], bool), np.ones(4, bool)
    with jax.enable_x64(True):
        compiled = jax.jit(lambda temperature: loss(*query, temperature))
        check_grads(compiled, (jnp.asarray(0.4),), order=1, modes=["rev"])
        assert jnp.all(jnp.isnan(jax.vmap(compiled)(jnp.array([0.0, -1.0]))))


def exact_recall(scores, positives, mask):
    order = np.asarray(rank(jnp.asarray(scores), jnp.asarray(mask)))
    return recall_at_k(np.where(np.take_along_axis(mask, order, axis=1), order, -1), positives, [1])[0]


def mean_average_precision(scores, positives, mask):
    rows = zip(scores, positives, mask, strict=True)
    return np.mean([average_precision(s[m].tolist(), p[m].tolist()) for s, p, m in rows])


@pytest.mark.parametrize(
    ("loss", "exact"), [(smooth_recall_at_1, exact_recall), (smooth_average_precision, mean_average_precision)]
)
def test_smooth_losses_tend_to_the_exact_ones_as_the_temperature_falls(loss, exact):
    queries = random_queries(1)
    has_positive = np.any(queries[1] & queries[2], axis=1)
    limit = 1 - exact(*(values[has_positive] for values in queries))
    assert 0.2 < limit < 0.8
    smooth = jax.jit(lambda temperature: mean_loss(partial(loss, temperature=temperature), *queries))
    errors = [abs(float(smooth(temperature)) - limit) for temperature in (1.0, 0.3, 0.1, 0.03)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-6


@losses
def test_mean_is_over_the_queries_that_teach(name):
    scores, positives, mask = random_queries(3, queries=30)
    expected = [oracle(name, *row) for row in zip(scores, positives, mask, strict=True) if np.any(row[1] & row[2])]
    assert 0 < len(expected) < 25
    mean = jax.jit(partial(mean_loss, LOSSES[name]))
    np.testing.assert_allclose(mean(scores, positives, mask), np.mean(expected), rtol=1e-5)
    positives[10:] = False
    assert mean(scores, positives, mask) == 0


def test_large_scores_neither_overflow_nor_lose_a_small_loss():
    """Histograms have scores in the thousands."""
    entropy, real, first = jax.jit(cross_entropy), np.ones(3, bool), np.array([True, False, False])
    np.testing.assert_allclose(entropy(np.float32([5010, 5000, 4000]), first, real), 4.5399e-05, rtol=4e-3)
    assert entropy(np.float32([-3e5, 3e5, 0]), first, real) == 6e5
