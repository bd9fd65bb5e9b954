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

from mfvpr.cli.command_line import load_system
from mfvpr.cli.programs import Parser, run_command
from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import Dataset, folder
from mfvpr.evaluation import System, rank_dataset
from mfvpr.evaluation.drives import Drive, DriveFilter
from mfvpr.evaluation.rankings import FrameCorrelation, Ranked
from mfvpr.evaluation.statistics import path_test
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache

NEAR = 2  # frames
STEADY, ANY = np.arange(0.8, 1.25, 0.1), np.arange(-8, 8.5, 0.5)  # rows from one image to the next
TRAJECTORY = 10  # images

Drives = dict[str, Int[np.ndarray, " images"]]
Matrix = Float[np.ndarray, "queries rows"]
Hits = dict[str, Bool[np.ndarray, " images"]]


def drives(number: int) -> Drives:
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
        self._similarities = queries @ database.T
        self._scores = np.full((self.number, self._rows), np.nan)
        there = self._ranked.rows >= 0
        self._scores[np.nonzero(there)[0], self._ranked.rows[there]] = self._ranked.scores[there]

    def hits(self, images: Int[np.ndarray, " images"]) -> Hits:
        """Whether the first row of each image is correct, by method."""
        ranked = Ranked(self._ranked.rows[images], self._ranked.scores[images])
        shortlist = Shortlist(ranked.rows, ranked.scores, ranked.rows >= 0)
        first = {"single": ranked.rows[:, 0]}
        for method in ("causal", "lagged", "smoothed"):
            first[method] = DriveFilter(method)(ranked, self._rows).rows[:, 0]
        first["at speed 1"] = DriveFilter("causal", Drive(advance=1))(ranked, self._rows).rows[:, 0]
        frames = np.where(shortlist.mask, FrameCorrelation()(shortlist, ranked.scores), -np.inf)
        first["frames"] = ranked.rows[np.arange(len(images)), frames.argmax(axis=1)]
        similarities, scores = standardized(self._similarities[images]), standardized(self._scores[images])
        matrices = {
            f"{name} {rows}": trajectories(values, speeds, TRAJECTORY)
            for name, values in (("SeqSLAM", similarities), ("scores", scores))
            for rows, speeds in (("1", STEADY), ("any", ANY))
        }
        first |= {name: values.argmax(axis=1) for name, values in matrices.items()}
        return {name: np.abs(rows - images) <= NEAR for name, rows in first.items()}


def lines(places: Mapping[str, Sequence[Place]]) -> Iterator[list[str]]:
    """Rows of the table: recall of each set and drive, then gains over single images, pooled over the sets."""
    pooled = {drive: list[tuple[Int[np.ndarray, " images"], Hits]]() for drive in drives(1)}  # with places along a path
    for number, (name, parts) in enumerate(places.items()):
        for drive, all_hits in pooled.items():
            images = [drives(place.number)[drive] for place in parts]
            hits = [place.hits(each) for place, each in zip(parts, images, strict=True)]
            all_hits += [(number * 10**6 + each, part) for each, part in zip(images, hits, strict=True)]
            recalls = [np.concatenate([part[method] for part in hits]).mean() for method in hits[0]]
            yield [name, drive, *(f"{100 * recall:.1f}" for recall in recalls)]
    for drive, all_hits in pooled.items():
        path = np.argsort(np.concatenate([images for images, _ in all_hits]), kind="stable")
        hits = {method: np.concatenate([part[method] for _, part in all_hits])[path] for method in all_hits[0][1]}
        alone, cells = hits.pop("single"), []
        for correct in hits.values():
            gain, p = correct.mean() - alone.mean(), path_test(correct, alone).p_value
            cells.append(f"{100 * correct.mean():.1f} ({100 * gain:+.1f}, p {p:.3f})")
        yield ["all", drive, f"{100 * alone.mean():.1f}", *cells]


def run(arguments: list[str], features: str) -> None:
    """Print a table of all data sets."""
    system, cache = load_system("mfvpr", features=features), FeatureCache()
    places = defaultdict[str, list[Place]](list)
    for name, _, paths in (argument.partition("=") for argument in arguments):
        dataset = folder(*paths.split(":"), ground_truth="order")
        places[name.partition(".")[0]].append(Place(dataset, system, cache))
    names = next(iter(places.values()))[0].hits(np.arange(1))
    print(f"| R@1 ±{NEAR} | drive | {' | '.join(names)} |")
    print(f"| :-- | :-- |{' --: |' * len(names)}")
    for cells in lines(places):
        print(f"| {' | '.join(cells)} |", flush=True)


def add_arguments(parser: Parser) -> None:
    """Declare the command line."""
    parser.add_argument("arguments", nargs="+", metavar="NAME=DATABASE:QUERIES", help="drives along data sets")
    parser.add_argument("--features", default="aliked", metavar="NAME", help="choice of the group features")
    parser.set_defaults(run="experiments.sequences:run")


if __name__ == "__main__":
    run_command("python -m experiments.sequences", str(__doc__), add_arguments)
