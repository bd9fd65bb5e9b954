"""Pages of run folders: of one run, or of several compared. `python -m experiments.report --help`."""

from pathlib import Path

from experiments.errors import Parser, one_line, unwind_on_sigterm

# Functions import what they need: --help and wrong usage need not wait for JAX.
REPORT = "python -m experiments.report"
_COMPARISON = "comparison.html"


def main() -> None:
    """Run the command line."""
    unwind_on_sigterm()
    with one_line():
        arguments = _parser().parse_args()
        write(arguments.runs, arguments.out)


def _parser() -> Parser:
    from experiments.launch import version

    parser = Parser(prog=REPORT, description="One HTML file that needs no other and no network: of one run folder of "
                     "experiments.evaluate, or of several beside each other.")  # fmt: skip
    parser.add_argument("--version", action="version", version=version(), help="print it and exit")
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="a run folder")
    parser.add_argument("--out", metavar="FILE", type=Path,
                        help=f"by default RUN/report.html of one run, {_COMPARISON} here of several")  # fmt: skip
    return parser


def write(folders: list[Path], out: Path | None) -> None:
    """The page of one run, or of several; says where it is."""
    from mfvpr.report.pages.one_run import write_report
    from mfvpr.report.pages.several_runs import write_comparison
    from mfvpr.utils.files import printable

    if len(folders) == 1:
        path = write_report(folders[0], out)
    else:
        path = out or Path(_COMPARISON)
        write_comparison(folders, path)
    print(printable(f"report: {path}"))


if __name__ == "__main__":
    main()
