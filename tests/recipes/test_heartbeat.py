"""A new field of the heartbeat, in the specification, the grammar and the sender: everything else is generated or follows."""

import csv
import json

import pytest

from tests.firmware.conftest import real_micropython
from tests.recipes.recipes import Copy

BY_HAND = {"firmware/truearm_box/health.py": "+4 -1", "protocol/SPEC.md": "+2 -1", "protocol/frames.cddl": "+1 -1"}
# A box that runs the copy's firmware answers requests to identify itself; its frames go into a session.
RECORD = """
import json, sys
from pathlib import Path
from truearm.record.links import HostClock
from truearm.record.session_writer import SessionWriter
from truearm_sim.box import BoxProcess, BoxSetup, Grant
from truearm_sim.micropython import probe
from truearm_wire import frame, messages

TOPICS = {messages.HEARTBEAT: "/box/heartbeat", messages.IDENT: "/box/ident"}

box = BoxProcess(probe(Path(sys.argv[1])) if sys.argv[1] else None, BoxSetup(), 7)
writer, beats = SessionWriter(Path(sys.argv[2]), HostClock()), []
identify = [frame.frame(messages.encode_payload([messages.IDENTIFY, k])) for k in range(10)]
sent = b"".join(box.grant(Grant(100_000 * k, rx=identify[k % 10] if k % 10 < 6 else b"")).tx for k in range(60))
for payload in (frame.unframe(run) for run in sent.split(b"\\0") if run):
    kind, *values = messages.decode_payload(payload)
    writer.add(TOPICS[kind], 10**9 + 10**6 * len(beats), payload)
    if kind == messages.HEARTBEAT:
        beats.append(dict(zip(messages.names(kind), values, strict=True)))
box.close()
writer.close()
json.dump(beats, sys.stdout)
"""


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The repository with the field, and what `make wire` generates."""
    copy = Copy(tmp_path_factory.mktemp("heartbeat"), ("host", "protocol", "firmware", "hil_sim"))
    copy.apply("A field of the heartbeat")
    assert copy.changes() == BY_HAND
    copy.python("protocol/make_layout.py")
    copy.python("protocol/make_vectors.py")
    assert set(copy.changes()) - set(BY_HAND) == {
        "protocol/truearm_wire/layout.py",
        "protocol/vectors/frames.json",
        "protocol/vectors/heartbeat.bin",
        "protocol/vectors/heartbeat-cold.bin",
    }
    return copy


@pytest.mark.parametrize("interpreter", ["micropython", "cpython"])
def test_the_box_sends_it_and_readers_show_it(copy, interpreter):
    path = str(real_micropython().path) if interpreter == "micropython" else ""
    name = f"{interpreter}.mcap"
    beats = json.loads(copy.python("-c", RECORD, path, name).out)
    counted = [beat["collections"] for beat in beats]
    assert len(counted) > 4
    assert counted == sorted(counted)
    assert counted[-1] > counted[0] >= 0
    inspected, as_json, exported = copy.run_each(
        ("inspect", name, "--details"), ("inspect", name, "--json"), ("session", "export", name, "--out", interpreter)
    )
    assert [inspected.code, as_json.code, exported.code] == [0, 0, 0], exported.err
    total = json.loads(as_json.out)["losses"]["box"]["collections"]
    assert total in (
        counted[-1],
        counted[-1] - counted[0],
    )  # of a boot that the session did not see, since its first heartbeat
    assert f"{total} collections" in " ".join(inspected.out.split())
    with (copy.folder / interpreter / "box_heartbeat.csv").open() as file:
        assert [int(row["collections"]) for row in csv.DictReader(file)] == counted
