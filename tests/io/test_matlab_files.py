"""MATLAB's files as arrays by their path; other and damaged files give one line."""

import numpy as np
import pytest

from mfvpr.checkpoints.checkpoint import read_checkpoint
from mfvpr.checkpoints.conversion import TABLES, convert
from mfvpr.checkpoints.networks import entry_of, plan_network
from mfvpr.networks import VggNetVlad
from mfvpr.utils import InputError
from tests.io.checks import one_line_error
from tests.random_checkpoints import cell, matlab_netvlad, matlab_shapes, write_matlab

pytestmark = pytest.mark.thorough


CONTENT = {
    "net": {
        "layers": cell([{"w": cell([np.arange(6.0).reshape(2, 3), np.float32([[7]])])}, {"name": "relu"}]),
        "note": "text",
        "empty": np.zeros((0, 0)),
        "flag": np.array([[True]]),
    },
    "other": np.int16([[1, -2]]),
}


@pytest.mark.parametrize("packed", [True, False])
def test_arrays_have_their_path(tmp_path, packed):
    arrays = read_checkpoint(write_matlab(tmp_path / "a.mat", CONTENT, packed=packed))
    assert {path: array.tolist() for path, array in arrays.items() if path != "net.flag"} == {
        "net.layers.0.w.0": [[0, 1, 2], [3, 4, 5]],
        "net.layers.0.w.1": [[7]],
        "other": [[1, -2]],
    }
    assert arrays["net.layers.0.w.1"].dtype == np.float32


def test_an_array_of_structures_is_as_a_cell_of_them(tmp_path):
    several = np.zeros((1, 2), [("w", object)])
    several[0, 0]["w"], several[0, 1]["w"] = np.ones((1, 2)), np.zeros((2, 1))
    arrays = read_checkpoint(write_matlab(tmp_path / "a.mat", {"net": {"layers": several}}))
    assert {path: array.shape for path, array in arrays.items()} == {"net.layers.0.w": (1, 2), "net.layers.1.w": (2, 1)}


def test_signs_and_axes(tmp_path):
    """The centers are stored with the other sign, all else as inputs, then outputs."""
    read = read_checkpoint(write_matlab(tmp_path / "a.mat", matlab_netvlad(4, 3)))
    assert {path: array.shape for path, array in read.items()} == matlab_shapes(4, 3)
    with pytest.raises(InputError, match="of another shape"):
        convert(read, TABLES["netvlad_matlab"], plan_network(entry_of("netvlad_pitts30k").builder()).shapes)
    plan = plan_network(lambda rngs: VggNetVlad(4, 3, original=True, rngs=rngs))
    parameters = convert(read, TABLES["netvlad_matlab"], plan.shapes)
    np.testing.assert_array_equal(parameters["pool.centers"], -read["net.layers.30.weights.1"].T)
    np.testing.assert_array_equal(parameters["pool.assignment.kernel"], read["net.layers.30.weights.0"])
    np.testing.assert_array_equal(parameters["projection.kernel"], read["net.layers.33.weights.0"][0, 0])
    np.testing.assert_array_equal(parameters["vgg.conv2_1.kernel"], read["net.layers.5.weights.0"])
    np.testing.assert_allclose(parameters["average"], [123.68, 116.779, 103.939], rtol=1e-6)


def test_other_versions_and_damaged_files_are_one_line(tmp_path):
    path = write_matlab(tmp_path / "a.mat", CONTENT)
    header, content = b"MATLAB 7.3 MAT-file, Platform".ljust(124) + b"\0\2IM" + bytes(1000), path.read_bytes()
    for damaged in (header, content[: len(content) // 2]):
        path.write_bytes(damaged)
        with one_line_error("a.mat: cannot be read"):
            read_checkpoint(path)
