"""Results that are computed once in a process."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from mfvpr.datasets.contents import files_of, state_of
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.utils.fingerprints import fingerprint, recipe_of

Value = TypeVar("Value")


@dataclass
class Memo:
    """Results by their name, their images, and the recipe of the extractor or retrieval that computes them."""

    _computed: dict[tuple, tuple[Any, Any]] = field(default_factory=dict, repr=False)

    def once(self, name: str, compute: Callable[[], Value], folder: ImageFolder | None, by: Any) -> Value:
        """The result of `compute`, called once while the images and the recipe of `by` stay the same.

        Without a recipe, the `id` of `by` counts. Without a folder, the result belongs to all images.
        """
        try:
            recipe = fingerprint(recipe_of(by, lambda path: [str(path), *map(state_of, files_of(path).paths)]))
        except TypeError:
            recipe = id(by)
        key = name, recipe, None if folder is None else (folder, hash(tuple(states(folder))))
        if key not in self._computed:
            self._computed[key] = compute(), by  # kept alive, so that no other object gets its id
        return self._computed[key][0]


def states(folder: ImageFolder) -> list[str]:
    """A text for each image, which changes with the file, or with the conversion of its pixels."""
    how = folder.orient, folder.bits
    paths = (f"{folder.root}/{image}" for image in folder.names)
    return [f"{path} {state_of(path)} {how}" for path in paths]
