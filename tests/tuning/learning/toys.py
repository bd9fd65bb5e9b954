"""A small training."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mfvpr.tuning.learning.training import Checkpoints, Fit, Schedule, fit

RECIPE = {"model": {"scorer": "line", "sizes": (1, 3)}, "data": {"name": "drawn", "images": 100}, "seed": None}
START = {"slope": 1.0, "offset": np.array([0.5, -0.5, 0.0], np.float32)}


def objective(parameters, batch):
    x, y = batch
    predicted = parameters["slope"] * x[:, None] + parameters["offset"][None]
    return jnp.mean((predicted - y) ** 2)


def batches(step):
    """The line 3 x + (1, 2, 3), with noise."""
    rng = np.random.default_rng(step)
    x = rng.normal(size=8).astype(np.float32)
    return x, (3 * x[:, None] + np.arange(1, 4) + rng.normal(size=(8, 3)) / 10).astype(np.float32)


def validate(parameters):
    return float(objective(parameters, batches(10**6)))


def train(folder: Path | None = None, steps: int = 20, **changes) -> Fit:
    schedule = {name: changes.pop(name) for name in ("optimizer", "every", "patience") if name in changes}
    arguments = {"parameters": START, "objective": objective, "batches": batches, "validate": validate,
                 "schedule": Schedule(**{"optimizer": optax.adam(0.1), "steps": steps, "every": 5} | schedule),
                 "checkpoints": folder and Checkpoints(folder, changes.pop("recipe", RECIPE))}  # fmt: skip
    return fit(**arguments | changes)


def same(first: Fit, second: Fit) -> bool:
    """To the bit."""
    leaves = zip(jax.tree.leaves(first.parameters), jax.tree.leaves(second.parameters), strict=True)
    equal = all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in leaves)
    return equal and (first.step, first.history, first.ended) == (second.step, second.history, second.ended)
