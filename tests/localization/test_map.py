"""A map: the predictions of an evaluation, whole rows only, and no place without evidence."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

import mfvpr
from mfvpr.core.types import Features
from mfvpr.evaluation import Confidence
from mfvpr.evaluation.stages import explain
from mfvpr.features import Aggregated, Description, Scale, Sift, VladFitting
from mfvpr.localization import Map
from mfvpr.localization import map as map_module
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
from mfvpr.storage.maps import MapFile, check_entry
from mfvpr.utils import InputError
from tests import scorers
from tests.builders import evaluate_parts, map_system
from tests.core.test_types import Tensor as TensorWithGradient
from tests.programs import snapshot

pytestmark = pytest.mark.thorough

SIFT, VLAD = Sift(max_keypoints=60, image_size=(160, 120)), VladFitting(num_words=8)
SURE = Confidence(1, (0.0, 0.0), (1.0, 1.0), (1.0, 1.0), 0.0)


def opened(folder, *, scorer=None, candidates=5, **options):
    return Map(folder, map_system(SIFT, VLAD, scorer, candidates), **options)


def rows_of(prediction):
    return [alternative.row for alternative in prediction.alternatives]


def test_answers_are_those_of_an_evaluation_with_a_store(dataset, folder, tmp_path):
    """Also by scores of others: a plain function, one that holds a key, and OpenCV's on the host."""
    systems = {"histogram": mfvpr.HistogramOfShifts(), "plain": scorers.plain,
               "sampled": scorers.Sampled(jax.random.key(0)), "host": mfvpr.OpenCvHomography()}  # fmt: skip
    retriever = Retrieval(Aggregated(SIFT, VLAD))
    result = evaluate_parts(dataset, SIFT, retriever, systems, candidates=5, cache=FeatureCache(tmp_path))
    for name, scorer in systems.items():
        [ranked], known, refused = result.systems[name], opened(folder, scorer=scorer), []
        for query, path in enumerate(dataset.queries.paths):
            prediction = known.localize(path)
            if prediction.reason == "no better than noise":  # a small image at night
                refused.append(query)
                continue
            assert rows_of(prediction) == ranked.rows[query].tolist()
            scores = [alternative.score for alternative in prediction.alternatives]
            np.testing.assert_allclose(scores, ranked.scores[query], rtol=1e-5)
            assert (prediction.place, prediction.score) == (ranked.rows[query, 0], scores[0])
        assert len(refused) < len(dataset.queries) / 2


def test_answers_do_not_depend_on_the_cores(dataset, folder, monkeypatch):
    predictions = []
    monkeypatch.setattr(map_module, "_PAIRS_AT_ONCE", 2)  # of five candidates
    for cores in (1, 2, 3, 7):
        monkeypatch.setattr(map_module, "available_cpus", lambda cores=cores: cores)
        predictions.append([opened(folder).localize(path).as_json() for path in dataset.queries.paths[:4]])
    assert predictions[1:] == predictions[:1] * 3


def test_an_image_of_the_map_is_found_where_it_is(dataset, folder):
    prediction = opened(folder).localize(dataset.database.read(3))
    assert (prediction.place, prediction.alternatives[0].name) == (3, dataset.database.names[3])
    np.testing.assert_allclose(prediction.shift, 0, atol=0.5)
    (low_x, low_y), (high_x, high_y) = prediction.shift_interval
    assert low_x <= prediction.shift[0] <= high_x
    assert low_y <= prediction.shift[1] <= high_y
    assert prediction.reason is None
    assert len(prediction.as_json(2)["alternatives"]) == 2


