"""The main job with networks: systems, stores and mistakes. D2-Net, MixVPR and SSM-VPR have random weights here."""

import json

import numpy as np
import pytest

from mfvpr.checkpoints import load_model
from mfvpr.datasets import image_folder, resize
from mfvpr.features import GlobalDescriptor
from tests import random_checkpoints
from tests.programs import ROOT, typed

pytestmark = pytest.mark.slow


def system(name, street, out, *more):
    folders = f"dataset.database={street}/database", f"dataset.queries={street}/queries", "dataset.ground_truth=order"
    return (f"system={name}", "dataset=folder", *folders, "candidates=10", "features.image_size=[160,160]",
            "figures=2", f"out={out}", *more)  # fmt: skip


@pytest.fixture
def evaluate(weights, monkeypatch, capsys):
    """Run an evaluation with the weights at hand; return the messages."""
    monkeypatch.setenv("MFVPR_WEIGHTS", str(weights))

    def evaluate(*arguments):
        code, _, stderr = typed(monkeypatch, capsys, "evaluate", *arguments)
        assert code == 0, stderr
        return stderr

    return evaluate


def test_the_papers_system_runs_and_is_read_from_its_stores_ever_after(evaluate, small_street, tmp_path, monkeypatch):
    monkeypatch.setenv("MFVPR_CACHE", str(tmp_path / "cache"))
    first = evaluate(*system("mix_hist_comb_10", small_street, tmp_path / "first"))
    stores = sorted(path.name.rpartition("-")[0] for path in (tmp_path / "cache" / "features").glob("*-*"))
    assert stores == ["D2NetFeatures", "D2NetFeatures", "MixVprDescriptor", "MixVprDescriptor", "matches"]
    assert "10 of 10 images to do, about 163 features of 512 dimensions each" in first
    assert "as the paper stores them" in first
    rows = json.loads((tmp_path / "first" / "results.json").read_text())
    assert list(dict.fromkeys(row["system"] for row in rows)) == ["filter", "histogram", "histogram + filter"]
    assert rows[0]["features"]["weights"] == "d2_tf"
    assert rows[-1]["parameters"]["c"] == 1e6
    predictions = [(tmp_path / "first" / name).read_text()
                   for name in ("predictions.csv", "predictions/histogram_filter.csv")]  # fmt: skip
    assert predictions[0] == predictions[1]

    again = evaluate(*system("mix_hist_comb_10", small_street, tmp_path / "again"))
    assert "matches: all 10 queries from" in again
    assert "images to do" not in again
    for name in ("filter", "histogram", "histogram_filter"):
        earlier, later = (tmp_path / out / "predictions" / f"{name}.csv" for out in ("first", "again"))
        assert earlier.read_text() == later.read_text()


def test_ssm_vpr_runs_on_what_it_learned_from_the_database(evaluate, small_street, tmp_path, monkeypatch):
    monkeypatch.setenv("MFVPR_CACHE", str(tmp_path / "cache"))
    few = ("features.max_images=3", "retrieval.max_images=4", "features.dimension=20", "retrieval.dimension=30")
    more = ("scorer.side=18", "previous_queries=2", "candidates=4", *few)
    stderr = evaluate(*system("ssm_vpr", small_street, tmp_path / "out", *more))
    stores = sorted(path.name.rpartition("-")[0] for path in (tmp_path / "cache" / "features").glob("*-*"))
    learned = ["SsmCells-whitening", "SsmWindows-whitening"]
    assert stores == ["SsmCells", "SsmCells", learned[0], "SsmWindows", "SsmWindows", learned[1], "matches"]
    assert "SsmWindows: whitening of 30 dimensions: " in stderr
    rows = json.loads((tmp_path / "out" / "results.json").read_text())
    parameters = {row["system"]: row["parameters"] for row in rows}
    assert list(parameters) == ["filter", "grid", "grid + filter", "grid + frames"]
    assert parameters["grid + frames"] == parameters["grid"] | {"previous": 2, "reach": 15.0, "gain": 0.4}
    assert rows[-1]["scorer"] == "grid"


