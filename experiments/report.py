"""Pages of run folders: of one run, or of several compared. `python -m experiments.report --help`."""

from pathlib import Path

from experiments.launch import Parser, run_command

# Functions import what they need: --help and wrong usage need not wait for JAX.
_COMPARISON = "comparison.html"


def main() -> None:
    """Run the command line."""
    run_command("python -m experiments.report", "One HTML file that needs no other and no network: of one run folder "
                "of experiments.evaluate, or of several beside each other.", _add_arguments)  # fmt: skip


def _add_arguments(parser: Parser) -> None:
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="a run folder")
    parser.add_argument("--out", metavar="FILE", type=Path,
                        help=f"by default RUN/report.html of one run, {_COMPARISON} here of several")  # fmt: skip
    parser.set_defaults(run="report:write_page")


def write_page(runs: list[Path], out: Path | None) -> None:
    """Write the page of one run, or of several compared, and print its path."""
    from mfvpr.report.pages.one_run import write_report
    from mfvpr.report.pages.several_runs import write_comparison
    from mfvpr.utils.files import printable

    if len(runs) == 1:
        path = write_report(runs[0], out)
    else:
        path = out or Path(_COMPARISON)
        write_comparison(runs, path)
    print(printable(f"report: {path}"))


if __name__ == "__main__":
    main()
