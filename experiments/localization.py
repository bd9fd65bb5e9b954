"""Questions to a map: files, folders, folders that are watched, and videos; answers as lines of JSON."""

import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments import build, maps
from experiments.console import tell
from experiments.settings import SettingsError
from mfvpr.confidence import Confidence, read_confidences
from mfvpr.data.datasets import image_folder
from mfvpr.data.files import printable
from mfvpr.data.images import SUFFIXES, read_image
from mfvpr.data.videos import SUFFIXES as VIDEOS
from mfvpr.data.videos import frames
from mfvpr.errors import InputError

POLL = 0.2  # seconds between two looks at a folder


def localize(settings: dict[str, Any]) -> None:
    """A line for every image as soon as it is answered; one that cannot be read is told in its line."""
    known = maps.opened(
        build.expanded(settings["map"]), confidence=_confidence(settings), threshold=settings["threshold"],
        memory=settings["memory"],
    )  # fmt: skip
    failed = 0
    for name, image in _images(settings):
        start = time.perf_counter()
        try:
            pixels = image if isinstance(image, np.ndarray) else read_image(image)
            answer = known.localize(pixels, recent=settings["recent"])
            line = answer.as_json(settings["alternatives"]) | {"seconds": round(time.perf_counter() - start, 4)}
        except InputError as error:
            if not len(known):
                raise
            failed += 1
            line = {"error": str(error)}
        print(printable(json.dumps({"image": name} | line, ensure_ascii=False, allow_nan=False)), flush=True)
    if failed:
        raise SettingsError(f"{failed} of the images could not be answered; their lines say why")


def _confidence(settings: Mapping[str, Any]) -> Confidence | None:
    """That of the map's score."""
    if settings["confidence"] is None:
        return None
    systems, _ = read_confidences(build.expanded(settings["confidence"]))
    name = maps.read(build.expanded(settings["map"]))["scorer"]["method"]
    if name not in systems:
        raise SettingsError(f"confidence={settings['confidence']}: expected p of {name}, which the map scores by, got "
                            f"{', '.join(systems) or 'none'}; evaluate with the map's settings")  # fmt: skip
    return systems[name]


def _images(settings: Mapping[str, Any]) -> Iterator[tuple[str, Path | np.ndarray]]:
    """(name, file or pixels), in their order."""
    paths = settings["images"] if isinstance(settings["images"], list) else [settings["images"]]
    paths = [build.expanded(path) for path in paths]
    for path in paths:
        if not path.exists():
            raise SettingsError(f"images={path}: expected an image, a folder or a video, got nothing")
    if settings["watch"] and not (len(paths) == 1 and paths[0].is_dir()):
        raise SettingsError(f"watch=true: expected images=DIR, one folder, got {settings['images']}")
    for path in paths:
        if settings["watch"]:
            yield from ((str(one), one) for one in _watched(path))
        elif path.is_dir():
            yield from ((str(one), one) for one in image_folder(path).paths)
        elif path.suffix.lower() in VIDEOS:
            yield from ((f"{path}:{number}", image) for number, image in frames(path, every=settings["every"]))
        else:
            yield str(path), path


def _watched(folder: Path) -> Iterator[Path]:
    """Images of a folder, then those that come, once their files do not change any more; until Ctrl-C."""
    done: set[str] = set()
    before: dict[str, tuple[int, int]] = {}
    tell(f"watching {folder}; end with Ctrl-C")
    while True:
        found = {path.name: path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES}
        states = {name: (path.stat().st_size, path.stat().st_mtime_ns) for name, path in found.items()
                  if name not in done and path.is_file()}  # fmt: skip
        for name in sorted(name for name, state in states.items() if before.get(name) == state):
            done.add(name)
            yield found[name]
        before = states
        time.sleep(POLL)