@pytest.mark.skipif(not random_checkpoints.ALIKED.is_dir(), reason="no ../shared/weights: ALIKED's are not shipped")
@pytest.mark.parametrize(
    ("name", "decides"), [("mix_hist_aliked_50", "histogram"), ("mfvpr", "histogram + anchor + filter")]
)
def test_aliked_recognizes_the_street(evaluate, small_street, tmp_path, name, decides):
    evaluate(*system(name, small_street, tmp_path / "out", "features.image_size=[320,320]"))
    rows = json.loads((tmp_path / "out" / "results.json").read_text())
    (recall,) = (row["recall_at"]["1"] for row in rows if (row["system"], row.get("tolerance")) == (decides, 1))
    assert recall >= 0.8
    out = tmp_path / "out"
    file = f"predictions/{decides.replace(' + ', '_')}.csv"
    assert (out / "predictions.csv").read_bytes() == (out / file).read_bytes()


@pytest.mark.skipif(not random_checkpoints.LIGHTGLUE.is_file(), reason="no ../shared/weights: LightGlue's do not ship")
def test_lightglue_matches_the_street_and_its_store_is_its_own(evaluate, street_settings, tmp_path, monkeypatch):
    monkeypatch.setenv("MFVPR_CACHE", str(tmp_path / "cache"))
    settings = (*street_settings, "candidates=3", "figures=0")
    features = ("features=aliked", "features.image_size=[160,160]", "retrieval.num_words=8")
    messages, seen = [], {}
    for name in ("neighbors", "lightglue", "lightglue"):
        out = tmp_path / f"out{len(seen)}"
        messages.append(evaluate(*settings, *features, f"matching={name}", f"out={out}"))
        seen[name] = json.loads((out / "results.json").read_text())
    assert "10 of 10 queries to match" in messages[1]
    assert "matches: all 10 queries from" in messages[2]
    assert seen["lightglue"][0]["matching"]["weights"] == "aliked_lightglue"
    assert len([*(tmp_path / "cache" / "features").glob("matches-*")]) == 2
    recall = {
        (name, row["system"]): row["recall_at"]["1"]
        for name, rows in seen.items()
        for row in rows
        if row.get("tolerance") == 1
    }
    assert recall["lightglue", "count"] >= recall["neighbors", "count"]


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """The error of a command line, one line, with the weights in a folder."""

    def refused(weights, *arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("MFVPR_WEIGHTS", str(weights))
        code, stdout, stderr = typed(monkeypatch, capsys, "evaluate", *arguments)
        assert (code, stdout, stderr.count("\n")) == (2, "", 1), stderr
        return stderr

    return refused


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["features=d2net"], "d2_tf: not installed in NOWHERE; "),
        (["features=aliked"], "python -m experiments.weights download aliked-n16"),
        (["retrieval=mixvpr"], "weights none stated"),
        (["features=d2net", "features.weights=mixvpr_512"], "features.weights=mixvpr_512: expected weights of d2net"),
        (["retrieval=mixvpr", "retrieval.image_size=[224,224]"], "MixVPR takes [320, 320] only"),
        (["retrieval=ssm", "retrieval.image_size=[336,336]"], "SSM-VPR's filter takes [224, 224] only"),
        (["features=aliked", "features.weights=alikd-n16"], "expected weights of aliked: one of"),
        (["matching=lightglue"], "python -m experiments.weights download aliked_lightglue"),
        (["features=aliked", "features.clahe_clip=2"], "features.clahe_clip: unknown setting"),
        (["system=mix_hist_20"], "system=mix_hist_20: expected one of mfvpr"),
        (["features.interpolation=torch_bilinear"], "SIFT takes whole numbers"),
        (["features=d2net", "features.preprocessing=vgg"], "expected one of caffe, torch"),
    ],
)
def test_mistakes_are_one_line(arguments, words, refused, tmp_path):
    places = ("dataset=folder", f"dataset.database={ROOT}", "dataset.queries=x")
    assert words.replace("NOWHERE", str(tmp_path / "none")) in refused(tmp_path / "none", *arguments, *places)


