"""Values that say what is evaluated: a pipeline finds and matches candidates, a system scores and ranks them."""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8

from mfvpr.baselines.scorers import SCORERS
from mfvpr.core.scorer import Scorer, check_bounds
from mfvpr.datasets.datasets import Dataset, ImageFolder
from mfvpr.datasets.image_reading import read_size, shape_size
from mfvpr.evaluation.drives import DriveFilter
from mfvpr.evaluation.rankings import FRAMES, RETRIEVAL, FinalScore, FrameCorrelation, Fusion, Ties
from mfvpr.features.extractor import Extractor, Scale, Source
from mfvpr.features.sift import Sift
from mfvpr.matchers.host_matcher import PairSource
from mfvpr.matchers.matcher import NEIGHBORS, LightGlueMatcher, Matcher
from mfvpr.retrieval.retriever import Retriever, with_parts
from mfvpr.utils.errors import InputError, require_type, require_word
from mfvpr.utils.fields import COUNT

_TYPICAL_MATCHES = 1000  # of a pair that no features limit
_SAME_ASPECT = 0.02  # relative difference of two aspect ratios that count as the same

Note = Callable[[str], object]


@dataclass(frozen=True)
class Pipeline:
    """Images -> features -> shortlist -> matches.

        sift = Sift()
        pipeline = Pipeline(sift, Retrieval(Aggregated(sift, VladFitting())), candidates=50)

    Attributes:
        extractor: extracts local features, or reads them, see `mfvpr.retrieval.precomputed`.
        retriever: the retrieval, which finds candidates.
        matcher: matches a pair, see `mfvpr.Matcher`; or a program of your own, see `mfvpr.HostMatcher`; or files, see
            `mfvpr.retrieval.MatchFiles`.
        candidates: number of candidates of each query.
        pixels: of a resized image, in the shape of the first database image; None = `image_size` of the extractor.
    """

    extractor: Extractor | Source
    retriever: Retriever
    matcher: Matcher | PairSource = NEIGHBORS
    candidates: int | Literal["all"] = 50
    pixels: int | None = None

    def __post_init__(self) -> None:
        """Raise an InputError unless the parts fit together."""
        (COUNT | "all").check("candidates", self.candidates)
        if not self.extractor.scales:
            raise InputError(f"{type(self.extractor).__name__}: expected an extractor that gives local features")
        if isinstance(self.matcher, type) or not (callable(self.matcher) or isinstance(self.matcher, PairSource)):
            expected = "a function of the features of two images that returns Matches"
            raise InputError(f"matcher: expected {expected}, got {self.matcher!r}; see mfvpr.Matcher")
        if isinstance(self.matcher, LightGlueMatcher):
            dimensions = {scale.dimension for scale in self.extractor.scales if scale.dimension}  # 0 = not known
            if isinstance(self.extractor, Sift) or dimensions - {self.matcher.dimension}:
                got = f"{type(self.extractor).__name__} of {', '.join(map(str, sorted(dimensions)))}"
                expected = f"ALIKED's features, of {self.matcher.dimension} dimensions"
                raise InputError(f"LightGlue: expected {expected}, got {got}; match nearest neighbors instead")

    @property
    def image_source(self) -> PairSource | None:
        """The matcher, if it takes images or files instead of features."""
        matcher = self.matcher
        return matcher if isinstance(matcher, PairSource) and matcher.inputs == "images" else None

    @property
    def scales(self) -> tuple[Scale, ...]:
        """Scales of the matches."""
        return self.extractor.scales if self.image_source is None else (Scale(0, _TYPICAL_MATCHES),)

    def size_for_images(self, folders: Iterable[ImageFolder], note: Note) -> tuple[int, int]:
        """The image size (width, height) of about `pixels` in the shape of the first image that can be read.

        `note` gets a line if images have another aspect ratio.
        """
        assert self.pixels is not None
        shapes = {}
        for folder in folders:
            for path in folder.paths:
                with suppress(InputError):
                    shapes[path] = read_size(path, orient=folder.orient)
        if not shapes:
            raise InputError("image_size: expected images to take the shape from, got none that can be read")
        first = next(iter(shapes.values()))
        size = shape_size(first, self.pixels, getattr(self.extractor, "side_multiple", 1))
        aspect = first[0] / first[1]
        different = lambda shape: abs(shape[0] / shape[1] / aspect - 1) > _SAME_ASPECT  # noqa: E731
        if other := [path for path, shape in shapes.items() if different(shape)]:
            got = f"{len(other)} of {len(shapes)} have another aspect ratio than the first, such as {other[0]}"
            note(f"images are resized to {size[0]} x {size[1]} px, but {got}: they are squashed")
        return size

    def with_image_size(self, size: tuple[int, int]) -> "Pipeline":
        """The pipeline with an extractor of another image size (width, height), px, in the retrieval as well."""
        extractor: Any = self.extractor
        return replace(_with_part(self, extractor, replace(extractor, image_size=size)), pixels=None)


