"""The tour of `help(mfvpr.core)`: its example runs, and says what its comments say."""

import inspect
import textwrap
from dataclasses import replace

import jax
import numpy as np

from mfvpr import core


def test_from_descriptors_to_a_ranking_a_grid_and_a_gradient():
    code = textwrap.dedent("    " + inspect.getdoc(core).split("\n\n    ", 1)[1])
    assert len(list(filter(None, code.splitlines()))) <= 15
    values = {name: getattr(core, name) for name in core.__all__} | {"jax": jax, "np": np, "replace": replace}
    exec(code, values)
    assert values["order"].tolist()[0] == 1
    assert values["grid"].shape == (2, 2, 3)
    step = values["score_of"](np.float32(22.6)) - values["score_of"](np.float32(22.4))
    np.testing.assert_allclose(values["slope"], step / 0.2, rtol=1e-2)
