"""A map: the predictions of an evaluation, whole rows only, and no place without evidence."""

import re
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import mfvpr
from mfvpr.core.types import Features
from mfvpr.datasets import image_folder, read_image
from mfvpr.evaluation import Confidence
from mfvpr.evaluation.evidence import LEAST_MATCHES
from mfvpr.evaluation.stages import explain
from mfvpr.evaluation.system import noise_images
from mfvpr.features import Aggregated, Description, Scale, Sift, VladFitting
from mfvpr.localization import Map, Prediction, query_steps
from mfvpr.localization.query_steps import match_and_score
from mfvpr.retrieval import Alternating, Retrieval, StandardizedSearch
from mfvpr.storage import FeatureCache
from mfvpr.storage.maps import check_entry
from mfvpr.utils import InputError
from tests import scorers
from tests.builders import evaluate_parts, make_features, map_system
from tests.core.test_types import Tensor as TensorWithGradient
from tests.io.checks import one_line_error
from tests.programs import snapshot
from tests.storage.synthetic_features import assert_same

pytestmark = pytest.mark.thorough

SIFT, VLAD = Sift(max_keypoints=60, image_size=(160, 120)), VladFitting(num_words=8)
SURE = Confidence((0.0, 0.0), (1.0, 1.0), (1.0, 1.0), 0.0)


@pytest.fixture(scope="module")
def folder(dataset, tmp_path_factory):
    """A map of the database, whose places are rows."""
    folder = tmp_path_factory.mktemp("maps") / "map"
    Map(folder, map_system(SIFT, VLAD)).build(dataset.database, list(range(len(dataset.database))))
    return folder


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
    monkeypatch.setattr(query_steps, "_PAIRS_AT_ONCE", 2)  # of five candidates
    for cores in (1, 2, 3, 7):
        monkeypatch.setattr(query_steps, "available_cpus", lambda cores=cores: cores)
        predictions.append([opened(folder).localize(path).as_json() for path in dataset.queries.paths[:4]])
    assert predictions[1:] == predictions[:1] * 3


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
    low, high = np.array(prediction.shift_interval)
    assert ((low < prediction.shift) & (prediction.shift < high)).all()
    assert prediction.shift_fraction == pytest.approx(np.divide(prediction.shift, width, dtype=np.float64), abs=1e-12)
    assert prediction.shift_fraction == pytest.approx((0.125, 0), abs=0.005)
    expected = [np.rad2deg(np.arctan(2 * x / width * np.tan(np.deg2rad(80.0) / 2)))
                for x, _ in (prediction.shift, *prediction.shift_interval)]  # fmt: skip
    assert prediction.shift_angles(80.0) == pytest.approx(expected, rel=1e-12)
    assert prediction.as_json()["shift_fraction"] == prediction.shift_fraction
    for field_of_view in (180, 1.2, np.nan):
        with pytest.raises(InputError, match=r"field_of_view=.*: expected degrees"):
            prediction.shift_angles(field_of_view)


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
    prediction = known.localize_with_evidence(image, recent=2, before=np.uint8(6)).prediction
    assert sorted(rows_of(prediction)) == [0, 1, 2, 3]
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
    sure = opened(folder, candidates=10, confidence=SURE).localize(image)
    assert 0.5 < sure.confidence <= 1
    assert sure.place is not None
    assert sure.reason is None
    refused = opened(folder, candidates=10, confidence=replace(SURE, bias=-100.0), threshold=0.5).localize(image)
    assert refused.place is None
    assert refused.confidence < 1e-9
    assert (refused.reason, refused.shift, refused.shift_interval) == ("low confidence", None, None)
    assert refused.alternatives == sure.alternatives
    assert opened(folder, candidates=10, confidence=SURE, threshold=sure.confidence).localize(image).place == sure.place


