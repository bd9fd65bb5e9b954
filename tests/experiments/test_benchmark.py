"""Benchmarks: all implementations compute the same, so that equals are compared; results on a device are exact."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from experiments.benchmark import accelerator_checks, networks, scores
from experiments.benchmark.benchmarks import THOUSAND, run
from experiments.benchmark.harness import torch_or_none
from mfvpr import InputError
from mfvpr.checkpoints import REGISTRY
from mfvpr.networks import SelaVpr
from tests.needs import skip_without
from tests.programs import output_of

# Smaller images where a network takes them, px.
SIZES = {networks.D2NET: (96, 96), networks.ALIKED: (96, 96), networks.MIXVPR: (320, 320), "selavpr_msls": (42, 28)}


@pytest.mark.slow
def test_results_are_exact_and_times_are_reported(tmp_path, monkeypatch, capsys):
    arguments = "accelerator", "correct", "rates", "--rounds", "2", "--out", tmp_path / "report.json"
    stdout, _ = output_of(monkeypatch, capsys, "benchmark.benchmarks", *arguments)
    report = json.loads((tmp_path / "report.json").read_text())["groups"]
    assert len(report["correct"]) > 15
    assert {row["exact"] for row in report["correct"]} == {"yes"}
    assert {row["step"] for row in report["rates"] if row["median, ms"] > 0} == {"product 256 x 256"}
    assert "product 256 x 256" in stdout


def test_matches_by_products_of_few_digits_differ():
    images = accelerator_checks.images()
    high_bits = np.uint32(0xFFFFE000)  # bits of TF32
    rounded = tuple(
        replace(image, descriptors=(image.descriptors.view(np.uint32) & high_bits).view(np.float32)) for image in images
    )
    assert accelerator_checks.match(images)[2] == 0
    assert accelerator_checks.match(images, rounded=rounded)[2] > 10


def test_mistakes_are_refused_before_the_work(tmp_path):
    with pytest.raises(InputError, match=r"expected some of correct, .* got network"):
        run("accelerator", ["network"], 1, tmp_path / "report.json")
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(InputError, match="expected a new file"):
        run("scores", [], 1, tmp_path / "report.json")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "sizes"),
    [
        (scores.scoring_entries, (6,)),
        (scores.matching_entries, (4, 60, 32)),
        (scores.search_entries, (2000, 32, (1, 5))),
        (scores.ranking_entries, (1, 4, 60, 32)),
        (scores.ranking_entries, (3, 4, 60, 32)),
        (scores.grid_entries, ("settings", THOUSAND, 6)),
    ],
)
def test_others_compute_the_same(make, sizes):
    skip_without("torch", "faiss")
    first = {}
    for step, name, call in make(*sizes):
        theirs = call()
        ours = first.setdefault(step, theirs)  # of mfvpr
        if name in ("bare product", "read", "mfvpr, with ratio"):
            continue
        if make is scores.matching_entries:
            expected = np.where(ours.mask, ours.index1, -1)
            if name == "torch":
                nearest1, mutual, distance = map(np.asarray, theirs)
                theirs = np.where(mutual, nearest1, -1)
                np.testing.assert_allclose(distance[mutual], np.asarray(ours.distance)[mutual], atol=1e-6)
            elif name.startswith("OpenCV"):
                found, theirs = theirs, np.full(expected.shape, -1)
                for row, matches in enumerate(found):
                    theirs[row, [match.queryIdx for match in matches]] = [match.trainIdx for match in matches]
            elif name.startswith("mfvpr"):
                theirs = np.where(theirs.mask, theirs.index1, -1)
            np.testing.assert_array_equal(theirs, expected, err_msg=name)
            continue
        if make is scores.search_entries:
            ours, theirs = ours.indices, theirs.indices if name == "mfvpr" else theirs
        theirs = np.asarray(theirs).squeeze()
        if make is scores.grid_entries and name == "torch":
            theirs = theirs.reshape(2, 25, 6, 2, 10).transpose(1, 0, 3, 4, 2)
        np.testing.assert_allclose(np.squeeze(ours), theirs, rtol=1e-5, err_msg=name)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Results of all networks on two small images with random weights, by step and implementation."""
    skip_without("torch")
    torch = torch_or_none()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # several wait for each other when other processes take their cores
    contests = [each for each in networks.CONTESTS if each.checkpoint != "aliked-n32"]
    contests = [each._replace(size=SIZES.get(each.checkpoint, (160, 128))) for each in contests]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MFVPR_WEIGHTS", str(tmp_path_factory.mktemp("weights")))
        narrow = replace(REGISTRY["selavpr_msls"], builder=lambda: partial(SelaVpr, 128, 2, 2))
        patch.setitem(REGISTRY, "selavpr_msls", narrow)
        yield {(step, name): call() for step, name, call in networks.network_entries(contests, (2,))}
    torch.set_num_threads(threads)


def peers(results, step):
    """Result of mfvpr for a batch of 2, and those of torch."""
    by_name = {name: result for (title, name), result in results.items() if title == f"{step}, batch 2"}
    ours = by_name.pop("mfvpr")
    assert len(by_name) == 3  # two memory layouts, and one by one
    return ours, by_name.values()


@pytest.mark.slow
def test_keypoints_are_the_same(results):
    ours, all_theirs = peers(results, "aliked-n16 features")
    assert len(ours) == 2
    for theirs in all_theirs:
        for features, (points, descriptors, strengths) in zip((image.features for image in ours), theirs, strict=True):
            assert len(features.keypoints) > 10
            assert abs(len(features.keypoints) - len(points)) <= 0.02 * len(features.keypoints)
            distance = np.linalg.norm(features.keypoints[:, None] - points, axis=2)
            nearest, same = distance.argmin(1), distance.min(1) < 0.05  # px; rounding moves a few maxima
            assert same.mean() >= 0.98
            np.testing.assert_allclose(features.descriptors[same], descriptors[nearest][same], atol=2e-3)
            np.testing.assert_allclose(features.scores[same], strengths[nearest][same], rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_dense_maps_and_global_descriptors_are_the_same(results):
    assert {step.partition(" ")[0] for step, _ in results} >= {"NetVLAD", "Patch-NetVLAD", "SelaVPR", "generalized"}
    ours, all_theirs = peers(results, "D2-Net dense map")
    ours = np.concatenate([np.asarray(dense) for dense in ours]).transpose(0, 3, 1, 2)
    for theirs in all_theirs:
        np.testing.assert_allclose(ours, np.stack([np.asarray(dense) for dense in theirs]), atol=1e-4 * ours.max())
    ours, all_theirs = peers(results, "MixVPR descriptor")
    for theirs in all_theirs:
        np.testing.assert_allclose([image.vector for image in ours], theirs, atol=1e-5)
