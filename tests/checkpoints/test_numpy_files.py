"""NumPy's files of pickled layers: read as data, or refused in one line and nothing executed."""

import pickle
import struct

import numpy as np
import pytest

from mfvpr.checkpoints.checkpoint import read_checkpoint
from tests.checkpoints.test_checkpoint import (
    Runs,
    assert_arrays_or_one_line,
    assert_same,
    flipped,
    random_changes,
    refused,
)
from tests.io.checks import memory_below
from tests.random_checkpoints import HEADER, Call, Global, Writer, layered, write_numpy

RECONSTRUCT = Global("numpy.core.multiarray", "_reconstruct")
NDARRAY = Global("numpy", "ndarray")
PLAIN = (3, "<", None, None, None, -1, -1, 0)  # of a type, what follows its code
OBJECT = (3, "|", None, None, None, -1, -1, 63)


def put(value):
    return Writer()._put(value)


def built(instance, state):
    """Instructions that make an instance and fill it."""
    return put(instance) + put(state) + b"b"


def typed(code="f4", state=PLAIN):
    return built(Call(Global("numpy", "dtype"), (code, 0, 1)), state)


def binary(values):
    """Instructions that make these bytes, in protocol 3."""
    return b"B" + struct.pack("<I", len(values)) + values


TYPE, VALUES, EMPTY = typed(), binary(bytes(24)), Call(RECONSTRUCT, (NDARRAY, (0,), "b"))


def array(shape=(6,), kind=TYPE, fortran=False, values=VALUES, version=1, call=EMPTY):
    """Instructions that make an array."""
    return built(call, (version, shape, kind, fortran, values))


def outer(value, **changes):
    """The pickle of an array that holds one object."""
    return b"\x80\x02" + array(**({"shape": (), "kind": typed("O8", OBJECT), "values": [value]} | changes)) + b"."


@pytest.fixture
def path(tmp_path):
    return tmp_path / "file.npy"


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    return {
        "conv1_1.weights": rng.standard_normal((4, 3, 3, 3)).astype(np.float32),
        "conv1_1.bias": rng.standard_normal(300),
        "fc8a_1.weights": np.asfortranarray(rng.standard_normal((5, 2))),
        "fc8a_1.count": np.arange(-3, 3),
    }


def refused_array(path, instructions):
    return refused(write_numpy(path, outer({"conv": {"weights": instructions}})))


@pytest.mark.parametrize("protocol", range(5))
def test_every_protocol(path, arrays, protocol):
    assert_same(read_checkpoint(write_numpy(path, layered(arrays), protocol=protocol)), arrays)


def test_files_of_this_numpy_and_of_older_ones(path, arrays):
    content = pickle.dumps(np.array(layered(arrays), dtype=object), protocol=3)
    old = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert old != content
    assert_same(read_checkpoint(write_numpy(path, old)), arrays)
    for version in ((1, 0), (2, 0), (3, 0)):
        with path.open("wb") as file:
            np.lib.format.write_array(file, np.array(layered(arrays), dtype=object), version)
        assert_same(read_checkpoint(path), arrays)


class Python2(pickle._Pickler):  # type: ignore
    """Writes strings as Python 2 does, where text is bytes."""

    dispatch = pickle._Pickler.dispatch.copy()  # type: ignore

    def save_string(self, value):
        content = value.encode("latin-1") if isinstance(value, str) else value
        length = len(content)
        self.write(b"U" + bytes([length]) if length < 256 else b"T" + struct.pack("<i", length))
        self.write(content)
        self.memoize(value)

    dispatch[str] = dispatch[bytes] = save_string


@pytest.mark.parametrize("protocol", [1, 2])
def test_files_of_python_2(path, arrays, protocol):
    with path.open("wb") as file:
        write_numpy(path, b"")
        file.seek(0, 2)
        Python2(file, protocol).dump(np.array(layered(arrays), dtype=object))
    assert b"U\x07conv1_1" in path.read_bytes()
    assert_same(read_checkpoint(path), arrays)


def test_layouts_of_values(path):
    grid = np.arange(24.0).reshape(2, 3, 4)
    arrays = {
        "a.big": grid.astype(">f4"), "a.fortran": np.asfortranarray(grid), "a.turned": grid.transpose(2, 0, 1),
        "a.both": np.asfortranarray(grid.astype(">f8")), "a.part": grid[:, ::2, 1:], "a.scalar": np.array(2.5),
        "a.none": np.zeros((0, 3)), "b.i8": np.array([-1]), "b.i4": np.array([2], "i4"), "b.i2": np.array([2], ">i2"),
        "b.i1": np.array([-3], "i1"), "b.u1": np.array([255], "u1"), "b.bool": np.array([True, False]),
    }  # fmt: skip
    loaded = read_checkpoint(write_numpy(path, layered(arrays), protocol=3))
    assert_same(loaded, {key: value.astype(value.dtype.newbyteorder("=")) for key, value in arrays.items()})
    assert not any(value.flags.writeable for key, value in loaded.items() if value.size and key == "a.fortran")