def test_images_come_one_by_one_and_others_see_them(dataset, tmp_path):
    adding, names = opened(tmp_path / "map"), dataset.database.names
    other = opened(tmp_path / "map")
    with pytest.raises(InputError, match="expected a map with images, got an empty one"):
        other.localize(dataset.queries.paths[0])
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
    with pytest.raises(InputError, match="expected one for an image that is no file"):
        adding.add(dataset.database.read(0), 0)


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
        (replace(SIFT, max_keypoints=50), VLAD, "other extractor"),
        (SIFT, VladFitting(num_words=4), "other describers"),
    ):
        with pytest.raises(InputError, match=f"made with {words}. Use what"):
            Map(folder, map_system(extractor, describer))


JSON = "expected a place that JSON can say"


@pytest.mark.parametrize(("name", "place", "words"), [
    ("a.jpg", None, JSON), ("a.jpg", float("nan"), JSON), ("a.jpg", {1, 2}, JSON),
    ("a.jpg", (1.0, 2.0), "(1.0, 2.0), which JSON gives back as [1.0, 2.0]"),
    ("a.jpg", {3: "room"}, "which JSON gives back as"),
    (("drive1", 9), 0, "name: expected text, got "), (5, 0, "name: expected text, got "),
], ids=lambda value: type(value).__name__)  # fmt: skip
def test_nothing_is_written_of_other_places_and_names(dataset, tmp_path, name, place, words):
    check_entry("a.jpg", [1, {"x": {"y": [None, "\udcff"]}}])
    known, image = Map(tmp_path / "map", map_system(Constant(), Constant())), replace(dataset.database, names=(name,))
    for add in (lambda: known.add(dataset.database.paths[0], place, name=name), lambda: known.build(image, [place])):
        with pytest.raises(InputError, match=rf"^[^\n]*{re.escape(words)}[^\n]*$"):
            add()
    assert not (tmp_path / "map").exists()


def test_scores_that_are_never_finite_are_refused(dataset, folder):
    """The grid's anchors expect as many keypoints as the grid has cells."""
    with pytest.raises(InputError, match=r"^it: every score of a pair that has matches is NaN or infinite"):
        opened(folder, scorer=mfvpr.GridAnchors()).localize(dataset.queries.paths[0])


@pytest.mark.parametrize("number", [-1, 1.5, "2"])
def test_numbers_of_rows_are_whole_and_not_negative(dataset, folder, number):
    known, image = opened(folder), dataset.database.paths[7]
    for limit in ({"recent": number}, {"before": number}, {"recent": None}):
        with pytest.raises(InputError, match=r"^(recent|before)=[^\n]*: expected a whole number [^\n]+$"):
            known.localize_with_evidence(image, **limit)


class Tensor:
    """Refuses to become an array, as tensors with gradients do."""

    def __array__(self, *_, **__):
        raise RuntimeError("call detach()\nfirst")


@pytest.mark.parametrize("image", [
    np.zeros((4, 4, 2), np.uint8), np.zeros((4, 4, 5), np.uint8), np.full((4, 4, 3), 2.0),
    np.zeros((0, 4, 3), np.uint8), np.zeros((4, 4), int), None, Tensor(), np.full((4, 4), np.nan),
])  # fmt: skip
def test_arrays_are_images(folder, image):
    with pytest.raises(InputError, match=r"^image: .*\[H, W, 3\] RGB .*got [^\n]+$"):
        opened(folder).localize(image)


def test_images_come_as_cameras_and_networks_give_them(dataset):
    path = dataset.database.paths[0]
    pixels = read_image(path)
    gray = pixels[..., 0]
    opaque = np.dstack([pixels, np.full(gray.shape, 255, np.uint8)])
    for image in (path.read_bytes(), opaque, pixels.astype(np.uint16) << 8, pixels / 255, jnp.asarray(pixels / 255)):
        np.testing.assert_array_equal(query_steps.load(image), pixels)
    for image in (gray, gray[..., None], gray / np.float32(255)):
        np.testing.assert_array_equal(query_steps.load(image), np.dstack([gray] * 3))
    with one_line_error("image: expected the bytes of an image file, got 8: "):
        query_steps.load(b"no image")


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


