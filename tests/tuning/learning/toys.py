"""A small training, and processes that are killed at it."""

import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mfvpr.tuning.learning import training as checkpoints
from mfvpr.tuning.learning.training import Checkpoints, Fit, Schedule, fit

ROOT = Path(__file__).parents[3]
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


def program(lines: str) -> subprocess.CompletedProcess[str]:
    """Run lines in a process of its own, with all names of this module."""
    call = [sys.executable, "-W", "default", "-c", f"from tests.tuning.learning.toys import *\n{lines}"]
    return subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False)


def contents(folder: Path) -> dict[str, bytes | None]:
    """Everything below a folder."""
    paths = [path for path in sorted(folder.rglob("*")) if path.name != ".lock"]
    return {str(path): path.read_bytes() if path.is_file() else None for path in paths}


def killed(action: Callable[[], object], folder: Path, moment: int) -> bool:
    """Whether a child that does `action` was killed, when it touched a file below `folder` for that time.

    Whoever forks must not have started JAX or Orbax, whose threads a child lacks.
    """
    child = os.fork()
    if child == 0:
        sys.addaudithook(_killer(str(folder), moment))
        try:
            action()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert status in (0, signal.SIGKILL), f"moment {moment}: status {status}"
    return status == signal.SIGKILL


def _killer(folder: str, moment: int) -> Callable[[str, tuple], None]:
    """An audit hook: Python calls it whenever a file is opened, renamed or removed."""
    touched = []

    def hook(event: str, arguments: tuple) -> None:
        if any(isinstance(argument, str | os.PathLike) and str(argument).startswith(folder) for argument in arguments):
            touched.append(event)
            if len(touched) == moment:
                os.kill(os.getpid(), signal.SIGKILL)

    return hook


def save_next(folder: Path) -> None:
    """Check that the newest checkpoint is whole, and save the next: every number in it is its step."""
    state = {"numbers": np.zeros((20, 30)), "count": np.int32(0)}
    stored = checkpoints.restore(folder, RECIPE, state)
    step = 0
    if stored:
        step = stored[1]
        assert all(np.all(leaf == step) for leaf in jax.tree.leaves(stored[0]))
    state = jax.tree.map(lambda leaf: np.full_like(leaf, step + 1), state)
    checkpoints.save_checkpoint(folder, step + 1, RECIPE, state, step + 1)


def killed_savers(folder: Path, stride: int) -> None:
    """Children that save, killed a few moments later every time, until one lives to the end; prints what they left."""
    for _ in range(2):
        assert not killed(lambda: save_next(folder), folder, -1)
    moment = 1
    while killed(lambda: save_next(folder), folder, moment):
        print(moment, sorted(path.name for path in folder.iterdir() if path.name != ".lock"))
        moment += stride