@pytest.mark.parametrize("width", [320, 640])
def test_a_shift_is_in_px_of_the_image_that_was_given(small_street, tmp_path, width):
    """A pair with a shift of an eighth of the width, in an image size of another shape."""
    height, moved = 3 * width // 8, width // 8
    scene = np.asarray(Image.open(small_street / "database/0000.png").resize((width + moved, height)))
    Image.fromarray(scene[:, :width]).save(tmp_path / "candidate.png")
    sift = Sift(max_keypoints=300, image_size=(200, 200))
    scorer = mfvpr.HistogramOfShifts(bin_size=3.0, sigma=5.0)
    known = Map(tmp_path / "map", map_system(sift, VladFitting(num_words=2), scorer))
    known.build(mfvpr.datasets.image_folder(tmp_path))
    prediction = known.localize(scene[:, moved:])
    assert prediction.image_width == width
    assert prediction.shift == pytest.approx((moved, 0), abs=width / 200)
    assert prediction.shift_fraction == pytest.approx(np.divide(prediction.shift, width, dtype=np.float64), abs=1e-12)
    assert prediction.shift_fraction == pytest.approx((0.125, 0), abs=0.005)
    expected = [np.rad2deg(np.arctan(2 * x / width * np.tan(np.deg2rad(80.0) / 2)))
                for x, _ in (prediction.shift, *prediction.shift_interval)]  # fmt: skip
    assert prediction.shift_angles(80.0) == pytest.approx(expected, rel=1e-12)
    assert prediction.as_json()["shift_fraction"] == prediction.shift_fraction
    for field_of_view in (180, 1.2, np.nan):
        with pytest.raises(InputError, match=r"field_of_view=.*: expected degrees"):
            prediction.shift_angles(field_of_view)


def test_without_a_shift_there_is_no_angle(dataset, folder):
    prediction = opened(folder).localize(np.full((30, 40, 3), 90, np.uint8))
    assert (prediction.shift_fraction, prediction.shift_angles(60), prediction.image_width) == (None, None, 40)


def test_a_question_keeps_what_it_was_answered_with(dataset, folder):
    known = opened(folder)
    for path in dataset.queries.paths[:3]:
        prediction, (features, vector), matches = known.localize_with_evidence(path)
        assert prediction == known.localize(path)
        [scorer] = known.system.scorers.values()
        assert scorer(matches) == pytest.approx(prediction.score, rel=1e-5)
        best = prediction.alternatives[0]
        assert (known.row(best.name), known.place(best.row)) == (best.row, best.place)
        keypoints = {tuple(point) for point in features.keypoints.tolist()}
        assert {tuple(point) for point in matches.points0[matches.mask].tolist()} <= keypoints
        assert vector @ vector == pytest.approx(1, rel=1e-5)
        np.testing.assert_allclose(2 * explain(scorer, matches).peak, prediction.shift, atol=2e-4)  # of 320 x 240 px
    assert known.row("no such") is None
    assert known.there.tolist() == [True] * len(dataset.database)


def test_the_newest_rows_can_be_left_out(dataset, folder):
    known, last, image = opened(folder), len(dataset.database) - 1, dataset.database.paths[7]
    prediction, _, matches = known.localize_with_evidence(image, recent=2, before=6)
    assert sorted(rows_of(prediction)) == [0, 1, 2, 3]
    assert matches.mask.any()
    assert known.localize_with_evidence(image, recent=np.int64(2), before=np.uint8(6)).prediction == prediction
    prediction, _, matches = known.localize_with_evidence(image, recent=2, before=2)
    assert (prediction.place, prediction.alternatives, matches) == (None, (), None)
    assert prediction.reason == "no candidates"
    assert max(rows_of(known.localize(dataset.database.paths[last], recent=3))) == last - 3
    assert known.localize(dataset.database.paths[last], recent=last + 1).alternatives == ()


def test_nothing_is_compiled_after_the_warm_up(dataset, folder, compilations):
    known, before = opened(folder), snapshot(folder)
    known.warm_up()
    assert compilations.count
    compilations.reset()
    predictions = [known.localize(path) for path in dataset.queries.paths]
    assert compilations.count == 0
    assert snapshot(folder) == before
    assert predictions == [opened(folder).localize(path) for path in dataset.queries.paths]
    with pytest.raises(InputError, match="expected a map with images"):
        opened(folder.with_name("empty")).warm_up()


def test_unsure_answers_are_no_place(dataset, folder):
    image = dataset.queries.paths[0]
    sure = opened(folder, confidence=SURE).localize(image)
    assert 0.5 < sure.confidence <= 1
    assert sure.place is not None
    assert sure.reason is None
    refused = opened(folder, confidence=replace(SURE, bias=-100.0), threshold=0.5).localize(image)
    assert refused.place is None
    assert refused.confidence < 1e-9
    assert (refused.reason, refused.shift, refused.shift_interval) == ("low confidence", None, None)
    assert refused.alternatives == sure.alternatives
    assert opened(folder, confidence=SURE, threshold=sure.confidence).localize(image).place == sure.place
    with pytest.raises(InputError, match="expected a confidence as well"):
        opened(folder, threshold=0.5)