@pytest.mark.parametrize("rule", ["none", "database"])
def test_two_retrievals_in_turns_answer_as_an_evaluation(dataset, tmp_path, rule):
    """One aggregates the local features, the other has an extractor of its own."""
    second = Retrieval(Constant(), StandardizedSearch(rule))
    retriever = Alternating(Retrieval(Aggregated(SIFT, VLAD)), second)
    system = map_system(SIFT, VLAD, candidates=5)
    known = Map(tmp_path / "map", replace(system, pipeline=replace(system.pipeline, retriever=retriever)))
    known.learn(dataset.database)
    known.build(replace(dataset.database, names=dataset.database.names[:9]))
    for path, name in zip(dataset.database.paths[9:], dataset.database.names[9:], strict=True):
        known.add(path, name, name=name)
    result = evaluate_parts(dataset, SIFT, retriever, dict(system.scorers), candidates=5)
    [ranked] = result.systems["histogram"]
    for query, path in enumerate(dataset.queries.paths):
        prediction = known.localize(path)
        if prediction.reason != "no better than noise":
            assert rows_of(prediction) == ranked.rows[query].tolist()


def test_the_robots_hood_is_ignored_as_in_an_evaluation(small_street, tmp_path):
    hood = np.full((240, 320), 255, np.uint8)
    hood[120:] = 0
    Image.fromarray(hood).save(tmp_path / "hood.png")
    database = image_folder(small_street / "database", masks=tmp_path / "hood.png")
    known = Map.create(tmp_path / "map", database, map_system(SIFT, VladFitting(num_words=8), candidates=5))
    path = small_street / "queries" / "0003.png"
    localized = known.localize_with_evidence(path, mask=tmp_path / "hood.png")
    with pytest.warns(UserWarning, match="expected a mask, as with the images of the map, got none"):
        masked, plain = localized.described[0], known.localize_with_evidence(path).described[0]
    height = SIFT.image_size[1]
    assert masked.keypoints[:, 1].max() < height / 2 < plain.keypoints[:, 1].max()
    queries = image_folder(small_street / "queries", masks=tmp_path / "hood.png")
    assert_same(masked, FeatureCache(tmp_path / "cache").local(queries, SIFT)[0][3])
    with one_line_error(r"missing\.png: "):
        known.localize(path, mask=tmp_path / "missing.png")
    with pytest.warns(UserWarning, match="calibrate on a longer drive"):
        known.calibrate(small_street / "database", small_street / "queries", masks=tmp_path / "hood.png")


def test_candidates_are_among_rows_or_near_a_place(dataset, tmp_path):
    known = Map(tmp_path / "map", map_system(SIFT, VLAD, candidates=4))
    known.build(dataset.database, [[10.0 * row, 0.0] for row in range(len(dataset.database))])
    image = dataset.database.paths[7]
    assert sorted(rows_of(known.localize(image, among={7, 2, np.int64(3)}))) == [2, 3, 7]
    assert sorted(rows_of(known.localize(image, near=([70, 8.0], 13)))) == [6, 7, 8]
    assert rows_of(known.localize(image, near=([70, 0], 13), among=[0, 6, 8], recent=len(known) - 7)) == [6]
    assert known.localize(image, among=[]).reason == "no candidates"
    known.confidence = SURE
    assert known.localize(image).confidence is not None
    assert known.localize(image, among=[7, 2]).confidence is None
    known.threshold = 0.5
    with one_line_error("threshold=0.5: expected candidates of the whole map"):
        known.localize(image, near=([70, 8.0], 13))
    known.threshold = None
    for mistake in ({"among": 7}, {"among": [len(known)]}, {"among": [0.5]}, {"among": [True]}, {"near": ([0], 5)},
                    {"near": ([np.nan], 5)}, {"near": ("here", 5)}, {"near": ([0, 0], -1)}, {"near": 5}):  # fmt: skip
        with pytest.raises(InputError, match=r"^(among|near)=[^\n]*: expected [^\n]*$"):
            known.localize(image, **mistake)


