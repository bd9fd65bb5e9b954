"""Published weights: list them, download, convert, verify. `python -m experiments.weights --help`."""

from pathlib import Path

from experiments.launch import WEIGHTS, Parser, run_command


def main() -> None:
    """Run the command line's command."""
    run_command(WEIGHTS, "Weights live in MFVPR_WEIGHTS, by default ~/.cache/mfvpr/weights. None come with the "
                "package; each has its own license.", _add_commands)  # fmt: skip


def _add_commands(parser: Parser) -> None:
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    command = commands.add_parser("list", help="all known weights, their licenses, and whether they are installed")
    command.set_defaults(run="checkpoints:list_weights")
    command = commands.add_parser("convert", help="install an official checkpoint")
    command.add_argument("file", metavar="FILE", type=Path, help="a checkpoint under its official name")
    command.add_argument("--as", dest="name", metavar="NAME", help="what FILE is, where it has another name")
    command.set_defaults(run="checkpoints:convert")
    command = commands.add_parser("verify", help="check what is installed, byte by byte")
    command.add_argument("names", metavar="NAME", nargs="*", help="by default all that are there")
    command.set_defaults(run="checkpoints:verify")
    command = commands.add_parser("download", help="fetch an official checkpoint whose hash is published")
    command.add_argument("name", metavar="NAME")
    command.set_defaults(run="checkpoints:download")


if __name__ == "__main__":
    main()
