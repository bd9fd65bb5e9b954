"""Query images of a map: files, folders, watched folders, and videos."""

import stat
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from mfvpr.cli.console import tell
from mfvpr.datasets import image_folder
from mfvpr.datasets.image_reading import VIDEO_SUFFIXES, read_frames
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import IMAGE_SUFFIXES, canonical_name, expand_user

POLL = 0.2  # seconds between two looks at a folder


def images(settings: Mapping[str, Any]) -> Iterator[tuple[str, Path | UInt8[np.ndarray, "height width channels"]]]:
    """(name, file or pixels) in order; names do not depend on the spelling of a path."""
    paths = settings["images"] if isinstance(settings["images"], list) else [settings["images"]]
    paths = [expand_user(path) for path in paths]
    for path in paths:
        if not path.exists():
            raise InputError(f"images={path}: expected an image, a folder or a video, got nothing")
    if settings["watch"] and not (len(paths) == 1 and paths[0].is_dir()):
        raise InputError(f"watch=true: expected images=DIR, one folder, got {settings['images']}")
    for path in paths:
        if settings["watch"]:
            yield from ((canonical_name(image), image) for image in _watch(path))
        elif path.is_dir():
            yield from ((canonical_name(image), image) for image in image_folder(path).paths)
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            name = canonical_name(path)
            yield from ((f"{name}:{number}", image) for number, image in read_frames(path, every=settings["every"]))
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
        states = {path.name: state for path in paths if (state := _state(path)) is not None}
        for name, state in states.items():
            if before.get(name) == state != done.get(name):
                done[name] = state
                yield folder / name
        before = states
        time.sleep(POLL)


def _state(path: Path) -> tuple[int, int] | None:
    """Size and modification time; None if there is no regular file, or it has been removed."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_size, status.st_mtime_ns) if stat.S_ISREG(status.st_mode) else None
