"""The programs as a user meets them: settings, mistakes, the demo's table, a run folder."""

import json
import subprocess

import numpy as np
import pytest
from PIL import Image

from mfvpr import AnchorPoints, HistogramOfShifts, RatioWeight
from mfvpr.baselines import ALONE, PAPER, SCORERS, Homography, OpenCvHomography
from mfvpr.cli import evaluation
from mfvpr.cli.command_line import override
from mfvpr.systems import assembly
from mfvpr.systems.assembly import CONF
from tests.programs import MFVPR, QUICK, ROOT, composed, csv_rows, folder, run, settings_of

pytestmark = pytest.mark.thorough

CHOICES = [
    (group.name, choice.stem)
    for group in sorted(CONF.iterdir())
    if group.is_dir()
    for choice in sorted(group.glob("*"))
]


@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_every_conf_composes_and_passes_its_own_checks(group, choice):
    paths = {
        "folder": ["dataset.database=a", "dataset.queries=b"],
        "grid": ["features=ssm", "matching.cross_check=candidate"],
        "address": ["cluster.address=tcp://localhost:8786"],
    }
    needs = paths.get(choice, ["dataset.root=r"] if choice in ("grief_season", "corridor") else [])
    programs = {"experiment": ["sweep"], "system": ["evaluate", "sweep", "learn"], "grid": ["learn"]}
    for config in programs.get(group, ["evaluate"]):
        settings_of(f"{group}={choice}", *needs, config=config)


def test_scorers_of_conf_are_as_their_fields_say():
    assert assembly.scorers(composed()["scorer"]) == {name: SCORERS[name]() for name in PAPER}
    every = assembly.scorers(composed("scorer=all")["scorer"])
    assert every == {name: scorer() for name, scorer in SCORERS.items() if name not in ALONE}
    ratio = {"anchor": AnchorPoints(weight=RatioWeight()), "histogram": HistogramOfShifts(weight=RatioWeight())}
    assert assembly.scorers(composed("scorer=ratio")["scorer"]) == ratio
    compared = assembly.scorers(composed("scorer=compared")["scorer"])
    assert compared["homography_8"] == Homography(8.0)
    assert compared["magsac_8"] == OpenCvHomography(8.0, estimator="magsac")


@pytest.mark.slow
def test_bad_images_by_policy(small_street, tmp_path, succeed, refuse):
    """Names with spaces, unicode and '@' in a parent folder; one image broken, one without keypoints."""
    root = tmp_path / "a@b, c's" / "ü"
    for name in ("database", "queries"):
        (root / name).mkdir(parents=True)
        for path in sorted((small_street / name).iterdir()):
            (root / name / f"é {path.name}").write_bytes(path.read_bytes())
    (root / "database" / "é 0003.png").write_bytes(b"")
    Image.new("RGB", (30, 30)).save(root / "queries" / "é 0005.png")
    arguments = ["dataset=folder", override("dataset.database", root / "database"),
                 override("dataset.queries", root / "queries"),
                 "dataset.ground_truth=order", *QUICK, "candidates=99", f"out={tmp_path}/out"]  # fmt: skip

    assert "é 0003.png: cannot be read" in refuse("evaluate", *arguments)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a@b, c's"]

    _, stderr = succeed("evaluate", *arguments, "on_bad_image=skip")
    assert "candidates=99, but the database has 10 images" in stderr
    skipped = csv_rows(tmp_path / "out" / "skipped.csv")
    assert [(row["folder"], row["image"]) for row in skipped] == [("database", "é 0003.png")]
    rows = csv_rows(tmp_path / "out" / "predictions.csv")
    assert {f"é {row:04d}.png" for row in range(10)} - {row["query"] for row in rows} == {"é 0005.png"}
    assert "é 0003.png" not in {row["database"] for row in rows}
    assert "é 0005.png: no candidates (1 such queries of 10)" in stderr


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["database features", "query folder features"])
def test_ctrl_c_leaves_nothing(small_street, tmp_path, interrupt, stage):
    command = [*MFVPR, "evaluate", *folder(small_street, "figures=10", f"out={tmp_path}/out")]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    seen = ""
    while stage not in seen:
        character = process.stderr.read(1)
        assert character, f"ended before {stage}: {seen}"
        seen += character
    interrupt(process)


@pytest.mark.slow
def test_one_evaluation_compiles_few_programs_and_the_next_none(
    small_street, tmp_path, monkeypatch, compilations, capsys
):
    monkeypatch.chdir(tmp_path)
    common = folder(small_street, "figures=2", "features.max_keypoints=120", "retrieval.num_words=8", "candidates=7")
    evaluation.evaluate(settings_of(*common))
    assert 1 <= compilations.count <= 20
    compilations.reset()
    unused = ["scorer.histogram.sigma=9", "scorer.histogram.bin_size=14.5", "scorer.anchor.tolerance=2",
              "scorer.anchor.window=6", "fusion.c=auto"]  # fmt: skip
    evaluation.evaluate(settings_of(*common, *unused))
    assert compilations.count == 0
    assert len(list((tmp_path / "runs" / "folder").iterdir())) == 2


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """`make demo` after its installation, with an empty cache."""
    root = tmp_path_factory.mktemp("demo")
    done = run("scorer=demo", cwd=root, MFVPR_CACHE=str(root / "cache"))
    assert done.returncode == 0, done.stderr
    (folder,) = (root / "runs" / "streets").iterdir()
    return done, folder


@pytest.mark.slow
def test_demo_ranks_histogram_above_count_above_retrieval_and_leaves_a_run_folder(demo):
    done, folder = demo
    rows = json.loads((folder / "results.json").read_text())
    recall = {(row["system"], row["tolerance"]): row["recall_at"]["1"] for row in rows}
    for tolerance in (1, 2):  # within 5 frames retrieval alone finds as many as the count
        assert recall["histogram", tolerance] > recall["count", tolerance] > recall["retrieval", tolerance]
    assert recall["histogram", 5] > recall["count", 5]
    systems = ["retrieval", *PAPER, "histogram_ratio", "histogram + retrieval"]
    _, _, *lines = done.stdout[done.stdout.index("system") :].splitlines()[: 2 + len(systems)]
    assert [line.split("  ")[0] for line in lines] == systems
    assert done.stdout.endswith(f"report: runs/streets/{folder.name}/report.html\n")
    assert (folder / "report.html").read_text("utf-8").count('src="data:image/jpeg;base64,') == 6
    assert "database features" in done.stderr
    figures = [*(folder / "figures").iterdir()]
    assert {path.stem.split("_")[0] for path in figures} == {"correct", "incorrect"}
    for path in figures:
        image = np.asarray(Image.open(path).convert("L"))
        assert image.shape[0] > 300
        assert image.std() > 20
    assert [row["system"] for row in csv_rows(folder / "table.csv")] == systems
