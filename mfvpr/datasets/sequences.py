"""Database and queries of one sequence: an image must not be the answer to itself, nor may its neighbors in time."""

from collections import defaultdict
from dataclasses import replace

from mfvpr.datasets.contents import Contents
from mfvpr.datasets.datasets import QuerySequence
from mfvpr.datasets.ground_truth import AllowedTruth, FrameTruth
from mfvpr.utils.errors import InputError

OwnRows = tuple[tuple[int, ...], ...]


def own_rows(queries: Contents, database: Contents) -> OwnRows:
    """For each query, the database rows of the very same image: the same file, or one of the same content."""
    rows = defaultdict(list)
    for row, file in enumerate(database.files):
        if file.sha256:
            rows[file.sha256].append(row)
    return tuple(tuple(rows.get(file.sha256, ())) for file in queries.files)


def without_neighbors(sequence: QuerySequence, num_database: int, own: OwnRows, neighbors: int) -> QuerySequence:
    """The queries, none of which finds itself, nor what stands within `neighbors` frames of it in the database.

    Neither do these images count as right: a query all of whose right answers they are has none, and is a failure.

    Args:
        sequence: of a database that is a sequence.
        num_database: N.
        own: `own_rows` of both.
        neighbors: in frames; 0 = the image itself alone.

    Raises:
        InputError: no query is among the database images, so that nobody knows where in the sequence it is.
    """
    if not any(own):
        raise InputError(
            f"exclude_neighbors={neighbors}: expected queries that are among the database images, got none in "
            f"{sequence.images.root}; leave it out for two different sequences"
        )
    excluded = FrameTruth(own, num_database).positives(neighbors)
    truth = None if sequence.truth is None else AllowedTruth(sequence.truth, excluded)
    return replace(sequence, truth=truth, excluded=excluded)