def test_a_store_that_is_a_file_is_refused(refused, street_settings, weights):
    error = refused(weights, *street_settings, "candidates=10", f"store={ROOT}/README.md")
    assert error.startswith("error: ")
    assert "README.md" in error


@pytest.mark.skipif(not random_checkpoints.LIGHTGLUE.is_file(), reason="no ../shared/weights: LightGlue's do not ship")
def test_features_that_lightglue_was_not_trained_for_are_refused(refused, street_settings, weights):
    error = refused(weights, *street_settings, "candidates=10", "matching=lightglue")
    assert "got Sift of 128; " in error


def test_sizes_that_networks_cannot_take_are_refused_with_those_they_can(refused, weights):
    error = refused(weights, "features=d2net", "features.multiscale=true", "features.image_size=[16,100]")
    assert "got 16 x 100" in error


@pytest.mark.parametrize(("name", "options"), [
    ("netvlad", ("retrieval.weights=patchnetvlad_mapillary_128", "retrieval.components=32")),
    ("gem", ("retrieval.weights=cosplace_vgg16_512",)),
])  # fmt: skip
def test_global_descriptors_of_networks_are_filters(
    evaluate, weights, small_street, street_settings, tmp_path, monkeypatch, name, options
):
    monkeypatch.setenv("MFVPR_CACHE", str(tmp_path / "cache"))
    stderr = evaluate(*street_settings, f"retrieval={name}", *options, "retrieval.image_size=[96,64]", "candidates=3",
                      "figures=0", f"out={tmp_path}/out")  # fmt: skip
    assert "note: R@5 and R@10 are R@3, of the filter too" in stderr
    stores = {path.name.rpartition("-")[0] for path in (tmp_path / "cache" / "features").glob("*-*")}
    assert "GlobalDescriptor" in stores
    model, components = load_model(options[0].partition("=")[2], weights), 32 if name == "netvlad" else None
    extractor, vectors = GlobalDescriptor(model, (96, 64), components=components), []
    for side in ("queries", "database"):
        images = image_folder(small_street / side)
        resized = [resize(images.read(row), (96, 64), "pil_bilinear") for row in range(len(images))]
        vectors.append(np.array([description.vector for description in extractor(np.array(resized))]))
    nearest = np.argsort(-(vectors[0] @ vectors[1].T), axis=1)[:, :3]
    lines = (tmp_path / "out" / "predictions" / "filter.csv").read_text().splitlines()[1:]
    assert [line.split(",")[2] for line in lines] == [f"{row:04d}.png" for row in nearest.reshape(-1)]


@pytest.mark.parametrize(("options", "words"), [
    (("retrieval=netvlad", "retrieval.weights=mixvpr_512"), "=mixvpr_512: expected weights of netvlad: one of"),
    (("retrieval=gem", "retrieval.weights=cosplace_vgg16_512", "retrieval.components=5"), "retrieval.components"),
    (("retrieval=netvlad", "retrieval.weights=patchnetvlad_mapillary_128", "retrieval.components=200"),
     "components=200: expected from 1 to 128"),
])  # fmt: skip
def test_mistakes_with_them_are_one_line(weights, monkeypatch, capsys, street_settings, tmp_path, options, words):
    monkeypatch.setenv("MFVPR_WEIGHTS", str(weights))
    code, _, stderr = typed(monkeypatch, capsys, "evaluate", *street_settings, *options, f"out={tmp_path}/out")
    assert code == 2
    assert words in stderr.splitlines()[-1]
