"""Maps: build one, add images, print what it holds; localize images, a line of JSON for each, with figures of some."""

import json
import time
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from jaxtyping import UInt8

from mfvpr.cli.console import tell, track, warn
from mfvpr.cli.jobs import dataset_of
from mfvpr.cli.schema import Localize, MapBuild
from mfvpr.datasets import image_folder, read_image
from mfvpr.datasets.contents import state_of
from mfvpr.datasets.image_reading import VIDEO_SUFFIXES, read_frames
from mfvpr.localization import Drive, Located, Map, Route
from mfvpr.localization.map_settings import fit_to_map, read_settings, read_system
from mfvpr.report.runs import file_names
from mfvpr.storage.maps import Entry
from mfvpr.systems import assembly
from mfvpr.systems.assembly import without
from mfvpr.utils import Runtime
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import IMAGE_SUFFIXES, canonical_name, expand_user, printable

POLL = 0.2  # seconds between two looks at a folder
Pixels = UInt8[np.ndarray, "height width channels"]


def build_map(settings: MapBuild) -> None:
    """Map a folder of images, or the database of a data set: build MAP IMAGES, see `mfvpr map build --help`."""
    system = assembly.system(settings)
    images = dataset_of(settings.dataset).database
    folder = expand_user(settings.map)
    robot_map = Map(folder, fit_to_map(folder, system, images, warn), runtime=Runtime(progress=track))
    added = robot_map.build(images)
    print(f"{robot_map.folder}: {len(robot_map)} images, {added} of them new")


def print_map(folder: Path) -> None:
    """Print the number of images, the size on disk and the settings of a map."""
    settings, robot_map = read_settings(folder), Map.open(folder)
    size = sum(path.stat().st_size for path in folder.iterdir()) / 1e6
    print(f"{folder}: {len(robot_map)} images, {size:.1f} MB; {_calibration_in_words(robot_map)}")
    print(json.dumps(settings, indent=1, ensure_ascii=False))


def calibrate(folder: Path, database: Path, queries: Path, *, masks: Path | None = None, route: bool = False) -> None:
    """Fit the confidence of a map on a drive: query i shows database image i, both folders of images along a path.

    `masks`: an image that is black where pixels of all images are ignored, or a folder with one for each image.
    `route`: for mfvpr localize route=..., where the retrieval standardizes descriptors.
    """
    robot_map = Map.open(folder)
    robot_map.calibrate(database, queries, masks=masks, route=route)
    print(f"{_calibration_in_words(robot_map)}; use threshold= of mfvpr localize")


def _calibration_in_words(robot_map: Map) -> str:
    about = robot_map.calibration()
    if not about:
        return "not calibrated: predictions have no confidence"
    rule = about["confidence"]["standardize"]
    scope = {None: "", "database": ", for images without a route", "running": ", for route="}.get(rule, "")
    counts = f"{about['queries']} queries, {about['correct']} correct, {about['absent_queries']} as absent places"
    return printable(f"calibrated on {about['of']}: {counts}{scope}{', with masks' * about['masks']}")


def add_images(folder: Path, images: list[Path], *, place: str | None = None, mask: Path | None = None) -> None:
    """Add image files to a map, one by one; other processes may localize meanwhile.

    `place` is where they were taken, by default their names; `mask` an image that is black where pixels are ignored.
    """
    robot_map = Map.open(folder)
    for path in images:
        robot_map.add(path, path.name if place is None else place, mask=mask)
        print(printable(f"{path}: added, {len(robot_map)} images"), flush=True)


def localize(settings: Localize) -> None:
    """Print a line for every image as soon as it is localized; errors of an image stand in its line."""
    folder, runtime = expand_user(settings.map), Runtime(memory=settings.memory)
    system = read_system(folder)
    confidence = None
    if settings.confidence is not None:
        from mfvpr.cli.evaluation import fitting_confidences  # here: it imports the reports

        of_map = read_settings(folder)
        used = without(of_map, "fusion") if of_map["final"] == "score" else of_map
        confidence = fitting_confidences(settings.confidence, system, used)[0][system.headline]
    robot_map = Map(folder, system, confidence=confidence, threshold=settings.threshold, runtime=runtime)
    robot_map.require_confidence(settings.route is not None)
    if settings.mask is not None:
        read_image(expand_user(settings.mask))  # an error comes before any image
    drive = _Drive(robot_map, settings)
    for number, (name, image) in enumerate(images_of(settings)):
        if number == 0 and len(robot_map):
            tell(f"{len(robot_map):,} images in the map; the first image takes longer")
        line: dict[str, Any] = {}
        try:
            drive.localize(number, name, image, line)
        finally:  # the prediction must not be lost if its image cannot be added
            if line:
                print(printable(json.dumps({"image": name} | line, ensure_ascii=False, allow_nan=False)), flush=True)
    if drive.failed:
        raise InputError(f"{drive.failed} of the images could not be localized or drawn; lines and warnings say why")
    if drive.missing:
        names = ",".join(sorted(map(str, drive.missing)))
        raise InputError(f"figures=[{names}]: expected rows of localized images, from 0, or names as in the lines")


