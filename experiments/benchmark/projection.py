"""What a database of another size would take on several machines, from what one machine takes for one thing."""

from dataclasses import dataclass

ASSUMED = (
    "each of the machines is as fast as the one that was measured, its disk too",
    "global descriptors of the whole database are made once, before anybody asks; they stay in memory, in float32",
    "the filter compares every query with every image, as fast whatever their numbers; the database's rows are divided "
    "evenly over the machines",
    "one machine sorts the candidates that all machines find, each of which takes as long",
    "local features are made of shortlisted images alone, no two queries share one: an upper bound, divided evenly",
    "local features of a query and its global descriptor are made when it is asked; queries are divided evenly",
    "re-ranking takes a query as long as here, where hardly any candidate is shared, whatever the size of the database",
    "network, waiting for the slowest machine, failures: nothing",
)


@dataclass(frozen=True)
class Rates:
    """What one machine takes.

    Attributes:
        describing: seconds for an image's global descriptor.
        comparing: for one query and one image of the database.
        merging: for one candidate of one machine.
        extracting: for an image's local features.
        storing: for writing these to disk.
        reranking: for a query with all its candidates.
        vector_bytes: of a global descriptor in memory.
        row_bytes: of an image's local features on disk.
    """

    describing: float
    comparing: float
    merging: float
    extracting: float
    storing: float
    reranking: float
    vector_bytes: float
    row_bytes: float


@dataclass(frozen=True)
class Plan:
    """What each of some machines takes; seconds of all queries together.

    Attributes:
        describing: seconds for the database's global descriptors, once.
        asking: for the queries' descriptors and features.
        filtering: for the shortlists, of which `merging` for making one of all machines'.
        merging: see there.
        extracting: for the features of the shortlisted images, made and written.
        reranking: for the rest.
        memory: bytes of global descriptors.
        disk: bytes of features.
    """

    describing: float
    asking: float
    filtering: float
    merging: float
    extracting: float
    reranking: float
    memory: float
    disk: float

    @property
    def answering(self) -> float:
        """Seconds from the queries' images to their rankings."""
        return self.asking + self.filtering + self.extracting + self.reranking


def projected(rates: Rates, images: int, queries: int, candidates: int, machines: int) -> Plan:
    """What it takes to find queries among the images of a database, under what is `ASSUMED`."""
    rows = min(images, queries * candidates)
    merging = rates.merging * queries * candidates * machines if machines > 1 else 0.0
    return Plan(
        describing=rates.describing * images / machines,
        asking=(rates.describing + rates.extracting) * queries / machines,
        filtering=rates.comparing * queries * images / machines + merging,
        merging=merging,
        extracting=(rates.extracting + rates.storing) * rows / machines,
        reranking=rates.reranking * queries / machines,
        memory=rates.vector_bytes * images / machines,
        disk=rates.row_bytes * rows / machines,
    )
