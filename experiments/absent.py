"""Calibration of confidences on other drives, for places in the map and for places that it does not show.

    python -m experiments.absent NAME=DATABASE:QUERIES NAME=DATABASE:QUERIES ...

Query i of a drive shows its database image i. A confidence is fitted on one drive: with its queries as they are, and as
`Map.calibrate` does. It is used on the others: for their queries in their own database, and for those of other drives,
whose places it does not show.
"""

import itertools

import numpy as np
from jaxtyping import Bool, Float

from mfvpr.cli.command_line import load_system
from mfvpr.cli.programs import Parser, run_command
from mfvpr.datasets.datasets import folder
from mfvpr.evaluation import Confidence, confidence_inputs, fit_confidence, rank_dataset
from mfvpr.evaluation.confidence import reliability
from mfvpr.localization.map_settings import fit_on_drive
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


def run(drives: list[str]) -> None:
    """Print a table of all drives."""
    system, cache = load_system("mfvpr"), FeatureCache()
    folders = {name: paths.split(":") for name, _, paths in (drive.partition("=") for drive in drives)}
    datasets = {name: folder(*paths, ground_truth="order") for name, paths in folders.items()}
    data = {name: fit_on_drive(dataset, system, cache)[1] for name, dataset in datasets.items()}
    present = {name: (values.present, values.correct) for name, values in data.items()}
    absent = {}
    for place, other in itertools.permutations(folders, 2):
        elsewhere = folder(folders[place][0], folders[other][1], ground_truth="none")
        [ranked] = rank_dataset(elsewhere, system, cache=cache).systems[system.headline]
        absent[place, other] = confidence_inputs(ranked), np.zeros(len(ranked.rows), bool)
    print("| fitted on | queries count | ECE, % | absent, answered, % | present and correct, answered, % |")
    print("| :-- | :-- | --: | --: | --: |")
    for name in datasets:
        fits = {"once": fit_confidence(*present[name]), "twice": data[name].fit()}
        for turns, confidence in fits.items():
            cells = row(confidence, [each for other, each in present.items() if other != name],
                        [each for (place, _), each in absent.items() if place != name])  # fmt: skip
            print(f"| {name} | {turns} | {' | '.join(cells)} |")


def add_arguments(parser: Parser) -> None:
    """Declare the command line."""
    parser.add_argument("drives", nargs="+", metavar="NAME=DATABASE:QUERIES", help="two or more drives")
    parser.set_defaults(run="experiments.absent:run")


if __name__ == "__main__":
    run_command("python -m experiments.absent", str(__doc__), add_arguments)
