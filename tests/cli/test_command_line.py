"""Command lines as they are typed: help, flags of Hydra, mistakes, and Ctrl-C."""

import re

import pytest

from mfvpr.cli.command_line import with_paths_as_settings
from mfvpr.systems.assembly import choices_of
from tests.builders import fill
from tests.io.checks import one_line_error
from tests.programs import ROOT, composed, run, small

pytestmark = pytest.mark.thorough

OWN = ("dataset=folder", "dataset.database=a", "dataset.queries=b")
LABELS = (*OWN, "dataset.ground_truth=label", "dataset.query_labels=c", "dataset.database_labels=d")
LARGE = [f"grid.{name}=[{','.join(map(str, range(1, 102)))}]" for name in ("sigma", "bin_size", "c")]
SIGMA = "grid.sigma=[10]"
PROGRAMS = {"evaluate": "evaluate", "sweep": "sweep", "learn": "learn", "map build": "map", "localize": "localize",
            "paper": "paper"}  # fmt: skip


@pytest.mark.parametrize("program", PROGRAMS)
def test_help_has_every_setting_with_its_sentence(succeed, program):
    stdout, stderr = succeed(program, "--help")
    assert stderr == ""
    pending = [composed(config=PROGRAMS[program])]
    while pending:
        for name, value in pending.pop().items():
            assert re.search(rf"^ *{name}:", stdout, flags=re.MULTILINE), name
            pending += [value] if isinstance(value, dict) else []
    assert "--multirun" in stdout


def test_help_is_of_the_groups_that_were_chosen(succeed):
    anchor, _ = succeed("sweep", "--help", "experiment=anchor", "dataset=corridor")
    assert "  window: 10.0  # cells; a number from 1e-06" in anchor
    assert "sigma: 22.5" not in anchor
    job, _ = succeed("evaluate", "--cfg", "job", "candidates=7")
    assert "\ncandidates: 7\n" in job


def test_a_scorer_composes_with_the_values_of_its_fields():
    for name, known in choices_of("scorer").items():
        values = composed(f"scorer={name}")["scorer"]
        assert values == {"method": name} | {field: each.default for field, each in known.items()}


@pytest.mark.parametrize(("program", "arguments", "words"), [
    ("sweep", ["system=mix_hist_50"], "grid: expected at least one axis"),
    ("sweep", ["fusion.c=zscore", "final=combined", "grid.sigma=[3]"], "fusion.c=zscore: expected a number, or auto"),
    ("evaluate", ["fusion.weights={retrieval: 2}"], "fusion.weights: expected c='zscore'"),
    ("evaluate", ["fusion.c=zscore", "fusion.weights={ancor: 1}"], "fusion.weights: expected retrieval"),
    ("evaluate", ["retrieval=[vlad,same]", "retrieval.same.whiten=0"], "retrieval.same.whiten=0: expected a whole"),
    ("evaluate", ["retrieval=[vlad,same,gem]"], "retrieval: expected one, or two in turns, got vlad, same, gem"),
    ("evaluate", ["retrieval.max_samples=63"], "max_samples=63: expected at least"),
    ("evaluate", ["matching=lightglue", "matching.weights=d2_tf"], "weights=d2_tf: expected weights of lightglue"),
    ("sweep", ["grid.sigma=[1,1.0]"], "grid.sigma=[1, 1.0]: expected different values"),
    ("evaluate", ["figures=[1.5]"], "figures=[1.5]: expected how many"),
    ("evaluate", ["candidats=3"], "candidats: unknown setting; see --help"),
    ("evaluate", ["features=aliket"], "features=aliket: expected one of aliked, d2net"),
    ("evaluate", ["a"], "a: expected DATABASE QUERIES"),
    ("evaluate", ["a", "b", "dataset=streets"], "a: expected either folders or dataset=NAME"),
    ("evaluate", ["a", "b"], "a: expected a folder of images"),
    ("localize", ["a"], "a: expected MAP IMAGES"),
    ("localize", ["map=a"], "images: expected a value, got none"),
    ("evaluate", [*OWN], "dataset.ground_truth: "),
    ("evaluate", [*OWN, "dataset.ground_truth=none"], "a: expected a folder of images"),
    ("evaluate", ["+new.key=1"], "new: unknown setting"),
    ("evaluate", ["scorer.count.method=nope"], "scorer.count.method=nope: expected one of"),
    ("evaluate", ["+scorer.count._target_=os.system"], "scorer.count._target_: unknown setting"),
    ("evaluate", ["dataset.name=../up"], "dataset.name=../up: expected letters"),
    ("evaluate", [f"out={ROOT}/README.md"], "README.md: expected a new or empty run folder"),
    ("evaluate", ["cluster=local", "cache=null"], "expected cache=DIR as well, a folder that all"),
    ("evaluate", ["cluster=address", "cluster.address=HOST"], "cluster.address=HOST: expected tcp://HOST:PORT"),
    ("evaluate", ["threshold=0.5"], "threshold=0.5: expected confidence=FILE"),
    ("evaluate", ["confidence=/none.json"], "/none.json: expected the confidence.json"),
    ("evaluate", ["system=ssm_vpr", "features=sift"], "scorer=grid: expected features=ssm"),
    ("evaluate", ["system=ssm_vpr", "matching.cross_check=mutual"], "cross_check=mutual: expected candidate"),
    ("evaluate", ["system=ssm_vpr", "features.image_size=[304,144]", "scorer.side=24"], "expected the [36, 16] cells"),
    ("sweep", LARGE, "grid: expected at most 1,000,000 settings, got 1,030,301"),
    ("evaluate", [*LABELS, "dataset.queries=[a,b]"], "ground_truth=label: expected one folder of queries"),
    ("evaluate", ["features=aliked", "features.image_size=null"], "features.image_size=null: expected a list of 2"),
    ("localize", ["map=a", "images=b", "route=-2000"], "route=-2000: expected a number from -1000 to 1000"),
    ("evaluate", ["scorer.histogram.weight=[]"], "scorer.histogram.weight=[]: expected "),
    ("evaluate", ["scorer.histogram.weight=[fs,fs]"], "expected every scorer once, got histogram_fs twice"),
    ("learn", ["scorer=histogram", "scorer.weight=[fs,ratio]"], "scorer.weight: expected one weight"),
    ("benchmark.__main__", ["foo"], "invalid choice: 'foo'"),
])  # fmt: skip
def test_mistakes_are_one_line_and_leave_nothing(refuse_at_once, program, arguments, words):
    assert words in refuse_at_once(program, *arguments)


