"""The main job with networks: systems, stores and mistakes. D2-Net, MixVPR and SSM-VPR have random weights here."""

import pytest

from tests.features.conftest import read_rows
from tests.needs import use_weights
from tests.programs import ROOT

pytestmark = pytest.mark.slow

SMALL = "candidates=10", "features.image_size=[160,160]", "figures=2"


@pytest.fixture
def evaluate(run_program, weights, street_settings, tmp_path, monkeypatch):
    """Run an evaluation of the street with the weights at hand; return the messages."""
    monkeypatch.setenv("MFVPR_WEIGHTS", str(weights))
    monkeypatch.setenv("MFVPR_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)

    def evaluate(*arguments, out="out", code=0):
        return run_program("evaluate", *street_settings, *arguments, f"out={tmp_path / out}", code=code)

    return evaluate


def store_names(tmp_path):
    return sorted(path.name.rpartition("-")[0] for path in (tmp_path / "cache" / "features").glob("*-*"))


def test_the_papers_system_runs_and_is_read_from_its_stores_ever_after(evaluate, tmp_path):
    first = evaluate("system=mix_hist_comb_10", *SMALL, out="first")
    assert store_names(tmp_path) == ["D2NetFeatures", "MixVprDescriptor", "matches"]
    assert "10 of 10 images to do" in first
    rows = read_rows(tmp_path / "first")
    assert list(dict.fromkeys(row["system"] for row in rows)) == ["retrieval", "histogram", "histogram + retrieval"]
    assert rows[0]["features"]["weights"] == "d2_tf"
    assert rows[-1]["parameters"]["c"] == 1e6
    predictions = [
        (tmp_path / "first" / name).read_text() for name in ("predictions.csv", "predictions/histogram_retrieval.csv")
    ]
    assert predictions[0] == predictions[1]

    again = evaluate("system=mix_hist_comb_10", *SMALL, out="again")
    assert "matches: all 10 queries from" in again
    assert "images to do" not in again
    for name in ("retrieval", "histogram", "histogram_retrieval"):
        earlier, later = (tmp_path / out / "predictions" / f"{name}.csv" for out in ("first", "again"))
        assert earlier.read_text() == later.read_text()


def test_ssm_vpr_runs_on_what_it_learned_from_the_database(evaluate, tmp_path):
    few = ("features.max_images=3", "retrieval.max_images=4", "features.dimension=20", "retrieval.dimension=30")
    more = ("scorer.side=18", "previous_queries=2", "candidates=4", *few)
    stderr = evaluate("system=ssm_vpr", *SMALL, *more)
    stores = [name for kind in ("SsmCells", "SsmWindows") for name in (kind, f"{kind}-whitening")]
    assert store_names(tmp_path) == [*stores, "matches"]
    assert "SsmWindows-whitening in " in stderr
    rows = read_rows(tmp_path / "out")
    parameters = {row["system"]: row["parameters"] for row in rows}
    assert list(parameters) == ["retrieval", "grid", "grid + retrieval", "grid + frames"]
    assert parameters["grid + frames"] == parameters["grid"] | {"previous": 2, "reach": 15.0, "gain": 0.4}
    assert rows[-1]["scorer"] == "grid"


@pytest.mark.parametrize("name", ["mix_hist_aliked_50", "mfvpr"])
def test_aliked_recognizes_the_street(evaluate, real_weights, tmp_path, monkeypatch, name):
    monkeypatch.setenv("MFVPR_WEIGHTS", str(real_weights))
    evaluate(f"system={name}", *SMALL, "features.image_size=[320,320]")
    out = tmp_path / "out"
    rows = read_rows(out)
    (recall,) = (row["recall_at"]["1"] for row in rows if (row["system"], row.get("tolerance")) == ("histogram", 1))
    assert recall >= 0.8
    assert (out / "predictions.csv").read_bytes() == (out / "predictions/histogram.csv").read_bytes()


def test_the_fast_system_recognizes_the_street(evaluate, tmp_path, monkeypatch):
    for name in ("efficientnet_lite0", "xfeat"):
        use_weights(name, monkeypatch)
    evaluate("system=fast", "candidates=10", "figures=0")
    rows = [row for row in read_rows(tmp_path / "out") if row.get("tolerance") == 1]
    recall = {row["system"]: row["recall_at"]["1"] for row in rows}
    assert recall["histogram"] >= max(0.8, recall["retrieval"])


def test_lightglue_matches_the_street_and_its_store_is_its_own(evaluate, real_weights, tmp_path, monkeypatch):
    monkeypatch.setenv("MFVPR_WEIGHTS", str(real_weights))
    features = ("features=aliked", "features.image_size=[160,160]", "retrieval.num_words=8")
    rows, stored = {}, []
    for name in ("neighbors", "lightglue", "lightglue"):
        out = f"out{len(stored)}"
        evaluate("candidates=3", "figures=0", *features, f"matching={name}", out=out)
        rows[name] = read_rows(tmp_path / out)
        stored.append({path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*matches*/*")})
    assert len(stored[0]) < len(stored[1])
    assert stored[1] == stored[2]
    assert rows["lightglue"][0]["matching"]["weights"] == "aliked_lightglue"
    assert store_names(tmp_path).count("matches") == 2
    recall = {
        name: row["recall_at"]["1"]
        for name in rows
        for row in rows[name]
        if (row["system"], row.get("tolerance")) == ("count", 1)
    }
    assert recall["lightglue"] >= recall["neighbors"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["features=d2net"], "d2_tf: not installed in NOWHERE; "),
        (["retrieval=mixvpr"], "weights none stated"),
        (["features=d2net", "features.weights=mixvpr_512"], "features.weights=mixvpr_512: expected weights of d2net"),
        (["retrieval=mixvpr", "retrieval.image_size=[224,224]"], "image_size=[224, 224]: expected [320, 320]"),
        (["matching=lightglue"], "mfvpr weights download aliked_lightglue"),
        (["retrieval=same"], "retrieval=same: expected features with a global descriptor"),
        (["features=aliked", "features.contrast_threshold=2"], "features.contrast_threshold: unknown setting"),
        (["features.interpolation=torch_bilinear"], "SIFT takes whole numbers"),
    ],
)
def test_mistakes_are_one_line(evaluate, arguments, words, tmp_path, monkeypatch):
    monkeypatch.setenv("MFVPR_WEIGHTS", f"{tmp_path}/none")
    error = evaluate(*arguments, f"dataset.database={ROOT}", "dataset.queries=x", code=2)
    assert words.replace("NOWHERE", f"{tmp_path}/none") in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("netvlad", ("retrieval.weights=patchnetvlad_mapillary_128", "retrieval.components=32")),
        ("gem", ("retrieval.weights=cosplace_vgg16_512",)),
    ],
)
def test_global_descriptors_of_networks_are_retrievers(evaluate, tmp_path, name, options):
    size = "retrieval.image_size=[96,64]"
    stderr = evaluate(f"retrieval={name}", *options, size, "candidates=3", "figures=0")
    assert "R@3, of retrieval too" in stderr
    assert "GlobalDescriptor" in store_names(tmp_path)