def test_written_byte_by_byte(path):
    weights = array(values=binary(np.arange(6, dtype="f4").tobytes()))
    loaded = read_checkpoint(write_numpy(path, outer({"conv": {"weights": weights}})))
    assert_same(loaded, {"conv.weights": np.arange(6, dtype=np.float32)})


@pytest.mark.parametrize("protocol", range(5))
def test_code_is_refused_and_not_executed(path, tmp_path, protocol):
    code = {"conv": {"weights": np.zeros(3), "bias": np.array([Runs(tmp_path / "made"), 1])}}
    for content in (pickle.dumps(code, protocol), code):  # without an array, in one
        assert "it asks for posix.mkdir" in refused(write_numpy(path, content, protocol=protocol))
    assert not (tmp_path / "made").exists()
    np.load(path, allow_pickle=True)
    assert (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (Call(RECONSTRUCT, (Global("os", "mkdir"), (0,), "b")), "it asks for os.mkdir"),
        (Call(RECONSTRUCT, (NDARRAY, (10**12,), "b")), "it asks for numpy.core.multiarray._reconstruct"),
        (Call(RECONSTRUCT, (NDARRAY, (0,), "O")), "it asks for numpy.core.multiarray._reconstruct"),
        (Call(RECONSTRUCT, ()), "it asks for numpy.core.multiarray._reconstruct"),
        (Call(NDARRAY, ((2, 3),)), "it asks for numpy.ndarray"),
        (Call(Global("numpy", "load"), ("other.npy", None, True)), "it asks for numpy.load"),
        (Call(Global("numpy.core.multiarray", "scalar"), (TYPE, "abcd")), "it asks for numpy.core.multiarray.scalar"),
        (Call(Global("_codecs", "encode"), ("abcd", "rot13")), "it asks for _codecs.encode"),
    ],
)  # fmt: skip
def test_other_names_are_refused(path, call, words):
    for instructions in (put(call), array(call=call)):
        assert words in refused_array(path, instructions)
    assert words in refused(write_numpy(path, outer({}, call=call)))


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (typed("O8", OBJECT), "got O8 at conv.weights"),
        (typed("f2"), "got f2 at conv.weights"),
        (typed("f4", (3, "<", (typed(), (2,)), None, None, 8, 4, 0)), "got f4"),
        (typed("f4", (3, "=", None, None, None, -1, -1, 0)), "got f4"),
        (typed("f4", (3, "f4,", None, None, None, -1, -1, 0)), "got f4"),
        (typed("f4", OBJECT), "damaged"),
        (typed("u1"), "damaged"),
        (typed("f4,f4"), "got f4,f4"),
        (typed(1000 * "long"), "got longlong"),
        (put(Call(Global("numpy", "dtype"), ("f4", 0, 1))), "damaged"),  # not filled
        (built(typed(), PLAIN), "got f4"),  # filled twice
        (put("f4"), "damaged"),
    ],
)
def test_other_types_are_refused(path, kind, words):
    assert words in refused_array(path, array(kind=kind))


@pytest.mark.filterwarnings("ignore:metadata on a dtype")
def test_other_types_that_numpy_writes_are_refused(path):
    for values, code in (
        (np.array(["a", 3], dtype=object), "O8"),
        (np.array(["text"]), "U4"),
        (np.zeros(2, "f2"), "f2"),
        (np.zeros(2, [("a", "f4"), ("b", "i4")]), "V8"),
        (np.array(["2020-01-01"], "M8[D]"), "M8"),
        (np.zeros(2, np.dtype("f4", metadata={"a": 1})), "f4"),
    ):
        write_numpy(path, {"a": {"b": values}})
        assert f"got {code}" in refused(path)
    for values in (np.ma.zeros(3), np.zeros(3).view(np.recarray), np.float32(3)):
        assert "it asks for numpy" in refused(write_numpy(path, {"a": {"b": values}}))


@pytest.mark.parametrize(
    "changes",
    [
        *({"shape": shape} for shape in ((7,), (5,), (), (-6,), (-2, -3), (6.0,), (True, 6), [6], ("6",), 6)),
        *({"shape": shape} for shape in ((6, *(1,) * 64), (2**40, 2**40))),
        *({"shape": shape, "values": binary(b"")} for shape in ((0, 2**62, 2**62), (2**62, 4))),
        *({"values": binary(bytes(length))} for length in (23, 25)),
        *({"values": values} for values in (put("\u0100" + 23 * "a"), [24], ["a"] * 24, {}, 24, put(None))),
        *({"fortran": fortran} for fortran in (2, "F")),
        *({"version": version} for version in (0, "1")),
    ],
    ids=str,
)
def test_other_sizes_than_the_values_have_are_refused(path, changes):
    message = refused_array(path, array(**changes))
    assert "damaged" in message or "than the file stores at conv.weights" in message


