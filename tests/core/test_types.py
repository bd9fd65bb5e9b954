"""`value`: dataclasses that jit tells apart, whatever they hold."""

from dataclasses import FrozenInstanceError, field, fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

import mfvpr
from mfvpr.core.types import per_match, per_pair
from tests.builders import make_features, random_matches
from tests.shapes import unchecked_shapes

pytestmark = pytest.mark.thorough


def one_number(factor):
    """A new class of scorers with the score `factor * number`."""

    class Score:
        number: float = 1.0

        def __call__(self, matches):
            return factor * self.number * jnp.any(matches.mask).astype(jnp.float32)

    Score.__annotations__ = {"number": float}
    Score.__name__ = Score.__qualname__ = f"Score{factor}"
    return mfvpr.value(Score)


def test_jit_never_takes_one_class_for_another():
    """Neither for traces, where only colliding hashes would show it, nor for programs."""
    evaluate = jax.jit(lambda scorer, matches: scorer(matches))
    matches = random_matches(np.random.default_rng(0), 3)

    def score_by_trace(scorer):
        program = evaluate.trace(scorer, matches).jaxpr
        return jaxpr_as_fun(program)(*jax.tree.leaves((scorer, matches)))[0]

    assert [factor for factor in range(400) if score_by_trace(one_number(factor)()) != factor] == []
    assert [factor for factor in range(50) if evaluate(one_number(factor)(), matches) != factor] == []


def test_classes_without_leaves_differ():
    first, second = (mfvpr.value(type(name, (), {})) for name in ("First", "Second"))
    assert jax.tree.structure(first()) != jax.tree.structure(second())
    assert jax.tree.structure(first()) == jax.tree.structure(first())


@mfvpr.value
class Example:
    number: float = 1.0
    count: int = 3
    inner: object = mfvpr.HistogramOfShifts(sigma=10.0)
    kind: str = field(default="a", metadata={"static": True})


def test_leaves_keep_their_types_and_floats_given_as_whole_numbers_are_floats():
    leaves, structure = jax.tree.flatten(Example(number=2, count=5))
    assert leaves[:2] == [2.0, 5]
    assert [type(leaf) for leaf in leaves[:2]] == [float, int]
    assert jax.tree.unflatten(structure, leaves) == Example(number=2.0, count=5)
    assert structure != jax.tree.structure(Example(kind="b"))
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(Example())]
    assert paths[:3] == [".number", ".count", ".inner.bin_size"]
    with pytest.raises(FrozenInstanceError):
        Example().number = 2.0


def test_every_field_of_matches_is_of_a_match_or_of_the_pair():
    """A field that is added must not be lost by stores and batches, which go by `per_match`."""
    matches = random_matches(np.random.default_rng(0), 5, capacity=8)
    of_pair = {"image_size0", "image_size1", "count0", "count1"}
    assert set(per_pair(matches)) == of_pair
    assert set(per_match(matches)) == {f.name for f in fields(matches)} - of_pair - {"mask"}
    assert all(len(values) == 8 for values in per_match(matches).values())
    without = mfvpr.Matches(**{f.name: getattr(matches, f.name) for f in fields(matches) if f.name != "ratio"})
    assert "ratio" not in per_match(without)


class Tensor:
    """An array as torch has them: no NumPy with a gradient, no NumPy at all on an accelerator."""

    def __init__(self, values, device=1, requires_grad=True):
        self.values, self.device, self.requires_grad = np.asarray(values), device, requires_grad

    def detach(self):
        return Tensor(self.values, self.device, requires_grad=False)

    def cpu(self):
        return Tensor(self.values, requires_grad=self.requires_grad)

    def __dlpack__(self, **options):
        if self.requires_grad or self.device != 1:
            raise BufferError("a gradient, or an accelerator that JAX does not use")
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.device, 0


@pytest.mark.parametrize("convert", [Tensor, lambda values: Tensor(values, device=2)])
def test_arrays_of_other_libraries_give_the_same_numbers(convert):
    """Also those that require a gradient, or whose masks are integers."""
    features = make_features(np.random.default_rng(0), 12, capacity=16)
    candidates = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), features)
    entries = [{f.name: getattr(image, f.name) for f in fields(image)} for image in (features, candidates)]
    with unchecked_shapes():
        images = [
            mfvpr.Features.of(**{n: convert(2 * v.astype(np.uint8) if n == "mask" else v) for n, v in image.items()})
            for image in entries
        ]
        matches = mfvpr.match_candidates(*images)
        arrays = {f.name: getattr(matches, f.name) for f in fields(matches) if getattr(matches, f.name) is not None}
        again = mfvpr.Matches(**{name: convert(np.asarray(values)) for name, values in arrays.items()})
        scores = mfvpr.score_candidates(mfvpr.HistogramOfShifts(), again)
        order = np.asarray(mfvpr.rank(convert(np.asarray(scores))))
        vectors = convert(features.descriptors[:12])
        shortlist = mfvpr.retrieve(vectors, vectors, num_candidates=2, mask=convert(np.full(12, 2)))
        recall = mfvpr.recall_at_k(convert(np.asarray(shortlist.indices)), convert(np.eye(12, dtype=bool)), [1])
    expected = mfvpr.match_candidates(features, candidates)
    jax.tree.map(np.testing.assert_array_equal, matches, expected)
    np.testing.assert_array_equal(scores, mfvpr.score_candidates(mfvpr.HistogramOfShifts(), expected))
    assert (order.tolist(), recall.tolist()) == (np.argsort(-scores, stable=True).tolist(), [1.0])


def test_features_have_defaults_but_no_image_size():
    """Counts need none; a score that needs one says so, traced or not."""
    rng = np.random.default_rng(0)
    [image] = [make_features(rng, 9)]
    features = mfvpr.Features.of(image.keypoints, image.descriptors)
    lists = mfvpr.Features.of(image.keypoints.tolist(), image.descriptors.tolist(), image_size=(640, 480))
    assert (lists.keypoints == features.keypoints).all()
    assert (features.scores.tolist(), features.mask.all()) == ([1.0] * 9, True)
    shapes = "keypoints=float32[9, 2], descriptors=float32[9, 16], scores=float32[9], mask=bool[9]"
    assert repr(features) == f"Features({shapes})"
    candidates = jax.tree.map(lambda leaf: leaf[None], features)
    for match in (mfvpr.match_candidates, jax.jit(mfvpr.match_candidates)):
        matches = match(features, candidates)
        with unchecked_shapes():
            assert mfvpr.score_candidates(mfvpr.MatchCount(), matches).tolist() == [9.0]
        for scorer in (mfvpr.HistogramOfShifts(), mfvpr.AnchorPoints(), mfvpr.Homography()):
            with unchecked_shapes(), pytest.raises(mfvpr.InputError, match=r"sizes of both images.*Features.of"):
                mfvpr.score_candidates(scorer, matches)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("keypoints", (8, 2)),
        ("scores", (9, 1)),
        ("image_size", (3,)),
        ("points0", (1, 2)),
        ("confidence", (3,)),
    ],
)
def test_arrays_of_different_lengths_are_refused(name, shape):
    rng = np.random.default_rng(0)
    data = next(data for data in (make_features(rng, 9), random_matches(rng, 9)) if hasattr(data, name))
    with unchecked_shapes(), pytest.raises(mfvpr.InputError, match=rf"\.{name}: expected shape .*, got \[") as error:
        replace(data, **{name: np.ones(shape, np.float32)})
    assert "\n" not in str(error.value)
