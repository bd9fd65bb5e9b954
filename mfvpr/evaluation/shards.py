"""Shards of one evaluation on many machines without a network between them: they fill the folder of one cache.

    print(fill_shard(dataset, system, FeatureCache(root), Shard(2, 8)))

A hash of its name assigns every image and query to a shard. A shard describes its images. When all shards have, start
it again: it matches its queries. Then `evaluate` with `FeatureCache(root)` reads features and matches, and returns the
result; what is missing, it computes.
"""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from mfvpr.datasets.datasets import Dataset, ImageFolder
from mfvpr.evaluation.image_sizes import folders_of
from mfvpr.evaluation.sequence_matching import match_rows, matches_recipe
from mfvpr.evaluation.system import Pipeline, System
from mfvpr.features.extractor import Aggregated, Extractor, Source
from mfvpr.retrieval.fitting import fit_to_database
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import fingerprint

MOST = 9999  # shards
SOME = 20  # shards that a line names


@dataclass(frozen=True)
class Shard:
    """One shard of an evaluation: its index, from 0, and the number of shards."""

    index: int
    count: int

    def __post_init__(self) -> None:
        if not (1 <= self.count <= MOST and 0 <= self.index < self.count):
            raise InputError(f"shard={self}: expected i/n with i from 0 to n - 1 and n up to {MOST}")

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """The shard `i/n`; raises `InputError` if the text is something else."""
        if not (numbers := re.fullmatch(r"(\d{1,9})/(\d{1,9})", text, re.ASCII)):
            raise InputError(f"shard={text}: expected i/n, such as 0/8, the first of eight")
        return cls(int(numbers[1]), int(numbers[2]))

    def rows(self, names: Sequence[str]) -> list[int]:
        """Rows of this shard: by a hash of the name, so that no order matters."""
        return [row for row, name in enumerate(names) if shard_of(name, self.count) == self.index]


def shard_of(name: str, count: int) -> int:
    """Index of the shard of a name: the first 8 bytes of its SHA-256, big endian, modulo `count`."""
    return int.from_bytes(hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()[:8]) % count


def fill_shard(dataset: Dataset, system: System, cache: FeatureCache, shard: Shard) -> str:
    """Do the part of a shard, and say in one line what is done, and what to do next."""
    if cache.root is None:
        raise InputError(f"shard={shard}: expected a cache with a root, the folder that all shards fill")
    system = system.fit_image_size(folders_of(dataset), cache.warn)
    database, pipeline, sequences = dataset.database, system.pipeline, dataset.sequences
    recipes = [matches_recipe(dataset, sequence, pipeline, cache) for sequence in sequences]
    marks = cache.root / f"shards-{fingerprint(recipes)}"  # a file for each shard that has described its images
    paths = [marks / f"{index}-of-{shard.count}" for index in range(shard.count)]
    if not paths[shard.index].exists():
        for folder in folders_of(dataset):
            names = tuple(folder.names[row] for row in shard.rows(folder.names))
            _describe(replace(folder, names=names), database, pipeline, cache)
        marks.mkdir(parents=True, exist_ok=True)
        write_text(paths[shard.index], "described\n")
    if missing := [index for index, path in enumerate(paths) if not path.exists()]:
        named = ", ".join(map(str, missing[:SOME])) + ", ..." * (len(missing) > SOME)
        return f"shard {shard}: its images are described, those of shards {named} are not; start it again when they are"
    for sequence in sequences:
        match_rows(dataset, sequence, pipeline, shard.rows(sequence.images.names), cache)
    return f"shard {shard}: its images and queries are done; when all shards are, run without shard= for the results"


def _describe(part: ImageFolder, database: ImageFolder, pipeline: Pipeline, cache: FeatureCache) -> None:
    """Describe images for the retrieval and the matching."""
    retriever = fit_to_database(pipeline.retriever, database, cache)
    describer = getattr(retriever, "describer", None)
    describers = [describer.extractor if isinstance(describer, Aggregated) else describer]
    if pipeline.image_source is None:
        describers.append(fit_to_database(pipeline.extractor, database, cache))
    for extractor in describers if len(part) else ():
        if isinstance(extractor, Extractor) and not isinstance(extractor, Source):
            cache.describe(part, extractor)
