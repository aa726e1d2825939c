"""The recorder with a faulty box in memory: everything is kept, and faults are reported as they occurred."""

import json
from functools import partial

import cbor2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from record_box import HOST_0, LATENCY, MS, SECOND, Box, Lab, array, u32
from record_files import Watching, events, received, run, topics

from truearm.record.recorder import RecordOptions
from truearm.session.frames import recorded_ident
from truearm.session.session_file import open_session


class TestFaults:
    @pytest.mark.parametrize("change", [{"scale": "abc"}, {"scale": [1]}, {"calibration": {"poly": [[1, 0]] * 17}}])
    def test_a_faulty_calibration_is_said_at_once_and_nothing_is_refused(self, lab, path, change):
        box = Box(lab)
        box.lvdt = change
        seen = []
        summary = run(
            lab,
            box,
            path,
            options=RecordOptions(osr=2048),
            operator=Watching(lambda status: seen.append(status.faults)),
        )
        (fault,) = summary.faults
        assert fault.startswith("channel 'c0' ")
        assert "stream adc: " in fault
        assert seen[1] == (fault,)
        assert events(path, "box-fault") == [{"kind": "box-fault", "text": fault}]
        assert len(topics(path)["/box/adc"]) == box.blocks > 100
        assert recorded_ident(open_session(path)).faults == (fault,)

    def test_a_lost_frame_and_a_doubled_one(self, lab, path):
        box = Box(lab)
        box.mangle = lambda i, raw: b"" if i == 100 else raw * 2 if i == 150 else raw
        summary = run(lab, box, path)
        assert summary.counters.lost_frames == 1
        assert summary.counters.odd_frames == 1
        assert summary.counters.restarts == 0
        assert received(path) == box.sent.replace(b"\0", b"")

    def test_a_flipped_bit_is_kept_as_console(self, lab, path):
        box = Box(lab)
        flipped = {}

        def flip(index, raw):
            if index == 120:
                flipped["raw"] = raw[:30] + bytes([raw[30] ^ 0x40 or 0x41]) + raw[31:]
                return flipped["raw"]
            return raw

        box.mangle = flip
        summary = run(lab, box, path)
        assert [m.data for m in topics(path)["/box/console"]] == [flipped["raw"].strip(b"\0")]
        assert summary.counters.lost_frames == 1

    @pytest.mark.parametrize("speaks_again", [True, False])
    def test_a_traceback_bears_the_time_of_its_end(self, lab, path, speaks_again):
        """It may wait long for a delimiter: for the next boot, or for ever."""
        box = Box(lab)

        def crash():
            box.streaming = False
            box.send_raw(b"Traceback")
            box.mangle = lambda i, raw: b""

        lab.at(HOST_0 + SECOND, crash)
        if speaks_again:
            lab.at(HOST_0 + 3 * SECOND, lambda: setattr(box, "mangle", lambda i, raw: raw))
        run(lab, box, path, 5.0)
        (message,) = topics(path)["/box/console"]
        assert message == ("/box/console", HOST_0 + SECOND + LATENCY, b"Traceback")

    @settings(max_examples=15, deadline=None)
    @given(
        st.dictionaries(st.integers(1, 250), st.binary(max_size=300), max_size=20), st.randoms(use_true_random=False)
    )
    def test_whatever_comes_is_kept(self, tmp_path_factory, insertions, random):
        """Junk anywhere, in the middle of frames too, in pieces of any size: the file holds every byte."""
        lab = Lab()
        path = tmp_path_factory.mktemp("junk") / "s.mcap"
        box = Box(lab)

        def insert(index, raw):
            at = random.randrange(len(raw))
            return raw[:at] + insertions.get(index, b"") + raw[at:]

        box.mangle = insert
        run(lab, box, path, 2.0)
        assert received(path) == box.sent.replace(b"\0", b"")

    def test_a_restart_in_the_middle(self, lab, path):
        """The box is configured and started again, and its ident is the new one's."""
        box = Box(lab)
        lab.at(HOST_0 + 2 * SECOND, lambda: box.boot(0x2222))
        run(lab, box, path, 4.0, options=RecordOptions(osr=2048))
        assert events(path, "box-restarted")[0]["boot_id"] == 0x2222
        assert [c[0] for c in box.commands if c[0] != 48] == [51, 49, 50, 51, 49, 50, 51]
        firsts = [cbor2.loads(m.data)[3] for m in topics(path)["/box/adc"]]
        assert firsts.count(0) == 2
        assert json.loads(open_session(path).metadata["box"]["ident"])["boot_id"] == 0x2222

    def test_what_the_box_lost_before_is_not_this_recordings(self, lab, path):
        """It streamed to nobody, and counts since its boot; the counter may wrap, a heartbeat may come late."""
        box = Box(lab)
        box.overruns = 2**30 - 5
        for second, overruns in ((2, 2**30 - 5), (3, 2), (4, 2**30 - 5), (5, 2)):
            lab.at(HOST_0 + second * SECOND, partial(setattr, box, "overruns", overruns))
        assert run(lab, box, path, 1.5).counters.overruns_in_box == 0
        assert run(lab, box, path.with_name("b"), 6.0).counters.overruns_in_box == 7
        box.overruns = 4
        lab.at(lab.now + 2 * SECOND, lambda: box.boot(0x2222))
        assert run(lab, box, path.with_name("c"), 4.0).counters.overruns_in_box == 4  # of a boot in its midst: all

    def test_echoed_requests_are_console(self, lab, path):
        """A box whose firmware ended by an exception stands at a prompt, which echoes what it is told: an echo is not a frame of its own."""
        box = Box(lab)
        echoed = []

        def crash():
            box.streaming = False
            box.send_raw(b"Traceback (most recent call last):\r\nMemoryError: \r\n>>> ")
            box.boot_id = None  # its heart stands still
            box.link.on_write = echo

        def echo(raw):
            echoed.append(raw)
            lab.at(lab.now + LATENCY, lambda: box.send_raw(raw))

        lab.at(HOST_0 + 2 * SECOND, crash)
        seen = []
        summary = run(lab, box, path, 6.0, operator=Watching(seen.append))
        assert summary.counters.lost_frames == summary.counters.odd_frames == 0
        assert summary.counters.unanswered_probes == sum(raw[2:5] == b"\x82\x18\x20" for raw in echoed) > 10
        assert seen[-1].rtt_us == pytest.approx(2 * LATENCY / 1000)
        assert "/box/other" not in topics(path)
        console = b"".join(m.data for m in topics(path)["/box/console"])
        assert console.endswith(b"".join(echoed).replace(b"\0", b""))
        assert received(path) == box.sent.replace(b"\0", b"")

    def test_unanswered_probes(self, lab, path):
        box = Box(lab)
        box.answer_probes = False
        seen = []
        summary = run(lab, box, path, 5.0, operator=Watching(seen.append))
        rows = [json.loads(m.data) for m in topics(path)["/sync"]]
        assert summary.counters.unanswered_probes == summary.counters.probes == len(rows)
        assert seen[-1].rtt_us is None
        assert all(set(row) == {"id", "t0_ns"} for row in rows)
        first = topics(path)["/sync"][0]
        assert 2 * SECOND <= first.t_host_ns - rows[0]["t0_ns"] <= 2 * SECOND + 50 * MS

    def test_frames_of_unknown_kinds(self, lab, path):
        box = Box(lab)
        lab.at(HOST_0 + SECOND, lambda: box.send(lambda seq: array(99, u32(seq), "new")))
        lab.at(HOST_0 + SECOND, lambda: box.send(lambda seq: array(17, u32(seq), 0, 5, 1)))
        lab.at(HOST_0 + SECOND, lambda: box.send(lambda seq: array(16, u32(seq), "odd")))
        lab.at(HOST_0 + SECOND, lambda: box.send(lambda seq: array(18, u32(seq), "odd")))
        lab.at(HOST_0 + SECOND, lambda: box.send(lambda seq: array(33, u32(seq), 1, -1, b"\xf5")))
        summary = run(lab, box, path)
        found = topics(path)
        assert len(found["/box/other"]) == 2
        assert len(found["/box/event"]) == 1
        assert summary.counters.lost_frames == 0
        assert received(path) == box.sent.replace(b"\0", b"")