def test_images_come_one_by_one_and_others_see_them(dataset, tmp_path):
    adding, names = opened(tmp_path / "map"), dataset.database.names
    other = opened(tmp_path / "map")
    for known in (adding, other):
        with pytest.raises(InputError, match="expected a map with images, got an empty one"):
            known.localize(dataset.queries.paths[0])
    with pytest.raises(InputError, match="no vocabulary yet; `learn`"):
        adding.add(dataset.database.paths[0], 0)
    adding.learn(dataset.database)
    for row, path in enumerate(dataset.database.paths):
        adding.add(path, {"row": row}, name=names[row])
        assert other.localize(path).place == {"row": row}
        assert len(other) == row + 1
    assert other.names == adding.names == list(names)
    with pytest.raises(InputError, match="has an image of this name"):
        adding.add(dataset.database.paths[0], 0, name=names[0])
    for image in (dataset.database.read(0), None):
        with pytest.raises(InputError, match="expected one for an image that is no file"):
            adding.add(image, 0)


def test_a_file_has_one_name_under_every_spelling(dataset, tmp_path, monkeypatch):
    known, (root, name) = opened(tmp_path / "map"), (dataset.database.root, dataset.database.names[0])
    known.learn(dataset.database)
    (tmp_path / "link").symlink_to(root)
    monkeypatch.chdir(root.parent)
    known.add(f"{root.name}/{name}", 0)
    for spelling in (root / name, f"{root.name}/./{name}", tmp_path / "link" / name):
        with pytest.raises(InputError, match="the map has an image of this name"):
            known.add(spelling, 0)


def test_a_map_goes_on_where_it_was(dataset, tmp_path):
    opened(tmp_path / "map").build(replace(dataset.database, names=dataset.database.names[:4]))
    again = opened(tmp_path / "map")
    assert [again.build(dataset.database) for _ in range(2)] == [len(dataset.database) - 4, 0]
    assert again.names == list(dataset.database.names)
    assert again.localize(dataset.database.paths[6]).place == dataset.database.names[6]
    with pytest.raises(InputError, match="a place of each of"):
        again.build(dataset.database, [1])


def test_a_map_of_other_settings_is_refused(folder):
    for extractor, describer, words in (
        (replace(SIFT, max_keypoints=50), VLAD, "another extractor"),
        (SIFT, VladFitting(num_words=4), "another describer"),
        (SIFT, Constant(), "another describer"),
    ):
        with pytest.raises(InputError, match=f"made with {words}. Use the settings"):
            Map(folder, map_system(extractor, describer))


def test_the_least_recently_used_features_make_room(folder, monkeypatch):
    read, features = [], MapFile.features
    known = opened(folder)
    monkeypatch.setattr(MapFile, "features", lambda self, rows: (read.extend(rows), features(self, rows))[1])
    known._free_bytes = 3.5 * sum(leaf.nbytes for leaf in jax.tree.leaves(known._read_features([0])[0]))
    known._features.clear()
    read.clear()
    for rows in ([0, 1, 2], [0, 3], [0], [1], [2, 3]):
        assert [len(each.scores) for each in known._read_features(rows)] == [60] * len(rows)
    assert read == [0, 1, 2, 3, 1, 2]


JSON = "expected a place that JSON can say"


@pytest.mark.parametrize(("name", "place", "words"), [
    ("a.jpg", None, JSON), ("a.jpg", float("nan"), JSON), ("a.jpg", {1, 2}, JSON), ("a.jpg", 10**5000, JSON),
    ("a.jpg", (1.0, 2.0), "(1.0, 2.0), which JSON gives back as [1.0, 2.0]"),
    ("a.jpg", {"at": [(1, 2)]}, "which JSON gives back as"),
    ("a.jpg", {3: "room"}, "which JSON gives back as"),
    *((name, 0, "name: expected text, got ") for name in (("drive1", 9), ["l"], 5, b"b", Path("x"), float("nan"))),
], ids=lambda value: type(value).__name__)  # fmt: skip
def test_other_places_and_names_are_refused(name, place, words):
    check_entry("a.jpg", [1, {"x": {"y": [None, "\udcff"]}}])
    with pytest.raises(InputError, match=re.escape(words)) as error:
        check_entry(name, place)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400


