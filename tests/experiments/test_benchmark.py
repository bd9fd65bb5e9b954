"""The networks of the benchmark do the same on both sides, so that equals are compared."""

import json
import subprocess
import sys
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from experiments.benchmark.__main__ import BENCHMARKS
from mfvpr.checkpoints import entry_of
from mfvpr.checkpoints.networks import NETWORKS, Network, blueprint, network_of
from mfvpr.checkpoints.tables import SELAVPR
from mfvpr.datasets import folder_dataset
from mfvpr.evaluation import evaluate
from mfvpr.features import Aggregated, Description, Sift, VladFitting
from mfvpr.networks import SelaVpr
from mfvpr.retrieval import Retrieval
from mfvpr.scoring import MatchCount
from mfvpr.types import Shortlist
from mfvpr.utils import InputError
from tests import random_checkpoints

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def contest(tmp_path_factory):
    """Small images and random weights; everyone's results after one round."""
    torch = pytest.importorskip("torch", reason="torch is what the networks are compared with")
    from experiments.benchmark import harness, networks

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # several wait for each other when other processes take their cores
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MFVPR_WEIGHTS", str(tmp_path_factory.mktemp("weights")))
        small = {"BATCHES": (2,), "D2NET_SIZE": 96, "ALIKED_SIZE": 96, "ALIKED": ("aliked-n16",), "BLOCKS": 2,
                 "PLACES_SIZE": (160, 128), "SELAVPR_SIZE": (42, 28)}  # fmt: skip
        narrow = Network(lambda: partial(SelaVpr, 128, 2, 2), SELAVPR)
        patch.setitem(NETWORKS, networks.SELAVPR, narrow)
        for name, value in small.items():
            patch.setattr(networks, name, value)
        lineup = networks.lineup()
        seconds, results = harness.take_turns([run for _, _, run in lineup.entries], rounds=1)
        out = tmp_path_factory.mktemp("benchmark") / "networks.json"
        harness.report(lineup, seconds, results, out)
    torch.set_num_threads(threads)
    by_step = {}
    for (step, name, _), result in zip(lineup.entries, results, strict=True):
        by_step.setdefault(step, {})[name] = result
    return by_step, json.loads(out.read_text())


def peers(results):
    """mfvpr's result, and each peer's."""
    others = dict(results)
    ours = others.pop("mfvpr")
    if isinstance(ours[0], Description):
        ours = [one.features if one.local else one.vector for one in ours]
    assert len(others) == 3  # two memory layouts, and one by one
    return ours, others.values()


@pytest.mark.parametrize("step", ["D2-Net", "aliked-n16"])
def test_keypoints_are_the_same(contest, step):
    ours, others = peers(contest[0][f"{step} features, batch 2"])
    assert len(ours) == 2
    for theirs in others:
        for one, other in zip(ours, theirs, strict=True):
            assert len(one.keypoints) > 10
            assert abs(len(one.keypoints) - len(other.keypoints)) <= 0.02 * len(one.keypoints)
            distance = np.linalg.norm(one.keypoints[:, None] - other.keypoints, axis=2)
            nearest = distance.argmin(1)
            same = distance.min(1) < 0.05  # px; rounding moves a few maxima
            assert same.mean() >= 0.98
            found = other.descriptors[nearest][same], other.scores[nearest][same]
            np.testing.assert_allclose(one.descriptors[same], found[0], atol=2e-3)
            np.testing.assert_allclose(one.scores[same], found[1], rtol=1e-3, atol=1e-4)


def test_dense_maps_are_the_same(contest):
    ours, others = peers(contest[0]["D2-Net dense map, batch 2"])
    ours = np.concatenate([np.asarray(one) for one in ours]).transpose(0, 3, 1, 2)
    for theirs in others:
        np.testing.assert_allclose(ours, np.stack([np.asarray(one) for one in theirs]), atol=1e-4 * ours.max())


def test_descriptors_are_the_same(contest):
    ours, others = peers(contest[0]["MixVPR descriptor, batch 2"])
    for theirs in others:
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


@pytest.mark.parametrize("step", ["NetVLAD descriptor", "generalized mean of ResNet-50"])
def test_global_descriptors_are_the_same(contest, step):
    ours, others = peers(contest[0][f"{step}, batch 2"])
    for theirs in others:
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


