"""Files of learned weights: equal to the last bit; other files raise."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.baselines.learned_weight import ABSOLUTE, RELATIVE, LearnedWeight
from mfvpr.baselines.weight_registry import read_weight, write_weight
from tests.builders import random_matches

PROVENANCE = {"command": "by hand", "seeds": [1, 2]}


def create(names=RELATIVE):
    return LearnedWeight.create(jax.random.key(1), random_matches(np.random.default_rng(0), 30), 3, names=names)


@pytest.mark.parametrize("names", [RELATIVE, ABSOLUTE])
def test_to_the_last_bit(tmp_path, names):
    weight = create(names)
    write_weight(tmp_path / "weight.json", weight, PROVENANCE)
    got, provenance = read_weight(tmp_path / "weight.json")
    assert (got.names, provenance) == (names, PROVENANCE)
    jax.tree.map(np.testing.assert_array_equal, got, weight)
    assert {leaf.dtype for leaf in jax.tree.leaves(got)} == {np.dtype("float32")}


def test_numbers_that_are_not_finite_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_weight(tmp_path / "weight.json", replace(create(), output_bias=np.float32(np.nan)), PROVENANCE)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "change",
    [
        {"format": "mfvpr match weight 0"},
        {"inputs": ["ratio"]},
        {"inputs": ["ratio", "x", "x0", "x1", "y0"]},
        {"scale": [1, 1, 0, 1, 1]},
        {"hidden": [[0] * 3] * 4},
        {"output": [1, "a", 2]},
        {"output_bias": [1]},
        {"center": None},
        {"scale": [1, 1, 1e-300, 1, 1]},
        {"output_bias": 1e300},
        {"output_bias": True},
        {"output_bias": 10**400},
        {"inputs": ["ratio", "ratio", "score0_rank", "score1_rank", "distance_rank"]},
        {"inputs": dict.fromkeys(RELATIVE)},
    ],
)
def test_damaged_files_raise(tmp_path, change):
    path = tmp_path / "weight.json"
    write_weight(path, create(), PROVENANCE)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=r"weight\.json: .*mfvpr learn"):
        read_weight(path)


def test_missing_files_and_other_json_raise(tmp_path):
    (tmp_path / "text.json").write_text("[]")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    for name, reason in (("none.json", "got nothing"), ("text.json", ""), ("deep.json", "Recursion")):
        with pytest.raises(InputError, match=f"{name}: .*mfvpr learn.*{reason}"):
            read_weight(tmp_path / name)
