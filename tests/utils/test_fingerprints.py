"""Recipes: what makes a result another one, and nothing else."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import nnx

from mfvpr import LightGlueMatcher, value
from mfvpr.baselines.scorers import SCORERS
from mfvpr.checkpoints import entry_of
from mfvpr.checkpoints.networks import plan_network
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


@dataclass(frozen=True)
class Mine:
    """A class of one's own with a recipe, which says what its fields do not."""

    size: int = 2
    function: object = len
    batch_size: int = field(default=3, metadata={"recipe": False})
    recipe = "mine 1"


class Newer(Mine):
    recipe = "mine 2"


def test_a_class_of_ones_own_names_its_recipe():
    assert recipe_of(Mine()) == {"class": f"{__name__}.Mine", "recipe": "mine 1", "size": 2}
    different = [Mine(), Mine(size=3), Newer()]
    assert len({fingerprint(recipe_of(each)) for each in different}) == len(different)
    assert recipe_of(Mine(batch_size=1, function=max)) == recipe_of(Mine())
    assert recipe_of([Mine(), {"a": Path("b")}], lambda path: "content")[1] == {"a": "content"}


@dataclass(frozen=True)
class Unnamed:
    size: int = 2


@value
class UnnamedValue:
    arrays: jax.Array


class BrighterSift(Sift):
    """A subclass of ours, whose code decides as well."""


class OtherLightGlue(LightGlueMatcher):
    """A subclass of one of ours with a recipe, which does not speak for it."""


@pytest.mark.parametrize(
    "part",
    [Unnamed(), UnnamedValue(np.ones(2)), BrighterSift(), OtherLightGlue(np.ones(1), "network"), len, lambda x: x],
)
def test_without_a_recipe_there_is_none(part):
    with pytest.raises(TypeError, match="names no `recipe`"):
        recipe_of([part])


def test_classes_of_the_library_are_known_by_name_and_fields():
    sift, vlad = Sift(), Vlad(np.ones((2, 3), np.float32))
    parts = [sift, VladFitting(), vlad, NearestNeighborMatcher(), WEIGHTS, Retrieval(Aggregated(sift, VladFitting()))]
    parts.append({name: scorer() for name, scorer in SCORERS.items()})
    assert len({fingerprint(recipe_of(part)) for part in parts}) == len(parts)
    assert recipe_of(ExactSearch())["class"] == "ExactSearch"
    assert recipe_of(LightGlueMatcher(np.ones(1), "network")) == {
        "class": "LightGlueMatcher",
        "recipe": {"network": "network", "filter_threshold": 0.1, "depth_confidence": None},
    }


def test_a_network_is_known_by_its_weights():
    plan = plan_network(entry_of("aliked-t16").builder())

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
