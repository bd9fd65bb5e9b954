"""The networks of the benchmark do the same on both sides, so that equals are compared."""

import json
from functools import partial

import numpy as np
import pytest

from experiments.benchmark import scores
from experiments.benchmark.__main__ import run as run_benchmark
from mfvpr import InputError
from mfvpr.checkpoints.conversion import SELAVPR
from mfvpr.checkpoints.networks import NETWORKS, Network
from mfvpr.networks import SelaVpr
from tests.needs import skip_without

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def contest(tmp_path_factory):
    """Results of all networks after one round on small images with random weights, and the report."""
    skip_without("torch")
    import torch

    from experiments.benchmark import networks

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # several wait for each other when other processes take their cores
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MFVPR_WEIGHTS", str(tmp_path_factory.mktemp("weights")))
        small = {"BATCHES": (2,), "D2NET_SIZE": (96, 96), "ALIKED_SIZE": (96, 96), "ALIKED": ("aliked-n16",),
                 "PLACES_SIZE": (160, 128), "SELAVPR_SIZE": (42, 28)}  # fmt: skip
        narrow = Network(lambda: partial(SelaVpr, 128, 2, 2), SELAVPR)
        patch.setitem(NETWORKS, networks.SELAVPR, narrow)
        for name, value in small.items():
            patch.setattr(networks, name, value)
        out = tmp_path_factory.mktemp("benchmark") / "networks.json"
        results = networks.run(1, out)
    torch.set_num_threads(threads)
    return results, json.loads(out.read_text())


def peers(contest, step):
    """Result of mfvpr for a batch of 2, and those of torch."""
    by_name = {name: result for (title, name), result in contest[0].items() if title == f"{step}, batch 2"}
    ours = by_name.pop("mfvpr")
    assert len(by_name) == 3  # two memory layouts, and one by one
    return ours, by_name.values()


@pytest.mark.parametrize("step", ["D2-Net", "aliked-n16"])
def test_keypoints_are_the_same(contest, step):
    ours, all_theirs = peers(contest, f"{step} features")
    assert len(ours) == 2
    for theirs in all_theirs:
        for features, expected in zip((image.features for image in ours), theirs, strict=True):
            assert len(features.keypoints) > 10
            assert abs(len(features.keypoints) - len(expected.keypoints)) <= 0.02 * len(features.keypoints)
            distance = np.linalg.norm(features.keypoints[:, None] - expected.keypoints, axis=2)
            nearest = distance.argmin(1)
            same = distance.min(1) < 0.05  # px; rounding moves a few maxima
            assert same.mean() >= 0.98
            descriptors, scores = expected.descriptors[nearest][same], expected.scores[nearest][same]
            np.testing.assert_allclose(features.descriptors[same], descriptors, atol=2e-3)
            np.testing.assert_allclose(features.scores[same], scores, rtol=1e-3, atol=1e-4)


def test_dense_maps_and_global_descriptors_are_the_same(contest):
    ours, all_theirs = peers(contest, "D2-Net dense map")
    ours = np.concatenate([np.asarray(dense) for dense in ours]).transpose(0, 3, 1, 2)
    for theirs in all_theirs:
        np.testing.assert_allclose(ours, np.stack([np.asarray(dense) for dense in theirs]), atol=1e-4 * ours.max())
    ours, all_theirs = peers(contest, "MixVPR descriptor")
    for theirs in all_theirs:
        np.testing.assert_allclose([image.vector for image in ours], theirs, atol=1e-5)


def test_report_has_everyone(contest):
    results, written = contest
    assert {(entry["step"], entry["name"]) for entry in written["results"]} == results.keys()
    assert {step.partition(" ")[0] for step, _ in results} >= {"NetVLAD", "Patch-NetVLAD", "SelaVPR", "generalized"}
    assert all(entry["median_ms"] > 0 for entry in written["results"])
    assert any("aliked-n16 features, batch 2: keypoints per image: mfvpr" in remark for remark in written["remarks"])


def test_all_searches_give_the_same_rows():
    results = {(step, name): call() for step, name, call in scores.search_entries(200, 24, (1, 3))}
    for (step, name), rows in results.items():
        if name != "bare product":
            rows = np.asarray(rows.indices if name == "mfvpr" else rows)
            np.testing.assert_array_equal(rows, results[step, "NumPy"])


def test_the_file_of_others_stays(tmp_path):
    """It is refused before the work."""
    (tmp_path / "precious.json").write_text("{}")
    with pytest.raises(InputError, match="expected a new file"):
        run_benchmark("scores", [], 1, tmp_path / "precious.json")
