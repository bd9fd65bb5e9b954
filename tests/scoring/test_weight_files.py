"""Files of learned weights: the same to the last bit, and nothing else is taken for one."""

import json
from dataclasses import fields, replace

import jax
import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.scoring.learned_weight import ABSOLUTE, RELATIVE, LearnedWeight
from mfvpr.scoring.weight_files import read_weight, write_weight
from tests.builders import random_matches

MADE = {"command": "by hand", "seeds": [1, 2]}


@pytest.fixture
def weight():
    matches = random_matches(np.random.default_rng(0), 30)
    return LearnedWeight.create(jax.random.key(1), matches, 3)


@pytest.mark.parametrize("names", [RELATIVE, ABSOLUTE])
def test_to_the_last_bit(tmp_path, names):
    weight = LearnedWeight.create(jax.random.key(1), random_matches(np.random.default_rng(0), 30), 3, names=names)
    write_weight(tmp_path / "weight.json", weight, MADE)
    got, made = read_weight(tmp_path / "weight.json")
    assert made == MADE
    assert got.names == names
    jax.tree.map(np.testing.assert_array_equal, got, weight)
    assert {leaf.dtype for leaf in jax.tree.leaves(got)} == {np.dtype("float32")}
    assert len(fields(got)) == 7


def test_what_is_not_finite_is_not_written(tmp_path, weight):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_weight(tmp_path / "weight.json", replace(weight, output_bias=np.float32(np.nan)), MADE)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "change",
    [
        {"format": "mfvpr match weight 0"}, {"inputs": ["ratio"]}, {"inputs": ["ratio", "x", "x0", "x1", "y0"]},
        {"scale": [1, 1, 0, 1, 1]}, {"hidden": [[0] * 3] * 4}, {"output": [1, "a", 2]}, {"output_bias": [1]},
        {"center": None}, {"scale": [1, 1, 1e-300, 1, 1]}, {"output_bias": 1e300}, {"output_bias": True},
        {"output_bias": 10**400}, {"inputs": ["ratio", "ratio", "score0_rank", "score1_rank", "distance_rank"]},
        {"inputs": dict.fromkeys(RELATIVE)},
    ],
)  # fmt: skip
def test_another_file_is_refused(tmp_path, weight, change):
    path = tmp_path / "weight.json"
    write_weight(path, weight, MADE)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=r"weight\.json: .*experiments.learn"):
        read_weight(path)


def test_no_file_and_no_json_are_refused(tmp_path):
    (tmp_path / "text.json").write_text("[]")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    for name, reason in (("none.json", "got nothing"), ("text.json", ""), ("deep.json", "Recursion")):
        with pytest.raises(InputError, match=f"{name}: .*experiments.learn.*{reason}"):
            read_weight(tmp_path / name)
