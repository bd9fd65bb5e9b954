"""Compiled scores, pairs of a batch, and tests of several scorers."""

import jax
import pytest

score = jax.jit(lambda scorer, matches: scorer(matches))


def pair_of(batch, row=0):
    return jax.tree.map(lambda leaf: leaf[row], batch)


def each_scorer(scorers):
    """Parametrize a test by scorers."""
    return pytest.mark.parametrize("scorer", scorers, ids=lambda scorer: type(scorer).__name__)
