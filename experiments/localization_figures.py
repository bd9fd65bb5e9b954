"""Figures of localized images."""

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np
from jaxtyping import UInt8

from experiments import build
from experiments.console import tell
from experiments.settings import SettingsError
from mfvpr.localization import Localization, Map
from mfvpr.report.file_names import file_names
from mfvpr.report.localizations import localization_figure


class LocalizationFigures:
    """Figures of the images that `figures=` names, each drawn as soon as the image is localized."""

    def __init__(self, robot_map: Map, settings: Mapping[str, Any]) -> None:
        """Read the settings `figures`, `out` and `root`."""
        figures, self._map, self._failed = settings["figures"], robot_map, 0
        self._wanted = set(range(figures) if isinstance(figures, int) else figures)
        self._missing = set() if isinstance(figures, int) else {*self._wanted}  # there may be fewer images
        self._out, self._root = (settings[name] and build.expand_user(settings[name]) for name in ("out", "root"))
        if self._root and not self._root.is_dir():
            raise SettingsError(f"root={self._root}: expected the folder of the map's images, got no folder")

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
        try:
            localization_figure(path, self._map, name, pixels, localized, root=self._root)
        except Exception as error:
            self._failed += 1
            tell(f"warning: {path}: not drawn ({error})")
            return {"figure": None}
        return {"figure": str(path)}

    def finish(self) -> None:
        """Raise a SettingsError if a figure could not be drawn, or if an image did not come."""
        if self._failed:
            raise SettingsError(f"{self._failed} of the figures could not be drawn; warnings say why")
        if self._missing:
            names = ",".join(sorted(map(str, self._missing)))
            raise SettingsError(f"figures=[{names}]: expected rows of localized images, from 0, or names as "
                                "the lines have them, or the last parts of these")  # fmt: skip
