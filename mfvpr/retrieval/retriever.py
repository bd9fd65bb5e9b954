"""Retrieval (the paper's filter): candidates for each query; what it learns from the database, it learns once."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

import numpy as np
from jaxtyping import Float, Int

from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import ImageFolder, QuerySequence
from mfvpr.datasets.positives import Positives
from mfvpr.features.extractor import Aggregated, Extractor, describe_folder
from mfvpr.features.whitening import Whitening, WindowFitting, origin
from mfvpr.retrieval.search import EXACT
from mfvpr.retrieval.standardization import Rule, Search, StandardizedSearch, rule_of_sequence
from mfvpr.storage.cache_files import CacheFiles
from mfvpr.storage.feature_cache import FeatureCache

if TYPE_CHECKING:  # Flax takes half a second
    from mfvpr.features.ssm_features import SsmWindows

QUERIES = 64  # of SSM-VPR, searched at a time
Tool = TypeVar("Tool")


class RetrievalResult(NamedTuple):
    """Candidates `[Q, C]` of a sequence's queries, and images that could not be used: row -> reason."""

    candidates: Shortlist
    bad_queries: Mapping[int, str]
    bad_database: Mapping[int, str]


class Retriever(Protocol):
    """Interface of a retrieval; one of your own needs a `recipe` for a cache on disk, see `mfvpr.utils.recipe_of`."""

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, cache: FeatureCache
    ) -> RetrievalResult:
        """Best candidates of each query, without database images that the sequence excludes."""
        ...


@dataclass(frozen=True)
class Retrieval:
    """Candidates by search among global descriptors, which are computed from pixels or from local features."""

    describer: Extractor | Aggregated
    search: Search = EXACT

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, cache: FeatureCache
    ) -> RetrievalResult:
        database_vectors = cache.vectors(database, self.describer, database, label="database")
        query_vectors = cache.vectors(sequence.images, self.describer, database, label=f"query {sequence.name}")
        search = cache.recipes.once("search", lambda: self.search.fit(database_vectors.values), database, self)
        # An image without features has the descriptor 0, which is equally similar to all.
        is_zero = ~query_vectors.values.any(axis=1, keepdims=True)
        queries = np.where(is_zero, np.nan, query_vectors.values)
        candidates = search.shortlist(queries, database_vectors.values, num_candidates, excluded=sequence.excluded)
        return RetrievalResult(candidates, query_vectors.bad, database_vectors.bad)


@dataclass(frozen=True)
class Alternating:
    """Candidates of two retrievals in turns: the first of one, the first of the other, the second of one, ...

    Each image is a candidate once. Scores fall in equal steps from 1 to 1 / C, since those of the two retrievals cannot
    be compared.
    """

    first: Retriever
    second: Retriever

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, cache: FeatureCache
    ) -> RetrievalResult:
        """See `Retriever`."""
        first, second = (
            each.shortlist(sequence, database, num_candidates, cache) for each in (self.first, self.second)
        )
        indices = np.full(first.candidates.indices.shape, -1, np.int32)
        for query, rows in enumerate(zip(first.candidates.indices, second.candidates.indices, strict=True)):
            candidates = in_turns(rows, num_candidates)
            indices[query, : len(candidates)] = candidates
        shortlist = Shortlist(indices, np.where(indices >= 0, scores_of_turns(num_candidates), 0), indices >= 0)
        bad_queries = {row: reason for row, reason in first.bad_queries.items() if row in second.bad_queries}
        bad_database = {row: reason for row, reason in first.bad_database.items() if row in second.bad_database}
        return RetrievalResult(shortlist, bad_queries, bad_database)


def in_turns(shortlists: Sequence[Int[np.ndarray, " _"]], number: int) -> Int[np.ndarray, " candidates"]:
    """At most `number` rows: the first of each shortlist, the second of each, ..., each row once; -1 is no row."""
    rows = [row for turn in itertools.zip_longest(*shortlists, fillvalue=-1) for row in turn if row >= 0]
    return np.array([*dict.fromkeys(rows)][:number], np.int32)


