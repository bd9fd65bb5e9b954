"""The benchmark of an accelerator on a CPU, with small sizes: results are exact, and torch computes the same."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest

from experiments.benchmark import accelerator, accelerator_checks
from mfvpr.utils.errors import InputError
from tests.needs import skip_without


@pytest.mark.parametrize(
    "parts",
    [
        (accelerator_checks.search_tasks,),
        pytest.param(accelerator_checks.PARTS, marks=pytest.mark.slow),
    ],
)
def test_results_are_exact_and_times_are_reported(parts, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(accelerator, "SECONDS", dict.fromkeys(accelerator.SECONDS, 1000))
    monkeypatch.setattr(accelerator_checks, "PARTS", parts)
    report = accelerator.run(2, tmp_path / "report.json", ["correct", "rates"])
    assert json.loads((tmp_path / "report.json").read_text())["groups"] == report["groups"]
    checked, timed = (report["groups"][group]["rows"] for group in ("correct", "rates"))
    assert len(checked) > len(parts)
    assert {row["exact"] for row in checked} == {"yes"}
    assert {row["case"] for row in timed if row["ms"] > 0 and row["calls"] <= 2} >= {"product 256 x 256"}
    printed = capsys.readouterr().out
    assert all(row["case"] in printed for row in timed)


def test_matches_by_products_of_few_digits_differ():
    images = accelerator_checks.images()
    high_bits = np.uint32(0xFFFFE000)  # bits of TF32
    rounded = tuple(
        replace(image, descriptors=(image.descriptors.view(np.uint32) & high_bits).view(np.float32)) for image in images
    )
    assert accelerator_checks.match(images, {})[2] == 0
    assert accelerator_checks.match(images, {}, rounded)[2] > 10


def test_late_and_failing_calls_say_so():
    case = accelerator.Case("rates", "of {}", lambda _: pytest.fail("too late"), (1,), (2,))
    late = list(accelerator.time_cases([case], 1, on_cpu=True, end=time.monotonic() - 1))
    assert late == [{"case": "of 2", "note": "skipped: out of time"}]
    calls = {"fails": lambda: 1 / 0, "runs": lambda: time.sleep(1e-3)}
    fails, runs = accelerator.time_calls("both", calls, 1.0, "call", 3)
    assert "ZeroDivisionError" in fails["note"]
    assert runs["ms"] >= 1
    assert runs["calls"] == 3


def test_groups_are_named(tmp_path):
    assert {case.group for case in accelerator.CASES} == accelerator.SECONDS.keys() - {"correct"}
    with pytest.raises(InputError, match="networks"):
        accelerator.run(1, tmp_path / "report.json", ["network"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "sizes", "options"),
    [
        (accelerator.scoring, (6,), {"name": "histogram"}),
        (accelerator.scoring, (6,), {"name": "anchor"}),
        (accelerator.scoring, (6,), {"name": "sum"}),
        (accelerator.matching, (4, 60, 32), {}),
        (accelerator.searching, (5, 2000, 32), {}),
        (accelerator.ranking, (1, 4, 60, 32), {}),
        (accelerator.ranking, (3, 4, 60, 32), {}),
        (accelerator.grid, (2, 3), {}),
    ],
)
def test_torch_computes_the_same(make, sizes, options):
    skip_without("torch")
    calls = make(*sizes, **options)[0]
    theirs, ours = calls["torch"](), next(iter(calls.values()))()
    if make is accelerator.matching:
        nearest1, mutual, distance = map(np.asarray, theirs)
        np.testing.assert_array_equal(mutual, ours.mask)
        np.testing.assert_array_equal(nearest1[mutual], np.asarray(ours.index1)[mutual])
        np.testing.assert_allclose(distance[mutual], np.asarray(ours.distance)[mutual], atol=1e-6)
        return
    theirs = np.asarray(theirs).squeeze()
    if make is accelerator.searching:
        ours = ours.indices
    if make is accelerator.grid:
        theirs = theirs.reshape(2, 25, 6, 2, 10).transpose(1, 0, 3, 4, 2)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)