@pytest.mark.parametrize("step", [
    "Patch-NetVLAD features, sizes 5, 512 dimensions", "Patch-NetVLAD features, sizes 2, 5, 8, 4096 dimensions",
    "SelaVPR features",
])  # fmt: skip
def test_local_descriptors_are_the_same(contest, step):
    results = dict(contest[0][f"{step}, batch 2"])
    ours = results.pop("mfvpr")
    assert len(results) == 3
    for theirs in results.values():
        for one, (whole, *local) in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(one.vector, whole, atol=1e-5)
            for features, expected in zip(one.local, local, strict=True):
                np.testing.assert_allclose(features.descriptors.ravel(), expected.ravel(), atol=2e-5)


def test_report_has_everyone(contest):
    by_step, written = contest
    names = {(entry["step"], entry["name"]) for entry in written["results"]}
    assert names == {(step, name) for step, results in by_step.items() for name in results}
    assert all(entry["median_ms"] > 0 for entry in written["results"])
    remarks = "\n".join(written["remarks"])
    for wanted in ("detection adds", "aliked-n16 features, batch 2: keypoints per image: mfvpr", "RTX 2080 Ti"):
        assert wanted in remarks


def test_a_small_database_is_ranked_in_its_own_process(tmp_path, monkeypatch, capsys):
    from experiments.benchmark import scale
    from experiments.benchmark.synthetic_features import MadeUp

    data = MadeUp(60, 3, 60, 16)
    monkeypatch.setattr(scale, "SETS", [data])
    scale.run(1, tmp_path / "out.json", tmp_path / "stores")
    stores = {path: path.stat().st_mtime_ns for path in (tmp_path / "stores").rglob("*.npz")}
    assert len(stores) == 60 + 3
    content = json.loads((tmp_path / "out.json").read_text())
    [row] = content["results"]
    assert row["images"] == 60
    assert row["same"] is True
    assert row["recall"] == 1
    assert row["rows"] == pytest.approx((60 + 3) / 3, abs=3)  # nearly all are somebody's candidates, and read once
    assert row["peak"] > 0.1
    assert 0 < row["steps"]["matching"] < row["total"][0]
    assert "bit for bit: 60 images, D = 16: yes" in capsys.readouterr().out
    data.stores(tmp_path / "stores")
    assert stores == {path: path.stat().st_mtime_ns for path in (tmp_path / "stores").rglob("*.npz")}


def test_stores_are_for_scale_alone(monkeypatch, capsys):
    from experiments.benchmark.__main__ import main

    monkeypatch.setattr(sys, "argv", ["benchmark", "scores", "--stores", "somewhere"])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert "--stores is for scale alone" in capsys.readouterr().err


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_is_a_module(name):
    assert callable(import_module(f"experiments.benchmark.{name}").run)


def test_help_needs_no_jax():
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "experiments.benchmark", "--help"],
        cwd=ROOT, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0
    assert all(f"{name} " in done.stdout and about in done.stdout for name, about in BENCHMARKS.items())
    assert " jax\n" not in done.stderr


def test_maps_are_matched_and_scored_as_in_torch(monkeypatch):
    pytest.importorskip("torch", reason="torch is what they are compared with")
    from experiments.benchmark import maps

    for name, value in {"SELAVPR": (3, (9, 9), 16), "SPEED": (4, (6, 8), 32)}.items():
        monkeypatch.setattr(maps, name, value)
    entries = [*maps.count_entries(maps.made_up(*maps.SELAVPR)), *maps.patch_entries(maps.made_up(*maps.SPEED))]
    results = {(step, who): run() for step, who, run in entries}
    for step in (maps.COUNT, maps.RAPID):
        ours, theirs = (results[step, who] for who in (maps.MFVPR, "torch, candidate by candidate"))
        np.testing.assert_allclose(ours, theirs, rtol=1e-4)
        assert (np.diff(ours) > 0).all()  # those that show more
    remarks = "\n".join(maps.list_remarks({key: [1.0, 2.0] for key in results}, results))
    for wanted in ("count: scores that differ: [0]", "and score: scores that differ: [0]", "1.00 x the matching"):
        assert wanted in remarks