def scores_of_turns(number: int) -> Float[np.ndarray, " candidates"]:
    """Scores of candidates in turns, see `Alternating`."""
    return 1 - np.arange(number, dtype=np.float32) / number


@dataclass(frozen=True)
class SsmVoting:
    """Candidates by votes (SSM-VPR): each query window votes for the images of its C nearest database windows.

    Images without votes fill the rest of the shortlist.
    """

    describer: "SsmWindows"

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, cache: FeatureCache
    ) -> RetrievalResult:
        """See `Retriever`; scores are votes."""
        describer = fit_to_database(self.describer, database, cache)
        database_vectors = cache.vectors(database, describer, database, label="database")
        query_vectors = cache.vectors(sequence.images, describer, database, label=f"query {sequence.name}")
        shape = (-1, describer.windows.count, describer.whitening.dimension)
        queries, windows = query_vectors.values.reshape(shape), database_vectors.values.reshape(shape)
        candidates = vote(queries, windows, num_candidates, excluded=sequence.excluded)
        return RetrievalResult(candidates, query_vectors.bad, database_vectors.bad)


def vote(
    queries: Float[np.ndarray, "queries windows dimensions"],
    database: Float[np.ndarray, "database windows dimensions"],
    num_candidates: int,
    *,
    excluded: Positives | None = None,
) -> Shortlist:
    """Candidates by votes, NumPy: most votes first, then the lowest row (the public code leaves their order open).

    Each query window votes for `num_candidates` windows. A query with a window that is not finite has no candidates; a
    database image with such a window is no candidate. Windows of `excluded` images get no votes.
    """
    usable0, usable1 = (np.asarray(np.isfinite(side).all(axis=(1, 2))) for side in (queries, database))
    windows = np.where(usable1[:, None, None], database, np.nan).reshape(-1, database.shape[2])
    squares = np.einsum("nd,nd->n", windows, windows, dtype=np.float64)
    windows = np.concatenate([windows, -squares[:, None] / 2], axis=1).astype(np.float32)
    window, excluded_windows = np.arange(database.shape[1]), None
    indices = np.full((len(queries), num_candidates), -1, np.int32)
    scores = np.zeros(indices.shape, np.float32)
    for start in range(0, len(queries), QUERIES):
        part = slice(start, start + QUERIES)
        unusable = ~(usable0[part, None] & usable1[None])
        if excluded is not None:  # all windows of the excluded images, for every window of a query
            unusable |= excluded.dense(part)
            images = map(excluded.of, range(len(excluded))[part])
            rows = [(each[:, None] * len(window) + window).reshape(-1) for each in images]
            excluded_windows = Positives.from_rows((of_query for of_query in rows for _ in window), len(windows))
        # The window b nearest to a maximizes (a, 1) . (b, -|b|^2 / 2).
        query_windows = np.pad(queries[part], ((0, 0), (0, 0), (0, 1)), constant_values=1)
        query_windows = query_windows.reshape(-1, windows.shape[1])
        nearest = EXACT.shortlist(query_windows, windows, num_candidates, excluded=excluded_windows)
        images = np.where(nearest.mask, nearest.indices // database.shape[1], len(database))
        votes = [np.bincount(row, minlength=len(database) + 1) for row in images.reshape(len(unusable), -1)]
        votes = np.where(unusable, -1, np.array(votes)[:, :-1])
        order = np.argsort(-votes, axis=1, kind="stable")[:, :num_candidates]
        counts = np.take_along_axis(votes, order, axis=1)
        indices[part, : order.shape[1]] = np.where(counts < 0, -1, order)
        scores[part, : order.shape[1]] = np.maximum(counts, 0)
    return Shortlist(indices, scores, indices >= 0)


def fit_to_database(tool: Tool, database: ImageFolder, cache: FeatureCache) -> Tool:
    """Learn the parts of an extractor, a retrieval, or a dataclass of these that need a database.

    The cache stores learned parts, by the images' content and all settings. Parts that are learned already stay the
    same, even if from another database. Images that cannot be read or are too few raise an `InputError`.
    """
    if isinstance(fitting := getattr(tool, "whitening", None), WindowFitting):
        whitening = cache.recipes.once("whitening", lambda: _whitening(tool, fitting, database, cache), database, tool)
        return replace(tool, whitening=whitening)  # pyright: ignore[reportArgumentType, reportCallIssue, reportReturnType]
    return with_parts(tool, lambda part: fit_to_database(part, database, cache))


def fit_to_sequence(tool: Any, sequence: QuerySequence) -> Any:
    """The retrieval with the rule of standardization that `auto` stands for with this sequence."""
    return with_standardization(tool, lambda rule: rule_of_sequence(rule, sequence))


def with_standardization(tool: Any, change: Callable[[Rule], Rule]) -> Any:
    """The retrieval with changed rules of standardization where it has some."""
    if isinstance(tool, StandardizedSearch):
        return StandardizedSearch(change(tool.standardize))
    return with_parts(tool, lambda part: with_standardization(part, change))


def standardizations(tool: Any, sequences: Sequence[QuerySequence]) -> set[Rule]:
    """The rules by which a retrieval, or its parts, standardize descriptors for these sequences."""
    if isinstance(tool, StandardizedSearch):
        return {rule_of_sequence(tool.standardize, each) for each in sequences}
    parts = [getattr(tool, part.name) for part in fields(tool)] if is_dataclass(tool) else []
    return {rule for part in parts for rule in standardizations(part, sequences)}


def with_parts(whole: Any, change: Callable[[Any], Any]) -> Any:
    """Apply a function to the fields of a dataclass; the same object if none changes, or if it is no dataclass."""
    if not is_dataclass(whole) or isinstance(whole, type):
        return whole
    parts = {part.name: getattr(whole, part.name) for part in fields(whole) if part.init}
    changed = {name: new for name, part in parts.items() if (new := change(part)) is not part}
    return replace(whole, **changed) if changed else whole


def whitening_recipe(extractor: Any, fitting: WindowFitting, cache: FeatureCache) -> dict[str, Any]:
    """Recipe of a whitening but for the database: network and its input, windows, and samples."""
    parts = {"windows": cache.recipes.of(extractor.windows), "whitening": cache.recipes.of(fitting)}
    return cache.recipes.of_features(extractor.maps) | parts


def _whitening(extractor: Any, fitting: WindowFitting, database: ImageFolder, cache: FeatureCache) -> Whitening:
    """Whitening from the cache, learned and stored there if it is missing."""
    name, own_origin = f"{type(extractor).__name__}-whitening", origin(extractor)

    def learn() -> Whitening:
        rows, track = fitting.sample_rows(len(database)), cache.runtime.progress(name.replace("-", " "))

        def maps() -> Iterator[dict[int, np.ndarray]]:
            for batch in describe_folder(database, extractor.maps, rows, {}, skip_bad=cache.skip_bad, track=track):
                yield {row: np.reshape(each.vector, extractor.windows.shape) for row, each in batch.items()}  # pyright: ignore

        return replace(fitting.fit(maps(), extractor.windows, rows), origin=own_origin)

    recipe = cache.recipe(lambda: whitening_recipe(extractor, fitting, cache))
    if recipe is None or cache.root is None:
        return learn()
    key = cache.recipes.contents(database).fingerprint
    files = CacheFiles(
        cache.root,
        name,
        recipe,
        pack=lambda whitening: {"mean": whitening.mean, "components": whitening.components},
        unpack=lambda arrays: Whitening(arrays["mean"], arrays["components"], own_origin),
    )
    whitening = files.get(key)
    if whitening is None:
        if key in files:
            cache.warn(f"{files.path(key)}: is damaged; learned again")
        whitening = learn()
        files.update({key: whitening})
        cache.runtime.log(f"{name} in {files.folder}")
    return whitening
