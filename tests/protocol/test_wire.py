"""The wire format in both interpreters: golden vectors, and hypothesis with cbor2, cobs and zlib."""

import importlib.util
import json
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path

import cbor2
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from truearm_sim import micropython
from truearm_wire import cbor, frame, messages

ROOT = Path(__file__).parents[2]
VECTORS = ROOT / "protocol" / "vectors"
CHECK = Path(__file__).with_name("check_vectors.py")


CONSTANTS = (
    *("DATA", "EVENT", "HEARTBEAT", "IDENT", "TEMPERATURE", "SYNC_REQUEST", "SYNC_REPLY", "IDENTIFY", "CONFIGURE"),
    *("START", "STOP", "GET_CONFIG", "PUT_CONFIG", "SELF_TEST", "TO_REPL", "RESET", "PULSE", "REPLY", "ERROR"),
)


def script(name: str):
    spec = importlib.util.spec_from_file_location(name, ROOT / "protocol" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_check(command: list[str]) -> str:
    done = subprocess.run(
        [*command, str(CHECK), str(VECTORS)],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "MICROPYPATH": str(ROOT / "protocol")},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_golden_vectors_on_cpython():
    assert run_check([sys.executable]).startswith("31 golden, 11 corrupted, 0 failed on cpython")


def test_golden_vectors_on_micropython():
    interpreter = micropython.find()
    assert interpreter is not None, "make micropython gets one"
    assert run_check([str(interpreter.path)]).startswith("31 golden, 11 corrupted, 0 failed on micropython")


def test_grammar_layout_and_vectors_have_the_same_frames():
    golden = {entry["values"][0] for entry in json.loads((VECTORS / "frames.json").read_text())}
    assert golden == set(messages.LAYOUT)
    make_layout = script("make_layout")
    grammar = (ROOT / "protocol" / "frames.cddl").read_text(encoding="utf-8")
    assert (ROOT / "protocol" / "truearm_wire" / "layout.py").read_text(encoding="utf-8") == make_layout.layout(grammar)
    constants = {v for k, v in vars(messages).items() if isinstance(v, int) and k in CONSTANTS}
    assert constants == set(messages.LAYOUT)


def test_the_specification_lists_the_elements_of_the_grammar():
    spec = (ROOT / "protocol" / "SPEC.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| [a-z-]+ \| (seq u32[^|]*) \|$", spec, re.MULTILINE)
    said = {int(kind): [part.split()[0] for part in text.split(", ")] for kind, text in rows}
    assert set(said) == {kind for kind, entries in messages.LAYOUT.items() if entries[0] == "seq:u32"}
    for kind, elements in said.items():
        # the specification says of a document's page and of a text by their type, and explains edge in brackets
        found = ["data" if name == "bytes" else name for name in elements]
        assert [name for name in found if name not in ("0", "1")][: len(messages.names(kind))] == messages.names(kind)


def test_vectors_are_those_of_their_generator(tmp_path, monkeypatch):
    generator = script("make_vectors")
    monkeypatch.setattr(generator, "FOLDER", tmp_path)
    generator.main()
    fresh = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    assert fresh == {p.name: p.read_bytes() for p in VECTORS.iterdir()}


values = st.recursive(
    st.integers(-(2**64), 2**64 - 1) | st.binary(max_size=40) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12,
)


@given(values)
def test_documents_as_cbor2(value):
    encoded = cbor.encode(value)
    assert encoded == cbor2.dumps(value)
    assert cbor.decode(encoded) == value


@given(values, st.integers(0, 3 * messages.PAGE_BYTES))
def test_pages_of_a_value_are_those_of_its_bytes(value, n):
    """Cut while it is encoded, at every offset: a text of n letters stands before the value."""
    whole = ["x" * n, value]
    assert messages.pages_of(whole) == messages.pages(cbor.encode(whole))


def test_more_pages_than_fit_are_refused():
    with pytest.raises(cbor.CborError, match="pages"):
        messages.pages_of("x" * (messages.PAGES_MAX * messages.PAGE_BYTES))


@given(st.binary(max_size=60))
def test_decode_never_raises_anything_else(data):
    try:
        cbor.decode(data)
    except cbor.CborError:
        return


@given(st.binary(max_size=60))
def test_decoded_like_cbor2(data):
    """What the small decoder accepts, cbor2 reads the same."""
    try:
        ours = cbor.decode(data)
    except cbor.CborError:
        return
    if b"\xc0" <= data[:1] < b"\xe0" or "Tag" in repr(ours):
        return  # cbor2 interprets tags (dates, bignums), ours keeps them
    assert ours == cbor2.loads(data)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x9f\xff",
        b"\xf9\x00\x00",
        b"\xf6",
        b"\x18",
        b"\x82\x01",
        b"\x9b" + b"\xff" * 8,
        b"\x81" * 60 + b"\x00",
        b"\x00\x00",
    ],
)
def test_refused(data):
    with pytest.raises(cbor.CborError):
        cbor.decode(data)


@given(st.binary(min_size=1, max_size=frame.PAYLOAD_MAX))
def test_frame_is_cobs_of_payload_and_crc(payload):
    expected = b"\0" + cobs.encode(payload + zlib.crc32(payload).to_bytes(4, "little")) + b"\0"
    assert frame.frame(payload) == expected
    assert frame.unframe(expected[1:-1]) == payload


@given(
    st.lists(st.binary(min_size=1, max_size=30), max_size=6),
    st.lists(st.binary(max_size=300), max_size=6),
    st.integers(1, 64),
)
def test_splitter_finds_every_frame_between_rubbish(payloads, rubbish, size):
    """However it arrives in pieces; what ended no frame is counted, once a run."""
    stream = b""
    for i in range(max(len(payloads), len(rubbish))):
        stream += rubbish[i] if i < len(rubbish) else b""
        stream += frame.frame(payloads[i]) if i < len(payloads) else b""
    splitter, found = frame.Splitter(), []
    for at in range(0, len(stream), size):
        end = min(at + size, len(stream))
        while at < end:
            at = splitter.push(stream, at, end)
            if splitter.end:
                found.append(bytes(splitter.buf[1 : splitter.end]))
    runs = [run for run in stream.split(b"\0")[:-1] if run]
    assert splitter.bad_frames + len(found) == len(runs)
    assert found == [payload for run in runs if (payload := frame.unframe(run)) is not None]
    it = iter(found)
    assert all(any(p == q for q in it) for p in payloads), "every frame comes out, in order"


@given(st.binary(min_size=1, max_size=255))
def test_cobs_decoder_agrees_with_the_library(run):
    """In place and bounded, yet it accepts what `cobs` accepts among zero-free runs whose last block is not implicit."""
    buf = bytearray(run)
    accepted = bool(len(run) > 1 and 0 not in run and frame.cobs_decode(buf, 0, len(buf)))
    try:
        expected = cobs.decode(run)
    except cobs.DecodeError:
        assert not accepted
        return
    if accepted:
        assert bytes(buf[1:]) == expected or 0xFF in run
