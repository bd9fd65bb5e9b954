"""The paper's evaluation as a program: it evaluates the data sets at hand once, however often it is killed."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest

from experiments.paper.runs import lock_output
from tests.programs import ROOT, output_of
from tests.programs import run as run_program

pytestmark = pytest.mark.slow

SYSTEMS = "systems=[sift_hist_10,sift_hist_comb_10,mix_hist_10]"
RUN = "runs/grief_season/sift_10"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with one data set: frames of the synthetic street under the names of another."""
    from mfvpr.datasets.streets import draw_streets

    folder = tmp_path_factory.mktemp("data") / "grief_season"
    draw_streets(folder, num_frames=8, image_size=(160, 120))
    (folder / "ground_truth.csv").unlink()
    return folder.parent


def arguments(data, out):
    return f"data={data}", "datasets=[grief_season,gardens_point]", SYSTEMS, f"out={out}", f"cache={out.parent}/store"


@pytest.fixture(scope="module")
def finished(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("paper") / "out"
    process = run_program(*arguments(data, out), program="paper")
    assert process.returncode == 0, process.stderr
    return out, process


@pytest.fixture
def copy(finished, tmp_path):
    return shutil.copytree(finished[0], tmp_path / "paper" / "out")


@pytest.fixture
def paper(data, monkeypatch, capsys):
    """Runs the program in this process: output and errors. Settings replace those of `arguments` with their names."""

    def run(out, *changes, data=data, code=0):
        names = {change.partition("=")[0] for change in changes}
        unchanged = [setting for setting in arguments(data, out) if setting.partition("=")[0] not in names]
        return output_of(monkeypatch, capsys, "paper", *unchanged, *changes, code=code)

    return run


def files(out):
    """Contents that do not depend on the time: every file but the seconds; results.json without its seconds."""
    contents = {}
    for path in sorted(path for path in out.rglob("*") if path.is_file()):
        if path.stem in ("run", "seconds", "report"):
            continue
        content = path.read_bytes()
        if path.name == "results.json":
            content = [{name: value for name, value in row.items() if name != "seconds"} for row in json.loads(content)]
        contents[str(path.relative_to(out))] = content
    return contents


def test_it_names_what_is_left_out_prints_recalls_and_links_every_page(finished, data):
    out, process = finished
    left_out = [line for line in process.stderr.splitlines() if line.startswith("left out: ")]
    assert left_out[0].startswith(f"left out: gardens_point: needs {data}/gardens_point (http")
    assert left_out[1].startswith("left out: mix_hist_10: needs d2_tf")
    assert "SIFT-hist 10" in process.stdout
    assert "Mix-hist 10" not in process.stdout
    assert process.stdout.endswith(f"tables: {out}\nreport: {out}/report.html\n")
    assert sorted(path.stem for path in (out / "tables").glob("*.md")) == [
        "averages", "data_sets", "depths", "recall", "seconds", "sizes",
    ]  # fmt: skip
    page = (out / "report.html").read_text()
    assert f"{data}/gardens_point (http" in page
    assert "d2_tf (d2_tf.pth)" in page
    assert re.findall(r'<li><a href="([^"#]+)">', page) == [f"{RUN}/report.html"]
    assert (out / RUN / "report.html").is_file()
    assert "SIFT-hist 10" in page


def test_seconds_of_another_device_are_measured_again(copy, paper):
    path = copy / RUN / "seconds.json"
    seconds = json.loads(path.read_text())
    path.write_text(json.dumps(seconds | {"matching": 77.0, "measured_on": {"device": "another"}}))
    _, stderr = paper(copy)
    assert "timing: sift_10 on grief_season" in stderr
    assert json.loads(path.read_text())["matching"] < 70
    heading = (copy / "tables/seconds.md").read_text().splitlines()[0]
    assert "here grief_season, on " in heading


def test_two_do_not_evaluate_into_one_folder(finished, paper):
    out, _ = finished
    with lock_output(out):
        _, stderr = paper(out, code=2)
    assert "another process evaluates into it" in stderr


def test_data_sets_with_positions_are_evaluated_and_runs_stand_side_by_side(data, tmp_path, paper):
    for side, east in (("database", 0), ("queries", 3)):
        folder = tmp_path / "data/my-town/images/test" / side
        folder.mkdir(parents=True)
        for row, image in enumerate(sorted((data / "grief_season" / side).iterdir())):
            shutil.copy(image, folder / f"@{500000 + 100 * row + east}@4600000@{row}@.png")
    shutil.copytree(tmp_path / "data/my-town", tmp_path / "data/my town")
    (tmp_path / "out/tables").mkdir(parents=True)
    for name in ("tables/sequences_other.md", "runs"):
        (tmp_path / "out" / name).mkdir()
    chosen = "systems=[sift_hist_10,sift_hist_50]", "datasets=[my-town,my town]"
    stdout, stderr = paper(tmp_path / "out", *chosen, data=tmp_path / "data")
    assert "left out: my town: " in stderr
    assert "my-town ±25" in stdout
    assert not (tmp_path / "out/tables/sequences_other.md").exists()
    assert "sift_50" in (tmp_path / "out/comparisons/my-town.html").read_text()
    links = re.findall(r'<li><a href="([^"#]+)">', (tmp_path / "out/report.html").read_text())
    assert links == ["comparisons/my-town.html", *(f"runs/my-town/{run}/report.html" for run in ("sift_50", "sift_10"))]
    assert all((tmp_path / "out" / link).is_file() for link in links)


def test_finished_runs_are_not_repeated(finished, paper):
    out, _ = finished
    before, path = files(out), out / RUN / "results.json"
    time_of_change = path.stat().st_mtime_ns
    stdout, stderr = paper(out)
    assert "SIFT-hist 10" in stdout
    assert "sift_10 on grief_season" not in stderr
    assert path.stat().st_mtime_ns == time_of_change
    assert files(out) == before


def test_sizes_count_what_an_earlier_process_extracted(copy, paper):
    path = copy / RUN / "sizes.json"
    before = path.read_text()
    for _ in range(2):  # the first fills the cache, the second reads matches alone
        shutil.rmtree(copy / RUN)
        paper(copy, "systems=[sift_hist_10]")
    assert path.read_text() == before


def test_runs_of_other_inputs_in_the_same_folder_are_errors(copy, data, tmp_path, paper):
    other = shutil.copytree(data, tmp_path / "data")
    queries = other / "grief_season/queries"
    shutil.copyfile(queries / "0004.png", queries / "0003.png")
    _, stderr = paper(copy, data=other, code=2)
    assert "sift_10: a finished run of other images" in stderr
    path = copy / RUN / "made_of.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"weights": "x"}))
    _, stderr = paper(copy, code=2)
    assert "a finished run of other" in stderr


def test_mistakes_are_one_line(data, tmp_path, paper):
    for change, words in (
        ("systems=[best]", "systems=[best]: expected some of"),
        ("datasets=[gardens_point]", "nothing to evaluate"),
    ):
        _, stderr = paper(tmp_path / "out", change, code=2)
        [line] = [line for line in stderr.splitlines() if line.startswith("error: ")]
        assert words in line
    assert not (tmp_path / "out").exists()
    both = shutil.copytree(data, tmp_path / "data")
    (both / "gardens_point").mkdir()  # of another layout
    stdout, stderr = paper(tmp_path / "out", data=both, code=2)
    assert "left out: gardens_point: " in stderr
    assert "could not be made: gardens_point" in stderr
    assert "SIFT-hist 10" in stdout


def test_killed_five_times_it_ends_with_the_same_bytes(finished, data, tmp_path):
    out, chance = tmp_path / "paper" / "out", random.Random(0)
    command = [sys.executable, "-m", "experiments.paper", *arguments(data, out)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for _ in range(5):
        with (tmp_path / "log").open("w") as log:
            options = {"cwd": ROOT, "stdout": log, "stderr": log, "env": environment, "start_new_session": True}
            running = subprocess.Popen(command, **options)
        time.sleep(chance.uniform(2, 12))
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()
    assert run_program(*arguments(data, out), program="paper").returncode == 0
    assert files(out) == files(finished[0])
    assert not [path for path in out.rglob("*") if path.name.startswith(".")]
