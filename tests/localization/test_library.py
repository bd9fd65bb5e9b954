"""A map as a program of one's own makes, opens and calibrates it."""

import json
import warnings
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import mfvpr
from mfvpr import InputError, Map, Route
from mfvpr.datasets import FrameTruth, read_image
from mfvpr.evaluation import Ranked, calibration
from mfvpr.evaluation.dataset_ranking import RankedDataset
from mfvpr.evaluation.drives import STREETS
from mfvpr.evaluation.system import noise_images
from mfvpr.features import Aggregated, VladFitting
from mfvpr.localization import map_settings
from mfvpr.retrieval import Alternating, Retrieval, StandardizedSearch
from mfvpr.retrieval.retriever import standardizations
from mfvpr.retrieval.standardization import standardize
from mfvpr.storage import FeatureCache
from mfvpr.storage.maps import MapFile
from tests.builders import map_system
from tests.storage.extractors import SIFT, Counted

pytestmark = pytest.mark.thorough

SMALL = {"features": {"max_keypoints": 60, "image_size": [160, 120]}, "retrieval": {"num_words": 8}, "candidates": 5}


def small(name, **more):
    """A system by name with SIFT, small and quick."""
    settings = SMALL | more
    features = {f"features.{setting}": value for setting, value in settings.pop("features").items()}
    return mfvpr.load_system(name, **settings, features="sift", **features)


@pytest.fixture(scope="module")
def street(small_street, tmp_path_factory):
    return Map.create(tmp_path_factory.mktemp("map") / "map", small_street / "database", small("steering"))


def test_a_map_in_the_shape_of_its_images_is_the_same_when_it_is_opened_again(small_street, tmp_path):
    system = small("steering", features={"max_keypoints": 60, "image_size": "auto"})
    with pytest.raises(InputError, match="expected the images of a new map"):
        Map(tmp_path / "map", system)
    known, query = Map.create(tmp_path / "map", small_street / "database", system), small_street / "queries/0003.png"
    assert known.extractor.image_size == (388, 291)
    assert map_settings.read_settings(tmp_path / "map")["features"]["image_size"] == [388, 291]
    prediction = known.localize(query)
    assert prediction.shift is not None
    for again in (Map.open(tmp_path / "map"), Map(tmp_path / "map", system)):
        assert again.localize(query) == prediction
    Image.new("RGB", (50, 90)).save(tmp_path / "tall.png")
    tall = mfvpr.datasets.image_folder(tmp_path)  # the map keeps its size
    assert Map.create(tmp_path / "map", tall, system).extractor.image_size == (388, 291)
    for pixels, is_about in ((20_000, False), (80_000, True), (160_000, True), (200_000, False)):
        refused = pytest.raises(InputError, match=f"made with images of 388 x 291 px, got {pixels} pixels")
        with nullcontext() if is_about else refused:
            Map(tmp_path / "map", small("steering", features={"max_keypoints": 60, "image_size": pixels}))


def test_an_image_is_located_on_a_route(street, small_street):
    """The position is that of the route when it is called by itself, which sees the rows that the image sees."""
    by_map, by_hand = Route(), Route()
    for path in sorted((small_street / "database").iterdir())[:4]:
        prediction = street.localize(path, route=by_map, recent=2)
        alone = street.localize(path, recent=2)
        assert alone.located is None
        assert prediction == replace(alone, located=by_hand(alone, street.there[:-2]))
        assert prediction.located is not None
        assert "located" not in prediction.as_json()


def test_descriptors_are_standardized_with_and_without_a_route(small_street, tmp_path):
    """A confidence holds for images of a drive or for single ones; the candidates are the rows that the rule ranks."""
    known = Map.create(tmp_path, small_street / "database", small("steering", retrieval={"standardize": "auto"}))
    queries = sorted((small_street / "queries").iterdir())[:4]
    vectors = np.stack([known.describing.image(path)[1] for path in queries])
    rows = known._vectors[: len(known)]
    for rule, route in (("database", None), ("running", Route())):
        of_queries, of_rows = standardize(vectors, rows, rule)
        for path, query in zip(queries, of_queries, strict=True):
            listed = {each.row for each in known.localize(path, route=route).alternatives}
            assert listed == {*np.argsort(-(of_rows @ query), kind="stable")[:5].tolist()}
    with warnings.catch_warnings(action="ignore"):
        known.calibrate(small_street / "database", small_street / "queries", route=True)
    assert Map.open(tmp_path).localize(queries[0], route=Route()).confidence is not None
    with pytest.raises(InputError, match="expected one that was fitted with standardize=database, got running"):
        Map.open(tmp_path).localize(queries[0])


