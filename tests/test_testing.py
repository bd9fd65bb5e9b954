"""`check_scorer` accepts what keeps the contract and names what does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mfvpr
from mfvpr import testing
from mfvpr.testing import check_scorer
from tests.scorers import FOREIGN, OWN, one_of_each_class, title

pytestmark = pytest.mark.thorough


@pytest.mark.first_case
@pytest.mark.parametrize("scorer", one_of_each_class([*OWN, *FOREIGN]), ids=title)
def test_what_keeps_the_contract_passes(scorer, monkeypatch):
    """These scores more closely than other people's need to."""
    monkeypatch.setattr(testing, "TOLERANCE", 3e-6)
    check_scorer(scorer)


def test_a_score_of_the_host_passes_and_other_images_and_seeds_do():
    check_scorer(mfvpr.OpenCvHomography())
    check_scorer(mfvpr.HistogramOfShifts(), image_size=(640, 480), seed=5)


def real(matches):
    return jnp.sum(matches.mask.astype(jnp.float32))


class Unregistered:
    def __call__(self, matches):
        return real(matches)


@mfvpr.value
class Worded:
    word: str = "mean"

    def __call__(self, matches):
        return real(matches)


@mfvpr.value
class Baked:
    """Its number is looked at by Python: jit cannot."""

    number: float = 2.0

    def __call__(self, matches):
        return float(self.number) * real(matches)


def lengths(shifts):
    return jnp.sqrt(jnp.sum(shifts**2, axis=-1))


def numpy_only(matches):
    return np.float32(np.sum(np.asarray(matches.mask)))


BROKEN = {
    "is no pytree.*@mfvpr.value": Unregistered(),
    r"Worded\.word = 'mean' is no number.*static": Worded(),
    "expected a scalar of float32, got shape": lambda m: m.mask.astype(jnp.float32),
    "of int32": lambda m: jnp.sum(m.mask.astype(jnp.int32)),
    "the score of 0 matches is nan.*mfvpr.masked": lambda m: jnp.sum(m.distance),
    r"without matches .*1.0, expected .*0": lambda m: 1.0 + real(m),
    "padding that holds inf changes the score": lambda m: (
        jnp.sum(jnp.isinf(m.distance).astype(jnp.float32)) * jnp.any(m.mask).astype(jnp.float32)
    ),
    "more slots of padding change the score": lambda m: real(m) / len(m.mask),
    "the order of the matches": lambda m: jnp.sum(jnp.where(m.mask, jnp.arange(len(m.mask), dtype=jnp.float32), 0.0)),
    "the gradient for points. is not finite": lambda m: jnp.sum(mfvpr.masked(lengths(m.points1 - m.points0), m.mask)),
    "jit scores otherwise": lambda m: (2.0 if isinstance(m.mask, jax.core.Tracer) else 1.0) * real(m),
    r"number .*jit .*jnp.where": Baked(),
    r".*jit .*jnp.where": numpy_only,
}


@pytest.mark.parametrize("words", BROKEN)
def test_what_breaks_it_is_named(words):
    with pytest.raises(AssertionError, match=words):
        check_scorer(BROKEN[words])
