"""The command `mfvpr` and its programs."""

import _thread
import argparse
import io
import pkgutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from functools import partial
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any, NoReturn

from mfvpr import __version__
from mfvpr.cli.console import one_line, refuse

COMMANDS = {
    "demo": "evaluate the paper's scores on a drawn street",
    "evaluate": "two folders of images in, recall, rankings and figures out",
    "sweep": "score a data set by a grid of parameters",
    "learn": "learn match weights and parameters, and compare them with searched ones",
    "map": "build a map for localization, calibrate it, add images to it",
    "localize": "localize images in a map",
    "weights": "list, download, add and verify weights of networks",
    "data": "list data sets, and check what a folder holds",
    "convert": "write predictions as files of other programs: candidates, trajectories, shifts with times",
    "report": "write the page of a run folder (evaluation, sweep, learning, multirun), or of evaluations compared",
}
_COMPARISON = "comparison.html"


def main() -> None:
    """Run the command `mfvpr PROGRAM ...`."""
    program = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if program in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        lines = [f"  {name:<{width}}  {about}" for name, about in COMMANDS.items()]
        print("usage: mfvpr PROGRAM [setting=value ...]", "", *lines, "", "mfvpr PROGRAM --help says more.", sep="\n")
    elif program == "--version":
        print(version())
    elif program not in COMMANDS:
        refuse(f"{program}: expected one of {', '.join(COMMANDS)}; see mfvpr --help")
    else:
        del sys.argv[1]
        run(program)


def run(program: str) -> None:
    """Run a program with the arguments of the command line."""
    if program == "demo":
        program, sys.argv[1:1] = "evaluate", ["scorer=demo"]
    if program == "map" and sys.argv[1:2] == ["build"]:
        del sys.argv[1]
        launch("map")
    elif program in _ARGUMENTS:
        description, add_arguments = _ARGUMENTS[program]
        run_command(f"mfvpr {program}", description, add_arguments)
    else:
        launch(program)


_JOBS = {  # command and job of each program with settings
    "evaluate": ("mfvpr evaluate", "mfvpr.cli.evaluation:evaluate"),
    "sweep": ("mfvpr sweep", "mfvpr.cli.sweeping:sweep"),
    "learn": ("mfvpr learn", "mfvpr.cli.learning:learn"),
    "map": ("mfvpr map build", "mfvpr.cli.localization:build_map"),
    "localize": ("mfvpr localize", "mfvpr.cli.localization:localize"),
    "paper": ("python -m experiments.paper", "experiments.paper.program:paper"),
}


def launch(program: str) -> None:
    """Run a program with the settings of the command line; one line and an exit code for wrong ones."""
    with one_line():
        _prepare_process()
        from mfvpr.cli.command_line import run as run_settings  # here, where Ctrl-C is handled

        command, job = _JOBS[program]
        run_settings(program, partial(pkgutil.resolve_name, job), command)


class Parser(argparse.ArgumentParser):
    """Command line of a program that has commands instead of settings."""

    def error(self, message: str) -> NoReturn:
        """Exit with one line for wrong usage."""
        refuse(f"{message}; see {self.prog} --help")


def run_command(prog: str, description: str, add_arguments: Callable[[Parser], None]) -> None:
    """Parse the command line, and call the job `package.module:function` that is the parser's default `run`."""
    with one_line():
        _prepare_process()
        parser = Parser(prog=prog, description=description)
        parser.add_argument("--version", action="version", version=version(), help="print it and exit")
        add_arguments(parser)
        arguments: dict[str, Any] = vars(parser.parse_args())
        pkgutil.resolve_name(arguments.pop("run"))(**arguments)


def version() -> str:
    """Versions of mfvpr, JAX and Python in one line."""
    return f"mfvpr {__version__} (jax {version_of('jax')}, Python {sys.version.split()[0]})"


def _prepare_process() -> None:
    """Let SIGTERM unwind the stack, Ctrl-C never be lost, and names and warnings be printed."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    sys.unraisablehook = _interrupt_again
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _interrupt_again(lost: "sys.UnraisableHookArgs") -> None:
    """Repeat a Ctrl-C that was raised where no code can catch it, as in JAX's callback of the garbage collection."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        threading.Timer(0.01, _thread.interrupt_main).start()
    else:
        sys.__unraisablehook__(lost)


def _add_map_commands(parser: Parser) -> None:
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    commands.add_parser("build", help="build map=DIR dataset=...: of the database of a data set")
    command = commands.add_parser("info", help="what a map holds, and what it was made with")
    command.add_argument("folder", metavar="DIR", type=Path, help="of the map")
    command.set_defaults(run="mfvpr.cli.localization:print_map")
    command = commands.add_parser(
        "calibrate", help="fit the confidence on a drive whose query i shows database image i"
    )
    command.add_argument("folder", metavar="DIR", type=Path, help="of the map")
    command.add_argument("database", metavar="DATABASE", type=Path, help="folder of images along a path")
    command.add_argument("queries", metavar="QUERIES", type=Path, help="folder of images of a drive along this path")
    command.set_defaults(run="mfvpr.cli.localization:calibrate")
    command = commands.add_parser("add", help="add images, one by one; other processes may localize meanwhile")
    command.add_argument("folder", metavar="DIR", type=Path, help="of the map")
    command.add_argument("images", metavar="IMAGE", nargs="+", type=Path, help="a file")
    command.add_argument("--place", help="where they were taken; by default their names")
    command.set_defaults(run="mfvpr.cli.localization:add_images")


