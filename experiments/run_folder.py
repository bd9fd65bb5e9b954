"""The folder of a run: claimed before the work and filled after it, the tables before any figure."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from experiments import build, console
from experiments.settings import SettingsError
from mfvpr.report import runs
from mfvpr.report.pages import one_run
from mfvpr.report.runs import Figure
from mfvpr.utils import InputError
from mfvpr.utils.versions import versions

_OF_THE_START = ("multirun", "command")  # what `command_line` adds to the settings


@contextmanager
def claimed(settings: Mapping[str, Any], **how: Any) -> Iterator[Path]:
    """The run folder that the settings name, for this run alone; `own` and `beside` as of `runs.claimed`."""
    out, name = settings["out"], settings["dataset"]["name"]
    folder = build.expanded(out) if out else runs.new_run_folder(Path("runs"), name)
    with ExitStack() as claim:
        try:
            folder = claim.enter_context(runs.claimed(folder, numbered=not out, **how))
        except InputError as error:
            raise SettingsError(f"{error} with out=DIR") from error
        yield folder


def leave(
    folder: Path,
    settings: Mapping[str, Any],
    ground_truth: Mapping[str, Any],
    *,
    text: str,
    write: Callable[[Path], None],
    figures: Sequence[Figure],
) -> None:
    """Files, then the text on stdout, then figures: what is computed is never lost to what comes after.

    Args:
        folder: `claimed`.
        settings: of the run.
        ground_truth: what the recall refers to.
        text: for the terminal; printed where the files cannot be written, too.
        write: the files, into the folder that it is given.
        figures: one that cannot be drawn costs a warning.
    """
    try:
        keep(folder, settings, ground_truth, write)
    finally:
        print(f"\n{text}", flush=True)
    draw(folder, figures)
    print(f"results: {folder}")


def keep(
    folder: Path, settings: Mapping[str, Any], ground_truth: Mapping[str, Any], write: Callable[[Path], None]
) -> None:
    """The files of a run, with what made them; arguments as of `leave`."""
    try:
        with runs.writing(folder) as new:
            write(new)
            runs.write_json(new / "run.json", _about(settings, ground_truth))
    except OSError as error:
        raise SettingsError(
            f"{folder}: the results cannot be written ({error.strerror}); they are printed above, and features and "
            "matches are kept where there is a store: make room, or name another folder with out=DIR"
        ) from error


def draw(folder: Path, figures: Sequence[Figure]) -> None:
    """The figures of a run; one that cannot be drawn costs a warning."""
    for name, drawn in console.track("figures")(figures, len(figures)):
        try:
            drawn(folder / "figures" / name)
        except Exception as error:
            console.tell(f"warning: {folder}/figures/{name}: not drawn ({error})")


def report(folder: Path) -> None:
    """Make the page of an evaluation that was left in a folder, and say where it is."""
    if page := report_page(folder):
        print(f"report: {page}")


def report_page(folder: Path) -> Path | None:
    """The page of an evaluation, now made; one that cannot be made costs a warning, as figures do."""
    try:
        return one_run.write_report(folder)
    except Exception as error:
        console.tell(f"warning: {folder}: no page was made of it ({error})")
        return None


def _about(settings: Mapping[str, Any], ground_truth: Mapping[str, Any]) -> dict[str, Any]:
    """What made the results."""
    return {
        "command": settings.get("command"),
        "settings": {name: value for name, value in settings.items() if name not in _OF_THE_START},
        "ground_truth": ground_truth,
        "commit": runs.commit(Path()),
        "versions": versions(),
    }
