"""Recipes of results, which are computed once in a process: content of files, extractor, versions of decoders."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, TypeVar

from mfvpr.datasets.contents import Contents, contents, files_of, state_of
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.utils.fingerprints import fingerprint, recipe_of
from mfvpr.utils.versions import versions

DECODERS = ("opencv-python-headless", "pillow")  # their versions decide which pixels an image file becomes
# Version of mfvpr that last changed the pixels of decoded or resized images. If `mfvpr.datasets.image_reading` gives
# other pixels, set it to the next version: stored features are then extracted again.
DECODING = "0.3.0"

Value = TypeVar("Value")


@dataclass
class Memo:
    """Results by their name, their images, and the recipe of the extractor or retrieval that computes them."""

    _computed: dict[tuple, tuple[Any, Any]] = field(default_factory=dict, repr=False)

    def once(self, name: str, compute: Callable[[], Value], folder: ImageFolder | None, by: Any) -> Value:
        """Call `compute` once while the images (None = any) and the recipe of `by`, or else its `id`, stay the same."""
        try:
            recipe = fingerprint(recipe_of(by, lambda path: [str(path), *map(state_of, files_of(path).paths)]))
        except TypeError:
            recipe = id(by)
        key = name, recipe, None if folder is None else (folder, hash(tuple(states(folder))))
        if key not in self._computed:
            self._computed[key] = compute(), by  # kept alive, so that no other object gets its id
        return self._computed[key][0]


def states(folder: ImageFolder, rows: Iterable[int] | None = None) -> list[str]:
    """A text for each image, which changes with the file, or with the conversion of its pixels."""
    how = folder.orient, folder.bits
    names = folder.names if rows is None else [folder.names[row] for row in rows]
    paths = (f"{folder.root}/{image}" for image in names)
    return [f"{path} {state_of(path)} {how}" for path in paths]


@dataclass
class Recipes:
    """Recipes of a cache in the folder `root`; None = hashes of files are not kept on disk."""

    root: Path | None
    _memo: Memo = field(default_factory=Memo, repr=False)

    def contents(self, folder: ImageFolder) -> Contents:
        """Hashes of the files of a folder; with a root, later runs read them from there."""
        records = None if self.root is None else self.root / "contents"
        return self._memo.once("contents", lambda: contents(folder, records), folder, None)

    def of(self, value: Any) -> Any:
        """See `fingerprints.recipe_of`, with the content of files and folders of files in place of their paths."""
        return recipe_of(value, self._content_of)

    def of_features(self, extractor: Any) -> dict[str, Any]:
        """Everything but the image that changes its features: extractor, versions of decoders."""
        decoders = {"mfvpr": DECODING} | {name: versions()[name] for name in DECODERS}
        return {"extractor": self.of(extractor), "versions": decoders}

    def of_folder(self, folder: ImageFolder, extractor: Any) -> dict[str, Any]:
        """Everything that changes the features of a folder's images."""
        return self.of_features(extractor) | {"images": self.contents(folder).fingerprint}

    def _content_of(self, path: PurePath) -> Any:
        path = Path(path)
        if not path.exists():
            return str(path)
        content = self.contents(files_of(path))
        return content.fingerprint if path.is_dir() else content.sha256