def test_a_confidence_is_fitted_by_the_rules_of_a_map(dataset, monkeypatch):
    """A route changes `auto`, but not a retrieval that is standardized by the database."""
    searches = [StandardizedSearch("database"), StandardizedSearch("auto")]
    retriever = Alternating(*(Retrieval(Aggregated(SIFT, VladFitting()), search) for search in searches))
    system, seen = map_system(SIFT, VladFitting()), []

    def rank(dataset, system, **_):
        seen.extend(standardizations(system.pipeline.retriever, dataset.sequences))
        raise InputError("enough")

    monkeypatch.setattr(calibration, "rank_dataset", rank)
    system = replace(system, pipeline=replace(system.pipeline, retriever=retriever))
    with pytest.raises(InputError, match="enough"):
        calibration.fit_on_drive(dataset, system, None, "running")
    assert sorted(seen) == ["database", "running"]


def test_a_robot_off_the_map_has_no_place(street, small_street):
    known, drive_route = Map(street.folder, street.system, confidence=STREETS), Route()
    frames = [read_image(path) for path in sorted((small_street / "database").iterdir())]
    on_map = [known.localize(image, route=drive_route) for image in frames[:4]]
    assert [prediction.located.row for prediction in on_map] == [*range(4)]
    for seed in range(10):
        prediction = known.localize(noise_images((160, 120), seeds=(seed,))[0], route=drive_route)
    assert (prediction.place, prediction.shift, prediction.reason) == (None, None, "off the map")
    assert (prediction.located.row, prediction.located.off > 0.9, prediction.located.p < 0.1) == (None, True, True)
    back = [known.localize(image, route=drive_route) for image in frames[4:9]]
    assert (back[-1].place, back[-1].located.row, back[-1].reason) == ("0008.png", 8, None)


def test_a_map_ranks_by_fused_scores_as_an_evaluation(small_street, tmp_path):
    """The scores are those of `system=mfvpr` in 0.2.0."""
    features = {"features": "sift", "features.max_keypoints": 60, "features.image_size": [160, 120]}
    weights = {"fusion.c": "zscore", "fusion.weights": {"retrieval": 0.5, "anchor": 1}, "final": "combined"}
    more = {"scorer": "ratio", "retrieval": "vlad", "retrieval.num_words": 8, "candidates": 5}
    fused = mfvpr.load_system("mfvpr", **features, **weights, **more)
    (tmp_path / "run.json").write_text(json.dumps({"settings": fused.settings}))
    system = mfvpr.load_system(tmp_path / "run.json")
    dataset = mfvpr.datasets.folder(small_street / "database", small_street / "database", ground_truth="none")
    result = mfvpr.evaluate(dataset, system, cache=FeatureCache(tmp_path / "cache"))
    Map.create(tmp_path / "map", dataset.database, fused)
    known = Map.open(tmp_path / "map")
    assert system.headline == "histogram + anchor + retrieval"
    [ranked] = result.only.systems[system.headline]
    for row, path in enumerate(dataset.database.paths):  # queries of so few keypoints are no better than noise
        alternatives = known.localize(path).alternatives
        assert [alternative.row for alternative in alternatives] == ranked.rows[row].tolist()
        np.testing.assert_allclose([each.score for each in alternatives], ranked.scores[row], rtol=1e-4, atol=1e-4)