@pytest.mark.parametrize(("name", "place"), [(("drive1", 9), 0), ("a.jpg", None)])
def test_nothing_is_written_of_an_entry_that_is_refused(dataset, tmp_path, name, place):
    known, image = Map(tmp_path / "map", map_system(Constant(), Constant())), replace(dataset.database, names=(name,))
    for add in (lambda: known.add(dataset.database.paths[0], place, name=name), lambda: known.build(image, [place])):
        with pytest.raises(InputError, match=r"expected (text|a place)"):
            add()
    assert not (tmp_path / "map").exists()


@pytest.mark.parametrize("scorer", [lambda matches: np.nan * matches.distance.sum(), mfvpr.GridAnchors()])
def test_scores_that_are_never_finite_are_refused(dataset, folder, scorer):
    """The grid's anchors expect as many keypoints as the grid has cells."""
    with pytest.raises(InputError, match=r"^it: every score of a pair that has matches is NaN or infinite"):
        opened(folder, scorer=scorer).localize(dataset.queries.paths[0])


@pytest.mark.parametrize("number", [-1, 1.5, "2", np.arange(4).reshape(2, 2), np.int64(-3)], ids=repr)
def test_numbers_of_rows_are_whole_and_not_negative(dataset, folder, number):
    known, image = opened(folder), dataset.database.paths[7]
    for ask in (lambda: known.localize_with_evidence(image, recent=number),
                lambda: known.localize_with_evidence(image, before=number),
                lambda: known.localize(image, recent=number), lambda: opened(folder, candidates=number)):  # fmt: skip
        with pytest.raises(InputError, match=r"^(recent|before|candidates).*: expected a whole number [^\n]+$"):
            ask()
    with pytest.raises(InputError, match=r"^recent=null: expected a whole number"):
        known.localize(image, recent=None)


class Tensor:
    """Refuses to become an array, as tensors with gradients do."""

    def __array__(self, *_, **__):
        raise RuntimeError("call detach()\nfirst")


@pytest.mark.parametrize("image", [
    np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((4, 4, 4), np.uint8), np.zeros((0, 4, 3), np.uint8),
    None, Tensor(), b"0.png", [[[0, 0, 0]], []],
])  # fmt: skip
def test_arrays_are_images(folder, image):
    with pytest.raises(InputError, match=r"^image: .*\[H, W, 3\] uint8 .*got [^\n]+$"):
        opened(folder).localize(image)


def test_images_may_be_what_numpy_converts(dataset, folder):
    known, pixels = opened(folder), dataset.database.read(3)
    expected = known.describing.image(dataset.database.paths[3])[1]
    for image in (pixels, jax.numpy.asarray(pixels), Image.fromarray(pixels), TensorWithGradient(pixels)):
        np.testing.assert_array_equal(known.describing.image(image)[1], expected)


@dataclass(frozen=True)
class Constant:
    """Both features and a global descriptor, of few pixels."""

    recipe = "constant"
    image_size: tuple[int, int] = (16, 12)
    interpolation: str = "pil_bilinear"
    batch_size: int = 4
    vector_size: int = 36
    scales: tuple[Scale, ...] = (Scale(9, 9),)

    def __call__(self, images):
        return [self.describe(image) for image in images]

    def describe(self, image):
        small = image[::4, ::4].astype(np.float32).reshape(-1)
        vector = (small - small.mean()) / (np.linalg.norm(small - small.mean()) + 1e-9)
        points = np.array([[x, y] for x in (1.0, 5.0, 9.0) for y in (2.0, 3.0, 6.0)], np.float32)
        features = Features(points, np.eye(9, dtype=np.float32), np.ones(9, np.float32), np.ones(9, bool),
                            np.array([16.0, 12.0]))  # fmt: skip
        return Description(vector, (features,))


def test_descriptors_may_be_the_extractors_own_or_anothers(dataset, tmp_path):
    same = Constant()
    for extractor, describer in ((same, same), (SIFT, same)):
        known = Map(tmp_path / type(extractor).__name__, map_system(extractor, describer, candidates=3))
        known.build(dataset.database)
        known.add(dataset.queries.paths[0], "a query", name="q")
        for image in (*dataset.database.paths, dataset.queries.paths[0]):
            assert len(known.localize(image).alternatives) == 3
