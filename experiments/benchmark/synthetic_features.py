"""Synthetic data sets of any size: local features in stores, global descriptors, and known correct images."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from mfvpr.cli.console import Progress
from mfvpr.storage.features import FeatureStore, forecast_bytes, open_store
from mfvpr.storage.manifest import store_path
from mfvpr.storage.rows import require_space
from mfvpr.types import Features
from mfvpr.utils.threads import ordered_map

SIZE = 336  # px
COMMON = 2 / 7  # share of its keypoints that an image has in common with the query of the same place
SHIFT, JITTER = 60.0, 3.0  # px: largest shift of the common keypoints together, deviation of each
NOISE = 0.5  # length of the noise of a common descriptor
GLOBAL = 512  # dimensions of a global descriptor
VIEWS = 3  # database images that show the place of a query
LIKENESS = 0.25  # cosine similarity of global descriptors of one place; of different places 0 +- 0.04
BATCH = 50  # images that are stored at a time


@dataclass(frozen=True)
class SyntheticSet:
    """A synthetic data set; equal fields give equal data."""

    images: int  # M, of the database
    queries: int  # Q
    keypoints: int  # N, of each image
    dimension: int  # of local descriptors

    @property
    def title(self) -> str:
        return f"{self.images} images, D = {self.dimension}"

    def similar(self) -> np.ndarray:
        """Rows `[Q, VIEWS]` of the database images that show the place of each query."""
        rows = np.random.default_rng([self.images, self.queries]).permutation(self.images)
        return rows[: self.queries * VIEWS].reshape(self.queries, VIEWS)

    def query(self, row: int) -> Features:
        """Features `[N, ...]` of a query."""
        rng = np.random.default_rng([0, row])
        return _features(rng, rng.uniform(0, SIZE, (self.keypoints, 2)), self._descriptors(rng, self.keypoints))

    def image(self, row: int, shows: int | None) -> Features:
        """Features `[N, ...]` of a database image that shows the place of the query `shows`; None = of no query."""
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
        """Unit vectors `[Q, GLOBAL]` of the queries and `[M, GLOBAL]` of the database."""
        rng = np.random.default_rng(2)
        sizes = self.queries, self.images
        queries, database = (_unit(rng.standard_normal((size, GLOBAL), np.float32)) for size in sizes)
        rows = self.similar()
        database[rows] = _unit(LIKENESS * queries[:, None] + np.sqrt(1 - LIKENESS**2) * database[rows])
        return queries, database

    def stores(self, root: Path) -> tuple[FeatureStore, FeatureStore]:
        """Complete stores of queries and database below `root`; missing features are made first."""
        query_of = {row: query for query, rows in enumerate(self.similar().tolist()) for row in rows}
        return (
            self._complete_store(root, "queries", self.queries, self.query),
            self._complete_store(root, "database", self.images, lambda row: self.image(row, query_of.get(row))),
        )

    def _complete_store(self, root: Path, side: str, total: int, make: Callable[[int], Features]) -> FeatureStore:
        recipe = {"synthetic": side, "views": VIEWS, "likeness": LIKENESS} | asdict(self)
        with open_store(store_path(root, side, recipe), recipe, num_images=total) as store:
            missing_rows = np.flatnonzero(~store.done)
            require_space(store.folder, forecast_bytes(len(missing_rows), self.keypoints, self.dimension))
            features = ordered_map(make, missing_rows.tolist(), workers=2)
            batches = np.split(missing_rows, range(BATCH, len(missing_rows), BATCH))
            for rows in Progress(f"{side} of {self.title}", len(batches), batches):
                store.write(dict(zip(rows.tolist(), islice(features, len(rows)), strict=True)))
        return store

    def _descriptors(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return _unit(rng.standard_normal((count, self.dimension), np.float32))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _features(rng: np.random.Generator, points: np.ndarray, descriptors: np.ndarray) -> Features:
    order = rng.permutation(len(points))
    scores = rng.uniform(100, 1000, len(points)).astype(np.float32)
    keypoints = np.clip(points, 0, SIZE - 1).astype(np.float32)[order]
    return Features(keypoints, descriptors[order], scores, np.ones(len(points), bool), np.full(2, SIZE, np.float32))
