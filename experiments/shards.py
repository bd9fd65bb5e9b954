"""Progress of a run that several tasks share (evaluate shard=i/n out=DIR). `python -m experiments.shards --help`."""

from pathlib import Path

from experiments.errors import Parser, run_command
from experiments.launch import program


def main() -> None:
    """Run the command line's command."""
    run_command("python -m experiments.shards", "Start missing tasks again until none is.", _add_commands)


def _add_commands(parser: Parser) -> None:
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, words in (
        ("status", "what each task of a run says of itself"),
        ("missing", "tasks that are to be started, as an array expression; nothing when all is done"),
    ):
        command = commands.add_parser(name, help=words)
        command.add_argument("folder", metavar="DIR", type=Path, help="out=DIR of the run")
        command.set_defaults(run=program("shards", name))


def status(folder: Path) -> None:
    """Print a line for each task, and whether the results are there."""
    from experiments import sharding
    from mfvpr.report.runs import LAST

    for index, state in enumerate(states := sharding.states(folder)):
        print(f"{index}/{len(states)}: {state}")
    print(f"results: {folder if (folder / LAST).exists() else 'not yet'}")


def missing(folder: Path) -> None:
    """Print the numbers of the tasks to start as an array expression."""
    from experiments import sharding
    from mfvpr.storage.shards import indices

    if left := indices(sharding.missing(folder)):
        print(left)


if __name__ == "__main__":
    main()