def test_cells_are_matched_and_scored_as_by_the_public_program(monkeypatch):
    from experiments.benchmark import cells

    for name, value in {"CANDIDATES": 3, "SIDE": 8, "CELLS": 64, "DIMENSION": 12}.items():
        monkeypatch.setattr(cells, name, value)
    results = {(step, who): run() for step, who, run in cells.entries(*cells.made_up())}
    ours, theirs = results["matching", "mfvpr"], results["matching", "NumPy, inner product"]
    np.testing.assert_array_equal(ours.index0, theirs)
    np.testing.assert_array_equal(results["score", "mfvpr"], results["score", "NumPy, patch by patch"])
    assert (np.asarray(results["score", "mfvpr"]) > 100).all()


def test_every_ransac_counts_the_plane(monkeypatch):
    from experiments.benchmark import homographies

    for name, value in {"PAIRS": 3, "SHARES": (0.6,), "THRESHOLDS": (8.0,)}.items():
        monkeypatch.setattr(homographies, name, value)
    counts = {who: np.asarray(run()) for _, who, run in homographies.entries()}
    assert len(counts) == 5
    on_plane = 0.6 * homographies.MATCHES
    for found in counts.values():
        assert (np.abs(found - on_plane) < 0.1 * on_plane).all()
    np.testing.assert_array_equal(counts["OpenCV RANSAC"], counts["OpenCV RANSAC, on threads"])


@pytest.fixture
def two_places(small_street, tmp_path, monkeypatch):
    """The folders that real images are expected in, and one kind of features."""
    from experiments.benchmark import agreement, fusions, hubs, real, weights, zoom

    for name, (database, queries) in real.FOLDERS.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / database).symlink_to(small_street / "database")
        (tmp_path / name / queries).symlink_to(small_street / "queries")
    sift = {"SIFT": Sift(image_size=(160, 120), max_keypoints=100)}
    for module in (agreement, fusions, hubs, real, weights, zoom):
        monkeypatch.setattr(module, "extractors", lambda *_: sift)
    return tmp_path


def test_all_scores_are_judged_on_the_same_matches(two_places, monkeypatch, capsys):
    from experiments.benchmark import real

    assert {"histogram", "anchor", "sum", "count", "homography_8"} <= real.compared().keys()
    monkeypatch.setattr(real, "compared", lambda: {"count": MatchCount()})
    real.run(None, two_places / "out.json", two_places)
    tables = json.loads((two_places / "out.json").read_text())["tables"]
    assert [table["matches"] for table in tables] == ["grief_season, SIFT", "corridor, SIFT"]
    for table in tables:
        by_score = {row["score"]: row for row in table["rows"]}
        assert by_score["filter"]["ms_per_query"] is None
        assert by_score["count"]["ms_per_query"] > 0
        for row in by_score.values():
            recalls = [row["recall"][str(tolerance)]["recall"] for tolerance in real.TOLERANCES]
            assert recalls == sorted(recalls)
    assert "R@1 ±2" in capsys.readouterr().out


def test_ransac_beside_opencv_s_is_pooled_over_places(two_places, monkeypatch, capsys):
    from experiments.benchmark import agreement

    monkeypatch.setattr(agreement, "THRESHOLDS", (8.0,))
    monkeypatch.setattr(agreement, "CANDIDATES", 3)
    agreement.run(2, two_places / "out.json", two_places)
    rows = json.loads((two_places / "out.json").read_text())["rows"]
    assert [(row["matches"], row["queries"], len(row["mfvpr"])) for row in rows] == [
        ("grief_season, SIFT", 10, 2), ("corridor, SIFT", 10, 2),
    ]  # fmt: skip
    for row in rows:
        low, middle, high = row["difference"]
        assert low <= middle <= high
        assert -2 <= middle <= 2
        assert 0 <= row["opencv"] <= row["queries"]
    [both] = agreement.pooled(rows)
    assert both["queries"] == 20
    assert both["mfvpr"] == [2 * right for right in rows[0]["mfvpr"]]
    assert "all, SIFT, 8 px" in capsys.readouterr().out


