"""Checkpoints: nothing foreign is read or overwritten, damage is told, and Orbax keeps quiet."""

import shutil
from functools import partial

import jax
import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.tuning.learning import training as checkpoints
from tests.storage.synthetic_features import DAMAGE
from tests.tuning.learning.toys import RECIPE, contents, program, train

pytestmark = pytest.mark.thorough

STATE = {"a": np.float32([1.5, -2.0]), "b": {"c": np.int32(3), "d": np.arange(600, dtype=np.float32).reshape(20, 30)}}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    train(folder, steps=10)
    return folder


def test_what_comes_back_is_what_was_saved(tmp_path):
    folder = tmp_path / "new" / "folder"
    assert checkpoints.restore(folder, RECIPE, STATE) is None
    for step in (3, 12, 100):
        checkpoints.save_checkpoint(folder, step, RECIPE, STATE, [[step, None, 0.1 + 0.2]])
    assert sorted({path.name for path in folder.iterdir()} - {".lock"}) == ["100", "12"]
    restored = checkpoints.restore(folder, RECIPE, STATE)
    assert restored is not None
    state, progress = restored
    assert progress == [[100, None, 0.1 + 0.2]]
    jax.tree.map(partial(np.testing.assert_array_equal, strict=True), state, STATE)


@pytest.mark.parametrize(("changes", "difference"), [
    ({"recipe": {**RECIPE, "model": {"scorer": "curve"}}}, "those of another model"),
    ({"recipe": {**RECIPE, "seed": 0}}, "those of another seed"),
    ({"recipe": {**RECIPE, "rate": 0.1}}, "those of another rate"),
    ({"recipe": {}}, "those of another model"),
    ({"steps": 5}, "this checkpoint is of step 10, expected at most 5"),
])  # fmt: skip
def test_another_training_is_refused_and_nothing_changes(finished, changes, difference):
    before = contents(finished)
    with pytest.raises(InputError) as refusal:
        train(finished, **changes)
    assert str(refusal.value).startswith(f"{finished}: ")
    assert f"{difference}; " in str(refusal.value)
    assert contents(finished) == before


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Orbax leaves an event loop behind
@pytest.mark.parametrize("damage", ["flipped", "half"])
def test_damage_is_told_and_the_one_before_still_serves(tmp_path, damage):
    state = {"only": np.random.default_rng(0).normal(size=(20, 30)).astype(np.float32)}
    for step in (1, 2):
        checkpoints.save_checkpoint(tmp_path, step, {}, state, [step])
    files = [path for path in (tmp_path / "2").rglob("*") if path.is_file() and path.suffix != ".txt"]
    DAMAGE[damage](max(files, key=lambda path: path.stat().st_size))
    with pytest.raises(InputError, match=r"/2: .* damaged one \(.+\); delete") as refusal:
        checkpoints.restore(tmp_path, {}, state)
    assert "\n" not in str(refusal.value)
    shutil.rmtree(tmp_path / "2")
    restored = checkpoints.restore(tmp_path, {}, state)
    assert restored is not None
    assert restored[1] == [1]


def test_killed_while_saving_the_newest_whole_one_is_there(tmp_path):
    """Processes killed while they make, fill, rename and remove folders; each checks what the one before left."""
    done = program(f"killed_savers(Path({str(tmp_path)!r}), 3)")
    assert done.returncode == 0, done.stderr
    left = done.stdout.splitlines()
    assert len(left) > 10
    assert any("orbax-checkpoint-tmp" in line for line in left)
    assert any("tmp" not in line and line.count("'") == 6 for line in left)  # three: before the oldest is removed
    assert len({path.name for path in tmp_path.iterdir()} - {".lock"}) == 2
