"""Installation: the wheel that the source distribution builds, in an environment without this clone."""

import email
import json
import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile

import pytest

from tests.needs import skip_without
from tests.programs import QUICK, ROOT, folder

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

SMALL = (*QUICK, "features.image_size=[160,120]", "candidates=5")
EXAMPLE = """
import numpy as np
import mfvpr

small = {{"features": {{"image_size": [160, 120]}}, "retrieval": {{"num_words": 8}}, "candidates": 5}}
system = mfvpr.load_system("steering", **small)
result = mfvpr.evaluate(mfvpr.datasets.folder("{street}/database", "{street}/queries", ground_truth="order"), system)
points = np.random.default_rng(0).uniform(0, 100, (9, 2))
features = mfvpr.Features.of(points, np.eye(9), image_size=(100, 100))
print(mfvpr.__file__, repr(result), mfvpr.HistogramOfShifts(weight=mfvpr.UnitWeight())(mfvpr.match(features, features)))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    skip_without("hatchling", "experiments")
    root = tmp_path_factory.mktemp("distributions")

    def build(target, source):
        subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", target, "-d", root], cwd=source, check=True)

    build("sdist", ROOT)
    with tarfile.open(next(root.glob("*.tar.gz"))) as archive:
        archive.extractall(root / "source", filter="data")
    build("wheel", next((root / "source").iterdir()))
    return next(root.glob("*.whl"))


@pytest.fixture(scope="module")
def run(wheel, tmp_path_factory):
    """Runs a program of an environment that has the wheel, and beside it only the tests' dependencies: its output."""
    root = tmp_path_factory.mktemp("installation")
    venv.create(root / "env", symlinks=True)
    python = root / "env" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python]
    subprocess.run([*pip, "install", "--quiet", "--no-index", "--no-deps", wheel], check=True)
    [packages] = (root / "env" / "lib").glob("*/site-packages")
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))  # its own .pth files are not read
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def call(program, *arguments):
        command = [python.with_name(program), *map(str, arguments)]
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return call


def test_the_wheel_has_the_package_its_data_and_its_license_alone(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        [path] = (name for name in names if name.endswith("METADATA"))
        metadata = email.message_from_bytes(archive.read(path))
    assert {"mfvpr/py.typed", "mfvpr/systems/conf/evaluate.yaml", "mfvpr/report/templates/page.html"} <= {*names}
    assert {name.split("/")[0].split("-")[0] for name in names} == {"mfvpr"}
    assert (metadata["License-Expression"], metadata["License-File"]) == ("MIT", "LICENSE")


def test_the_programs_and_the_library_work_where_they_are_installed(run, small_street):
    assert "evaluate the paper's scores" in run("mfvpr", "--help")
    assert "histogram_ratio" in run("mfvpr", "demo", *SMALL)
    assert "histogram" in run("mfvpr", "evaluate", *folder(small_street), *SMALL)
    images = *folder(small_street)[:3], "dataset.ground_truth=none", *SMALL[1:]  # a map draws no figures
    assert "10 images, 10 of them new" in run("mfvpr", "map", "build", "map=map", *images)
    lines = run("mfvpr", "localize", "map=map", f"images={small_street}/queries").splitlines()
    assert [json.loads(line)["place"] is not None for line in lines] == [True] * 10
    module, *words = run("python", "-c", EXAMPLE.format(street=small_street)).split(" ")
    assert "site-packages" in module
    assert "histogram" in " ".join(words)
