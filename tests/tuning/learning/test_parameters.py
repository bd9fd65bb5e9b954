"""Positive numbers behind free parameters."""

import jax
import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.tuning.learning.parameters import from_logarithms, to_logarithms


def test_there_and_back_and_always_above_0():
    values = {"sigma": 22.5, "tolerance": 3, "temperature": np.array([1e-3, 40.0])}
    free = to_logarithms(values)
    jax.tree.map(
        lambda got, expected: np.testing.assert_allclose(got, expected, rtol=1e-6), from_logarithms(free), values
    )
    anywhere = jax.tree.map(lambda parameter: parameter * -7 - 1, free)
    assert all(np.all(value > 0) for value in from_logarithms(anywhere).values())


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, np.array([1.0, 0.0])])
def test_a_start_that_is_not_above_0_is_refused(value):
    with pytest.raises(InputError, match=r"^sigma=.*: .*above 0"):
        to_logarithms({"sigma": value})
