"""Exported programs give the numbers of the library; scorers and systems that cannot be exported are refused."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mfvpr
from mfvpr import ExportShapes, Features, InputError, Matches
from mfvpr.baselines import SCORERS
from mfvpr.deployment.folders import (
    check_inputs,
    export_program,
    largest_difference,
    without_unused_inputs,
)
from mfvpr.deployment.programs import make_program
from mfvpr.evaluation import Fusion
from mfvpr.features import Aggregated, Scale, Sift, VladFitting
from mfvpr.retrieval import Retrieval
from tests.scorers import plain

pytestmark = pytest.mark.thorough

SHAPES = ExportShapes(candidates=4, keypoints=49, image_size=(320, 240))
HISTOGRAM = mfvpr.HistogramOfShifts(weight=mfvpr.RatioWeight())
SIFT = Sift()


def make_system(scorers, *, extractor=SIFT, matcher=mfvpr.NearestNeighborMatcher(), **options):  # noqa: B008
    pipeline = mfvpr.Pipeline(extractor, Retrieval(Aggregated(SIFT, VladFitting())), matcher)
    return mfvpr.System(pipeline, scorers, **options)


def outputs_of(method, *, with_shift=False):
    """Inputs of a program, and what its serialized form returns for them, by name."""
    program = make_program(method, SHAPES, with_shift=with_shift)
    inputs = check_inputs(program)
    exported = jax.export.deserialize(export_program(program).serialize())
    outputs = exported.call(*inputs.values())
    assert exported.platforms == ("cpu", "cuda")
    return inputs, dict(zip((each.name for each in program.outputs), map(np.asarray, outputs), strict=True))


def candidate_matches(inputs):
    copies = {name: np.stack([inputs[name]] * SHAPES.candidates) for name in ("image_size0", "count0")}
    return Matches(**inputs | copies)


@pytest.mark.optimized
@pytest.mark.parametrize(
    "scorer",
    [
        *(SCORERS[name]() for name in SCORERS if name not in ("homography", "homography_opencv", "grid")),
        HISTOGRAM,
        plain,
        mfvpr.GridAnchors(side=7),
        mfvpr.HistogramOfShifts(temperature=0.5),
        pytest.param(mfvpr.Homography(), marks=pytest.mark.slow),
    ],
)
def test_a_scorer_gives_the_scores_of_score_candidates(scorer):
    inputs, outputs = outputs_of(scorer)
    expected = {"scores": np.asarray(mfvpr.score_candidates(scorer, candidate_matches(inputs)))}
    assert largest_difference(outputs, expected) <= 1e-5
    assert outputs["scores"][0] > 0
    assert outputs["scores"][-1] == 0  # without matches


def test_a_system_matches_and_scores_by_all_scorers_the_deciding_one_first():
    scorers = {"count": mfvpr.MatchCount(), "histogram": HISTOGRAM}
    matcher = mfvpr.NearestNeighborMatcher(max_distance=0.7)
    inputs, outputs = outputs_of(make_system(scorers, matcher=matcher, final="histogram"), with_shift=True)
    names = "keypoints", "descriptors", "scores", "mask", "image_size"
    query, candidates = (Features(*(inputs[f"{name}{side}"] for name in names)) for side in "01")
    matches = mfvpr.match_candidates(query, candidates, with_ratio=True, product="float32")
    matches = jax.vmap(lambda pair: mfvpr.filter_matches(pair, max_distance=0.7))(matches)
    scores = {name: np.asarray(mfvpr.score_candidates(scorer, matches)) for name, scorer in scorers.items()}
    expected = {"scores": scores["histogram"], "scores_count": scores["count"]}
    assert [*outputs] == ["scores", "scores_count", "shift"]
    assert largest_difference(outputs, expected) <= 1e-5
    assert scores["count"][0] > 30
    np.testing.assert_allclose(outputs["shift"][0], [16, 12], atol=3)  # 5 % of the image


@pytest.mark.slow
def test_padding_does_not_matter_and_a_loop_gives_the_same():
    scorers = {"histogram": HISTOGRAM, "anchor": mfvpr.AnchorPoints()}
    program = make_program(make_system(scorers), SHAPES, with_shift=True)
    inputs = check_inputs(program)
    for side in "01":
        for name in ("keypoints", "descriptors", "scores"):
            inputs[f"{name}{side}"][~inputs[f"mask{side}"]] = np.nan
    expected = program.call(*check_inputs(program).values())
    for values, each in zip(program.call(*inputs.values()), expected, strict=True):
        np.testing.assert_array_equal(values, each)
    for values, each in zip(program.call(*inputs.values(), form="loop"), expected, strict=True):
        np.testing.assert_allclose(values, each, rtol=1e-5, atol=1e-5)


def test_images_above_the_capacity_score_nan_and_smaller_ones_a_number():
    program = make_program(HISTOGRAM, SHAPES, with_shift=False)
    inputs = check_inputs(program)
    for factor, is_number in ((0.9, True), (2.0, False)):
        changed = inputs | {name: factor * inputs[name] for name in ("image_size0", "image_size1")}
        [scores] = program.call(*changed.values())
        assert np.isfinite(scores[0]) == is_number


@pytest.mark.parametrize(
    ("scorer", "names"),
    [
        (mfvpr.MatchCount(), ["mask"]),
        (mfvpr.RapidSpatialScore(per_feature=True), ["points0", "points1", "mask", "image_size0", "count0"]),
        (HISTOGRAM, ["points0", "points1", "mask", "image_size0", "image_size1", "ratio"]),
    ],
)
def test_inputs_without_effect_are_left_out(scorer, names):
    program = without_unused_inputs(make_program(scorer, SHAPES, with_shift=False))
    assert [each.name for each in program.inputs] == names
    assert program.call(*check_inputs(program).values())[0][0] > 0


def call_python(matches):
    shape = jax.ShapeDtypeStruct((), np.float32)
    return jax.pure_callback(lambda mask: np.float32(mask.sum()), shape, matches.mask, vmap_method="sequential")


def call_lapack(matches):
    return jnp.linalg.svd(matches.points0, compute_uv=False)[0] + jnp.linalg.eigh(jnp.eye(2))[0][0]


def branch_in_python(matches):
    return 1.0 if matches.mask[0] else 0.0


@pytest.mark.parametrize(
    ("scorer", "message"),
    [
        (call_python, "without calls into Python, got .*callback"),
        (call_lapack, r"cusolver_\w+, lapack_ssyevd_ffi, lapack_sgesdd_ffi|lapack_sgesdd_ffi, lapack_ssyevd_ffi"),
        (branch_in_python, "code that JAX compiles for cpu and cuda, .* got TracerBoolConversionError.*use jax.numpy"),
        (lambda matches: matches.distance, r"expected a number for each of 1 pairs"),
        (mfvpr.OpenCvHomography(), r"OpenCvHomography: expected a scorer that JAX compiles, .*score_pairs"),
    ],
)
def test_scorers_that_cannot_be_exported_are_refused_by_the_operation(scorer, message):
    with pytest.raises(InputError, match=message) as error:
        export_program(make_program(scorer, SHAPES, with_shift=False))
    assert "\n" not in str(error.value)


@dataclass(frozen=True)
class TwoScales:
    scales: tuple = (Scale(8, 100), Scale(8, 100))


COUNT = {"count": mfvpr.MatchCount()}
FUSED = {"fused": {"count": Fusion()}, "final": "count + retrieval"}


@pytest.mark.parametrize(
    ("system", "options", "message"),
    [
        (FUSED, {}, r"final='count \+ retrieval': expected a scorer, got a ranking that needs the retrieval"),
        ({"extractor": TwoScales()}, {}, "system: expected local features of one scale.*got 2 scales of TwoScales"),
        ({}, {"with_shift": True}, "with_shift=True: expected a HistogramOfShifts.*MatchCount"),
        ({}, {"with_confidence": True}, "with_confidence=True: expected a scorer"),
        ({}, {"shapes": replace(SHAPES, dimension=64)}, "dimension=64: expected 128"),
    ],
)
def test_systems_that_cannot_be_exported_are_refused(system, options, message):
    with pytest.raises(InputError, match=message) as error:
        make_program(make_system(COUNT, **system), **{"shapes": SHAPES, "with_shift": False} | options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("name", "number"), [("candidates", 0), ("dimension", -1), ("image_size", (320, 0))])
def test_shapes_out_of_bounds_are_refused(name, number):
    with pytest.raises(InputError, match=f"{name}=.*: expected"):
        replace(SHAPES, **{name: number})


def test_matches_may_have_a_confidence():
    program = make_program(mfvpr.MatchCount(), SHAPES, with_shift=False, with_confidence=True)
    inputs = check_inputs(program)
    [scores] = program.call(*inputs.values())
    np.testing.assert_allclose(scores, (inputs["confidence"] * inputs["mask"]).sum(axis=1), rtol=1e-5)
