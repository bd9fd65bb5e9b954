"""Recipes: what makes a result another one, and nothing else."""

import importlib
import json
import sys
from dataclasses import dataclass

import jax
import numpy as np
import pytest
from flax import nnx

from mfvpr.features.aliked import AlikedFeatures
from mfvpr.features.sift import Sift
from mfvpr.features.vlad import Vlad, VladFitting
from mfvpr.fingerprints import fingerprint, recipe_of
from mfvpr.weights.networks import blueprint
from mfvpr.weights.registry import entry_of


def test_other_numbers_make_another_recipe():
    """Batch sizes do not."""
    keys = [recipe_of(Sift(max_keypoints=60, batch_size=size)) for size in (1, 8)]
    assert keys[0] == keys[1]
    others = [recipe_of(Sift(max_keypoints=61)), recipe_of(Sift(max_keypoints=60, image_size=(320, 336)))]
    others += [recipe_of(VladFitting(seed=1)), recipe_of(Vlad(np.ones((2, 3), np.float32)))]
    others += [recipe_of(Vlad(np.ones((3, 2), np.float32))), recipe_of(Vlad(np.zeros((2, 3), np.float32)))]
    assert len({json.dumps(one, sort_keys=True) for one in (*keys, *others)}) == 7
    with pytest.raises(TypeError, match="expected a dataclass, arrays, or a property `recipe`"):
        recipe_of(lambda images: images)


def test_classes_of_one_name_are_told_apart():
    made = [dataclass(type("Sift", (), {"__module__": name})) for name in ("theirs", "theirs.newer", "mfvpr.features")]
    assert [recipe_of(one())["class"] for one in made] == ["theirs.Sift", "theirs.newer.Sift", "Sift"]
    assert recipe_of(Sift())["class"] == "Sift"


def test_changed_code_of_ones_own_is_another_recipe(tmp_path, monkeypatch):
    text = "from dataclasses import dataclass\n@dataclass\nclass Base:\n    a: int = 1\n    def f(self): return {}\n" \
           "@dataclass\nclass Mine(Base):\n    b: int = {}\n"  # fmt: skip
    recipes = []
    for number, values in enumerate(((1, 2), (1, 2), (5, 2), (1, 3))):
        root = tmp_path / str(number)
        root.mkdir()
        (root / "of_ones_own.py").write_text(text.format(*values))
        monkeypatch.syspath_prepend(root)
        recipes.append(recipe_of(importlib.import_module("of_ones_own").Mine(b=2)))
        del sys.modules["of_ones_own"]
    assert recipes[0] == recipes[1]
    assert len({fingerprint(one) for one in recipes}) == 3


def test_a_network_is_known_by_its_weights():
    entry = entry_of("aliked-t16")
    plan = blueprint(entry)
    filled = [
        plan.filled({name: np.full(shape, value, np.float32) for name, shape in plan.shapes.items()})
        for value in (0, 1)
    ]
    recipes = [recipe_of(AlikedFeatures(model)) for model in (*filled, filled[0])]
    assert recipes[0] == recipes[2]
    assert recipes[0] != recipes[1]


def test_a_network_is_known_wherever_its_functions_are_in_memory():
    def network():
        def promote(arrays, **_):
            return arrays

        return nnx.Conv(1, 1, (1, 1), promote_dtype=promote, rngs=nnx.Rngs(0))

    first, second = network(), network()
    assert str(jax.tree.structure(first)) != str(jax.tree.structure(second))
    assert recipe_of(first) == recipe_of(second)
