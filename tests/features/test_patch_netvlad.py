"""Patch-NetVLAD as a system: patches of several sizes, scored alone and fused; one pass with its own retrieval."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

import mfvpr
from mfvpr.evaluation import fuse_scales
from mfvpr.features import PatchNetVladFeatures
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
from mfvpr.utils import InputError
from tests.builders import evaluate_parts, read_golden
from tests.features.conftest import read_rows
from tests.golden import make_patch_scores as patch_scores
from tests.golden.make_netvlad import POSITIONS, image, name
from tests.golden.make_relatives import PATCHES
from tests.networks.checkpoints import fill_netvlad

pytestmark = pytest.mark.thorough

SIZE = (160, 128)


SCORERS = {"count": mfvpr.MatchCount(), "histogram": mfvpr.HistogramOfShifts()}


@pytest.fixture(scope="module")
def model():
    return fill_netvlad(4, 16)


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize("position", POSITIONS, ids=map(str, POSITIONS))
def test_patches_are_where_the_public_code_has_them(model, position):
    size, patch = position
    extractor = PatchNetVladFeatures(model, size, patch_sizes=(patch,))
    [scale], [description] = extractor.scales, extractor(image(size))
    expected = read_golden("netvlad")[name("positions", *position)]
    np.testing.assert_array_equal(description.features.keypoints, expected)
    assert description.features.descriptors.shape == (len(expected), 16)
    assert scale == (16, len(expected), 1.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"patch_sizes": ()}, r"patch_sizes=\(\): expected a list of one or more"),
        ({"patch_sizes": (9,)}, "expected sizes from 1 to 8, .*10 x 8"),
        ({"patch_sizes": (0, 2)}, "from 1"),
        ({"scale_weights": (1.0, 2.0)}, r"scale_weights=\[1.0, 2.0\]: .*patch_sizes=\[5\], or None"),
    ],
)
def test_what_cannot_be_is_refused(model, options, words):
    with pytest.raises(InputError, match=words):
        PatchNetVladFeatures(model, SIZE, **options)
    with pytest.raises(InputError, match=r"PatchNetVladFeatures: .*VggNetVlad .*got Vgg16"):
        PatchNetVladFeatures(model.vgg, SIZE)
    with pytest.raises(ValueError, match=r"one scale, got 2; .*`local`"):
        _ = PatchNetVladFeatures(model, SIZE, patch_sizes=(2, 3))(image(SIZE))[0].features


@pytest.mark.slow
def test_scales_are_standardized_weighted_and_summed(model, dataset, tmp_path):
    """As the public code does: z-scores over a query's candidates by scale, by float64 loops; also out of its store."""
    sizes, weights = (2, 3, 5), (0.45, 0.15, 0.4)
    extractor = PatchNetVladFeatures(model, SIZE, patch_sizes=sizes, scale_weights=weights)
    lines = []
    cache = partial(FeatureCache, tmp_path, runtime=mfvpr.Runtime(log=lines.append))
    options = {"candidates": 6, "cache": cache()}
    report = evaluate_parts(dataset, extractor, Retrieval(extractor), SCORERS, **options)
    assert sum("images to do" in line for line in lines) == 2  # one pass a side: descriptors and patches
    single = []
    for size in sizes:  # out of stores as well, which round descriptors
        alone = replace(extractor, patch_sizes=(size,), scale_weights=None)
        scale_cache = FeatureCache(tmp_path / str(size))
        single.append(evaluate_parts(dataset, alone, Retrieval(alone), SCORERS, candidates=6, cache=scale_cache))
    for scorer in SCORERS:
        expected = 0.0
        for weight, alone in zip(weights, single, strict=True):
            [ranked] = alone.systems[scorer]
            scores = np.take_along_axis(ranked.scores, np.argsort(ranked.rows, axis=1), axis=1).astype(np.float64)
            expected += weight * (scores - scores.mean(axis=1, keepdims=True)) / scores.std(axis=1, keepdims=True)
        [ranked] = report.systems[scorer]
        actual = np.take_along_axis(ranked.scores, np.argsort(ranked.rows, axis=1), axis=1)
        np.testing.assert_allclose(actual, expected, atol=1e-4)
    other = replace(extractor, scale_weights=(1.0, 2.0, 3.0))
    changed = evaluate_parts(dataset, other, Retrieval(other), SCORERS, candidates=6, cache=cache())
    assert sum("images to do" in line for line in lines) == 2  # weights are no part of what is kept
    for scorer in SCORERS:
        assert np.abs(changed.systems[scorer][0].scores - report.systems[scorer][0].scores).max() > 0.1


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize(
    ("matcher", "scorer", "unit"),
    [
        (
            "spatialApproximator",
            lambda patch: mfvpr.RapidSpatialScore(
                size=tuple(16.0 * (side - patch) for side in reversed(patch_scores.MAP)), per_feature=True
            ),
            256,
        ),
        ("RANSAC", lambda patch: mfvpr.Homography(24.0, few="zero", per_feature=True), 1),
    ],
)
def test_scores_and_rankings_are_the_public_codes(model, matcher, scorer, unit):
    """Every size, for pairs and over candidates; the public scores are the smaller, the better, and in patches.

    Where few patches show a place, RANSAC finds one more or less by luck; here most do.
    """
    golden, height, width = read_golden("patch_scores"), *(16 * side for side in patch_scores.MAP)
    scores = []
    for patch in PATCHES:
        [places] = PatchNetVladFeatures(model, (width, height), patch_sizes=(patch,))(image((width, height)))
        query, candidates = patch_scores.descriptors(patch)
        everywhere = jax.tree.map(
            partial(np.repeat, repeats=len(candidates), axis=0),
            jax.tree.map(lambda field: field[None], places.features),
        )
        matches = mfvpr.match_candidates(
            replace(places.features, descriptors=query), replace(everywhere, descriptors=candidates)
        )
        scores.append(np.asarray(mfvpr.score_candidates(scorer(patch), matches)) / unit)
    fused_scores, real = np.stack(scores, axis=1), np.ones(len(scores[0]), bool)
    np.testing.assert_allclose(fused_scores, -golden[f"{matcher}/scales"], rtol=1e-4)
    weights = np.array(patch_scores.WEIGHTS)
    np.testing.assert_allclose(fused_scores @ weights, -golden[f"{matcher}/pairs"], rtol=1e-4)
    fused = fuse_scales(fused_scores, real, weights)
    np.testing.assert_allclose(fused, -golden[f"{matcher}/fused"], atol=1e-4)
    np.testing.assert_array_equal(mfvpr.rerank(fused).order, np.argsort(golden[f"{matcher}/fused"]))


