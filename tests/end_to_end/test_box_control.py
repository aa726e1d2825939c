"""A conversation with the box in virtual time: every command, pages, refusals, lost answers, a hostile peer."""

from contextlib import contextmanager

import cbor2
import pytest
from tests.end_to_end.levels import LEVELS, lab_of

from truearm.box.condition import FAIL, PASS, WARN, findings
from truearm.box.control import MAX_WAITING, BoxControl, sample
from truearm.errors import LinkError, ProtocolError, RefusedError
from truearm.findings import option
from truearm.progress import listening
from truearm.record.requests import NoAnswerError
from truearm_wire import messages as wire
from truearm_wire.frame import frame


@pytest.fixture(scope="module", params=sorted(LEVELS))
def level(request):
    return request.param


@pytest.fixture(scope="module")
def lab(level):
    """Return a shared lab for tests that leave the box unchanged: booting the chip takes as long as most tests."""
    with lab_of(level) as lab:
        yield lab


@pytest.fixture(scope="module")
def box(lab):
    """One conversation: a box takes a request with the number of the last one for its repetition."""
    return BoxControl(lab.box_link, lab.clock)


class Lossy:
    """A link on which some written data never arrives and some answers are lost."""

    def __init__(self, link, lose_writes=(), lose_reads=0):
        self.name, self._link, self.written = link.name, link, []
        self._lose_writes, self._lose_reads = set(lose_writes), lose_reads

    def write(self, data):
        self.written.append(data)
        return 0 if len(self.written) - 1 in self._lose_writes else self._link.write(data)

    def read(self, timeout_s):
        arrivals = self._link.read(timeout_s)
        if arrivals and self._lose_reads:
            self._lose_reads -= 1
            return []
        return arrivals


def test_what_is_no_configuration_is_refused_and_changes_nothing(box):
    box.identify()
    config = box.config()
    with pytest.raises(RefusedError, match="osr: must be one of") as info:
        box.put_config({**config, "osr": 1000})
    assert info.value.code == wire.ERROR_RANGE
    with pytest.raises(ProtocolError, match="box accepts 16"):
        box.put_config({**config, "note": "x" * 4000})
    assert box.config() == config


def test_samples_of_a_stream(box):
    """So many samples, none twice, none of the first while the filter settles."""
    streams = box.identify().streams
    counts = sample(box, streams[0], 0.5)
    assert 0.5e9 / streams[0].period_ns <= len(counts) < 0.5e9 / streams[0].period_ns + 13
    assert counts.shape[1] == 4
    shots = sample(box, streams[1], 0.5)
    assert shots.shape[1] == 1
    assert box.frame_count.lost == 0


def test_a_lost_command_and_a_lost_answer_are_repeated_with_the_same_id(lab):
    """The level of the trigger output would be set twice if the box took a repetition for another command."""
    BoxControl(lab.box_link, lab.clock).identify()
    lab.box_link.read(0.1)  # ids begin with the time: that of the next conversation is another
    link = Lossy(lab.box_link, lose_writes={0})
    box = BoxControl(link, lab.clock)
    box.command(wire.PULSE, 1)
    assert len(link.written) == 2
    assert link.written[0] == link.written[1]
    assert lab.box.output

    link = Lossy(lab.box_link, lose_reads=1)
    box = BoxControl(link, lab.clock)
    box.command(wire.PULSE, 0)
    assert len(set(link.written)) == 1
    assert not lab.box.output


# --- the other side made up


class Parrot:
    """A link that answers requests in its own virtual time. ``answer(request) → bytes``."""

    name = "parrot"
    kind = "virtual"

    def __init__(self, answer):
        self._answer, self._due, self._now_ns = answer, [], 0

    def now_ns(self):
        return self._now_ns

    def write(self, data):
        request = cbor2.loads(_payload(data))
        self._due.append((self._now_ns, self._answer(request)))
        return self._now_ns

    def read(self, timeout_s):
        self._now_ns += int(timeout_s * 1e9)
        due, self._due = self._due, []
        return due


def _payload(data):
    from truearm_wire.frame import unframe

    return unframe(data.strip(b"\0"))


def reply(req_id, document, seq=0):
    pages = wire.pages(document)
    return b"".join(frame(wire.encode_payload([wire.REPLY, seq + k, req_id, *page])) for k, page in enumerate(pages))


def talk(answer):
    link = Parrot(answer)
    return BoxControl(link, link)


@pytest.mark.parametrize(
    ("document", "says"),
    [
        (b"\xff", "cannot be decoded| table"),  # a break is none, or an object of its own: cbor2 decides
        (b"", "cannot be decoded"),
        (cbor2.dumps([1]), " table"),
        (cbor2.dumps({1: 2}), " table"),
        (b"\xa1" * 100 + b"\x60", "cannot be decoded| table"),
        (bytes.fromhex("d8 1c 81 d8 1d 00"), "cannot be decoded"),  # a list that holds itself
    ],
)
def test_a_document_that_is_none(document, says):
    with pytest.raises(ProtocolError, match=says):
        talk(lambda request: reply(request[1], document)).config()


