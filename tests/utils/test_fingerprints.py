"""Recipes: what makes a result another one, and nothing else."""

import importlib
import json
import linecache
import math
import re
import sys
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import nnx

from mfvpr import LightGlueMatcher, value
from mfvpr.baselines.scorers import SCORERS
from mfvpr.checkpoints import entry_of
from mfvpr.checkpoints.networks import blueprint
from mfvpr.core.weights import WEIGHTS
from mfvpr.features import Aggregated, AlikedFeatures, Sift, Vlad, VladFitting
from mfvpr.matchers import NearestNeighborMatcher
from mfvpr.retrieval import ExactSearch, Retrieval
from mfvpr.utils import recipe_of
from mfvpr.utils.fingerprints import fingerprint


def test_other_numbers_make_another_recipe():
    """Batch sizes do not."""
    assert recipe_of(Sift(batch_size=1)) == recipe_of(Sift(batch_size=8))
    vocabularies = [np.ones((2, 3), np.float32), np.ones((3, 2), np.float32), np.zeros((2, 3), np.float32)]
    extractors = [Sift(), Sift(max_keypoints=61), Sift(image_size=(320, 336)), VladFitting(seed=1)]
    recipes = [recipe_of(part) for part in (*extractors, *map(Vlad, vocabularies))]
    assert len({json.dumps(recipe, sort_keys=True) for recipe in recipes}) == len(recipes) == 7
    with pytest.raises(TypeError, match=r"dataclass, arrays, .*`recipe`"):
        recipe_of(lambda images: images)


def test_classes_of_one_name_are_told_apart():
    modules = {"theirs": "theirs.Sift", "theirs.newer": "theirs.newer.Sift", "mfvpr.features": "Sift"}
    for module, name in modules.items():
        assert recipe_of(dataclass(type("Sift", (), {"__module__": module}))())["class"] == name
    assert recipe_of(Sift())["class"] == "Sift"
    assert recipe_of(NearestNeighborMatcher())["class"] == "Matching"  # its first name, as in stores of 0.2.0


def made_by(number, *, gain=1, default=3):
    """Classes that differ by what they close over, by an attribute, by a default, by a wrapped method."""

    @dataclass
    class Mine:
        size: int = 2
        strength = gain

        def __call__(self, images, power=default):
            return images * number**power

        @cached_property
        def table(self):
            return [number] * self.size

    return Mine


class Inner(made_by(1)):
    def __call__(self, images):
        return super().__call__(images) + 1


def test_code_of_ones_own_is_part_of_the_recipe():
    recipe, used = recipe_of(made_by(1)()), made_by(1)()
    assert used.table
    used.detector, type(used)._cache = object(), {1: 2}  # what a class keeps while it works is no part
    assert recipe_of(used) == recipe
    scorers = [made_by(2)(), made_by(1, gain=7)(), made_by(1, default=4)(), made_by(1)(size=3), Inner()]
    assert len({fingerprint(other) for other in (recipe, *map(recipe_of, scorers))}) == 1 + len(scorers)
    assert recipe_of(Inner()) == recipe_of(Inner())


@pytest.mark.parametrize(
    ("body", "different"),
    [("def f(self): return {}", 3),  # after its file was edited, the old code still runs
     ("class Config:\n        n = {}", 2)],  # a nested class: the text alone tells
)  # fmt: skip
def test_both_code_and_text_count(tmp_path, monkeypatch, body, different):
    text = f"from dataclasses import dataclass\n@dataclass\nclass Mine:\n    {body}\n"
    path = tmp_path / "of_ones_own.py"
    monkeypatch.syspath_prepend(tmp_path)
    path.write_text(text.format(1))
    module = importlib.import_module("of_ones_own")
    recipes = [recipe_of(module.Mine())]
    path.write_text(text.format(222))
    linecache.clearcache()
    recipes.append(recipe_of(module.Mine()))
    importlib.reload(module)
    recipes.append(recipe_of(module.Mine()))
    del sys.modules["of_ones_own"]
    assert len({*map(fingerprint, recipes)}) == different


def with_private_gain(value):
    """A class of the same text whatever its private attribute holds."""

    class Mine(Sift):
        _gain = value

        def __call__(self, images):
            return super().__call__([image * self._gain for image in images])

    return Mine


def test_private_constants_are_part_of_the_recipe():
    values = [1, 3, 1.0, "1", (1, 2), {"a": 1}, [1], np.ones(2), np.zeros(2), np.float32]
    recipes = [fingerprint(recipe_of(with_private_gain(value)())) for value in values]
    assert len({*recipes}) == len(values)
    assert recipes[0] == fingerprint(recipe_of(with_private_gain(1)()))


