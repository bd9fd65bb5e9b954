"""Recall of sequences: single images, the drive filters of this library, and the field's methods, on the same features.

    python -m experiments.sequences NAME=DATABASE:QUERIES NAME=DATABASE:QUERIES ...

Query i of a drive shows its database image i. Names before a dot are pooled: streets.night, streets.snow. Each drive is
taken as it is, every fourth image, every second backwards, with stops, and in clips of 25 in another order.

The field's methods see the same images as "causal": those before.

- single: each image alone
- causal, lagged, smoothed: `DriveFilter` of the scores
- at speed 1: causal, told that the robot moves one row from one image to the next
- frames: frame correlation with the 2 images before (Camara & Preucil, RAS 2020)
- SeqSLAM 1, SeqSLAM any: straight trajectories of 10 images, 0.8 to 1.2 or -8 to 8 rows from one to the next, through
  the similarities of global descriptors, which are standardized for each image (after Milford & Wyeth, ICRA 2012)
- scores 1, scores any: the same, through the standardized scores
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.drives import NEAR, datasets_of, main
from mfvpr.cli.command_line import load_system
from mfvpr.core.types import Shortlist
from mfvpr.datasets import Dataset
from mfvpr.evaluation import System, rank_dataset
from mfvpr.evaluation.drives import Drive, DriveFilter
from mfvpr.evaluation.rankings import FrameCorrelation, Ranked
from mfvpr.evaluation.statistics import path_test
from mfvpr.report import Table
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache

STEADY, ANY = np.arange(0.8, 1.25, 0.1), np.arange(-8, 8.5, 0.5)  # rows from one image to the next
TRAJECTORY = 10  # images

Matrix = Float[np.ndarray, "queries rows"]


def drives_along(number: int) -> dict[str, Int[np.ndarray, " images"]]:
    """Query images of each drive along a data set of a number of queries."""
    rows = np.arange(number)
    stops = np.repeat(rows, 1 + 2 * ((rows > number // 3) & (rows < number // 2)))
    clips = [rows[start : start + 25] for start in range(0, number, 25)]
    clips = np.concatenate([*clips[2::4], *clips[::4], *clips[3::4], *clips[1::4]])
    return {"as they are": rows, "every fourth": rows[::4], "every second, backwards": rows[::-2],
            "with stops": stops, "clips": clips}  # fmt: skip


def standardized(values: Matrix) -> Matrix:
    """Values of each query, with mean 0 and standard deviation 1 where they are finite, and 0 elsewhere."""
    finite = np.isfinite(values)
    mean = np.mean(values, axis=1, keepdims=True, where=finite)
    deviation = np.std(values, axis=1, keepdims=True, where=finite)
    return np.where(finite, (values - mean) / np.maximum(deviation, 1e-12), 0.0)


def trajectories(values: Matrix, speeds: Float[np.ndarray, " speeds"], length: int) -> Matrix:
    """Largest mean over straight trajectories that end at each query and row; outside of the map, values are 0."""
    queries, rows = np.arange(len(values))[:, None], np.arange(values.shape[1])
    best = np.full(values.shape, -np.inf)
    for speed in speeds:
        total, count = np.zeros(values.shape), np.zeros(values.shape)
        for back in range(length):
            query, row = queries - back, np.round(rows - speed * back).astype(int)
            inside = (query >= 0) & (row >= 0) & (row < len(rows))
            total += np.where(inside, values[np.maximum(query, 0), np.clip(row, 0, len(rows) - 1)], 0.0)
            count += query >= 0
        best = np.maximum(best, total / count)
    return best


class Place:
    """A data set, ranked once: drives along it take some of its queries."""

    def __init__(self, dataset: Dataset, system: System, cache: FeatureCache) -> None:
        ranked, retriever = rank_dataset(dataset, system, cache=cache), system.pipeline.retriever
        assert isinstance(retriever, Retrieval)
        [self._ranked] = ranked.systems[system.headline]
        self.number, self._rows = len(dataset.only.images), len(dataset.database)
        sides = (dataset.only.images, dataset.database)
        queries, database = (cache.vectors(each, retriever.describer, dataset.database).values for each in sides)
        scores, there = np.full((self.number, self._rows), np.nan), self._ranked.rows >= 0
        scores[np.nonzero(there)[0], self._ranked.rows[there]] = self._ranked.scores[there]
        self._matrices = {"SeqSLAM": queries @ database.T, "scores": scores}

    def hits(self, images: Int[np.ndarray, " images"]) -> dict[str, Bool[np.ndarray, " images"]]:
        """Whether the first row of each image is correct, by method."""
        ranked = Ranked(self._ranked.rows[images], self._ranked.scores[images])
        shortlist = Shortlist(ranked.rows, ranked.scores, ranked.rows >= 0)
        filters = {method: DriveFilter(method) for method in ("causal", "lagged", "smoothed")}
        filters["at speed 1"] = DriveFilter("causal", Drive(advance=1))
        first = {"single": ranked.rows[:, 0]}
        first |= {name: drive_filter(ranked, self._rows).rows[:, 0] for name, drive_filter in filters.items()}
        frames = np.where(shortlist.mask, FrameCorrelation()(shortlist, ranked.scores), -np.inf)
        first["frames"] = ranked.rows[np.arange(len(images)), frames.argmax(axis=1)]
        for name, matrix in self._matrices.items():
            for rows, speeds in (("1", STEADY), ("any", ANY)):
                means = trajectories(standardized(matrix[images]), speeds, TRAJECTORY)
                first[f"{name} {rows}"] = means.argmax(axis=1)
        return {name: np.abs(rows - images) <= NEAR for name, rows in first.items()}


def lines(places: Mapping[str, Sequence[Place]]) -> Iterator[list[str]]:
    """Rows of the table: recall of each set and drive, then gains over single images, pooled over the sets."""
    pooled = defaultdict[str, list[tuple[np.ndarray, np.ndarray]]](list)  # places along a path, and hits by method
    for number, (name, parts) in enumerate(places.items()):
        for drive in drives_along(1):
            images = [drives_along(place.number)[drive] for place in parts]
            of_parts = [[*place.hits(each).values()] for place, each in zip(parts, images, strict=True)]
            hits = np.concatenate(of_parts, axis=1)
            pooled[drive].append((number * 10**6 + np.concatenate(images), hits))
            yield [name, drive, *(f"{100 * recall:.1f}" for recall in hits.mean(axis=1))]
    for drive, of_sets in pooled.items():
        path, hits = (np.concatenate(each, axis=-1) for each in zip(*of_sets, strict=True))
        (alone, *methods), cells = hits[:, np.argsort(path, kind="stable")], []
        for correct in methods:
            gain, p = correct.mean() - alone.mean(), path_test(correct, alone).p_value
            cells.append(f"{100 * correct.mean():.1f} ({100 * gain:+.1f}, p {p:.3f})")
        yield ["all", drive, f"{100 * alone.mean():.1f}", *cells]


def run(drives: list[str], features: str) -> None:
    """Print a table of all data sets."""
    datasets, cache = datasets_of(drives), FeatureCache()
    system = load_system("mfvpr", retrieval="vlad", features=features)
    places = defaultdict[str, list[Place]](list)
    for name, dataset in datasets.items():
        places[name.partition(".")[0]].append(Place(dataset, system, cache))
    methods = next(iter(places.values()))[0].hits(np.arange(1))
    print(Table([f"R@1 ±{NEAR}", "drive", *methods], [*lines(places)], 2).markdown())


if __name__ == "__main__":
    main("sequences", __doc__)
