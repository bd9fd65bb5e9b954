"""The benchmark of an accelerator on a CPU, with small sizes: results are exact, and torch computes the same."""

import json
from dataclasses import replace

import numpy as np
import pytest

from experiments.benchmark import accelerator, accelerator_checks, scores
from mfvpr.utils.errors import InputError
from tests.needs import skip_without


@pytest.mark.slow
def test_results_are_exact_and_times_are_reported(tmp_path, capsys):
    report = accelerator.run(2, tmp_path / "report.json", ["correct", "rates"])
    assert json.loads((tmp_path / "report.json").read_text())["groups"] == report
    assert len(report["correct"]) > 15
    assert {row["exact"] for row in report["correct"]} == {"yes"}
    assert {row["step"] for row in report["rates"] if row["median_ms"] > 0} == {"product 256 x 256"}
    assert "product 256 x 256" in capsys.readouterr().out


def test_matches_by_products_of_few_digits_differ():
    images = accelerator_checks.images()
    high_bits = np.uint32(0xFFFFE000)  # bits of TF32
    rounded = tuple(
        replace(image, descriptors=(image.descriptors.view(np.uint32) & high_bits).view(np.float32)) for image in images
    )
    assert accelerator_checks.match(images)[2] == 0
    assert accelerator_checks.match(images, rounded=rounded)[2] > 10


def test_groups_are_named(tmp_path):
    with pytest.raises(InputError, match="networks"):
        accelerator.run(1, tmp_path / "report.json", ["network"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "sizes"),
    [
        (scores.scoring_entries, (6,)),
        (scores.matching_entries, (4, 60, 32)),
        (scores.search_entries, (2000, 32, (5,))),
        (scores.ranking_entries, (1, 4, 60, 32)),
        (scores.ranking_entries, (3, 4, 60, 32)),
        (accelerator.settings_entries, (6,)),
    ],
)
def test_torch_computes_the_same(make, sizes):
    skip_without("torch")
    entries = make(*sizes)
    of_torch = {step: call for step, name, call in entries if name == "torch"}
    for step, call in [(step, call) for step, name, call in entries if name in ("mfvpr", "mfvpr, in one jit")]:
        theirs, ours = of_torch[step](), call()
        if make is scores.matching_entries:
            nearest1, mutual, distance = map(np.asarray, theirs)
            np.testing.assert_array_equal(mutual, ours.mask)
            np.testing.assert_array_equal(nearest1[mutual], np.asarray(ours.index1)[mutual])
            np.testing.assert_allclose(distance[mutual], np.asarray(ours.distance)[mutual], atol=1e-6)
            continue
        theirs = np.asarray(theirs).squeeze()
        if make is scores.search_entries:
            ours = ours.indices
        if make is accelerator.settings_entries:
            theirs = theirs.reshape(2, 25, 6, 2, 10).transpose(1, 0, 3, 4, 2)
        np.testing.assert_allclose(np.squeeze(ours), theirs, rtol=1e-5)
