"""Calibration of confidences on other drives, for places in the map and for places that it does not show.

    python -m experiments.absent NAME=DATABASE:QUERIES NAME=DATABASE:QUERIES ...

Query i of a drive shows its database image i. A confidence is fitted on one drive: with its queries as they are, and as
`Map.calibrate` does. It is used on the others: for their queries in their own database, and for those of other drives,
whose places it does not show.
"""

import itertools
from collections import defaultdict
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from experiments.drives import datasets_of, main
from mfvpr.cli.command_line import load_system
from mfvpr.evaluation import Confidence, confidence_inputs, fit_confidence, rank_dataset
from mfvpr.evaluation.calibration import fit_on_drive
from mfvpr.evaluation.confidence import reliability
from mfvpr.report import Table
from mfvpr.storage import FeatureCache

SURE = 0.8  # confidence from which on a prediction is taken for an answer

# Inputs of the confidence, and whether the top prediction is correct.
Ranked = tuple[Float[np.ndarray, "queries inputs"], Bool[np.ndarray, " queries"]]


def row(confidence: Confidence, present: list[Ranked], absent: list[Ranked]) -> list[str]:
    """Expected calibration error, share of absent places answered, and of present and correct ones, in %."""
    here, elsewhere = ([confidence.probability(inputs) for inputs, _ in parts] for parts in (present, absent))
    values = np.nan_to_num(np.concatenate([*here, *elsewhere]))
    correct = np.concatenate([is_correct for _, is_correct in (*present, *absent)])
    error = reliability(values, correct).calibration_error
    answered = [np.concatenate(parts) >= SURE for parts in (elsewhere, here)]
    is_correct = np.concatenate([is_correct for _, is_correct in present])
    return [f"{100 * share:.0f}" for share in (error, answered[0].mean(), answered[1][is_correct].mean())]


def run(drives: list[str], features: str) -> None:
    """Print a table of all drives."""
    datasets, cache = datasets_of(drives), FeatureCache()
    system = load_system("mfvpr", retrieval="vlad", features=features)
    data = {name: fit_on_drive(dataset, system, cache)[1] for name, dataset in datasets.items()}
    present = {name: (values.present, values.correct) for name, values in data.items()}
    absent = defaultdict[str, list[Ranked]](list)
    for place, drive in itertools.permutations(datasets, 2):
        elsewhere = replace(datasets[place], sequences=(replace(datasets[drive].only, truth=None),))
        [ranked] = rank_dataset(elsewhere, system, cache=cache).systems[system.headline]
        absent[place].append((confidence_inputs(ranked), np.zeros(len(ranked.rows), bool)))
    header = ["fitted on", "queries count", "ECE, %", "absent, answered, %", "present and correct, answered, %"]
    rows = []
    for name in datasets:
        here = [parts for place, parts in present.items() if place != name]
        elsewhere = [part for place, parts in absent.items() if place != name for part in parts]
        for turns, confidence in (("once", fit_confidence(*present[name])), ("twice", data[name].fit())):
            rows.append([name, turns, *row(confidence, here, elsewhere)])
    print(Table(header, rows, 2).markdown())


if __name__ == "__main__":
    main("absent", __doc__)