def test_arrays_are_filled_once(path):
    state = (1, (), typed(), False, b"C\x04abcd")
    for instructions in (put(EMPTY), built(array(), state), built({}, {}), b"}}b"):
        assert "damaged" in refused_array(path, instructions)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (outer({}), "expected a dictionary of layers"),
        (outer([array()]), "expected a dictionary of layers"),
        (outer({"conv": {}}, shape=(1,)), "expected a dictionary of layers"),
        (outer({"conv": {}}, values=[{"a": {}}, {}]), "expected a dictionary of layers"),
        (outer({"conv": {}}, kind=typed()), "expected a dictionary of layers"),
        (b"\x80\x02}.", "expected a dictionary of layers"),
        (outer({"conv": array()}), "expected arrays by layer, got Array at conv"),
        (outer({"conv": {"weights": Global("os", "system")}}), "expected arrays by layer, got Name at conv.weights"),
        (outer({"a\n\x1b[2J": {"b": "text"}}), r"got str at a\n\x1b[2J.b"),
        (outer({3: {"weights": array()}}), "damaged"),
        (outer({"conv": {3: array()}}), "damaged"),
        (outer({"a.b": {"c": array()}, "a": {"b.c": array()}}), "damaged"),
        (outer({100 * "long": {"c": array()}}), "damaged"),
        (outer({"conv": {"weights": array()}}) + b"\0", "damaged"),
        (b"\x80\x02S'\\d'\n.", "its pickle is more than data (STRING)"),  # Python's reader of strings warns of it
    ],
)
def test_other_content(path, content, words):
    assert words in refused(write_numpy(path, content))


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (3,), }", "expected a dictionary of layers, got an array"),
        (HEADER.replace("()", "(1,)"), "got another object"),
        ("__import__('os').mkdir('made')", "got an array, __import__"),
        (HEADER + "\n\x1b[2J", "got an array"),
        (HEADER.ljust(3000), None),
        (HEADER.replace(", }", "}"), None),
    ],
)
def test_headers(path, arrays, header, words):
    write_numpy(path, layered(arrays), header=header)
    if words is None:
        assert_same(read_checkpoint(path), arrays)
    else:
        assert words in refused(path)


def entries(items):
    """Instructions that make a dictionary."""
    return b"}(" + b"".join(put(key) + value for key, value in items) + b"u"


def test_nothing_grows_beyond_the_file(path):
    keep, recall = b"r\1\1\0\0", b"j\1\1\0\0"
    big_endian = typed("f4", (3, ">", *PLAIN[2:]))
    views = [array((25_000,), big_endian, values=values) for values in (binary(bytes(100_000)) + keep, recall)]
    shared_values = entries((str(place), views[place > 0]) for place in range(500))  # 50 MB
    empty = array((0,), values=binary(b""))
    layer = entries((str(place), empty) for place in range(500)) + keep
    shared_layers = entries((str(place), recall if place else layer) for place in range(2000))  # a million arrays
    name = put("long" * 25_000) + keep
    long_names = entries((name if place == 0 else recall, entries([(str(place), empty)])) for place in range(3))
    with memory_below(30e6):
        assert "no more values than the file stores" in refused(write_numpy(path, outer({"a": shared_values})))
        assert "no more values than the file stores" in refused(write_numpy(path, outer(shared_layers)))
        assert "damaged" in refused(write_numpy(path, outer(long_names)))
        path.write_bytes(b"\x93NUMPY\x02\0\xff\xff\xff\xff" + HEADER.encode())
        assert "damaged" in refused(path)


@pytest.mark.parametrize("protocol", [2, 4])
def test_damage_is_refused_wherever_it_is(path, protocol):
    """A cut file is refused; a changed byte gives one line or arrays, which `convert` checks."""
    expected = {"conv": {"weights": np.arange(4, dtype=np.float32).reshape(2, 2), "bias": np.zeros(2)}}
    intact = write_numpy(path, expected, protocol=protocol).read_bytes()
    for length in range(len(intact)):
        path.write_bytes(intact[:length])
        refused(path)
    for changed in (*(flipped(intact, place) for place in range(len(intact))), *random_changes(intact, 128)):
        path.write_bytes(changed)
        assert_arrays_or_one_line(path)