def _add_weights_commands(parser: Parser) -> None:
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    command = commands.add_parser("list", help="all known weights, their licenses, and whether they are installed")
    command.set_defaults(run="mfvpr.cli.checkpoints:list_weights")
    command = commands.add_parser("add", help="install an official checkpoint, or weights of your own")
    command.add_argument("file", metavar="FILE", type=Path, help="a checkpoint under its official name")
    command.add_argument("--as", dest="name", metavar="NAME", help="what FILE is, where it has another name")
    command.add_argument(
        "--own", metavar="NAME", help="your own weights with the official file's keys: weights=own/NAME"
    )
    command.set_defaults(run="mfvpr.cli.checkpoints:add")
    command = commands.add_parser("verify", help="check what is installed, byte by byte")
    command.add_argument("names", metavar="NAME", nargs="*", help="by default all that are there")
    command.set_defaults(run="mfvpr.cli.checkpoints:verify")
    command = commands.add_parser("download", help="fetch an official checkpoint whose hash is published")
    command.add_argument("name", metavar="NAME")
    command.set_defaults(run="mfvpr.cli.checkpoints:download")


def _add_data_commands(parser: Parser) -> None:
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    command = commands.add_parser("list", help="the published data sets, their sizes, and what their folders hold")
    command.add_argument("names", metavar="NAME", nargs="*", help="by default a table of all")
    command.set_defaults(run="mfvpr.cli.published_data:list_data")
    command = commands.add_parser("check", help="what a folder holds beside what is published; draws pairs of images")
    command.add_argument("name", metavar="NAME", help="as in dataset=NAME")
    command.add_argument("settings", metavar="root=DIR", nargs="*", help="settings of the data set, without `dataset.`")
    command.add_argument("--sheet", metavar="FILE", type=Path, help="where to draw them, by default NAME.png")
    command.set_defaults(run="mfvpr.cli.published_data:check_data_set")


def _add_report_arguments(parser: Parser) -> None:
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="a run folder")
    parser.add_argument("--out", metavar="FILE", type=Path,
                        help=f"by default RUN/report.html of one run, {_COMPARISON} here of several")  # fmt: skip
    parser.set_defaults(run="mfvpr.cli.programs:write_page")


def _add_convert_arguments(parser: Parser) -> None:
    layouts = ("preds", "hloc", "kapture", "tum", "kitti", "shifts")
    about = {
        "--poses": "for tum and kitti: poses of the database images in this layout, a line for each",
        "--times": "for tum and shifts: times of the queries, a line for each; by default the names of their files",
        "--database": "for tum and kitti of mfvpr localize: the folder of the map's images",
        "--query-prefix": "for hloc and kapture: what stands before the names of the queries, such as queries/",
        "--database-prefix": "for hloc and kapture: what stands before the names of the database images",
    }
    parser.add_argument("source", metavar="SOURCE", type=Path, help="run folder of mfvpr evaluate, or file of the "
                        "lines that mfvpr localize prints")  # fmt: skip
    parser.add_argument("out", metavar="OUT", type=Path, help="a file; for preds, and for several query sequences, a "
                        "new folder")  # fmt: skip
    parser.add_argument("--layout", required=True, choices=layouts, help="candidates of an evaluation for "
                        "VPR-methods-evaluation, hloc or kapture; trajectory of TUM or KITTI; table of shifts with "
                        "ROS's times")  # fmt: skip
    for name, text in about.items():
        is_prefix = name.endswith("prefix")
        kind = {"type": str, "default": "", "metavar": "TEXT"} if is_prefix else {"type": Path, "metavar": "PATH"}
        parser.add_argument(name, help=text, **kind)
    parser.set_defaults(run="mfvpr.cli.prediction_files:convert")


_ARGUMENTS = {  # of programs that have commands or arguments instead of settings
    "map": ("Localize images in a map with mfvpr localize. Settings of the first command: mfvpr map build --help.",
            _add_map_commands),
    "weights": ("Weights live in MFVPR_WEIGHTS, by default ~/.cache/mfvpr/weights. None come with the package; each "
                "has its own license.", _add_weights_commands),
    "data": ("Nothing is downloaded: each data set has its place and its license.", _add_data_commands),
    "convert": ("Queries without a place are left out of candidates and of TUM, have an empty place in "
               "the table of shifts, and are an error for KITTI.", _add_convert_arguments),
    "report": ("One HTML file that needs no other and no network: of one run folder of mfvpr evaluate, sweep or learn, "
               "of a multirun (runs/multirun/TIME), or of several evaluations beside each other.",
               _add_report_arguments),
}  # fmt: skip


def write_page(runs: list[Path], out: Path | None) -> None:
    """Write the page of one run, or of several compared, and print its path."""
    from mfvpr.report.pages import write_comparison, write_report
    from mfvpr.utils.files import printable

    if len(runs) == 1:
        path = write_report(runs[0], out)
    else:
        path = out or Path(_COMPARISON)
        write_comparison(runs, path)
    print(printable(f"report: {path}"))