def test_the_paper_s_weights_gain_nothing_over_themselves(two_places):
    from experiments.benchmark import weights

    weights.run(None, two_places / "out.json", two_places)
    [table] = json.loads((two_places / "out.json").read_text())["tables"]
    by_name = {(row["system"], row["weight"]): row for row in table["rows"]}
    assert len(by_name) == len(table["rows"]) == 6 * len(weights.WEIGHTS)
    for system, weight in (("histogram", "fs"), ("anchor + filter", "fs"), ("sum", "dmf")):
        row = by_name[system, weight]
        assert (row["gained"], row["lost"], row["sign_flips"]["p_value"]) == (0, 0, 1)
        assert row["recall"]["grief_season"] == row["recall"]["corridor"] == row["recall"]["all"] > 0.5
    gains = by_name["sum", "ratio"]
    more = (gains["recall"]["all"] - by_name["sum", "dmf"]["recall"]["all"]) * 20
    assert gains["gained"] - gains["lost"] == pytest.approx(more)


def test_fusions_are_held_against_what_they_are_made_of(two_places, small_street, monkeypatch, capsys):
    from experiments.benchmark import fusions, real

    street = folder_dataset(small_street / "database", small_street / "queries", name="streets", ground_truth="order")
    monkeypatch.setattr(real.prepare, "dataset_of", lambda _: street)
    fusions.run(None, two_places / "out.json", two_places)
    rows = json.loads((two_places / "out.json").read_text())["rows"]
    by_system = {(row["scores"], row["fusion"]): row for row in rows}
    assert len(by_system) == len(rows) == 1 + 4 + 4 * 6 + 2 * 5
    for (scores, fusion), row in by_system.items():
        assert [*row["recall"]] == ["grief_season, SIFT", "corridor, SIFT", "streets, SIFT"]
        [recall] = {*row["recall"].values()}  # three times the same images
        assert row["mean"] == pytest.approx(recall)
        best = max(by_system[name, "alone"]["mean"] for name in ("filter", *scores.split(" + ")))
        assert row["worst"] == pytest.approx(row["mean"] - best)
        assert row["worst"] == 0 or (scores, fusion) != ("filter", "alone")
    assert "z, filter 0.25" in capsys.readouterr().out


def test_reciprocal_ranks_are_summed():
    from experiments.benchmark.fusions import reciprocal_ranks

    there = np.array([[True, True, True, False]])
    candidates = Shortlist(np.array([[4, 2, 9, -1]]), np.zeros((1, 4), np.float32), there)
    parts = [np.array([[3.0, 2.0, 1.0, np.nan]]), np.array([[1.0, 5.0, 7.0, np.nan]])]
    got = reciprocal_ranks(candidates, parts)
    np.testing.assert_allclose(got[0, :3], [1 / 61 + 1 / 63, 2 / 62, 1 / 63 + 1 / 61])


def test_a_thinned_database_has_fewer_right_images(two_places, small_street, monkeypatch):
    from experiments.benchmark import real, zoom

    street = folder_dataset(
        small_street / "database", small_street / "queries", name="streets", ground_truth="order"
    )  # fmt: skip
    monkeypatch.setattr(real.prepare, "dataset_of", lambda _: street)
    monkeypatch.setattr(zoom, "THINNED", {1: 2, 100: 2})
    monkeypatch.setattr(zoom, "SCORERS", {name: zoom.SCORERS[name] for name in ("fs", "fs, 7 scales, prior")})
    zoom.run(None, two_places / "out.json", two_places)
    rows = json.loads((two_places / "out.json").read_text())["rows"]
    places = ("grief_season", "corridor", "streets")
    names = [(f"{place}, SIFT", scorer) for place in places for scorer in zoom.SCORERS]
    assert [(row["matches"], row["scorer"]) for row in rows] == names
    for row in rows:
        every, first = row["recall"]
        assert 0.5 < every <= 1
        assert first == pytest.approx(0.3)  # of ten queries three are near the only image that is left
        assert row["ms_per_query"] > 0


