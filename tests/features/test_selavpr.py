"""SelaVPR as a system, DINOv2 as retriever and features, by name, with weights converted from files; small networks."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from mfvpr.checkpoints import REGISTRY
from mfvpr.networks import SelaVpr, VisionTransformer
from tests.features.conftest import read_rows
from tests.random_checkpoints import dinov2_shapes, random_checkpoint, selavpr_shapes, write_zip


def training(tensors):
    """The public code's training checkpoint, with the optimizer's notes."""
    moments = [{"step": 7, "exp_avg": np.zeros(3, np.float32), "exp_avg_sq": np.ones(3, np.float32)}]
    groups = [{"lr": 1e-5, "betas": (0.9, 0.999), "weight_decay": 0, "amsgrad": False, "params": [0, 1]}]
    optimizer = {"state": dict(enumerate(moments)), "param_groups": groups}
    return {"epoch_num": 3, "model_state_dict": tensors, "optimizer_state_dict": optimizer, "best_r5": 97.2}


@pytest.fixture
def program(run_program, street_settings, tmp_path, monkeypatch):
    """A command line, with small networks under the published names, none of which is installed yet."""
    monkeypatch.setenv("MFVPR_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setenv("MFVPR_CACHE", str(tmp_path / "cache"))
    for name, registers in (("selavpr_pitts30k", 0), ("selavpr_msls", 0), ("selavpr_msls_registers", 4)):
        build = partial(SelaVpr, 64, 1, 1, registers=registers)
        monkeypatch.setitem(REGISTRY, name, replace(REGISTRY[name], builder=lambda build=build: build))
    small = replace(REGISTRY["dinov2_vits14"], builder=lambda: partial(VisionTransformer, 64, 1, 1))
    monkeypatch.setitem(REGISTRY, "dinov2_vits14", small)

    def run(kind, *more, code=0):
        settings = () if kind == "weights" else (*street_settings, f"out={tmp_path}/out")
        return run_program(kind, *settings, *more, code=code)

    return run


def checkpoint(folder, name="SelaVPR_msls", registers=0):
    tensors = random_checkpoint(selavpr_shapes(64, 1, registers))
    return write_zip(folder / f"{name}.pth", training(tensors))


@pytest.mark.slow
@pytest.mark.parametrize(("system", "file"), [("selavpr_msls", "SelaVPR_msls"), ("selavpr_pitts", "SelaVPR_pitts30k")])
def test_it_runs_by_name_once_its_weights_are_converted(program, tmp_path, system, file):
    stderr = program("evaluate", f"system={system}", code=2)
    assert f"not installed in {tmp_path}/weights; get {file}.pth from https://drive.google.com/" in stderr
    program("weights", "add", checkpoint(tmp_path, file))
    program("evaluate", f"system={system}", "features.image_size=[56,42]", "candidates=6")
    rows = read_rows(tmp_path / "out")
    assert [row["system"] for row in rows if row["decides"]] == ["count"] * 3
    assert (rows[0]["retrieval"]["name"], rows[0]["candidates"]) == ("same", 6)
    assert {row["parameters"]["single"] for row in rows if row["system"] == "count"} == {"zero"}


def test_the_variant_with_registers_takes_its_own_weights_alone(program, tmp_path):
    without, with_registers = checkpoint(tmp_path), checkpoint(tmp_path, "SelaVPR_reg4_msls", registers=4)
    stderr = program("weights", "add", without, "--as", "selavpr_msls_registers", code=2)
    assert "backbone.registers missing; use the official SelaVPR_reg4_msls.pth" in stderr
    assert "register_tokens" in program("weights", "add", with_registers, "--as", "selavpr_msls", code=2)
    program("weights", "add", with_registers)
    small = "features.image_size=[28,28]", "candidates=3", "figures=0"
    program("evaluate", "system=selavpr_msls", "features.weights=selavpr_msls_registers", *small)


@pytest.fixture
def dinov2(program, tmp_path):
    """A command line, with a small DINOv2 installed."""
    tensors = random_checkpoint(dinov2_shapes(64, 1))
    program("weights", "add", write_zip(tmp_path / "dinov2_vits14_pretrain.pth", tensors))
    return program


@pytest.mark.slow
@pytest.mark.parametrize("pooling", ["cls", "gem"])
def test_dinov2_is_a_retriever(dinov2, tmp_path, pooling):
    options = "retrieval=dinov2", "retrieval.weights=dinov2_vits14", "retrieval.image_size=[56,42]"
    small = "features.max_keypoints=50", "candidates=5", "figures=0"
    dinov2("evaluate", *options, f"retrieval.pooling={pooling}", *small)
    assert {row["retrieval"]["pooling"] for row in read_rows(tmp_path / "out")} == {pooling}
    stderr = dinov2("evaluate", *options, "retrieval.image_size=[56,40]", *small, f"out={tmp_path}/2", code=2)
    assert "image_size=[56, 40]: expected multiples of 14, the side of a patch in px" in stderr


@pytest.mark.slow
@pytest.mark.parametrize(("features", "facet"), [("dinov2", "token"), ("dinov2_attention", "value")])
def test_dinov2_gives_features_and_the_global_descriptor(dinov2, tmp_path, features, facet):
    network = f"features={features}", "features.weights=dinov2_vits14", "features.block=-1"
    small = "features.image_size=[70,56]", "candidates=5", "figures=0"
    dinov2("evaluate", *network, *small, "retrieval=same", "scorer=demo")
    rows = read_rows(tmp_path / "out")
    assert {row["system"] for row in rows} >= {"retrieval", "count", "anchor", "histogram"}
    assert {row["features"]["facet"] for row in rows} == {facet}
    stores = {path.name.rpartition("-")[0] for path in (tmp_path / "cache" / "features").glob("*-*")}
    assert stores == {"Dinov2Features", "matches"}