def test_folders_stand_for_settings(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {"day": ["0", "1"], "night": ["0", "1"], "snow": ["a", "b"], "short": ["0"], "utm": ["@1@2@", "@3@4@"]}
    fill(tmp_path, [f"{folder}/{name}.png" for folder, images in names.items() for name in images])

    def settings(program, *typed):
        return with_paths_as_settings(program, [*typed])

    folders = ["dataset=folder", "dataset.database='day'"]
    order = [*folders, "dataset.queries='night'", "dataset.ground_truth=order"]
    assert settings("evaluate", "day", "-m", "night", "candidates=3") == [*order, "-m", "candidates=3"]
    assert settings("sweep", "--cfg", "job", "day", "night") == [*order, "--cfg", "job"]
    several = [*folders, "dataset.queries=['night','snow']", "dataset.ground_truth=order"]
    assert settings("evaluate", "day", "night", "snow") == several
    assert "of the same name" not in capsys.readouterr().err.splitlines()[-1]
    assert settings("evaluate", "utm", "utm")[-1] == "dataset.ground_truth=utm"
    assert settings("evaluate", "day", "short", "ground_truth=none")[-1] == "dataset.ground_truth=none"
    for queries in (["short"], ["night", "short"]):
        with one_line_error("ground_truth: expected one of order .*since there are"):
            settings("evaluate", "day", *queries)
    built = settings("map", "my map", "day", "masks=hood.png")
    assert built[3:] == ["map='my map'", "dataset.ground_truth=none", "dataset.masks=hood.png"]
    assert settings("localize", "map", "day", "./a=b") == ["map='map'", "images=['day','./a=b']"]
    assert settings("evaluate", "dataset=streets") == ["dataset=streets"]


@pytest.mark.parametrize(("program", "arguments", "words"), [
    ("sweep", ["grid.max_distance=[0.3,0.9]", "matching.max_distance=0.4"], "grid.max_distance=[0.3, 0.9]: expected"),
    ("sweep", ["scorer=all", SIGMA], "scorer: a sweep takes one scorer at a time"),
    ("sweep", [SIGMA, "dataset.ground_truth=none", "dataset.index_file=null"], "choosing settings needs order"),
    ("sweep", [SIGMA, "recall.tolerances=[30]", "split=both"], "no query of one half"),
    ("sweep", [SIGMA, "features=sift,aliked"], "add --multirun"),
    ("learn", ["scorer=count"], "scorer=count: expected one to learn"),
    ("learn", ["recall.tolerances=[30]"], "smaller tolerances or radius"),
    ("learn", ["also=[streets]"], "expected report=[...] as well"),
    ("learn", ["report=[streets]", "split=first_half"], "split=first_half: expected none with report="),
    ("learn", ["report=[{streets: {seed: -1}}]"], "dataset.seed=-1: expected a whole number from 0"),
])  # fmt: skip
def test_mistakes_about_data_are_one_line(root, refuse_at_once, program, arguments, words):
    assert words in refuse_at_once(program, *small(root), *arguments)


@pytest.mark.slow
def test_a_device_that_is_not_there_is_one_line():
    for name in ("cuda", "nonsense"):
        done = run("features=sift", JAX_PLATFORMS=name)
        assert done.returncode == 2
        assert f"error: JAX_PLATFORMS={name}: expected a device" in done.stderr
        assert done.stderr.count("\n") == 1
