"""The README is run, not believed."""

import re
import shlex
import shutil
import subprocess

import numpy as np
import pytest

from mfvpr.cli import overrides
from mfvpr.datasets import image_folder
from mfvpr.features import Sift
from mfvpr.io import write_features
from mfvpr.storage import FeatureCache
from mfvpr.systems.settings import CONF, RULES, check, scorer_rules
from tests import random_checkpoints
from tests.builders import make_matches
from tests.programs import QUICK, ROOT, composed, run, typed

pytestmark = pytest.mark.thorough

README = (ROOT / "README.md").read_text()
BESIDE = [(ROOT / place).read_text() for place in ("experiments/results.md", "conf/README.md")]
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README, flags=re.DOTALL)
COMMANDS = [line for language, block in BLOCKS if language == "sh" for line in block.splitlines()]


def test_commands_are_of_the_kinds_checked_here():
    assert {line.split()[0] for line in COMMANDS} == {"make", "mfvpr", "python", "."}


@pytest.mark.parametrize("target", [line.split()[1] for line in COMMANDS if line.startswith("make")])
def test_make_targets_exist(target):
    done = subprocess.run(["make", "--dry-run", target], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("command", [line for line in COMMANDS if line.startswith("mfvpr evaluate")])
def test_commands_run(command, small_street, weights, tmp_path, monkeypatch, capsys):
    if "aliked" in command and not random_checkpoints.ALIKED.is_dir():
        pytest.skip("no ../shared/weights: ALIKED's are not shipped")
    root = tmp_path / "root"
    shutil.copytree(small_street, root)
    shutil.copytree(root / "database", root / "ref")  # corridor's names
    shutil.copytree(root / "queries", root / "query")
    arguments = shlex.split(command.removeprefix("mfvpr evaluate"))
    places = {"database": root / "database", "queries": root / "queries", "root": root}
    folders = {f"dataset.{name}=DIR": f"dataset.{name}={path}" for name, path in places.items()}
    folders["dataset.queries=[DIR,DIR]"] = f"dataset.queries=[{root}/queries,{root}/query]"
    for side in ("database", "queries"):
        folders[f"features.{side}=FILE"] = f"features.{side}={tmp_path}/{side}.npz"
    arguments = [folders.get(argument, argument) for argument in arguments]
    if not any(argument.startswith("dataset=") for argument in arguments):  # streets would take longer
        arguments += ["dataset=folder", "dataset.ground_truth=order", *list(folders.values())[:2]]
    if "features=import" in arguments:
        for side in ("database", "queries"):
            images = image_folder(root / side)
            [features] = FeatureCache().local(images, Sift(max_keypoints=60))
            write_features(tmp_path / f"{side}.npz", images.names, features.read(range(len(images))))
    fixed = ("retrieval.",) if "mixvpr" in command or "system" in command else ()
    fixed += ("features.",) if "features=import" in arguments else ()
    quick = [setting for setting in QUICK if not setting.startswith(fixed)]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MFVPR_WEIGHTS", str(weights))
    code, stdout, stderr = typed(monkeypatch, capsys, "evaluate", *arguments, *quick)
    assert code == 0, stderr
    assert "Settings" in stdout or "histogram" in stdout or "anchor" in stdout


@pytest.mark.parametrize("program", ["sweep", "learn"])
def test_commands_of_sweeps_and_learning_are_settings(program):
    """They run in the tests of these programs, on less."""
    commands = [shlex.split(line) for line in COMMANDS if line.startswith(f"mfvpr {program}")]
    assert len(commands) >= 2
    for _, _, *arguments in commands:
        chosen = [
            argument.replace("=DIR", "=root")
            for argument in arguments
            if argument != "-m" and not argument.startswith("hydra/")
        ]
        if "-m" in arguments:  # the first of several values
            chosen = [re.sub(r"=(\[[^]]*\]|[^,\[]*),.*", r"=\1", argument) for argument in chosen]
        settings = composed(*map(overrides.quote, overrides.split_first(chosen)), config=program)
        check(settings)
        for name in ("also", "report"):
            assert not settings.get(name) or overrides.compose_data_sets(name, settings[name])


@pytest.mark.slow
def test_benchmark_runs(tmp_path):
    out = tmp_path / "benchmark.json"
    done = run("--rounds", "1", "--out", out, program="benchmark")
    assert done.returncode == 0, done.stderr
    for step in ("matching", "matching + histogram", "histogram", "anchor", "sum"):
        assert re.search(rf"^{re.escape(step)} +mfvpr", done.stdout, flags=re.MULTILINE)
    assert out.is_file()


EXAMPLES = [block for language, block in BLOCKS if language == "python"]


def lines(code):
    return [line for line in code.splitlines() if line.strip()]


def test_library_example(small_street, tmp_path, monkeypatch, capsys):
    assert len([line for line in lines(EXAMPLES[0]) if "import" not in line]) <= 10
    shutil.copy(small_street / "queries" / "0004.png", tmp_path / "query.jpg")
    shutil.copy(small_street / "database" / "0004.png", tmp_path / "candidate.jpg")
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[0], "README.md", "exec"), {})
    printed = capsys.readouterr().out
    for name in ("HistogramOfShifts", "AnchorPoints", "AggregatedScore", "candidate minus query"):
        assert name in printed


@pytest.mark.slow
def test_the_whole_way_in_one_call(small_street, tmp_path, monkeypatch, capsys):
    for side in ("database", "queries"):
        shutil.copytree(small_street / side, tmp_path / side)
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[1], "README.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    systems = [line.split()[0] for line in printed if line.startswith(("retrieval", "histogram"))]
    assert systems == ["retrieval", "histogram"]
    assert all((tmp_path / name).exists() for name in ("features", "run/results.json", "report.html"))


def test_a_scorer_of_your_own_keeps_the_contract():
    code, names = EXAMPLES[2], {}
    assert len(lines(code)) <= 15
    exec(compile(code, "README.md", "exec"), names)
    points = np.random.default_rng(0).uniform(50, 250, (12, 2))
    assert names["Concentration"]()(make_matches(points, points + 30)) == pytest.approx(12)
    assert len(EXAMPLES) == 3


def test_settings_that_the_text_names_exist():
    names = re.findall(r"`(?:[\w.]+\.)?(\w+)=[^`(]*`", "".join([README, *BESIDE]))
    assert len(names) > 20
    groups = {path.name for path in CONF.iterdir() if path.is_dir()}
    rules = [*RULES, *(name for scorer in scorer_rules(CONF / "rules.yaml").values() for name in scorer)]
    assert set(names) <= {rule.rpartition(".")[2] for rule in rules} | groups


def test_readme_names_no_machine_path():
    assert not re.search(r"/(work|tmp|root|home)/", "".join([README, *BESIDE]))
    assert len(README.splitlines()) <= 320
    assert (ROOT / "LICENSE").read_text().startswith("MIT")
