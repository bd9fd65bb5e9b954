"""Maps that are asked: build one, add to it, say what it holds. `python -m experiments.map --help`."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments.errors import Parser, run_command
from experiments.launch import launch

# Functions import what they need: --help and wrong usage need not wait for JAX.
MAP = "python -m experiments.map"


def main() -> None:
    """Run the command line's command."""
    if sys.argv[1:2] == ["build"]:
        del sys.argv[1]
        launch(build, "map")
        return
    run_command(_parser)


def build() -> Callable[[dict[str, Any]], None]:
    """A map of a data set's database."""

    def job(settings: dict[str, Any]) -> None:
        from experiments import maps
        from experiments.console import track
        from experiments.stages import dataset_of

        known = maps.made(settings)
        added = known.build(dataset_of(settings["dataset"]).database, track=track("images"))
        print(f"{known.folder}: {len(known)} images, {added} of them new")

    return job


def _parser() -> Parser:
    from experiments.launch import version

    parser = Parser(prog=MAP, description=f"Ask a map with python -m experiments.localize. Settings of the first "
                     f"command: {MAP} build --help.")  # fmt: skip
    parser.add_argument("--version", action="version", version=version(), help="print it and exit")
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
    return parser


def info(folder: Path) -> None:
    """Print images, bytes and settings."""
    import json

    from experiments import maps
    from mfvpr.storage.disk import used_bytes

    settings, known = maps.read(folder), maps.opened(folder)
    print(f"{folder}: {len(known)} images, {used_bytes(folder) / 1e6:.1f} MB")
    print(json.dumps(settings, indent=1, ensure_ascii=False))


def add(folder: Path, images: list[Path], place: str | None) -> None:
    """Add files under their absolute paths."""
    from experiments import maps
    from mfvpr.utils.files import printable

    known = maps.opened(folder)
    for path in images:
        known.add(path, path.name if place is None else place)
        print(printable(f"{path}: added, {len(known)} images"), flush=True)


if __name__ == "__main__":
    main()
