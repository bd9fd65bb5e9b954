"""The command `mfvpr` and its programs."""

import _thread
import argparse
import inspect
import io
import pkgutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin

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
_FUNCTIONS: dict[str, Any] = {  # of mfvpr.cli: the job of a program with settings, or functions of arguments
    "evaluate": "evaluation:evaluate",
    "sweep": "sweeping:sweep_program",
    "learn": "learning:learn",
    "map": {
        "build": "localization:build_map",
        "info": "localization:print_map",
        "calibrate": "localization:calibrate",
        "add": "localization:add_images",
    },
    "localize": "localization:localize",
    "weights": {
        "list": "commands:list_weights",
        "add": "commands:add_weights",
        "verify": "commands:verify_weights",
        "download": "commands:download_weights",
    },
    "data": {"list": "commands:list_data", "check": "commands:check_data_set"},
    "convert": "commands:convert",
    "report": "commands:write_page",
}


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
    functions = _FUNCTIONS[program]
    if program == "map" and sys.argv[1:2] == ["build"]:
        del sys.argv[1]
        launch("map", f"mfvpr.cli.{functions['build']}")
    elif program in ("evaluate", "sweep", "learn", "localize"):
        launch(program, f"mfvpr.cli.{functions}")
    else:
        run_command(f"mfvpr {program}", COMMANDS[program], partial(_add_functions, functions=functions))


def launch(program: str, job: str) -> None:
    """Run a job `package.module:function` with the settings of the command line; one line for wrong ones."""
    with one_line():
        _prepare_process()
        from mfvpr.cli.command_line import run as run_settings  # here, where Ctrl-C is handled

        run_settings(program, partial(pkgutil.resolve_name, job))


class Parser(argparse.ArgumentParser):
    """Command line of a program that has commands instead of settings."""

    def error(self, message: str) -> NoReturn:
        """Exit with one line for wrong usage."""
        refuse(f"{message}; see {self.prog} --help")


def run_command(prog: str, description: str, add_arguments: Callable[[Parser], None]) -> None:
    """Parse the command line, and call the job `package.module:function` that is the parser's default `run`."""
    with one_line():
        _prepare_process()
        parser = Parser(prog=prog, description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
        parser.add_argument("--version", action="version", version=version(), help="print it and exit")
        add_arguments(parser)
        arguments: dict[str, Any] = vars(parser.parse_args())
        pkgutil.resolve_name(arguments.pop("run"))(**arguments)


def version() -> str:
    """Versions of mfvpr, JAX and Python in one line."""
    return f"mfvpr {__version__} (jax {version_of('jax')}, Python {sys.version.split()[0]})"


def _prepare_process() -> None:
    """Let SIGTERM unwind the stack, Ctrl-C never be lost, and names and warnings be printed."""

    def interrupt_again(lost: "sys.UnraisableHookArgs") -> None:  # which no code can catch, as in JAX's callback
        if issubclass(lost.exc_type, KeyboardInterrupt):
            threading.Timer(0.01, _thread.interrupt_main).start()
        else:
            sys.__unraisablehook__(lost)

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    sys.unraisablehook = interrupt_again
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _add_functions(parser: argparse.ArgumentParser, functions: str | dict[str, str]) -> None:
    """Let a parser take the parameters of a function of mfvpr.cli; or commands, for each of several functions."""
    if not isinstance(functions, str):
        commands = parser.add_subparsers(metavar="COMMAND", required=True)
        for name, function in functions.items():
            about = (pkgutil.resolve_name(f"mfvpr.cli.{function}").__doc__ or "").partition("\n")[0]
            _add_functions(commands.add_parser(name, help=about), function)
        return
    function = pkgutil.resolve_name(f"mfvpr.cli.{functions}")
    parser.formatter_class, parser.description = argparse.RawDescriptionHelpFormatter, inspect.getdoc(function)
    parser.set_defaults(run=f"mfvpr.cli.{functions}")
    for name, each in inspect.signature(function).parameters.items():
        kind, is_required = each.annotation, each.default is inspect.Parameter.empty
        options: dict[str, Any] = {"type": Path if "Path" in str(kind) else str}
        options |= {} if is_required else {"default": each.default}
        if get_origin(kind) is Literal:
            options["choices"] = get_args(kind)
        elif kind is bool:
            options = {"action": "store_true"}
        if each.kind is inspect.Parameter.KEYWORD_ONLY:
            flag = name.strip("_").replace("_", "-")
            parser.add_argument(f"--{flag}", dest=name, required=is_required, **options)
        else:
            nargs = {"nargs": "+" if is_required else "*"} if get_origin(kind) in (list, Sequence) else {}
            parser.add_argument(name, metavar=name.upper(), **nargs, **options)
