"""Data sets by name: list them, and check what a folder holds. `python -m experiments.data --help`."""

from pathlib import Path

from experiments.launch import Parser, run_command


def main() -> None:
    """Run the command line's command."""
    description = "Nothing is downloaded: each data set has its place and its license."
    run_command("python -m experiments.data", description, _add_commands)


def _add_commands(parser: Parser) -> None:
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    command = commands.add_parser("list", help="the published data sets, their sizes, and what their folders hold")
    command.add_argument("names", metavar="NAME", nargs="*", help="by default a table of all")
    command.set_defaults(run="published_data:list_data")
    command = commands.add_parser("check", help="what a folder holds beside what is published; draws pairs of images")
    command.add_argument("name", metavar="NAME", help="as in dataset=NAME")
    command.add_argument("settings", metavar="root=DIR", nargs="*", help="settings of the data set, without `dataset.`")
    command.add_argument("--sheet", metavar="FILE", type=Path, help="where to draw them, by default NAME.png")
    command.set_defaults(run="published_data:check_data_set")


if __name__ == "__main__":
    main()
