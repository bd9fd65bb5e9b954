"""The folder of a run: claim it before the work, and fill it after, tables before figures."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from mfvpr.cli import console
from mfvpr.cli.schema import Common
from mfvpr.report import pages, runs
from mfvpr.report.runs import Figure
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import to_values
from mfvpr.utils.files import expand_user


@contextmanager
def claim(out: str | None, dataset: str, **options: Any) -> Iterator[Path]:
    """The run folder `out`, for this run alone; None = a new one of a data set. Options as of `claim_run_folder`."""
    folder = expand_user(out) if out else Path("runs", dataset, f"{datetime.now():%Y-%m-%d_%H-%M-%S}")
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(runs.claim_run_folder(folder, numbered=not out, **options))
        except InputError as error:
            raise InputError(f"{error} with out=DIR") from error
        yield folder


def write_results(
    folder: Path, settings: Common, ground_truth: Mapping[str, Any], *,
    text: str, write: Callable[[Path], None], figures: Sequence[Figure],
) -> None:  # fmt: skip
    """Write the files, then print the text, then draw the figures, so that no failure loses earlier results.

    The text is printed even if the files cannot be written; `write` gets the folder for them.
    """
    try:
        write_files(folder, settings, ground_truth, write)
    finally:
        print(f"\n{text}", flush=True)
    draw_figures(folder, figures)
    print(f"results: {folder}")
    if job := settings.multirun:
        runs.add_job(Path(job["multirun"]), job["number"], job["overrides"], folder)
        print(f"jobs: {job['multirun']}")


def write_files(folder: Path, settings: Common, ground_truth: Mapping[str, Any], write: Callable[[Path], None]) -> None:
    """Write the files of a run and run.json; arguments as of `write_results`."""
    try:
        with runs.writing(folder) as new:
            write(new)
            runs.write_about(new, to_values(settings), ground_truth, settings.command)
    except OSError as error:
        raise InputError(
            f"{folder}: the results cannot be written ({error.strerror}); they are printed above, and features and "
            "matches are kept where there is a store: make room, or name another folder with out=DIR"
        ) from error


def draw_figures(folder: Path, figures: Sequence[Figure]) -> None:
    """Draw the figures of a run; warn if one cannot be drawn."""
    for name, draw_figure in console.track("figures")(figures, len(figures)):
        try:
            draw_figure(folder / "figures" / name)
        except Exception as error:  # of any kind from Matplotlib; the results are already written
            console.tell(f"warning: {folder}/figures/{name}: not drawn ({error})")


def report_page(folder: Path) -> Path | None:
    """Write the page of an evaluation and return its path; warn and return None if that fails."""
    try:
        return pages.write_report(folder)
    except (ImportError, InputError, OSError) as error:
        console.tell(f"warning: {folder}: no page was made of it ({error})")
        return None
