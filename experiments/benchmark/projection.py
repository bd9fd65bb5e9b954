"""Forecast of the cost of a database of another size on several machines, from rates measured on one machine."""

from dataclasses import dataclass

ASSUMED = (
    "all machines and their disks are as fast as the measured ones",
    "global descriptors of the whole database are extracted once, before the queries; they stay in memory, in float32",
    "the filter compares every query with every image in time proportional to their numbers; the database's rows are "
    "divided evenly over the machines",
    "one machine sorts the candidates of all machines in time proportional to their number",
    "local features are extracted for shortlisted images alone, divided evenly; no two queries share an image, which "
    "is an upper bound",
    "local features and global descriptor of a query are extracted when it arrives; queries are divided evenly",
    "re-ranking a query takes as long as here, where hardly any candidate is shared, whatever the size of the database",
    "network, waiting for the slowest machine and failures cost nothing",
)


@dataclass(frozen=True)
class Rates:
    """Seconds and bytes on one machine."""

    describing: float  # the global descriptor of an image
    comparing: float  # a query with a database image
    merging: float  # a candidate of a machine
    extracting: float  # the local features of an image
    storing: float  # writing the local features of an image
    reranking: float  # a query with all its candidates
    vector_bytes: float  # a global descriptor in memory
    row_bytes: float  # the local features of an image on disk


@dataclass(frozen=True)
class Plan:
    """Seconds of all queries together, and bytes, on each machine."""

    describing: float  # global descriptors of the database, once
    asking: float  # global descriptors and local features of the queries
    filtering: float  # shortlists, including `merging`
    merging: float  # one shortlist from those of all machines
    extracting: float  # local features of the shortlisted images, extracted and written
    reranking: float
    memory: float  # bytes of global descriptors
    disk: float  # bytes of local features

    @property
    def answering(self) -> float:
        """Seconds from the queries' images to their rankings."""
        return self.asking + self.filtering + self.extracting + self.reranking


def forecast(rates: Rates, images: int, queries: int, candidates: int, machines: int) -> Plan:
    """Cost of ranking queries among the images of a database, under the assumptions `ASSUMED`."""
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
