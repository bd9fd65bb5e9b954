"""Errors of an evaluation's arguments and of user-defined parts: one line, before anything is done."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
import pytest

import mfvpr
from mfvpr.core.types import Shortlist
from mfvpr.datasets import FrameTruth
from mfvpr.evaluation import DriveFilter, FrameCorrelation, Fusion
from mfvpr.features import Description, Sift, VladFitting
from mfvpr.retrieval import Retrieval, RetrievalResult
from mfvpr.storage import FeatureCache
from mfvpr.utils import InputError
from tests.builders import evaluate_parts, map_system
from tests.io.checks import one_line_error
from tests.shapes import unchecked_shapes

pytestmark = pytest.mark.thorough

SIFT = Sift(max_keypoints=20, image_size=(160, 120))
FRAMES = FrameCorrelation()
HISTOGRAM = {"histogram": mfvpr.HistogramOfShifts()}


@dataclass(frozen=True)
class Fixed:
    """A retriever that gives what it is told to."""

    indices: tuple
    scores: float = 0.5

    def shortlist(self, sequence, database, num_candidates, cache):
        indices = np.tile(np.array(self.indices, np.int32), (len(sequence.images), 1))
        return RetrievalResult(
            Shortlist(indices, np.full(indices.shape, self.scores, np.float32), indices != -1), {}, {}
        )


@dataclass(frozen=True)
class Own:
    """An extractor that gives what it is told to."""

    change: str = ""
    image_size, interpolation, batch_size = SIFT.image_size, SIFT.interpolation, 3
    vector_size, scales = 0, SIFT.scales

    def __call__(self, images):
        vector = np.ones(2, np.float32) if self.change == "vector" else None
        features = [CHANGES.get(self.change, lambda image: image)(description.features) for description in SIFT(images)]
        descriptions = [Description(vector, (image,)) for image in features]
        return {"features": features, "fewer": descriptions[1:]}.get(self.change, descriptions)


def pad(features):
    """Add four slots of nonsense."""
    more = {name: np.concatenate([values, np.full((4, *values.shape[1:]), 9, values.dtype)])
            for name, values in (("keypoints", features.keypoints), ("descriptors", features.descriptors),
                                 ("scores", features.scores))}  # fmt: skip
    return replace(features, **more, mask=np.arange(len(features.mask) + 4) < len(features.mask))


CHANGES = {
    "dimension": lambda image: replace(image, descriptors=image.descriptors[:, :5]),
    "shape": lambda image: replace(image, descriptors=image.descriptors.T),
    "padded": pad,
}


def evaluate(dataset, extractor=SIFT, chosen=Fixed((0, 1, 2)), scorers=HISTOGRAM, **options):
    """Evaluate with three candidates unless the options have another number."""
    return evaluate_parts(dataset, extractor, chosen, scorers, **{"candidates": 3} | options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        *(({"candidates": wrong}, f"candidates={wrong}: expected .*all") for wrong in (0, "some", 2.5, True)),
        ({"ties": "indx"}, "ties='indx': expected one of retrieval, index"),
        ({"fused": {"nope": Fusion()}}, r"fused: .*\(histogram\), got nope"),
        ({"sequences": {"histogram": DriveFilter()}}, r"sequences: expected a list of DriveFilter"),
        ({"sequences": {"histogram": [DriveFilter()]}, "final": "histogram + causal sequence"}, "cannot decide"),
        ({"correlated": {"retrieval": FRAMES}}, r"correlated: .*\(histogram\), got retrieval"),
        ({"scorers": {"retrieval": mfvpr.MatchCount()}}, "expected every name once, got retrieval twice"),
        ({"scorers": HISTOGRAM | {"histogram + retrieval": mfvpr.MatchCount()}, "fused": {"histogram": Fusion()}},
         r"every name once, got histogram \+ retrieval twice"),
        ({"scorers": {"h": mfvpr.MatchCount}}, r"h .*got <class .*MatchCount"),
        ({"scorers": {"h": 5}}, r"scorers: .*h .*got 5"),
        ({"scorers": {"h": mfvpr.HistogramOfShifts(sigma=np.float32(-1.0))}}, "sigma=-1.0: expected a number from"),
        ({"scorers": {"v": lambda matches: matches.points0[:, 0]}}, "v: expected a number for each of"),
        ({"scorers": {"v": lambda matches: matches.points0[0, 0].astype(complex)}}, "scorer: expected real number"),
        ({"fused": {"histogram": Fusion(1.0, "euclidean")}}, "retrieval_score='euclidean': expected one of"),
        ({"fused": {"histogram": Fusion(1.0, "negative_euclidean")}, "chosen": Fixed((0, 1, 2), 3.0)},
         r"cosine .*1, got 3"),
        *(({"fused": {"histogram": Fusion(wrong)}}, f"c={wrong}: expected a number from 0 to .*, or zscore, or null")
          for wrong in ("auto", np.nan, -1.0)),
        ({"fused": {"histogram": Fusion(weights={"retrieval": 2.0})}}, r"weights: .*c='zscore'.* got c=None"),
        ({"fused": {"histogram": Fusion("zscore", weights={"anchor": 1})}},
         r"weights: .*retrieval .*\(histogram\), got anchor"),
        *(({"fused": {"histogram": Fusion("zscore", weights={"retrieval": wrong})}},
           r"weights.retrieval=.*: expected a number from 1e-06 to 1e\+12")
          for wrong in (0, np.nan, "1")),
        ({"fused": {"histogram": Fusion("zscore", weights={"count": 1})},
          "correlated": {"histogram + retrieval": FRAMES}, "scorers": HISTOGRAM | {"count": mfvpr.MatchCount()}},
         "correlated: expected .* got histogram [+] retrieval"),
        *(({"chosen": Fixed((0, 1, wrong))}, rf"Fixed: .*0 to 9, got \[0, 1, {wrong}\] for query 0")
          for wrong in (10, 1)),
        ({"chosen": Fixed((0, 1))}, r"Fixed: .*indices .*scores .*mask .*\[10, 3\]"),
        ({"chosen": Fixed((0, 1, 2), np.nan)}, "Fixed: expected finite scores"),
        ({"chosen": Retrieval(SIFT)}, r"Sift: .*global descriptor.*Aggregated"),
        ({"extractor": Own("fewer")}, r"Own: .*Description .*3 images, got 2"),
        ({"extractor": Own("features")}, "Own: expected a Description, got Features"),
        ({"extractor": Own("dimension")}, r"Own: .*\[128\] .*got \[5\]"),
        ({"extractor": Own("shape")}, r"Features.descriptors: expected shape \[20, 20\] beside a mask \[20\]"),
        ({"extractor": Own("vector")}, r"Own: .*vector_size=0 numbers, got 2"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_told(dataset, options, words):
    with unchecked_shapes(), pytest.raises(InputError, match=words):
        evaluate(dataset, **options)


def test_other_types_are_told_with_an_example(dataset, tmp_path):
    parts = map_system(SIFT, VladFitting(num_words=8))
    for call, name in (
        (lambda: mfvpr.evaluate(dataset, "mfvpr"), "system"),
        (lambda: mfvpr.evaluate("day", parts), "data"),
        (lambda: mfvpr.System(parts.pipeline, mfvpr.MatchCount()), "scorers"),
        (lambda: mfvpr.System("sift", parts.scorers), "pipeline"),
        (lambda: mfvpr.Map(tmp_path / "map", "mfvpr"), "system"),
    ):
        with one_line_error(f"^{name}: expected a .*, such as .*, got "):
            call()


def test_padding_of_ones_own_extractor_is_dropped(dataset, tmp_path):
    expected, *got = (
        evaluate(dataset, extractor, cache=cache).matched[0].matches[0].counts
        for extractor, cache in ((SIFT, None), (Own("padded"), None), (Own("padded"), FeatureCache(tmp_path)))
    )
    for counts in got:
        np.testing.assert_array_equal(counts, expected)


def test_no_scorer_is_retrieval_alone(dataset):
    result = evaluate(dataset, scorers={}, candidates=np.int64(3))
    assert list(result.systems) == ["retrieval"]
    [ranked] = result.systems["retrieval"]
    np.testing.assert_array_equal(ranked.shortlist.indices, ranked.rows)


def test_scores_that_are_nan_are_told(dataset):
    lines = []
    counts = [matched.matches[0].counts for matched in evaluate(dataset).matched]
    few = float(np.median(counts[0][counts[0] > 0]))

    def scorer(matches):
        count = matches.mask.sum().astype(jnp.float32)
        return jnp.where(count > few, jnp.nan, count)

    scorers = {"n": scorer}
    evaluate(dataset, scorers=scorers, cache=FeatureCache(runtime=mfvpr.Runtime(log=lines.append)))
    assert any("of n are NaN" in line for line in lines)
    lines.clear()  # of a single candidate every z-score is 0
    options = {"chosen": Fixed((4,)), "candidates": 1, "fused": {"n": Fusion("zscore")}}
    evaluate(dataset, scorers=scorers, cache=FeatureCache(runtime=mfvpr.Runtime(log=lines.append)), **options)
    assert any("of n + retrieval are NaN" in line for line in lines)


@pytest.mark.parametrize("scorer", [lambda matches: jnp.inf * jnp.sum(matches.distance), mfvpr.GridAnchors()])
def test_a_scorer_of_nothing_but_nan_is_refused(dataset, scorer):
    with pytest.raises(InputError, match=r"^n: .*NaN"):
        evaluate(dataset, scorers={"n": scorer})


def test_a_ground_truth_of_other_images_is_told(dataset):
    other = replace(dataset.only, truth=FrameTruth(tuple((row,) for row in range(9)), 10))
    result = evaluate(replace(dataset, sequences=(other,)))
    with pytest.raises(InputError, match=r"10 queries.*10 .*got .*9"):
        result.recall([0])
    with pytest.raises(InputError, match=r"ks=\[0\]: expected depths from 1"):
        result.recall([0], [0])
    with pytest.raises(InputError, match="threshold=-1: expected a number from 0"):
        result.recall([-1])