class _Drive:
    """One drive through a map: images are localized, added and drawn one by one."""

    def __init__(self, robot_map: Map, settings: Localize) -> None:
        self._map, self._settings, self._route, figures = robot_map, settings, None, settings.figures
        if settings.route is not None:
            advance = None if isinstance(settings.route, str) else settings.route
            self._route = Route(Drive(advance), warn=lambda text: warn(f"route={advance}: {text} (route=auto)"))
        self._wanted = set(range(figures) if isinstance(figures, int) else figures)
        self.missing = set() if isinstance(figures, int) else {*self._wanted}  # figures whose image did not come
        self.failed = 0
        self._mask = None if settings.mask is None else expand_user(settings.mask)
        self._root = None if settings.root is None else expand_user(settings.root)
        if self._root and not self._root.is_dir():
            raise InputError(f"root={self._root}: expected the folder of the map's images, got no folder")

    def localize(self, number: int, name: str, image: Path | Pixels, line: dict[str, Any]) -> None:
        """Localize an image, `number` from 0, add it to the map and draw it as the settings say, and fill its line."""
        start, settings, known = time.perf_counter(), self._settings, self._map
        row = known.row(name) if settings.add else None  # an image that is in the map sees the images before it
        try:
            pixels = image if isinstance(image, np.ndarray) else read_image(image)
            localized = known.localize_with_evidence(
                pixels, recent=settings.recent, before=row, route=self._route, mask=self._mask
            )
        except InputError as error:
            if not len(known):
                raise
            self.failed += 1
            rows = known.there[: max(0, len(known) - settings.recent)]  # the robot has moved
            line.update({"error": str(error)} | self._route_entry(self._route and self._route(None, rows)))
            return
        prediction, (features, vector), _ = localized
        line.update(prediction.as_json(settings.alternatives) | self._route_entry(prediction.located))
        if settings.field_of_view is not None:
            line["shift_angles"] = prediction.shift_angles(settings.field_of_view)
        line["seconds"] = round(time.perf_counter() - start, 4)
        if settings.add:
            if row is None:
                known.add_described([Entry(name, name, vector)], [features])
            line["added"] = row is None
        names = {number, name, PurePath(name).name}
        if settings.out is not None and self._wanted & names:
            from mfvpr.report.figures import localization_figure  # here: Matplotlib takes 0.4 s

            self.missing -= names
            [file] = file_names([f"{number:04d}_{PurePath(name).stem}"]).values()
            path = expand_user(settings.out) / f"{file}.png"
            try:
                localization_figure(path, known, name, pixels, localized, root=self._root)
                line["figure"] = str(path)
            except Exception as error:  # of any kind from Matplotlib; the drive goes on
                line["figure"] = None
                self.failed += 1
                warn(f"{path}: not drawn ({error})")

    def _route_entry(self, located: Located | None) -> dict[str, Any]:
        if self._route is None:
            return {}
        if located is None:
            return {"route": None}
        numbers = {"p": round(located.p, 4), "advance": round(located.advance, 2), "off": round(located.off, 4)}
        return {"route": {"place": located.row if located.row is None else self._map.place(located.row)} | numbers}


def images_of(settings: Localize) -> Iterator[tuple[str, Path | Pixels]]:
    """(name, file or pixels) in order; names do not depend on the spelling of a path."""
    paths = settings.images if isinstance(settings.images, list) else [settings.images]
    paths = [expand_user(path) for path in paths]
    for path in paths:
        if not path.exists():
            raise InputError(f"images={path}: expected an image, a folder or a video, got nothing")
    if settings.watch and not (len(paths) == 1 and paths[0].is_dir()):
        raise InputError(f"watch=true: expected images=DIR, one folder, got {settings.images}")
    for path in paths:
        if path.is_dir():
            images = _watch(path) if settings.watch else image_folder(path).paths
            yield from ((canonical_name(image), image) for image in images)
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            name = canonical_name(path)
            yield from ((f"{name}:{number}", image) for number, image in read_frames(path, every=settings.every))
        else:
            yield canonical_name(path), path


def _watch(folder: Path) -> Iterator[Path]:
    """Images of a folder, then new ones as soon as their files stop changing, until Ctrl-C.

    An image whose file changes later, as when a camera writes slowly, comes again.
    """
    done, before = dict[Path, list[int] | None](), dict[Path, list[int] | None]()
    tell(f"watching {folder}; end with Ctrl-C")
    while True:
        paths = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
        states = {path: state_of(path) for path in paths}
        for path, state in states.items():
            if before.get(path) == state != done.get(path):
                done[path] = state
                yield path
        before = states
        time.sleep(POLL)
