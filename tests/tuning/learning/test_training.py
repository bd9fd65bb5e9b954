"""Training: what it finds, when it ends, and that an interruption changes nothing."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from mfvpr import InputError
from mfvpr.tuning.learning.training import Checkpoints, Schedule, TrainingError, fit
from tests.storage.synthetic_features import DAMAGE

pytestmark = pytest.mark.thorough

RECIPE = {"model": {"scorer": "line", "sizes": (1, 3)}, "seed": None}
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


def train(folder=None, steps=20, recipe=RECIPE, **changes):
    schedule = {name: changes.pop(name) for name in ("optimizer", "every", "patience") if name in changes}
    schedule = Schedule(**{"optimizer": optax.adam(0.1), "steps": steps, "every": 5} | schedule)
    arguments = {"objective": objective, "batches": batches, "validate": validate, **changes}
    return fit(START, schedule=schedule, checkpoints=folder and Checkpoints(folder, recipe), **arguments)


def same(first, second):
    """To the bit."""
    leaves = zip(jax.tree.leaves(first.parameters), jax.tree.leaves(second.parameters), strict=True)
    equal = all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in leaves)
    return equal and (first.step, first.history, first.ended) == (second.step, second.history, second.ended)


@pytest.fixture(scope="module")
def uninterrupted():
    return train()


def test_finds_the_least_squares_line():
    x, y = (np.concatenate(parts) for parts in zip(*(batches(step) for step in range(20)), strict=True))
    design = np.concatenate([np.repeat(x, 3)[:, None], np.tile(np.eye(3), (len(x), 1))], axis=1)
    slope, *offset = np.linalg.lstsq(design, y.reshape(-1), rcond=None)[0]
    result = train(steps=400, batches=lambda step: (x, y), optimizer=optax.adam(0.1), every=400)
    np.testing.assert_allclose(result.parameters["slope"], slope, atol=1e-4)
    np.testing.assert_allclose(result.parameters["offset"], offset, atol=1e-4)


def test_history_and_best(uninterrupted):
    assert [record.step for record in uninterrupted.history] == [0, 5, 10, 15, 20]
    assert uninterrupted.history[0].loss is None
    assert uninterrupted.history[0].validation == validate(START)
    assert uninterrupted.ended == "all 20 steps are done"
    first = train(steps=5, every=1)
    assert uninterrupted.history[1].loss == np.mean([record.loss for record in first.history[1:]])
    assert validate(uninterrupted.parameters) == min(record.validation for record in uninterrupted.history)


def test_stops_in_time_and_returns_the_best():
    scripted = iter([5.0, 4.0, 6.0, 3.0, 3.0, 9.0, 0.0])
    seen = []

    def scripted_validation(parameters):
        seen.append(parameters)
        return next(scripted)

    result = train(steps=100, every=2, patience=2, validate=scripted_validation)
    assert [record.validation for record in result.history] == [5.0, 4.0, 6.0, 3.0, 3.0, 9.0]
    assert (result.step, result.ended) == (6, "no gain in 2 validations")
    jax.tree.map(np.testing.assert_array_equal, result.parameters, seen[3])


def test_the_start_may_be_the_best():
    result = train(steps=3, every=1, validate=lambda parameters: float(parameters["slope"]))
    assert (result.step, result.parameters["slope"]) == (0, 1)


def test_one_compilation_for_all_steps(compilations):
    traces, compiled = [], []

    def traced(parameters, batch):
        traces.append(1)
        return objective(parameters, batch)

    def counted(step):
        compiled.append(compilations.count)
        return batches(step)

    train(objective=traced, batches=counted)
    assert len(traces) == 1
    assert compiled[1] == compiled[-1]


def steps_of(training):
    """Steps that a training does, in order."""
    seen = []
    result = training(batches=lambda step: seen.append(step) or batches(step))
    return result, seen


def test_goes_on_to_the_bit(tmp_path):
    """Seven steps end between two validations, where one of 20 steps would neither look nor choose."""
    short = train(tmp_path, steps=7)
    assert [record.step for record in short.history] == [0, 5, 7]
    assert same(short, train(steps=7))
    for steps, expected in ((7, []), (9, [7, 8]), (20, [*range(9, 20)])):
        result, seen = steps_of(partial(train, tmp_path, steps=steps))
        assert same(result, train(steps=steps))
        assert seen == expected
    with pytest.raises(InputError, match=r"steps=5: the checkpoint in .* is of step 20"):
        train(tmp_path, steps=5)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Orbax leaves an event loop behind
@pytest.mark.parametrize("damage", ["flipped", "half"])
def test_a_damaged_checkpoint_and_that_of_another_training_are_not_taken(tmp_path, damage, uninterrupted):
    train(tmp_path, steps=10, recipe={**RECIPE, "seed": 1})
    [other] = tmp_path.iterdir()
    train(tmp_path, steps=10)
    [folder] = {*tmp_path.iterdir()} - {other}
    assert [path.name for path in folder.iterdir()] == ["10"]
    files = [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".txt"]
    DAMAGE[damage](max(files, key=lambda path: path.stat().st_size))
    with pytest.warns(UserWarning, match="the checkpoint is damaged"):
        result, seen = steps_of(partial(train, tmp_path))
    assert same(result, uninterrupted)
    assert seen == list(range(20))


@pytest.mark.parametrize(("spike", "broken"), [
    (1e6, lambda p, b: objective(p, b) + jnp.where(b[0][0] > 1e5, jnp.nan, 0.0)),  # the loss
    (np.inf, lambda p, b: objective(p, b) + jnp.sqrt(jnp.maximum(1e5 - b[0][0], 0.0)) * 0 * p["slope"]),  # a gradient
])  # fmt: skip
def test_what_is_not_finite_is_told_and_leaves_the_checkpoint(tmp_path, uninterrupted, spike, broken):
    def spiked(step):
        x, y = batches(step)
        return (np.where(np.arange(8) == 0, np.float32(spike), x), y) if step == 13 else (x, y)

    with pytest.raises(TrainingError, match=r"^step 13: .* of batch 13 is not finite; [^\n]*$"):
        train(tmp_path, batches=spiked, objective=broken)
    result, seen = steps_of(partial(train, tmp_path))
    assert same(result, uninterrupted)
    assert seen == list(range(10, 20))


def test_a_step_to_infinity_and_a_validation_of_nan_are_told():
    with pytest.raises(TrainingError, match=r"step 0: .*batch 0 is not finite"):
        train(objective=lambda parameters, batch: 10 * objective(parameters, batch), optimizer=optax.sgd(1e38))
    with pytest.raises(TrainingError, match=r"step 5: the validation is not finite"):
        train(validate=lambda parameters: np.nan if parameters["slope"] != 1 else 0.0)