@dataclass(frozen=True)
class Limit:
    limit: float
    recipe: str = "a field, which says nothing of the others"

    def __call__(self, value):
        return value < self.limit


SEASON = Enum("SEASON", ["DAY", "NIGHT"])
CONSTANTS = [
    (Limit(1.0), Limit(2.0)), ([Limit(1.0)], [Limit(2.0)]), (Path("a"), Path("b")), (SEASON.DAY, SEASON.NIGHT),
    (np.sin, np.cos), (math.sin, math.cos), (range(2), range(3)), (slice(2), slice(3)), (np, math),
    (frozenset({(1, 2)}), frozenset({(1, 3)})), (re.compile("a"), re.compile("b")),
    (Limit(1.0).__call__, Limit(2.0).__call__),
]  # fmt: skip


@pytest.mark.parametrize(("first", "second"), CONSTANTS)
def test_what_a_class_closes_over_is_part_of_its_recipe(first, second):
    def closing_over(value):
        @dataclass
        class Mine:
            def __call__(self, images):
                return value, images

        return Mine

    for make in (closing_over, with_private_gain):
        names = [fingerprint(recipe_of(make(value)())) for value in (first, first, second)]
        assert names[0] == names[1] != names[2]


def test_a_class_that_closes_over_anything_else_has_no_recipe():
    class Mine(Sift):
        detector = object()

    with pytest.raises(TypeError, match="object: expected a dataclass"):
        recipe_of(Mine())


def test_a_subclass_adds_its_fields_and_its_code_to_a_recipe():
    def adding(gain):
        @value
        class Mine(LightGlueMatcher):
            least: float = 0.5

            def __call__(self, features0, features1):
                return gain * self.least

        return Mine

    arguments = np.ones(1), "network"
    matchers = [adding(1)(*arguments), adding(1)(*arguments, least=0.9), adding(2)(*arguments)]
    assert len({fingerprint(recipe_of(matcher)) for matcher in [*matchers, adding(1)(*arguments)]}) == 3
    assert len({fingerprint(recipe_of(Limit(limit))) for limit in (1.0, 2.0)}) == 2  # a field called `recipe`


def test_the_recipes_of_the_library_are_those_of_stored_features():
    """Other recipes would make stores of all users anew."""
    sift = Sift()
    parts = [sift, VladFitting(), Vlad(np.ones((2, 3), np.float32)), NearestNeighborMatcher(), WEIGHTS, ExactSearch(),
             Retrieval(Aggregated(sift, VladFitting())), {n: scorer() for n, scorer in SCORERS.items()}]  # fmt: skip
    pinned = ["e844b5c04fa19ee0", "addef6222ae3f0e4", "08a68e20048ddb13", "26525b65982a6c3e", "7efc3c4cb5c3bcf7",
              "95685df458da8465", "463ddce214f26858", "bb3d90ab0e510374"]  # fmt: skip
    assert [fingerprint(recipe_of(part)) for part in parts] == pinned
    assert recipe_of(LightGlueMatcher(np.ones(1), "network")) == {
        "class": "LightGlueMatching",
        "recipe": {"network": "network", "filter_threshold": 0.1, "depth_confidence": None},
    }


def test_a_recipe_of_ones_own_belongs_to_its_class():
    class Theirs:
        recipe = "thumbnails"

    class Others(Theirs):
        pass

    assert recipe_of(Theirs())["recipe"] == "thumbnails"
    assert recipe_of(Theirs()) != recipe_of(Others())
    with pytest.raises(TypeError, match="Partial: expected a dataclass"):
        recipe_of(jax.tree_util.Partial(lambda x: 2 * x, np.ones(2)))


def test_a_network_is_known_by_its_weights():
    plan = blueprint(entry_of("aliked-t16"))

    def recipe(value):
        weights = {name: np.full(shape, value, np.float32) for name, shape in plan.shapes.items()}
        return recipe_of(AlikedFeatures(plan.build(weights)))

    assert recipe(0) == recipe(0) != recipe(1)


def test_a_network_is_known_wherever_its_functions_are_in_memory():
    def network():
        def promote(arrays, **_):
            return arrays

        return nnx.Conv(1, 1, (1, 1), promote_dtype=promote, rngs=nnx.Rngs(0))

    first, second = network(), network()
    assert str(jax.tree.structure(first)) != str(jax.tree.structure(second))
    assert recipe_of(first) == recipe_of(second)
