"""Systems by name in the library are those of the programs."""

import functools
import json
import math
import sys
from contextlib import nullcontext

import numpy as np
import pytest

import mfvpr
from mfvpr import InputError, load_system
from mfvpr.checkpoints.networks import RECOMMENDED
from mfvpr.cli import command_line, evaluation, jobs, programs
from mfvpr.cli.command_line import translate
from mfvpr.cli.schema import Evaluate
from mfvpr.features import AlikedFeatures, Sift, SsmCells
from mfvpr.storage import FeatureCache
from mfvpr.systems.assembly import CONF
from mfvpr.utils.fields import from_values
from mfvpr.utils.fingerprints import recipe_of
from tests.io.checks import one_line_error
from tests.programs import CANDIDATES, composed, csv_rows, settings_of, shared, small

FEATURES = {"max_keypoints": 60, "image_size": [160, 120]}
SMALL = {"features": FEATURES, "retrieval": {"num_words": 8}, "candidates": CANDIDATES}


@pytest.mark.parametrize("name", sorted(path.stem for path in CONF.glob("system/*.yaml")))
def test_every_system_loads_or_names_the_weights_to_install(name, tmp_path, monkeypatch):
    monkeypatch.setenv("MFVPR_WEIGHTS", str(tmp_path))
    if name == "steering":
        with pytest.warns(UserWarning, match="^system=steering uses SIFT .* mfvpr weights download aliked-n16$"):
            assert isinstance(load_system(name).pipeline.extractor, Sift)
    else:
        with pytest.raises(InputError, match=r"^[\w-]+: not installed in "):
            load_system(name)


@pytest.mark.parametrize(
    ("installed", "system"),
    [
        ((), "features=sift"),
        (("aliked-n16",), "features=sift"),
        (("xfeat", "efficientnet_lite0"), "system=fast"),
        (RECOMMENDED, "system=mfvpr"),
    ],
)
def test_without_a_choice_the_best_system_whose_weights_are_installed_runs(installed, system, monkeypatch):
    monkeypatch.setattr(command_line, "is_installed", lambda entry: entry.name in installed)
    assert translate("system=auto") == [system]
    line = "mfvpr weights download recommended" if system == "features=sift" else f"system=auto: {system[7:]},"
    assert line in command_line.installed_system()[1]


@pytest.mark.parametrize("names", ["[vlad,same]", "[vlad, same]"])
def test_two_retrievals_are_a_list(names):
    expected = ["~retrieval", "+retrieval@retrieval.vlad=vlad", "+retrieval@retrieval.same=same"]
    assert translate(f"retrieval={names}") == expected
    assert translate("retrieval=vlad") == ["retrieval=vlad"]
    settings = settings_of(*expected, "retrieval.vlad.num_words=8", "retrieval.same.standardize=running")
    assert settings.retrieval["vlad"]["num_words"] == 8
    with pytest.raises(InputError, match=r"^retrieval.vlad.standardize=all: expected one of auto"):
        settings_of(*expected, "retrieval.vlad.standardize=all")
    with pytest.raises(InputError, match=r"^retrieval: expected one, or two in turns, got vlad, same, third"):
        settings_of(*expected, "+retrieval@retrieval.third=vlad")


def test_a_run_says_how_descriptors_were_standardized(tmp_path, tmp_path_factory, capsys):
    """Two retrievals in turns; the recall without later queries stands behind the heading; other confidences fail."""
    two = ("~retrieval", "+retrieval@retrieval.vlad=vlad", "+retrieval@retrieval.drive=vlad")
    values = ("retrieval.vlad.num_words=8", "retrieval.drive.num_words=8", "retrieval.drive.standardize=auto")
    data = [each for each in small(shared(tmp_path_factory)) if not each.startswith("retrieval")]
    job = functools.partial(settings_of, *data, "figures=0", *two, *values)
    evaluation.evaluate(job(f"out={tmp_path}/run"))
    [heading] = [line for line in capsys.readouterr().out.splitlines() if " queries, " in line]
    assert "(vlad and drive, standardized by drive)" in heading
    assert "a robot, which knows earlier queries only, has R@1" in heading
    confidence = f"confidence={tmp_path}/run/confidence.json"
    evaluation.evaluate(job(f"out={tmp_path}/same", confidence))
    with pytest.raises(InputError, match=r"fitted with standardize=running, got drive; set retrieval.standardize"):
        evaluation.evaluate(job(f"out={tmp_path}/other", confidence, "retrieval.drive.standardize=running"))


def test_steering_takes_aliked_if_its_weights_are_installed(weights, monkeypatch, recwarn):
    monkeypatch.setenv("MFVPR_WEIGHTS", str(weights))
    system = load_system("steering")
    assert isinstance(system.pipeline.extractor, AlikedFeatures)
    assert system.settings["features"]["weights"] == "aliked-n16"
    assert isinstance(load_system("steering", features="sift").pipeline.extractor, Sift)
    assert system.with_image_size((64, 96)).settings["features"]["image_size"] == [64, 96]
    assert not recwarn


