"""Data sets of any size, made up: features in stores, a few images that show what a query shows, and descriptors."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from experiments.console import bar
from mfvpr.storage.features import FeatureStore, forecast_bytes, open_store, require_space
from mfvpr.storage.manifest import store_path
from mfvpr.types import Features
from mfvpr.utils.threads import ordered_map

SIZE = 336  # px
COMMON = 2 / 7  # of the keypoints they share with it
SHIFT, JITTER = 60.0, 3.0  # px, of all of them at most, and of each
NOISE = 0.5  # length of what is added to a descriptor
GLOBAL = 512  # dimensions of a global descriptor
BATCH = 50  # images that are stored at a time


@dataclass(frozen=True)
class MadeUp:
    """A data set; the same numbers give the same one.

    Attributes:
        images: M of the database.
        queries: Q.
        keypoints: N of each image.
        dimension: of its descriptors.
        views: images of the database that show the place of a query.
        likeness: cosine similarity of the global descriptors of images of one place; others': 0 +- 0.04.
    """

    images: int
    queries: int
    keypoints: int
    dimension: int
    views: int = 3
    likeness: float = 0.25

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.images} images, D = {self.dimension}"

    def similar(self) -> np.ndarray:
        """`[Q, views]` rows of the database that show what a query shows, each of one query."""
        rows = np.random.default_rng([self.images, self.queries]).permutation(self.images)
        return rows[: self.queries * self.views].reshape(self.queries, self.views)

    def shown(self) -> dict[int, int]:
        """The query whose place an image of the database shows, by row; the others show none."""
        return {row: query for query, rows in enumerate(self.similar().tolist()) for row in rows}

    def query(self, row: int) -> Features:
        """Features `[N, ...]` of a query."""
        rng = np.random.default_rng([0, row])
        return _features(rng, rng.uniform(0, SIZE, (self.keypoints, 2)), self._descriptors(rng, self.keypoints))

    def image(self, row: int, shows: int | None) -> Features:
        """Features `[N, ...]` of an image of the database, which shows the place of a query, or of none."""
        rng = np.random.default_rng([1, row])
        points, descriptors = rng.uniform(0, SIZE, (self.keypoints, 2)), self._descriptors(rng, self.keypoints)
        if shows is not None:
            query, common = self.query(shows), rng.permutation(self.keypoints)[: int(COMMON * self.keypoints)]
            moved = query.keypoints[common] + rng.uniform(-SHIFT, SHIFT, 2)
            points[: len(common)] = moved + rng.normal(0, JITTER, moved.shape)
            noise = NOISE * self._descriptors(rng, len(common))
            descriptors[: len(common)] = _unit(query.descriptors[common] + noise)
        return _features(rng, points, descriptors)

    def global_descriptors(self) -> tuple[np.ndarray, np.ndarray]:
        """Of queries and database, `[Q, GLOBAL]` and `[M, GLOBAL]`, of unit length."""
        rng = np.random.default_rng(2)
        queries, database = (_unit(_normal(rng, count, GLOBAL)) for count in (self.queries, self.images))
        rows = self.similar()
        database[rows] = _unit(self.likeness * queries[:, None] + np.sqrt(1 - self.likeness**2) * database[rows])
        return queries, database

    def stores(self, root: Path) -> tuple[FeatureStore, FeatureStore]:
        """Those of queries and database below `root`, complete; what is missing there is made first."""
        shown = self.shown()
        return (
            self._complete(root, "queries", self.queries, self.query),
            self._complete(root, "database", self.images, lambda row: self.image(row, shown.get(row))),
        )

    def _complete(self, root: Path, side: str, total: int, make: Callable[[int], Features]) -> FeatureStore:
        recipe = {"made_up": side} | asdict(self)
        store = open_store(store_path(root, side, recipe), recipe, num_images=total)
        with store:
            todo = np.flatnonzero(~store.done)
            require_space(store.folder, forecast_bytes(len(todo), self.keypoints, self.dimension))
            made = zip(todo.tolist(), ordered_map(make, todo.tolist(), workers=2), strict=True)
            batch: dict[int, Features] = {}
            for row, features in bar(f"{side} of {self.title}", len(todo), made):
                batch[row] = features
                if len(batch) == BATCH or row == todo[-1]:
                    store.write(batch)
                    batch = {}
        return store

    def _descriptors(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return _unit(_normal(rng, count, self.dimension))


def _normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.standard_normal(shape, np.float32)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _features(rng: np.random.Generator, points: np.ndarray, descriptors: np.ndarray) -> Features:
    order = rng.permutation(len(points))
    scores = rng.uniform(100, 1000, len(points)).astype(np.float32)
    keypoints = np.clip(points, 0, SIZE - 1).astype(np.float32)[order]
    return Features(keypoints, descriptors[order], scores, np.ones(len(points), bool), np.full(2, SIZE, np.float32))
