"""`mfvpr learn` with several data sets: what is learned on some is reported on the others, each as it is alone."""

import csv
import json
from types import SimpleNamespace

import pytest
import yaml

from mfvpr.cli import evaluation, learning
from mfvpr.cli.command_line import compose_data_sets
from mfvpr.datasets.streets import streets_folder
from tests.programs import QUERIES, results, settings_of, small

pytestmark = pytest.mark.slow

SHORT = ("scorer=sum", "steps=2", "every=1", "batch=4", "grid.c=[1]", "grid.weight=[dmf,ratio]")


def as_text(street, name):
    """A synthetic street's folder, in the words of a list of data sets."""
    index = f"ground_truth: index, index_file: {street}/ground_truth.csv, widen_index: true"
    return f"{{folder: {{name: {name}, database: {street}/database, queries: {street}/queries, {index}}}}}"


def read(text):
    """The settings of a data set of such a list."""
    return compose_data_sets([yaml.safe_load(text)])[0]


@pytest.fixture(scope="module")
def streets(root):
    """The small data set's, and two more."""
    drawn = [streets_folder(root, seed=seed, num_frames=QUERIES, image_size=(160, 120)) for seed in (0, 1, 2)]
    return [as_text(street, f"street{seed}") for seed, street in enumerate(drawn)]


@pytest.fixture(scope="module")
def learned(root, streets, tmp_path_factory):
    """On the small data set and another, reported on a third."""
    out = tmp_path_factory.mktemp("learned")
    common = (*SHORT, f"report=[{streets[2]}]")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learning.searches, "comparison_figures", lambda *_: [])
        learning.learn(settings_of(*small(root), *common, f"also=[{streets[1]}]", f"out={out}/out", config="learn"))
    return out, results(out / "out")


def test_results_and_tables_name_the_sets(learned):
    out, content = learned
    for row in content["rows"]:
        assert row["by_set"]["street2"] == pytest.approx(row["recall_at_1"])
    assert [entry["dataset"] for entry in content["data_sets"]] == ["folder", "street1"]
    assert [entry["dataset"] for entry in content["reported_sets"]] == ["street2"]
    sets = [*content["data_sets"], *content["reported_sets"]]
    assert len({json.dumps(entry["data_fingerprint"]) for entry in sets}) == 3
    assert content["queries"]["reported"] == [list(range(2 * QUERIES, 3 * QUERIES))]
    assert content["queries"]["chosen_on"] == [list(range(2 * QUERIES))]
    with (out / "out" / "table.csv").open() as file:
        header = next(csv.reader(file))
    assert header[:4] == ["score", "R@1 ±0", "R@1 ±1", "street2 ±1"]
    assert sorted(path.name for path in (out / "out" / "weights").iterdir())[0] == "other_sets_match_labels.json"


def test_several_sets_as_they_are_typed():
    [corridor, drawn] = compose_data_sets([{"corridor": {"root": "/a,b:c"}}, {"streets": {"seed": 4}}])
    assert corridor["database"] == "/a,b:c/ref"
    assert (drawn["name"], learning.label(drawn)) == ("streets", "streets 4")
    assert compose_data_sets(["streets"])[0]["seed"] == 0


def test_images_that_were_learned_on_are_not_reported_on_and_queries_count_once(root, streets, tmp_path, refuse):
    again = streets[1].replace("name: street1", "name: again")
    for report, name, other, same in (
        (streets[0], "report=street0", "folder", 2 * QUERIES), (f"{streets[1]},{again}", "again", "street1", QUERIES),
    ):  # fmt: skip
        error = refuse("learn", *small(root), *SHORT, f"report=[{report}]", f"out={tmp_path}/out")
        assert error.startswith(f"error: {name}: expected")
        assert f"; {same} " in error.partition(f" {other}")[2]


def test_sets_of_one_map_are_not_independent(root, streets, tmp_path, capsys):
    """Other queries of the same database: no set of blocks knows that they show the same places."""
    several = []
    for name, of_queries in (("there", 1), ("back", 2)):
        database, queries = (read(streets[number]) for number in (1, of_queries))
        dataset = database | {"name": name, "queries": queries["queries"], "ground_truth": "order"}
        settings = settings_of(*small(root), f"out={tmp_path}/out", dataset=dataset | {"index_file": None})
        inputs = learning.prepare(settings, evaluation.Stopwatch())
        several.append(learning.Prepared(SimpleNamespace(name=name), inputs))
    learning.require_disjoint([], several)
    assert capsys.readouterr().err.splitlines()[-1].startswith("warning: there and back ")
    learning.require_disjoint([], several[:1])
    assert "there and back" not in capsys.readouterr().err


def test_a_learned_weight_knows_what_it_was_learned_on(root, streets, learned, tmp_path, capsys, succeed):
    weight = learned[0] / "out" / "weights" / "other_sets_match_labels.json"
    on_these = "was learned on images of folder"
    common = (*small(root), f"scorer.weight={weight}", "figures=0")
    for number, (more, warns) in enumerate([
        (["scorer=sum"], [on_these]), (["scorer=histogram"], [on_these]),
        (["scorer=histogram", "scorer.weight=learned_aliked"], ["other features (aliked instead of sift, aliked-n16 "]),
        (["scorer=histogram", "scorer.weight=ratio"], []),
    ]):  # fmt: skip
        _, stderr = succeed("evaluate", *common, *more, f"out={tmp_path}/{number}")
        assert [line for line in stderr.splitlines() if "was learned" in line and any(t in line for t in warns)] == [
            line for line in stderr.splitlines() if "was learned" in line
        ]
        assert stderr.count("was learned") == len(warns)
    reported = read(streets[2])
    learning.prepare(settings_of(*common, "scorer=sum", dataset=reported), evaluation.Stopwatch())
    assert "was learned" not in capsys.readouterr().err
