"""Maps: build one, add images, print what it holds; localize images, a line of JSON for each, with figures of some."""

import json
import stat
import time
import warnings
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from jaxtyping import UInt8

from mfvpr.cli.console import tell, track
from mfvpr.cli.inputs import dataset_of
from mfvpr.cli.schema import Localize, MapBuild
from mfvpr.datasets import image_folder, read_image
from mfvpr.datasets.image_reading import VIDEO_SUFFIXES, read_frames
from mfvpr.evaluation import Confidence, System
from mfvpr.localization import Drive, Localization, Located, Map, Route
from mfvpr.localization.declaration import fit_to_map, read_declaration, read_system
from mfvpr.report.runs import file_names
from mfvpr.storage.maps import Entry
from mfvpr.systems import assembly
from mfvpr.utils import Runtime
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import IMAGE_SUFFIXES, canonical_name, expand_user, printable, used_bytes

POLL = 0.2  # seconds between two looks at a folder


def build_map(settings: MapBuild) -> None:
    """Map the database of a data set."""
    system = assembly.system(settings)
    images = dataset_of(settings.dataset).database
    folder, warn = expand_user(settings.map), lambda line: tell(f"warning: {line}")
    robot_map = Map(folder, fit_to_map(folder, system, images, warn))
    added = robot_map.build(images, track=track("images"))
    print(f"{robot_map.folder}: {len(robot_map)} images, {added} of them new")


def print_map(folder: Path) -> None:
    """Print the number of images, the size on disk and the settings of a map."""
    settings, robot_map = read_declaration(folder), Map.open(folder)
    print(f"{folder}: {len(robot_map)} images, {used_bytes(folder) / 1e6:.1f} MB")
    print(json.dumps(settings, indent=1, ensure_ascii=False))


def calibrate(folder: Path, database: Path, queries: Path) -> None:
    """Fit the confidence of a map, which its folder then keeps."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Map.open(folder).calibrate(database, queries)
    for warning in caught:
        tell(f"warning: {warning.message}")
    print(printable(f"{folder}: calibrated on {queries}; use threshold= of mfvpr localize"))


def add_images(folder: Path, images: list[Path], place: str | None) -> None:
    """Add image files to a map, one by one."""
    robot_map = Map.open(folder)
    for path in images:
        robot_map.add(path, path.name if place is None else place)
        print(printable(f"{path}: added, {len(robot_map)} images"), flush=True)


def localize(settings: Localize) -> None:
    """Print a line for every image as soon as it is localized; errors of an image stand in its line."""
    folder, runtime = expand_user(settings.map), Runtime(memory=settings.memory)
    system = read_system(folder)
    confidence = _confidence(settings, system)
    robot_map = Map(folder, system, confidence=confidence, threshold=settings.threshold, runtime=runtime)
    drive, figures, failed = _Drive(robot_map, settings), _LocalizationFigures(robot_map, settings), 0
    for number, (name, image) in enumerate(images_of(settings)):
        if number == 0 and len(robot_map):
            tell(f"{len(robot_map):,} images in the map; the first image takes longer")
        try:
            pixels = image if isinstance(image, np.ndarray) else read_image(image)
            localized, line = drive.localize(name, pixels)
        except InputError as error:
            if not len(robot_map):
                raise
            failed += 1
            localized, line = None, {"error": str(error)} | drive.entry_without_image()
        try:
            if localized is not None:
                line |= drive.add(name, localized) | figures.draw(number, name, pixels, localized)
        finally:  # the prediction must not be lost if its image cannot be added
            print(printable(json.dumps({"image": name} | line, ensure_ascii=False, allow_nan=False)), flush=True)
    if failed:
        raise InputError(f"{failed} of the images could not be localized; their lines say why")
    figures.finish()


class _Drive:
    """One drive through a map: images are localized and added one by one."""

    def __init__(self, robot_map: Map, settings: Localize) -> None:
        self._map, self._settings = robot_map, settings
        advance = None if isinstance(settings.route, str) else settings.route
        warn = lambda text: tell(f"warning: route={advance}: {text} (route=auto)")  # noqa: E731
        self._route = None if settings.route is None else Route(Drive(advance), warn=warn)

    def localize(
        self, name: str, pixels: UInt8[np.ndarray, "height width channels"]
    ) -> tuple[Localization, dict[str, Any]]:
        """Localize an image and return its line; an image that is in the map sees only the images before it."""
        start = time.perf_counter()
        row, recent = self._map.row(name) if self._settings.add else None, self._settings.recent
        localized = self._map.localize_with_evidence(pixels, recent=recent, before=row, route=self._route)
        prediction = localized.prediction
        line = prediction.as_json(self._settings.alternatives) | self._route_entry(prediction.located)
        if (field_of_view := self._settings.field_of_view) is not None:
            line |= {"shift_angles": prediction.shift_angles(field_of_view)}
        return localized, line | {"seconds": round(time.perf_counter() - start, 4)}

    def add(self, name: str, localized: Localization) -> dict[str, Any]:
        """Add an image to the end of the map, unless it has one of this name, and return the entry in its line."""
        if not self._settings.add:
            return {}
        features, vector = localized.described
        is_new = self._map.row(name) is None
        if is_new:
            self._map.add_described([Entry(name, name, vector)], [features])
        return {"added": is_new}

    def entry_without_image(self) -> dict[str, Any]:
        """The route's entry in the line of an image that cannot be read: the robot has moved."""
        rows = self._map.there
        rows = rows[: max(0, len(rows) - self._settings.recent)]
        return self._route_entry(self._route and self._route(None, rows))

    def _route_entry(self, located: Located | None) -> dict[str, Any]:
        if self._route is None or located is None:
            return {} if self._route is None else {"route": None}
        numbers = {"p": round(located.p, 4), "advance": round(located.advance, 2), "off": round(located.off, 4)}
        return {"route": {"place": located.row if located.row is None else self._map.place(located.row)} | numbers}