# Images without a place


def without_place(reason, image):
    return Prediction(reason=reason, image_width=image.shape[1])


@pytest.mark.parametrize("kind", ["black", "gray", "dark noise", "lens cap"])
def test_images_of_nothing_have_no_place_whatever_the_confidence(folder, kind):
    rng, values = np.random.default_rng(0), {"black": 0, "gray": 90, "dark noise": 5}
    image = np.full((480, 640, 3), values.get(kind, 0), np.uint8)
    if kind == "dark noise":
        image += rng.integers(0, 5, image.shape, np.uint8)
    if kind == "lens cap":  # with a little light at its rim
        image[:, :40] = np.arange(40, 0, -1)[:, None]
    prediction, _, matches = opened(folder, confidence=replace(SURE, bias=100.0)).localize_with_evidence(image)
    assert (prediction, matches) == (without_place("too few features", image), None)
    assert (prediction.as_json()["reason"], prediction.image_width) == ("too few features", 640)
    assert (prediction.shift_fraction, prediction.shift_angles(60)) == (None, None)


def test_strong_features_with_few_matches_have_no_place(folder):
    image = np.zeros((120, 160, 3), np.uint8)
    image[40:60, 70:95] = 255
    prediction, (features, _), matches = opened(folder, confidence=SURE).localize_with_evidence(image)
    assert 0 < len(features.scores) < LEAST_MATCHES
    assert (prediction, matches) == (without_place("too few matches", image), None)


@pytest.mark.parametrize("grain", [1, 3])
def test_noise_has_no_place_whatever_the_confidence(folder, grain):
    image = noise_images((160, 120), seeds=(7,), grains=(grain,))[0]
    prediction = opened(folder, confidence=replace(SURE, bias=100.0)).localize(image)
    assert prediction == without_place("no better than noise", image)


@dataclass(frozen=True)
class Bright(Constant):
    """Keypoints as strong as the image is bright."""

    def describe(self, image):
        vector, (features,) = super().describe(image)
        return Description(vector, (replace(features, scores=np.full(9, image.max() / 255, np.float32)),))


def test_rows_that_are_left_out_do_not_say_how_strong_a_query_must_be(tmp_path):
    rng, known = np.random.default_rng(0), Map(tmp_path / "map", map_system(Bright(), Bright(), candidates=3))
    images = [rng.integers(0, 2 if row < 3 else 256, (3, 4, 3), np.uint8) for row in range(8)]
    images = [image.repeat(4, axis=0).repeat(4, axis=1) for image in images]
    for row, image in enumerate(images):
        known.add(image, row, name=str(row))
    assert known.localize(images[0]).reason == "too few features"
    assert known.localize_with_evidence(images[0], before=3).prediction.place == 0


# Matches and scores


def test_a_pair_is_padded_by_its_own_keypoints_and_is_the_same_alone():
    rng, sizes = np.random.default_rng(0), set()

    def matcher(query, candidate):
        sizes.add((len(query.mask), len(candidate.mask)))
        return mfvpr.match(query, candidate, with_ratio=True)

    query, scorers = make_features(rng, 40), {"it": mfvpr.MatchCount()}
    images = [make_features(rng, count) for count in (600, *[300] * 9)]
    matches, scores = match_and_score(query, images, matcher, scorers, 300)
    assert sizes == {(256, 320), (256, 1024)}
    for number in (0, 1, 9):
        [alone], alone_scores = match_and_score(query, [images[number]], matcher, scorers, 300)
        np.testing.assert_array_equal(alone.points1, matches[number].points1)
        np.testing.assert_array_equal(alone_scores["it"], scores["it"][[number]])
        assert matches[number].mask.any()