@dataclass(frozen=True)
class System:
    """Matches -> scores -> rankings: by the retrieval, by each scorer, and by combined scores.

        system = mfvpr.System(pipeline, {"histogram": mfvpr.HistogramOfShifts(), "count": mfvpr.MatchCount()})

    Attributes:
        pipeline: finds and matches candidates.
        scorers: by name.
        fused: by name of a scorer, how its score is combined with the retrieval's (ranking `name + retrieval`), and
            with other scorers' (`name + other + retrieval`).
        correlated: by name of such a ranking, how its scores depend on the queries before (`name + frames`).
        ties: equal scores keep the order of the retrieval, or go by the row of the database.
        final: name of the ranking that decides; None = that of the first scorer, or of the retrieval without scorers.
        sequences: by name of such a ranking, how the queries of a drive are ranked together (`name + causal sequence`);
            the database must be in the order of a drive as well.
        settings: that it was made from, by `mfvpr.load_system`; a map keeps them, so that `Map.open` needs no system.
    """

    pipeline: Pipeline
    scorers: Mapping[str, Scorer]
    fused: Mapping[str, Fusion] = field(default_factory=dict)
    correlated: Mapping[str, FrameCorrelation] = field(default_factory=dict)
    ties: Ties = "retrieval"
    final: str | None = None
    sequences: Mapping[str, Sequence[DriveFilter]] = field(default_factory=dict)
    settings: Mapping[str, Any] | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Raise an InputError for scorers out of their bounds, or names that are taken or unknown."""
        require_word("ties", self.ties, Ties)
        require_type("pipeline", self.pipeline, Pipeline, "Pipeline(extractor, retriever)")
        require_type("scorers", self.scorers, Mapping, '{"histogram": HistogramOfShifts()}')
        for name, filters in self.sequences.items():
            if not isinstance(filters, list | tuple) or not all(isinstance(each, DriveFilter) for each in filters):
                raise InputError(f"sequences: expected a list of DriveFilter(...) for {name}, got {filters!r}")
        if self.headline not in self.final_scores:
            raise InputError(f"final={self.final!r}: expected one of {', '.join(self.final_scores)}")
        if isinstance(self.final_scores[self.headline].step, DriveFilter):
            raise InputError(f"final={self.final!r}: a sequence cannot decide, as its first row may be no candidate")
        for name, scorer in self.scorers.items():
            if isinstance(scorer, type) or not callable(scorer):
                raise InputError(f"scorers: expected {name} to map Matches to a score, got {scorer!r}")
            if type(scorer) in SCORERS.values():
                check_bounds(scorer)

    @cached_property
    def final_scores(self) -> dict[str, FinalScore]:
        """Scores that candidates are ranked by, by name, those that are made of other ones behind them."""
        scores = [FinalScore(RETRIEVAL), *(FinalScore(name, (name,)) for name in self.scorers)]
        for name, fusion in self.fused.items():
            fusion.check(name, self.scorers)
            scores.append(FinalScore(fusion.system(name), tuple(fusion.members(name)), name, fusion))
        known = {score.name: score.scorers for score in scores[1:]}
        steps: list[tuple[str, str, str, Any]] = []
        steps += [("correlated", name, FRAMES, correlation) for name, correlation in self.correlated.items()]
        steps += [("sequences", name, each.name, each) for name, filters in self.sequences.items() for each in filters]
        for setting, name, words, step in steps:
            if name not in known:
                names = ", ".join(known) or "there are none"
                raise InputError(f"{setting}: expected names of scorers ({names}), got {name}")
            scores.append(FinalScore(f"{name} + {words}", known[name], name, step))
        by_name = {score.name: score for score in scores}
        for score in scores:
            if by_name[score.name] is not score:
                raise InputError(f"scorers: expected every name once, got {score.name} twice; choose another one")
        return by_name

    @property
    def headline(self) -> str:
        """Name of the ranking that decides."""
        return self.final or next(iter(self.scorers), RETRIEVAL)

    def with_image_size(self, size: tuple[int, int]) -> "System":
        """The system with another image size (width, height), px, also in its settings."""
        settings = self.settings
        if settings is not None:
            settings = {**settings, "features": {**settings["features"], "image_size": [*size]}}
        return replace(self, pipeline=self.pipeline.with_image_size(size), settings=settings)

    def fit_image_size(self, folders: Iterable[ImageFolder], note: Note) -> "System":
        """The system at the image size that its pipeline leaves to the images."""
        if self.pipeline.pixels is None:
            return self
        return self.with_image_size(self.pipeline.size_for_images(folders, note))


def folders_of(dataset: Dataset) -> list[ImageFolder]:
    """The folders of a data set, the database first."""
    return [dataset.database, *(sequence.images for sequence in dataset.sequences)]


def noise_images(
    size: tuple[int, int] = (64, 48), *, seeds: Sequence[int] = (0, 1), grains: Sequence[int] = (1, 2)
) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Images of random squares of some px, (width, height) px, in which every extractor finds features."""
    images, (width, height) = [], size
    for seed, grain in itertools.product(seeds, grains):
        squares = np.random.default_rng(seed).integers(0, 256, (-(-height // grain), -(-width // grain), 3), np.uint8)
        images.append(squares.repeat(grain, axis=0).repeat(grain, axis=1)[:height, :width])
    return images


def _with_part(whole: Any, part: Any, new: Any) -> Any:
    """A dataclass of parts, in which a part is replaced wherever it is."""
    if whole is part or (type(whole) is type(part) and whole == part):
        return new
    return with_parts(whole, lambda each: _with_part(each, part, new))