class _LocalizationFigures:
    """Figures of the images that `figures=` names, each drawn as soon as the image is localized."""

    def __init__(self, robot_map: Map, settings: Localize) -> None:
        """Read the settings `figures`, `out` and `root`."""
        figures, self._map, self._failed = settings.figures, robot_map, 0
        self._wanted = set(range(figures) if isinstance(figures, int) else figures)
        self._missing = set() if isinstance(figures, int) else {*self._wanted}  # there may be fewer images
        self._out = Path() if settings.out is None else expand_user(settings.out)
        self._root = None if settings.root is None else expand_user(settings.root)
        if self._root and not self._root.is_dir():
            raise InputError(f"root={self._root}: expected the folder of the map's images, got no folder")

    def draw(
        self, number: int, name: str, pixels: UInt8[np.ndarray, "height width channels"], localized: Localization
    ) -> dict[str, Any]:
        """Draw the figure of an image, `number` from 0, and return its entry in the line; warn if that fails."""
        names = {number, name, PurePath(name).name}
        if not self._wanted & names:
            return {}
        self._missing -= names
        [file] = file_names([f"{number:04d}_{PurePath(name).stem}"]).values()
        path = self._out / f"{file}.png"
        from mfvpr.report.figures import localization_figure  # here: Matplotlib takes 0.4 s

        try:
            localization_figure(path, self._map, name, pixels, localized, root=self._root)
        except Exception as error:  # of any kind from Matplotlib; the line must still be printed
            self._failed += 1
            tell(f"warning: {path}: not drawn ({error})")
            return {"figure": None}
        return {"figure": str(path)}

    def finish(self) -> None:
        """Raise a InputError if a figure could not be drawn, or if an image did not come."""
        if self._failed:
            raise InputError(f"{self._failed} of the figures could not be drawn; warnings say why")
        if self._missing:
            names = ",".join(sorted(map(str, self._missing)))
            raise InputError(f"figures=[{names}]: expected rows of localized images, from 0, or names as "
                                "the lines have them, or the last parts of these")  # fmt: skip


def _confidence(settings: Localize, system: System) -> Confidence | None:
    """The confidence that the settings name, of the score that the map was made with."""
    if settings.confidence is None:
        return None
    from mfvpr.cli import confidences  # here: it imports the reports

    map_settings, name = read_declaration(expand_user(settings.map)), system.headline
    if map_settings["final"] == "score":
        del map_settings["fusion"]
    file, scorers = confidences.read_file(settings.confidence), system.final_scores[name].scorers
    return confidences.confidence_of(file, name, scorers, map_settings, map_settings["candidates"])


def images_of(settings: Localize) -> Iterator[tuple[str, Path | UInt8[np.ndarray, "height width channels"]]]:
    """(name, file or pixels) in order; names do not depend on the spelling of a path."""
    paths = settings.images if isinstance(settings.images, list) else [settings.images]
    paths = [expand_user(path) for path in paths]
    for path in paths:
        if not path.exists():
            raise InputError(f"images={path}: expected an image, a folder or a video, got nothing")
    if settings.watch and not (len(paths) == 1 and paths[0].is_dir()):
        raise InputError(f"watch=true: expected images=DIR, one folder, got {settings.images}")
    for path in paths:
        if settings.watch:
            yield from ((canonical_name(image), image) for image in _watch(path))
        elif path.is_dir():
            yield from ((canonical_name(image), image) for image in image_folder(path).paths)
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            name = canonical_name(path)
            yield from ((f"{name}:{number}", image) for number, image in read_frames(path, every=settings.every))
        else:
            yield canonical_name(path), path


def _watch(folder: Path) -> Iterator[Path]:
    """Images of a folder, then new ones as soon as their files stop changing, until Ctrl-C.

    An image whose file changes later, as when a camera writes slowly, comes again.
    """
    done: dict[str, tuple[int, int]] = {}
    before: dict[str, tuple[int, int]] = {}
    tell(f"watching {folder}; end with Ctrl-C")
    while True:
        paths = (path for path in sorted(folder.iterdir()) if path.suffix.lower() in IMAGE_SUFFIXES)
        states = {path.name: state for path in paths if (state := _file_state(path)) is not None}
        for name, state in states.items():
            if before.get(name) == state != done.get(name):
                done[name] = state
                yield folder / name
        before = states
        time.sleep(POLL)


def _file_state(path: Path) -> tuple[int, int] | None:
    """Size and modification time; None if there is no regular file, or it has been removed."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_size, status.st_mtime_ns) if stat.S_ISREG(status.st_mode) else None
