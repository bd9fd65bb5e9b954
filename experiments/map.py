"""Build a map for localization, add images to it, list its content. `python -m experiments.map --help`."""

import sys
from pathlib import Path

from experiments.errors import Parser, run_command
from experiments.launch import launch, program

# Functions import what they need: --help and wrong usage need not wait for JAX.
_MAP = "python -m experiments.map"


def main() -> None:
    """Run the command line's command."""
    if sys.argv[1:2] == ["build"]:
        del sys.argv[1]
        launch(program("maps", "build_map"), "map")
        return
    run_command(_MAP, "Ask a map with python -m experiments.localize. Settings of the first command: "
                f"{_MAP} build --help.", _add_commands)  # fmt: skip


def _add_commands(parser: Parser) -> None:
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    commands.add_parser("build", help="build map=DIR dataset=...: of the database of a data set")
    command = commands.add_parser("info", help="what a map holds, and what it was made with")
    command.add_argument("folder", metavar="DIR", type=Path, help="of the map")
    command.set_defaults(run=info)
    command = commands.add_parser("add", help="add images, one by one; others may ask meanwhile")
    command.add_argument("folder", metavar="DIR", type=Path, help="of the map")
    command.add_argument("images", metavar="IMAGE", nargs="+", type=Path, help="a file")
    command.add_argument("--place", help="where they were taken; by default their names")
    command.set_defaults(run=add)


def info(folder: Path) -> None:
    """Print the number of images, the size on disk and the settings of a map."""
    import json

    from experiments import maps
    from mfvpr.storage.disk import used_bytes

    settings, robot_map = maps.read(folder), maps.open_map(folder)
    print(f"{folder}: {len(robot_map)} images, {used_bytes(folder) / 1e6:.1f} MB")
    print(json.dumps(settings, indent=1, ensure_ascii=False))


def add(folder: Path, images: list[Path], place: str | None) -> None:
    """Add image files to a map, one by one."""
    from experiments import maps
    from mfvpr.utils.files import printable

    robot_map = maps.open_map(folder)
    for path in images:
        robot_map.add(path, path.name if place is None else place)
        print(printable(f"{path}: added, {len(robot_map)} images"), flush=True)


if __name__ == "__main__":
    main()
