"""Products of bfloat16 that are checked, against checked products of all pairs in NumPy."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mfvpr
from mfvpr.core import checked
from mfvpr.core.matching import match, match_prepared
from mfvpr.core.nearest import ready
from tests.builders import make_features, stack, unit

pytestmark = [pytest.mark.optimized, pytest.mark.thorough]

DIMENSIONS = 96
KINDS = ("random", "positive", "twins", "near twins", "not unit", "tiny", "huge", "broken", "half")
rounded_once = jax.jit(
    lambda query, candidates, with_ratio: mfvpr.match_candidates(
        query, candidates, with_ratio=with_ratio, product="bfloat16"
    ),
    static_argnames="with_ratio",
)


WORTHWHILE_CHECKS = checked.WORTHWHILE_CHECKS


def transposed(query):
    rounded = checked.round_image(query)
    return rounded._replace(descriptors=rounded.descriptors.T)


def round_query(query):
    query = ready(query)
    return checked.RoundedQuery(query, transposed(query))


def match_rounded(query, candidate):
    """`match` with products of bfloat16."""
    query = query if isinstance(query, checked.RoundedQuery) else round_query(query)
    return match_prepared(query, candidate, cross_check="mutual", with_ratio=True)


@pytest.fixture(autouse=True)
def check_every_pair(monkeypatch):
    """Pairs that would be left to float32 are checked as well."""
    monkeypatch.setattr(checked, "WORTHWHILE_CHECKS", np.inf)


def numpy_products(rows0, rows1):
    """Float32 products of all rows, in the order that `checked_product` documents."""
    length = 8
    while length < rows0.shape[1]:
        length *= 2
    products = np.zeros((len(rows0), len(rows1), length), np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        products[..., : rows0.shape[1]] = rows0[:, None] * rows1[None]
        parts = products.reshape(len(rows0), len(rows1), 8, -1)
        sums = parts[:, :, 0]
        for part in range(1, 8):
            sums = sums + parts[:, :, part]
        while sums.shape[-1] > 1:
            half = sums.shape[-1] // 2
            sums = sums[..., :half] + sums[..., half:]
    return sums[..., 0]


def make_pair(kind, seed=0, counts=(70, 90)):
    rng = np.random.default_rng(seed)
    pair = [make_features(rng, count, capacity=count + 6, dimension=DIMENSIONS) for count in counts]
    for features in pair:
        rows = features.descriptors[features.mask]
        if kind == "positive":
            rows = unit(np.abs(rows))
        if kind == "twins":
            rows = rows[rng.integers(0, len(rows) // 3, len(rows))]
        if kind == "near twins":
            rows = unit(pair[0].descriptors[rng.integers(0, 30, len(rows))] + 1e-7 * rows)
        if kind == "not unit":
            rows = rows * rng.uniform(0.01, 100, (len(rows), 1)).astype(np.float32)
        if kind in ("tiny", "huge"):
            rows = rows * np.float32(1e-12 if kind == "tiny" else 1e18)
        if kind == "broken":
            rows[[3, 8], [0, 5]] = np.nan, np.inf
        features.descriptors[features.mask] = rows.astype(np.float16) if kind == "half" else rows
    if kind == "half":
        pair = [replace(features, descriptors=features.descriptors.astype(np.float16)) for features in pair]
    return pair


def neighbors_in_numpy(query, candidate):
    """Mutual neighbors i -> (j, second) by the products above; the first index wins a tie."""
    with np.errstate(invalid="ignore", over="ignore"):
        products = numpy_products(*(side.descriptors.astype(np.float32) for side in (query, candidate)))
    usable = query.mask[:, None] & candidate.mask[None] & np.isfinite(products)
    products = np.where(usable, products, -np.inf)
    order = np.argsort(-products, axis=1, kind="stable")
    back = np.argmax(products, axis=0)
    return {
        i: (j, second)
        for i, (j, second) in enumerate(order[:, :2].tolist())
        if products[i, j] > -np.inf and back[j] == i
    }


@pytest.mark.parametrize("dimensions", [1, 7, 8, 100, 512])
def test_checked_products_have_the_bits_of_numpy(dimensions):
    rng = np.random.default_rng(dimensions)
    rows0, rows1 = (rng.normal(size=(20, dimensions)).astype(np.float32) for _ in range(2))
    expected = np.diag(numpy_products(rows0, rows1))
    for call in (checked.checked_product, jax.jit(checked.checked_product)):
        np.testing.assert_array_equal(call(rows0, rows1), expected)
    np.testing.assert_allclose(expected, np.einsum("nd,nd->n", rows0.astype(float), rows1), atol=1e-4)


@pytest.mark.first_case
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("with_ratio", [False, True])
def test_neighbors_are_those_of_checked_products(kind, with_ratio):
    for seed in range(4):
        query, candidate = make_pair(kind, seed)
        matches = jax.tree.map(lambda leaf: leaf[0], rounded_once(query, stack([candidate]), with_ratio))
        expected = neighbors_in_numpy(query, candidate)
        places = np.flatnonzero(matches.mask)
        assert dict(zip(places.tolist(), matches.index1[places].tolist(), strict=True)) == {
            i: j for i, (j, _) in expected.items()
        }
        if with_ratio:
            rows0, rows1 = (side.descriptors.astype(np.float64) for side in (query, candidate))
            for i, (j, second) in expected.items():
                closest, further = (np.linalg.norm(rows0[i] - rows1[index]) for index in (j, second))
                ratio = closest / further if closest < further else 1.0
                np.testing.assert_allclose(matches.ratio[i], ratio, rtol=2e-3 if kind == "near twins" else 1e-5)


@pytest.mark.slow
def test_the_bound_holds_and_is_needed(monkeypatch):
    """With no room for rounding, neighbors are wrong."""
    monkeypatch.setattr(checked, "_norm", lambda rows: jnp.full(len(rows), 1e-6))
    wrong = 0
    for seed in range(4):
        query, candidate = make_pair("positive", seed, (400, 500))
        matches = jax.jit(lambda *pair: match_rounded(*pair))(query, candidate)
        places = np.flatnonzero(matches.mask)
        expected = {(i, j) for i, (j, _) in neighbors_in_numpy(query, candidate).items()}
        wrong += expected != {*zip(places.tolist(), np.asarray(matches.index1)[places].tolist(), strict=True)}
    assert wrong > 0


@pytest.mark.parametrize("dimensions", [16, 512])
def test_rounded_products_stay_within_the_bound(dimensions):
    rng = np.random.default_rng(dimensions)
    query, candidate = (make_features(rng, 60, dimension=dimensions, garbage=0) for _ in range(2))
    sides = transposed(query), checked.round_image(candidate)
    products = np.asarray(sides[1].descriptors, np.float64) @ np.asarray(sides[0].descriptors, np.float64)
    exact = candidate.descriptors.astype(np.float64) @ query.descriptors.T.astype(np.float64)
    direction = checked._direction(jnp.asarray(products, jnp.float32), 0, *sides)
    error = np.abs(products - exact).max(axis=0)
    assert (error <= direction.window / 2).all()
    assert (direction.window / 2 < 0.01).all()  # or it would hold whatever the products are


mutual_neighbors = jax.jit(
    lambda query, candidate, with_second: checked.mutual_neighbors(
        transposed(query), checked.round_image(candidate), with_second=with_second
    ),
    static_argnames="with_second",
)


def features_of(rows):
    return mfvpr.Features.of(np.zeros((len(rows), 2), np.float32), np.asarray(rows, np.float32), image_size=(9, 9))


@pytest.mark.slow
def test_sums_are_checked_where_bfloat16_loses_nothing():
    """All products of a query are exactly equal, so only the order of sums tells the candidates apart."""
    rng = np.random.default_rng(0)
    values = np.asarray(jnp.asarray(rng.lognormal(sigma=3, size=700), jnp.bfloat16), np.float32)
    queries = np.asarray(jnp.asarray(rng.uniform(0.1, 1, 8), jnp.bfloat16), np.float32)
    wrong = 0
    for query in queries:
        rows0, rows1 = np.full((1, 700), query), np.stack([rng.permutation(values) for _ in range(12)])
        pair = features_of(rows0), features_of(rows1)
        neighbors, settled = mutual_neighbors(*pair, with_second=False)
        assert settled
        products = numpy_products(rows0, rows1)[0]
        assert int(neighbors.match[0]) == int(products.argmax())
        summed = checked._products(transposed(pair[0]), checked.round_image(pair[1]))
        wrong += int(np.argmax(summed[:12, 0]) != products.argmax())
    assert wrong > 0  # or no sum had to be checked


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*KINDS, "equal", "three times", "all padding", "few"])
def test_equal_and_nearly_equal_images_are_left_to_float32(kind, monkeypatch):
    query, candidate = make_pair(kind, counts=(2, 3) if kind == "few" else (140, 180))
    if kind == "equal":
        query.descriptors[:], candidate.descriptors[:] = query.descriptors[0], query.descriptors[0]
    if kind == "three times":
        for side in (query, candidate):
            side.descriptors[:] = side.descriptors[np.arange(len(side.mask)) // 3 * 3]
    if kind == "all padding":
        query.mask[:] = False
    in_single = match(query, candidate, with_ratio=True)
    mask = np.asarray(in_single.mask)
    for most in (WORTHWHILE_CHECKS, -np.inf):  # whatever the guess says, matches are those of float32
        monkeypatch.setattr(checked, "WORTHWHILE_CHECKS", most)
        rounded = match_rounded(query, candidate)
        np.testing.assert_array_equal(rounded.mask, mask)
        np.testing.assert_array_equal(np.asarray(rounded.index1)[mask], np.asarray(in_single.index1)[mask])
    monkeypatch.setattr(checked, "WORTHWHILE_CHECKS", WORTHWHILE_CHECKS)
    rounded = round_query(query).rounded, checked.round_image(ready(candidate))
    _, settled = jax.jit(partial(checked.mutual_neighbors, with_second=False))(*rounded)
    assert settled == (kind not in ("twins", "near twins", "equal", "three times"))


def test_other_devices_than_a_cpu_take_float32(monkeypatch):
    query, candidate = make_pair("random")
    batch = stack([candidate])
    monkeypatch.setattr(checked, "device_of", lambda _: SimpleNamespace(platform="gpu"))
    choose = partial(checked.choose_product, query=query, candidates=batch, cross_check="mutual")
    assert {choose(product, chunk_size=8) for product in (None, "bfloat16", "float32")} == {"float32"}
    # A program that was traced for a CPU and is compiled for a GPU has no products of bfloat16.
    function = jax.jit(match_rounded).trace(round_query(query), candidate)
    products = {
        platform: "xbf16>) -> tensor" in function.lower(lowering_platforms=(platform,)).as_text()
        for platform in ("cpu", "cuda")
    }
    assert products == {"cpu": True, "cuda": False}


@pytest.mark.slow
def test_gradients_are_those_of_float32():
    query, candidate = make_pair("random")

    def total(descriptors, product):
        features = replace(query, descriptors=descriptors)
        matches = mfvpr.match_candidates(features, stack([candidate]), with_ratio=True, product=product)
        return jnp.sum(mfvpr.masked(matches.distance * matches.ratio, matches.mask))

    descriptors = np.where(query.mask[:, None], query.descriptors, 0)
    in_single, rounded = (jax.grad(total)(descriptors, product) for product in ("float32", "bfloat16"))
    assert np.abs(in_single).max() > 0
    np.testing.assert_array_equal(rounded, in_single)


def test_bfloat16_is_taken_for_long_descriptors_where_it_is_faster(monkeypatch):
    rng = np.random.default_rng(0)
    long, short = (make_features(rng, 4, dimension=dimension) for dimension in (256, 128))

    def choose(features, cross_check="mutual", chunk_size=1):
        return checked.choose_product(None, features, features, cross_check, chunk_size)

    monkeypatch.setattr(checked, "has_bfloat16", lambda: True)
    assert choose(long) == "bfloat16"
    assert {choose(short), choose(long, "none"), choose(long, chunk_size=2)} == {"float32"}
    monkeypatch.setattr(checked, "has_bfloat16", lambda: False)
    assert choose(long) == "float32"
    with pytest.raises(ValueError, match=r"expected cross_check=mutual, chunk_size=1.*leave product out"):
        checked.choose_product("bfloat16", long, long, "none", 2)