def test_images_that_a_cache_knows_are_not_described_again(small_street, tmp_path):
    extractor, cache = Counted(), FeatureCache(tmp_path / "cache")
    system = map_system(extractor, VladFitting(num_words=8), candidates=5)
    dataset = mfvpr.datasets.folder(small_street / "database", small_street / "queries", ground_truth="order")
    mfvpr.evaluate(dataset, system, cache=cache)
    seen = extractor.seen
    known = Map.create(tmp_path / "map", dataset.database, system, cache=cache)
    assert extractor.seen == seen + len(noise_images())
    assert [path.name for path in (tmp_path / "map").iterdir() if "sqlite" not in path.name] == []
    extractor.seen = 0
    plain = Map.create(tmp_path / "plain", dataset.database, system)
    # The vocabulary is learned from the features that are added.
    assert extractor.seen == len(dataset.database) + len(noise_images())
    opened, extractor.seen = Map(tmp_path / "plain", system), 0
    assert opened.localize(dataset.queries.paths[0]) == plain.localize(dataset.queries.paths[0])
    assert extractor.seen == 2  # the noise images' score is in the folder
    for path in dataset.queries.paths[:3]:
        assert known.localize(path) == plain.localize(path)


def test_a_system_of_ones_own_opens_its_map(small_street, tmp_path):
    system = map_system(SIFT, VladFitting(num_words=8), candidates=5)
    Map.create(tmp_path, small_street / "database", system)
    with pytest.raises(InputError, match="of a system of your own with `Map"):
        Map.open(tmp_path)
    assert len(Map(tmp_path, system)) == 10


def test_a_map_keeps_its_confidence(small_street, tmp_path):
    known = Map.create(tmp_path, small_street / "database", small("steering"))
    query = small_street / "queries/0003.png"
    assert known.localize(query).confidence is None
    with pytest.raises(InputError, match=r"threshold=0\.5: expected .* a confidence"):
        Map.open(tmp_path, threshold=0.5)
    with pytest.raises(InputError, match=r"threshold=1\.5: expected a number from 0 to 1"):
        Map.open(tmp_path, threshold=1.5)
    with pytest.warns(UserWarning, match="there are no candidates, so that places that the map does not show"):
        confidence = known.calibrate(small_street / "database", small_street / "queries")
    assert known.confidence == confidence
    refused = [known.localize(path).reason is not None for path in sorted((small_street / "queries").iterdir())]
    assert confidence.refusals == ((sum(refused) + 2) / 20, 0.5)  # no query has candidates of other places
    assert Map.open(tmp_path).confidence == confidence
    prediction = Map.open(tmp_path).localize(query)
    assert prediction == known.localize(query)
    assert 0 < prediction.confidence < 1
    assert Map.open(tmp_path, threshold=1).localize(query).reason == "low confidence"


@pytest.mark.filterwarnings("ignore:.*calibrate on a longer drive")
def test_refusals_are_shares_of_images_on_the_map_and_of_images_of_absent_places(dataset, monkeypatch):
    """Four of six queries are on the map; three of these have candidates further than ten frames from their place."""
    rows = np.array([[0, 30], [5, 7], [20, 1], [39, 25], [3, 4], [3, 4]])
    truth = FrameTruth(((0,), (5,), (20,), (39,), (), ()), 40)
    data, system = replace(dataset, sequences=(replace(dataset.only, truth=truth),)), small("steering")
    ranked = RankedDataset(data, system, [], {system.headline: [Ranked(rows, np.tile([2.0, 1.0], (6, 1)))]}, {})
    refused = iter([[[0, 4]], [[1, 3, 5]]])  # of the queries as they are, and without their places
    lacks = lambda *_: [["blurred" if row in rows else None for row in range(6)] for rows in next(refused)]  # noqa: E731
    monkeypatch.setattr(calibration, "rank_dataset", lambda *_, **__: ranked)
    monkeypatch.setattr(calibration, "evidence_against", lacks)
    confidence, fitted = calibration.fit_on_drive(data, system, None)
    assert (fitted.num_absent, fitted.correct.tolist()) == (0, [True] * 4 + [False] * 2)
    assert confidence.refusals == pytest.approx(((1 + 2) / 14, (2 + 5) / 15))


def test_a_confidence_belongs_to_its_system(small_street, tmp_path):
    known = Map.create(tmp_path, small_street / "database", small("steering"))
    with pytest.warns(UserWarning, match="calibrate on a longer drive"):
        known.calibrate(small_street / "database", small_street / "queries")
    settings = map_settings.read_settings(tmp_path)
    settings["scorer"]["sigma"] = 30.0
    MapFile(tmp_path).write({"system": json.dumps(settings).encode()})
    with pytest.raises(InputError, match="got that of another system"):
        Map.open(tmp_path)
