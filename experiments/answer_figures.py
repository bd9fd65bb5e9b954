"""Figures of some of the answers of a map."""

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np

from experiments import build
from experiments.console import tell
from experiments.settings import SettingsError
from mfvpr.localization import Asked, Map
from mfvpr.report.answers import answer_figure
from mfvpr.report.file_names import file_names


class AnswerFigures:
    """Those of images that settings ask for, each as soon as it is answered."""

    def __init__(self, known: Map, settings: Mapping[str, Any]) -> None:
        """None yet.

        Raises:
            SettingsError: the folder of the map's images is none.
        """
        shown, self._known, self._failed = settings["figures"], known, 0
        self._wanted = set(range(shown) if isinstance(shown, int) else shown)
        self._missing = set() if isinstance(shown, int) else {*self._wanted}  # there may be fewer than so many
        self._out, self._root = (settings[name] and build.expanded(settings[name]) for name in ("out", "root"))
        if self._root and not self._root.is_dir():
            raise SettingsError(f"root={self._root}: expected the folder of the map's images, got no folder")

    def draw(self, number: int, name: str, pixels: np.ndarray, asked: Asked) -> dict[str, Any]:
        """What the line of an image, the how manieth from 0, says of its figure; one that fails costs a warning."""
        called = {number, name, PurePath(name).name}
        if not self._wanted & called:
            return {}
        self._missing -= called
        [file] = file_names([f"{number:04d}_{PurePath(name).stem}"]).values()
        path = self._out / f"{file}.png"
        try:
            answer_figure(path, self._known, name, pixels, asked, root=self._root)
        except Exception as error:
            self._failed += 1
            tell(f"warning: {path}: not drawn ({error})")
            return {"figure": None}
        return {"figure": str(path)}

    def finish(self) -> None:
        """Say what was asked for in vain.

        Raises:
            SettingsError: a figure was not drawn, or there was no such image.
        """
        if self._failed:
            raise SettingsError(f"{self._failed} of the figures could not be drawn; warnings say why")
        if self._missing:
            names = ",".join(sorted(map(str, self._missing)))
            raise SettingsError(f"figures=[{names}]: expected rows of images that were answered, from 0, or names as "
                                "the lines have them, or the last parts of these")  # fmt: skip