def test_answers_to_others_are_not_ours():
    with pytest.raises(NoAnswerError):
        talk(lambda request: reply(request[1] + 1, b"")).command(wire.STOP)


def test_waiting_for_an_answer_is_a_step_that_a_terminal_shows():
    @contextmanager
    def hear(what):
        heard.append(what)
        try:
            yield None
        finally:
            heard.append("end")

    heard = []
    with listening(hear), pytest.raises(NoAnswerError):
        talk(lambda request: b"").command(wire.STOP)
    step, end = heard
    assert ("'stop'" in step, end) == (True, "end")


def test_an_answer_that_came_while_the_machine_was_busy_is_taken():
    """The command's time was over before it could run; the box's answer is already there."""

    class Busy(Parrot):
        def now_ns(self):
            self._now_ns += 10**12
            return self._now_ns

    link = Busy(lambda request: reply(request[1], b"ok"))
    assert BoxControl(link, link).command(wire.STOP, retries=1) == b"ok"


def test_noise_is_counted_and_survived():
    box = talk(lambda request: b"\0Traceback\r\n\0" + b"\x05" * 300 + b"\0" + reply(request[1], b"ok"))
    assert box.command(wire.STOP) == b"ok"
    assert box.console_bytes > 300


def test_a_flood_is_bounded():
    beat = [wire.HEARTBEAT, 0, 1, 0, *[0] * 13]
    flood = frame(wire.encode_payload(beat)) * (MAX_WAITING + 100)
    box = talk(lambda request: flood + reply(request[1], b""))
    box.command(wire.STOP)
    assert len(list(box.sent(0.0))) == MAX_WAITING


def test_a_link_that_is_lost_by_a_reset_is_what_was_asked_for():
    class Unplugged(Parrot):
        def read(self, timeout_s):
            raise LinkError("gone")

    link = Unplugged(lambda request: b"")
    BoxControl(link, link).reset(wire.BOOT_LOADER)
    with pytest.raises(LinkError, match="gone"):
        BoxControl(link, link).command(wire.STOP)


# --- the self-test in words


def result(value, ok=1, **more):
    return {"ok": ok, "value": value, "unit": "", "low": 0, "high": 10, **more}


def test_findings_pass_warn_and_fail():
    found = findings(
        {
            "converter_id": result(0x2400, 0, low=0x2401, high=0x24FF),
            "rail_5v": result(4410, low=4400, high=5500),
            "noise_0": result(2900),
            "stops": result(15),
            "temperature": "hot",
            "coffee": result(3),
            "tea": result(3, 0, low=None),
        }
    )
    verdicts = {PASS: {"noise_0", "coffee"}, FAIL: {"converter_id", "temperature", "tea"}}
    verdicts[WARN] = {"noise_1", "noise_2", "noise_3", "stops", "rail_5v"}
    assert {
        verdict: {name for name, f in found.items() if f.values["verdict"] == verdict} for verdict in verdicts
    } == verdicts
    assert found["converter_id"].values["value"] == "0x2400 (allowed: 0x2401 to 0x24ff)"
    supply = found["rail_5v"]
    assert (supply.code, supply.values["value"], supply.values["near"]) == ("test-supply", "4.41 V", True)
    assert (found["noise_1"].code, found["noise_1"].values["value"]) == ("test-noise", "")
    assert {found[name].code for name in ("noise_0", "coffee")} == {"test-passed"}
    assert (found["temperature"].code, found["tea"].code) == ("test-unreadable", "test-unknown")


@pytest.mark.parametrize(
    "junk", [None, 3, [], {}, {"ok": 2, "value": 1}, {"ok": 1, "value": 2**70}, {"ok": 1, "value": True}]
)
def test_results_that_are_none_are_failures_or_not_measured(junk):
    assert findings({"rail_5v": junk})["rail_5v"].values["verdict"] == (WARN if junk is None else FAIL)


def test_advice_names_commands_for_this_box():
    few, none = {"ok": 0, "value": 0, "unit": ""}, {"ok": 0, "value": 1, "unit": ""}
    results = {"stops": few, "thermometers_missing": none, "excitation": few}
    found = {name: finding.text(option) for name, finding in findings(results, "/dev/ttyACM1").items()}
    assert "run truearm box config set magnetostrictive.period_us=0 --box /dev/ttyACM1" in found["stops"]
    assert "truearm box config get --box /dev/ttyACM1 prints" in found["thermometers_missing"]
    assert "run truearm box config set channel.NAME.over= --box /dev/ttyACM1 for each" in found["excitation"]
