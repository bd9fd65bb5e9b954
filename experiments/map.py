"""Build a map for localization, add images to it, list its content. `python -m experiments.map --help`."""

import sys
from pathlib import Path

from experiments.launch import Parser, launch, run_command

_MAP = "python -m experiments.map"


def main() -> None:
    """Run the command line's command."""
    if sys.argv[1:2] == ["build"]:
        del sys.argv[1]
        launch("map")
        return
    run_command(_MAP, "Localize images in a map with python -m experiments.localize. Settings of the first command: "
                f"{_MAP} build --help.", _add_commands)  # fmt: skip


def _add_commands(parser: Parser) -> None:
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    commands.add_parser("build", help="build map=DIR dataset=...: of the database of a data set")
    command = commands.add_parser("info", help="what a map holds, and what it was made with")
    command.add_argument("folder", metavar="DIR", type=Path, help="of the map")
    command.set_defaults(run="maps:print_map")
    command = commands.add_parser("add", help="add images, one by one; other processes may localize meanwhile")
    command.add_argument("folder", metavar="DIR", type=Path, help="of the map")
    command.add_argument("images", metavar="IMAGE", nargs="+", type=Path, help="a file")
    command.add_argument("--place", help="where they were taken; by default their names")
    command.set_defaults(run="maps:add_images")


if __name__ == "__main__":
    main()
