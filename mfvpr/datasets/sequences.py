"""Database and queries from one sequence: exclude each query and its neighbors in time from its candidates."""

from collections import defaultdict
from dataclasses import replace

from mfvpr.datasets.contents import Contents
from mfvpr.datasets.datasets import QuerySequence
from mfvpr.datasets.truth import AllowedTruth, FrameTruth
from mfvpr.utils.errors import InputError

OwnRows = tuple[tuple[int, ...], ...]


def own_rows(queries: Contents, database: Contents) -> OwnRows:
    """For each query, the database rows of files with the same content."""
    rows = defaultdict(list)
    for row, file in enumerate(database.files):
        if file.sha256:
            rows[file.sha256].append(row)
    return tuple(tuple(rows.get(file.sha256, ())) for file in queries.files)


def without_neighbors(sequence: QuerySequence, num_database: int, query_rows: OwnRows, neighbors: int) -> QuerySequence:
    """Exclude each query and its neighbors within `neighbors` frames from the query's candidates; 0 = the query alone.

    Excluded images are not correct either: a query without other correct images counts as a failure. `query_rows` are
    `own_rows` of queries and database, which is a sequence of `num_database` images.

    Raises:
        InputError: no query is among the database images, so that their frame numbers are unknown.
    """
    if not any(query_rows):
        raise InputError(
            f"exclude_neighbors={neighbors}: expected queries that are among the database images, got none in "
            f"{sequence.images.root}; leave it out for two different sequences"
        )
    excluded = FrameTruth(query_rows, num_database).positives(neighbors)
    truth = None if sequence.truth is None else AllowedTruth(sequence.truth, excluded)
    return replace(sequence, truth=truth, excluded=excluded)