@pytest.fixture
def program(run_program, weights, street_settings, tmp_path, monkeypatch):
    """Run a command line with small images; return its folder and its messages."""
    monkeypatch.setenv("MFVPR_WEIGHTS", str(weights))
    small = ("features.weights=patchnetvlad_mapillary_128", "features.image_size=[160,128]", "candidates=5")

    def run(kind, *more, code=0):
        out = tmp_path / str(len([*tmp_path.iterdir()]))
        return out, run_program(kind, *street_settings, *small, f"out={out}", *more, code=code)

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "scorer"), [("patch_netvlad_performance", "homography"), ("patch_netvlad_storage", "rapid")]
)
def test_its_configurations_run_by_name(program, system, scorer):
    reach = () if scorer == "homography" else ("scorer.size=[80,48]",)
    if reach:  # at another size of images, that of the configuration is another score
        _, stderr = program("evaluate", f"system={system}", code=2)
        assert "scorer.size=[560, 400]: expected " in stderr
        assert "[80, 48]" in stderr
    out, _ = program("evaluate", f"system={system}", "figures=2", *reach)
    rows = read_rows(out)
    assert [row["system"] for row in rows if row["decides"]] == [scorer] * 3
    assert rows[0]["features"]["patch_sizes"] == ([2, 5, 8] if "performance" in system else [5])
    assert rows[0]["retrieval"]["name"] == "same"
