"""Command lines of experiments with drives, NAME=DATABASE:QUERIES, whose query i shows their database image i."""

from collections.abc import Sequence

from mfvpr.cli.programs import Parser, run_command
from mfvpr.datasets import Dataset, folder
from mfvpr.utils.errors import InputError

NEAR = 2  # frames: within them, a prediction is correct


def main(program: str, description: str | None) -> None:
    """Run the program `experiments.PROGRAM:run` with the drives and the features of the command line."""

    def add_arguments(parser: Parser) -> None:
        parser.add_argument("drives", nargs="+", metavar="NAME=DATABASE:QUERIES", help="by names of your choice")
        parser.add_argument("--features", default="aliked", metavar="NAME", help="choice of the group features")
        parser.set_defaults(run=f"experiments.{program}:run")

    run_command(f"python -m experiments.{program}", str(description), add_arguments)


def datasets_of(drives: Sequence[str]) -> dict[str, Dataset]:
    """Data sets by name."""
    datasets = {}
    for drive in drives:
        name, _, paths = drive.partition("=")
        database, _, queries = paths.partition(":")
        if not (name and database and queries):
            raise InputError(f"{drive}: expected NAME=DATABASE:QUERIES")
        datasets[name] = folder(database, queries, ground_truth="order")
    return datasets
