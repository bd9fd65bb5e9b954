"""The paper's evaluation as a program: of what is there, once, however often it is killed."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.paper import program, systems
from experiments.paper.runs import lock_output
from mfvpr.report import Table
from tests.programs import ROOT, composed, typed
from tests.programs import run as run_program

pytestmark = pytest.mark.slow

SYSTEMS = "systems=[sift_hist_10,sift_hist_comb_10,mix_hist_10]"
QUERIES = 8


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with one data set: frames of the synthetic street under the names of another."""
    from mfvpr.datasets.streets import draw_streets

    folder = tmp_path_factory.mktemp("data") / "grief_season"
    draw_streets(folder, num_frames=QUERIES, image_size=(160, 120))
    (folder / "ground_truth.csv").unlink()
    return folder.parent


def arguments(data, out):
    return f"data={data}", "datasets=[grief_season,gardens_point]", SYSTEMS, f"out={out}", f"store={out.parent}/store"


@pytest.fixture(scope="module")
def finished(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("paper") / "out"
    done = run_program(*arguments(data, out), program="paper")
    assert done.returncode == 0, done.stderr
    return out, done


def files(out):
    """What does not depend on the time: every file but seconds and their figures, and results without them."""
    found = {}
    for path in sorted(path for path in out.rglob("*") if path.is_file()):
        if path.parent.name == "seconds" or path.stem in ("speed", "growth", "run", "seconds", "report"):
            continue
        content = path.read_bytes()
        if path.name == "results.json":
            content = [{name: value for name, value in row.items() if name != "seconds"} for row in json.loads(content)]
        found[str(path.relative_to(out))] = content
    return found


def test_it_says_what_is_left_out_and_prints_what_it_found(finished, data):
    out, done = finished
    assert f"left out: gardens_point: needs {data}/gardens_point (http" in done.stderr
    assert "left out: mix_hist_10: needs d2_tf (d2_tf.pth)" in done.stderr
    assert "SIFT-hist 10" in done.stdout
    assert "Mix-hist 10" not in done.stdout
    assert done.stdout.endswith(f"tables and figures: {out}\nreport: {out}/report.html\n")
    assert sorted(path.stem for path in (out / "tables").glob("*.md")) == [
        "averages", "data_sets", "depths", "recall", "seconds", "settings", "sizes",
    ]  # fmt: skip
    assert {path.name for path in (out / "figures").iterdir()} >= {"averages.png", "speed.png"}


def test_every_run_has_a_page_and_one_leads_to_them(finished):
    out, _ = finished
    page = (out / "report.html").read_text()
    addresses = re.findall(r'<li><a href="([^"#]+)">', page)
    assert addresses == ["runs/grief_season/sift_10/report.html"]
    assert all((out / address).is_file() for address in addresses)
    assert "SIFT-hist 10" in page
    assert "sift_10: histogram" in page  # a picture


def test_runs_of_a_data_set_stand_side_by_side(finished, data, tmp_path, monkeypatch, capsys):
    out, whole = tmp_path / "paper" / "out", finished[0]
    shutil.copytree(whole, out)
    (out / "runs/grief_season/sift_10/report.html").unlink()
    (out / "tables/sequences_other.md").touch()
    chosen = [one for one in arguments(data, out) if not one.startswith("systems=")]
    code, _, _ = typed(monkeypatch, capsys, "paper", *chosen, "systems=[sift_hist_10,sift_hist_50]")
    assert code == 0
    assert "sift_50" in (out / "comparisons/grief_season.html").read_text()
    assert not (out / "tables/sequences_other.md").exists()
    assert '<a href="comparisons/grief_season.html">' in (out / "report.html").read_text()
    assert (out / "runs/grief_season/sift_10/report.html").is_file()
    assert {path.name for path in (out / "figures").iterdir()} >= {"failures.png", "growth.png", "histogram.png"}


def test_what_a_run_left_that_was_killed_while_its_files_moved_is_no_obstacle(finished, data, tmp_path):
    whole, out = finished[0], tmp_path / "paper" / "out"
    shutil.copytree(whole, out)
    folder = out / "runs/grief_season/sift_10"
    kept = files(folder)
    (folder / ".unfinished").mkdir()
    (folder / "results.json").rename(folder / ".unfinished/results.json")
    (folder / "of another.csv").touch()
    done = run_program(*arguments(data, out), program="paper")
    assert done.returncode == 0, done.stderr
    assert files(folder) == kept


def test_seconds_of_something_else_are_measured_again(finished, data, tmp_path, monkeypatch, capsys):
    out = tmp_path / "paper" / "out"
    shutil.copytree(finished[0], out)
    path = out / "seconds/sift_10.json"
    kept = json.loads(path.read_text())
    for content in (json.dumps(kept | {"matching": 77.0, "of": kept["of"] | {"images": "others"}}), "{"):
        path.write_text(content)
        code, _, stderr = typed(monkeypatch, capsys, "paper", *arguments(data, out))
        assert code == 0
        assert "timing: sift_10 on grief_season" in stderr
        assert json.loads(path.read_text())["matching"] < 70
    heading = (out / "tables/seconds.md").read_text().splitlines()[0]
    assert "here grief_season, on " in heading


@pytest.mark.parametrize("name", ["results.json", "run.json", "sizes.json"])
def test_damaged_runs_are_told(finished, data, tmp_path, monkeypatch, capsys, name):
    out = tmp_path / "paper" / "out"
    shutil.copytree(finished[0], out)
    (out / "runs/grief_season/sift_10" / name).write_text("[")
    code, _, stderr = typed(monkeypatch, capsys, "paper", *arguments(data, out))
    assert code == 2
    assert f"sift_10/{name}: is damaged" in stderr


def test_the_plan_comes_first_and_tables_before_the_seconds(tmp_path, monkeypatch, capsys):
    """An interrupted timing costs no table."""
    place = systems.Place("streets_seasons", ("dataset=streets_seasons",))
    monkeypatch.setattr(program.systems, "places", lambda *_: ([place], ["corridor: needs a folder"]))
    monkeypatch.setattr(program, "evaluate_all", lambda *_: ({place.name: None}, []))
    monkeypatch.setattr(
        program, "paper_tables", lambda evaluations: [("recall", "heading", Table(["system"], [["SIFT"]]))]
    )

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(program, "measure_times", interrupted)
    with pytest.raises(KeyboardInterrupt):
        program.paper(composed("systems=[sift_hist_10]", f"out={tmp_path}/out", config="paper"))
    assert (tmp_path / "out" / "tables" / "recall.csv").read_text() == "system\nSIFT\n"
    stdout, stderr = capsys.readouterr()
    assert "SIFT" in stdout
    first, second = stderr.splitlines()
    assert first.startswith("plan: 1 evaluations (sift_10) on each of 1 data sets (streets_seasons), 0 of 1 finished")
    assert second == "left out: corridor: needs a folder"


def test_two_do_not_evaluate_into_one_folder(finished, data, monkeypatch, capsys):
    out, _ = finished
    (out / "tables" / ".recall-0123456z.csv").touch()  # of one that was killed
    (out / "tables" / ".mine").touch()
    with lock_output(out):
        assert {path.name for path in (out / "tables").glob(".*")} == {".mine"}
        code, _, stderr = typed(monkeypatch, capsys, "paper", *arguments(data, out))
    (out / "tables" / ".mine").unlink()
    assert code == 2
    assert "another process evaluates into it" in stderr


def test_data_sets_whose_names_tell_positions_are_found(data, tmp_path, monkeypatch, capsys):
    for side, east in (("database", 0), ("queries", 3)):
        folder = tmp_path / "data" / "my-town" / "images" / "test" / side
        folder.mkdir(parents=True)
        for row, image in enumerate(sorted((data / "grief_season" / side).iterdir())):
            shutil.copy(image, folder / f"@{500000 + 100 * row + east}@4600000@{row}@.png")
    shutil.copytree(tmp_path / "data/my-town", tmp_path / "data/my town")
    arguments = [f"data={tmp_path}/data", f"out={tmp_path}/out", f"store={tmp_path}/store", "systems=[sift_hist_10]"]
    code, stdout, stderr = typed(monkeypatch, capsys, "paper", *arguments, "datasets=[my-town,my town]")
    assert code == 0
    assert "left out: my town: " in stderr
    assert "my-town ±25" in stdout
    assert (tmp_path / "out/runs/my-town/sift_10/results.json").is_file()
    assert '<a href="runs/my-town/sift_10/report.html">' in (tmp_path / "out/report.html").read_text()


def test_what_is_finished_is_not_done_again(finished, data, monkeypatch, capsys):
    out, _ = finished
    before, folder = files(out), out / "runs/grief_season/sift_10"
    made = (folder / "results.json").stat().st_mtime_ns
    code, stdout, stderr = typed(monkeypatch, capsys, "paper", *arguments(data, out))
    assert code == 0
    assert "SIFT-hist 10" in stdout
    assert "sift_10 on grief_season" not in stderr
    assert (folder / "results.json").stat().st_mtime_ns == made
    assert files(out) == before


def test_other_images_in_the_same_folder_are_no_finished_run(finished, data, tmp_path, monkeypatch, capsys):
    out, _ = finished
    other = tmp_path / "data"
    shutil.copytree(data, other)
    image = other / "grief_season/queries/0003.png"
    image.write_bytes((other / "grief_season/queries/0004.png").read_bytes())
    code, _, stderr = typed(monkeypatch, capsys, "paper", *arguments(other, out))
    assert code == 2
    assert "sift_10: a finished run of other images" in stderr
    made = out / "runs/grief_season/sift_10/made_of.json"
    kept = made.read_text()
    for content in (json.dumps(json.loads(kept) | {"weights": "x"}), "[]", "{"):
        made.write_text(content)
        code, _, stderr = typed(monkeypatch, capsys, "paper", *arguments(data, out))
        assert code == 2
        assert "a finished run of other" in stderr
    made.write_text(kept)


@pytest.mark.parametrize(("changed", "words"), [
    (["systems=[best]"], "systems=[best]: expected some of"),
    (["datasets=[x]"], "datasets=[x]: expected some of streets_seasons"),
    (["data=/no/such"], "data=/no/such: expected a folder"),
    (["systems=[mix_hist_10]"], "nothing to evaluate"),
    (["datasets=[gardens_point]"], "nothing to evaluate"),
    (["systems=sift_hist_10"], "systems=sift_hist_10: expected"),
    (["sytems=[x]"], "the nearest is systems"),
])  # fmt: skip
def test_mistakes_are_one_line(data, tmp_path, monkeypatch, capsys, changed, words):
    names = {one.partition("=")[0] for one in changed}
    kept = [one for one in arguments(data, tmp_path / "out") if one.partition("=")[0] not in names]
    code, _, stderr = typed(monkeypatch, capsys, "paper", *kept, *changed)
    assert code == 2
    [line] = [line for line in stderr.splitlines() if line.startswith("error: ")]
    assert words in line
    assert not (tmp_path / "out").exists()


def test_a_data_set_of_another_layout_is_left_out(data, tmp_path, monkeypatch, capsys):
    both = tmp_path / "data"
    shutil.copytree(data, both)
    (both / "gardens_point").mkdir()
    code, stdout, stderr = typed(monkeypatch, capsys, "paper", *arguments(both, tmp_path / "out"))
    assert code == 2
    assert "left out: gardens_point: " in stderr
    assert "could not be made: gardens_point" in stderr
    assert "SIFT-hist 10" in stdout


@pytest.mark.slow
def test_killed_five_times_it_ends_with_the_same_bytes(finished, data, tmp_path):
    whole, _ = finished
    out, chance = tmp_path / "paper" / "out", random.Random(0)
    command = [sys.executable, "-m", "experiments.paper", *arguments(data, out)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for _ in range(5):
        with (tmp_path / "log").open("w") as log:
            running = subprocess.Popen(
                command, cwd=ROOT, stdout=log, stderr=log, env=environment, start_new_session=True
            )
        time.sleep(chance.uniform(2, 12))
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()
    assert run_program(*arguments(data, out), program="paper").returncode == 0
    assert files(out) == files(whole)
    assert not [path for path in Path(out).rglob("*") if path.name.startswith(".")]