@pytest.mark.slow
def test_a_run_records_the_size_that_the_images_decide(tmp_path):
    settings = settings_of(*small(tmp_path), "features.image_size=19200", f"out={tmp_path}/run", "figures=0")
    evaluation.evaluate(settings)
    assert json.loads((tmp_path / "run/run.json").read_text())["settings"]["features"]["image_size"] == [160, 120]


@pytest.mark.parametrize(("name", "settings", "words"), [
    ("mix", {}, "system=mix: expected one of"),
    ("steering", {"sigma": 3}, "sigma: unknown setting"),
    ("steering", {"features": "import"}, "^features.image_size=auto: expected a list of 2"),
    ("mfvpr", {"features": "import"}, "^features: files of other programs belong to a data set"),
    ("no/run.json", {}, "^no/run.json: expected the run.json of a run"),
    ("no/run.json", {"candidates": 3}, "^no/run.json: expected no other settings, got candidates"),
])  # fmt: skip
def test_what_cannot_be_loaded_is_one_line(name, settings, words):
    with pytest.raises(InputError, match=words) as error:
        load_system(name, **settings)
    assert "\n" not in str(error.value)


def test_a_run_json_of_another_program_or_that_lacks_a_setting_is_one_line(tmp_path):
    """A default in its place may be another value than that of the run."""
    path = tmp_path / "run.json"
    contents = {"cannot be read": {"model": "resnet"}, "lr: unknown setting": {"settings": {"lr": 0.1}}}
    for name in ("features.image_size", "retrieval.num_words", "scorer.histogram.sigma", "scorer"):
        *groups, last = name.split(".")
        lacking = contents[f"{name}: expected .* got none$"] = {"settings": composed()}
        del functools.reduce(dict.__getitem__, groups, lacking["settings"])[last]
    for words, content in contents.items():
        path.write_text(json.dumps(content))
        with one_line_error(f"^{path}: {words}"):
            load_system(path)


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize("size", [[224, 224], [304, 144], [144, 304], [337, 330], [330, 100]])
def test_the_side_of_the_grid_is_that_of_the_cells_whatever_their_number(size, stride):
    """36 x 16 cells are as many as 24 x 24; also of one score of several."""
    settings = composed("system=ssm_vpr", f"features.image_size={size}", f"features.stride={stride}")
    rows, columns = SsmCells(None, tuple(size), stride=stride).windows.grid
    for side in {rows, columns, math.isqrt(rows * columns)}:
        grid = settings["scorer"] | {"side": side}
        for scorer in (grid, {"it": grid, "count": composed()["scorer"]["count"]}):
            words = rf"^scorer.side={side}: expected the \[{columns}, {rows}\] cells"
            with nullcontext() if rows == columns else one_line_error(words):
                from_values(Evaluate, settings | {"scorer": scorer})


@pytest.mark.slow
def test_a_system_evaluates_and_localizes_as_the_program(small_street, tmp_path):
    arguments = ("system=steering", f"out={tmp_path}/run", "figures=0")
    evaluation.evaluate(settings_of(*small(tmp_path), *arguments))
    system = load_system("steering", **SMALL)
    again = load_system(tmp_path / "run" / "run.json")
    assert recipe_of(again.pipeline) == recipe_of(system.pipeline)
    data = jobs.dataset_of(composed(*small(tmp_path))["dataset"])
    result = mfvpr.evaluate(data, system, cache=FeatureCache(tmp_path / "features"))
    names = np.array(data.database.names)[result.only.systems["histogram"][0].rows[:, 0]]
    rows = [row for row in csv_rows(tmp_path / "run" / "predictions.csv") if row["rank"] == "1"]
    assert [row["database"] for row in rows] == names.tolist()
    result.save(tmp_path / "saved", thresholds=[0, 1], ks=[1, 5])
    files = {path.relative_to(tmp_path / "run") for path in (tmp_path / "run").rglob("*.csv")}
    assert len(files) > 10
    for file in files:
        assert (tmp_path / "saved" / file).read_bytes() == (tmp_path / "run" / file).read_bytes()
    street = mfvpr.Map(tmp_path / "map", system)
    street.build(data.database)
    places = [street.localize(path).place for path in data.queries.paths]
    answered = [row for row, place in enumerate(places) if place is not None]
    assert len(answered) > len(places) / 2
    assert [places[row] for row in answered] == names[answered].tolist()


def test_the_command_runs_programs_and_refuses_others(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["mfvpr"])
    programs.main()
    assert {*programs.COMMANDS} <= {*capsys.readouterr().out.split()}
    monkeypatch.setattr(sys, "argv", ["mfvpr", "evaluat"])
    with pytest.raises(SystemExit) as left:
        programs.main()
    assert left.value.code == 2
    assert capsys.readouterr().err.startswith("error: evaluat: expected one of demo, evaluate")