def test_hubs_are_divided_as_an_evaluation_does_it(two_places, small_street, monkeypatch):
    from experiments.benchmark import hubs, real

    street = folder_dataset(
        small_street / "database", small_street / "queries", name="streets", ground_truth="order"
    )  # fmt: skip
    monkeypatch.setattr(real.prepare, "dataset_of", lambda _: street)
    scorers = {"histogram ratio": hubs.SCORERS["histogram ratio"], "sum ratio": hubs.SCORERS["sum ratio"]}
    small = {"STREETS": (0,), "NEIGHBORS": 2, "CANDIDATES": {"all": None, "6": 6}, "SCORERS": scorers, "TOLERANCE": 0}
    for name, value in small.items():
        monkeypatch.setattr(hubs, name, value)
    hubs.run(None, two_places / "out.json", two_places)
    found = json.loads((two_places / "out.json").read_text())
    ways = ["nothing", "hubs by database", "all by database", "all by queries"]
    [table] = found["tables"]
    by_name = {(row["score"], row["candidates"], row["divided"]): row for row in table["rows"]}
    assert [*by_name] == [(name, listed, way) for name in scorers for listed in small["CANDIDATES"] for way in ways]
    filter = Retrieval(Aggregated(*hubs.extractors().values(), VladFitting()))
    for listed, candidates in (("all", "all"), ("6", 6)):
        options = {"candidates": candidates, "cohort": 2, "archive": real.kept()}
        recall = evaluate(street, filter.describer.extractor, filter, scorers, **options).recall([0], [1])
        for name in scorers:
            expected = {"nothing": recall[name], "hubs by database": recall[f"{name} + cohort"]}
            for way, one in expected.items():
                row = by_name[name, listed, way]
                assert {*row["recall"].values()} == {one.pooled[0, 0]}
                gain = one.pooled - recall[name].pooled
                assert row["gained"] - row["lost"] == pytest.approx(20 * gain[0, 0])
    drawn = {row["divided"]: row["recall"] for row in found["streets"]}
    assert [*drawn["nothing"]] == ["all, ±1", "all, ±0", "6, ±1", "6, ±0"]
    for listed in small["CANDIDATES"]:
        some = [by_name[name, listed, "nothing"]["recall"]["streets"] for name in scorers]
        assert drawn["nothing"][f"{listed}, ±0"] == pytest.approx(np.mean(some))
        some = [by_name[name, listed, "all by database"]["recall"]["streets"] for name in scorers]
        assert drawn[f"all by the mean, {listed}"][f"{listed}, ±0"] == pytest.approx(np.mean(some))


def test_shifts_of_a_drawn_street_are_near_the_true_ones(tmp_path, monkeypatch, capsys):
    from experiments.benchmark import shifts

    monkeypatch.setenv("MFVPR_CACHE", str(tmp_path))
    monkeypatch.setattr(shifts, "FRAMES", 5)
    shifts.run(1, tmp_path / "shifts.json")
    rows = json.loads((tmp_path / "shifts.json").read_text())["rows"]
    expected = [(image, scorer) for image in shifts.SEEN for scorer in shifts.SCORERS]
    assert [(row["image"], row["histogram"]) for row in rows] == expected
    for row in rows:
        assert row["refined"]["gross"] == 0
        assert max(row["refined"]["median"]) < 10
        assert min(row["0.95"]["coverage"]) > 0.5
        assert np.all(np.less(row["0.68"]["width"], row["0.95"]["width"]))
    assert "5 px bins, sigma 10" in capsys.readouterr().out


def test_lightglue_matches_what_candidates_have_in_common(monkeypatch):
    """Early stop or not; of the keypoints that are moved all alike, most."""
    from experiments.benchmark import lightglue
    from mfvpr.checkpoints.checkpoint import read_checkpoint
    from mfvpr.checkpoints.conversion import convert

    if not random_checkpoints.LIGHTGLUE.is_file():
        pytest.skip("no ../shared/weights: weights do not ship with the project")
    for name, value in {"CANDIDATES": 1, "KEYPOINTS": 60, "COMMON": 30}.items():
        monkeypatch.setattr(lightglue, name, value)
    entry = entry_of(lightglue.NAME)
    arrays = convert(read_checkpoint(random_checkpoints.LIGHTGLUE), network_of(entry).table, blueprint(entry).shapes)
    results = {(step, who): run() for step, who, run in lightglue.entries(lightglue.made_up(), arrays, None)}
    assert [len(found) for found in results.values()] == [1, 1, 1, 1]
    for found in results.values():
        for rows in found:
            common = rows[rows[:, 0] < 30]
            assert len(common) > 20
            assert (common[:, 0] == common[:, 1]).all()
    with pytest.raises(InputError, match=r"nowhere: .*https://github.com/cvg/LightGlue"):
        list(lightglue.entries(lightglue.made_up(), arrays, Path("nowhere")))
