"""Shards of names, which never change, and how shards wait for each other."""

import hashlib
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr.storage import NotYet, Shard
from mfvpr.storage.shards import indices, shard_of, together
from mfvpr.utils import InputError


def test_patience():
    """A shard that waits goes on as soon as no row is missing."""
    calls = []

    def missing():
        calls.append(1)
        return [] if len(calls) > 2 else [0]

    Shard(0, 2).wait(missing, ["a"], "images", patience=60)
    assert len(calls) == 3
    with pytest.raises(NotYet, match=rf"images: 1 of 1 .*shards {shard_of('a', 2)}"):
        Shard(0, 2).wait(lambda: [0], ["a"], "images")


@given(st.lists(st.text(st.characters(codec="utf-8"), min_size=1), unique=True), st.integers(1, 20), st.randoms())
def test_every_name_is_of_one_shard_whatever_the_order(names, count, rng):
    parts = [Shard(index, count).rows(names) for index in range(count)]
    assert sorted(row for part in parts for row in part) == [*range(len(names))]
    shuffled = [*names]
    rng.shuffle(shuffled)
    for index, part in enumerate(parts):
        assert {shuffled[row] for row in Shard(index, count).rows(shuffled)} == {names[row] for row in part}
    assert Shard(0, count).rows(names, [0] if parts[0][:1] == [0] else []) == parts[0][:1][: parts[0][:1] == [0]]


def test_names_are_spread_and_assigned_for_ever():
    names = [f"image{row:04d}.jpg" for row in range(8000)]
    sizes = np.array([len(Shard(index, 8).rows(names)) for index in range(8)])
    assert abs(sizes - 1000).max() < 5 * np.sqrt(1000)
    digest = hashlib.sha256(b"image0000.jpg").digest()
    assert shard_of("image0000.jpg", 8) == int.from_bytes(digest[:8], "big") % 8
    assert shard_of("\udcff.jpg", 7) == int.from_bytes(hashlib.sha256(b"\xff.jpg").digest()[:8], "big") % 7


@pytest.mark.parametrize(
    "text", ["", "1", "1/", "/2", "2/2", "-1/2", "0/0", "1.0/2", "0/99999", "0/2/3", " 0/2", "a/b"]
)
def test_what_is_no_shard(text):
    with pytest.raises(InputError, match=r"^shard="):
        Shard.parse(text)


def test_array_expressions():
    assert indices([]) == ""
    assert indices([4, 2, 3, 0, 3]) == "0,2-4"
    assert str(Shard.parse("03/8")) == "3/8"


def test_what_waits_does_not_keep_the_rest():
    done = []

    def wait(line):
        raise NotYet(line)

    with pytest.raises(NotYet, match=r"^a; b$"):
        together(lambda: wait("a"), lambda: done.append(1), lambda: wait("b"), lambda: wait("a"))
    assert done == [1]
    assert together(lambda: 1, lambda: 2) == [1, 2]


@pytest.mark.parametrize("complete", [(True, True), (True, False), (False, True), (False, False)])
def test_a_shard_is_complete_if_all_that_waits_for_others_is(complete):
    shards = [Shard(0, 2), Shard(1, 2)]
    waits = [partial(shard.wait, lambda: [0, 1], ["a", "b"], "scores", is_complete=is_complete)
             for shard, is_complete in zip(shards, complete, strict=True)]  # fmt: skip
    with pytest.raises(NotYet) as error:
        together(*waits)
    assert error.value.is_complete == all(complete)
    assert error.value.shards == {shard_of("a", 2), shard_of("b", 2)}
