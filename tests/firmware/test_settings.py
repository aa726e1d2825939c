"""The configuration: read and written by command, kept on flash, old and damaged files; self-test, reset, the last traceback."""

import copy
import json

import cbor2
import pytest

from tests.firmware.conftest import Bench, flash_folder, ident_document, real_micropython
from tests.wire_frames import command, frames
from truearm_sim.box import CRASH, HEALTHY
from truearm_wire import cbor, frame, messages
from truearm_wire.messages import ERROR, IDENT, PUT_CONFIG, REPLY

OLD = {  # as a box of version 1.0 has it
    "osr": 1024,
    "channels": [{"name": name, "unit": "V", "scale": [1430511474609375, -22]} for name in ("lvdt", "a", "b", "ref")],
}


@pytest.fixture
def flash(tmp_path):
    return flash_folder(tmp_path / "flash")


@pytest.fixture
def boot(flash):
    """Return a function that boots a box from the flash folder."""
    boxes = []

    def boot(**setup):
        for box in boxes:
            box.box.close()
        boxes.append(Bench(real_micropython(), flash=flash, boot_id=len(boxes) + 1, **setup))
        return boxes[-1]

    yield boot
    for box in boxes:
        box.box.close()


def changed(config, **changes):
    """Return the configuration with changed keys, also by path: magnetostrictive__serial."""
    config = copy.deepcopy(config)
    for key, value in changes.items():
        *path, last = key.split("__")
        table = config
        for part in path:
            table = table[int(part) if isinstance(table, list) else part]
        table[int(last) if isinstance(table, list) else last] = value
    return config


def test_a_configuration_is_put_told_kept_and_in_force(boot):
    box = boot()
    config = changed(
        box.document(messages.GET_CONFIG),
        osr=512,
        magnetostrictive__serial="T-1234",
        magnetostrictive__us_per_inch=[9017, -3],
        magnetostrictive__reference="gauge blocks 4711",
        magnetostrictive__reference_sigma=[1, -6],
        channels__0__calibration={"unit": "m", "poly": [[-42, -5], [379, -4]], "serial": "L7", "date": "2026-03-04"},
        debounce_us=[2000, 0],
    )
    answer = box.put(config)
    assert [f[0] for f in answer] == [REPLY] + [IDENT] * (len(answer) - 1)
    assert {f[2] for f in answer} == {box.req_id}
    said = ident_document(answer)
    adc = said["streams"][0]
    assert (adc["osr"], adc["period_ns"], adc["group_delay_ns"]) == (512, 122_880, 360 * 511)
    assert adc["channels"] == config["channels"]
    of_head = said["streams"][1]["channels"][0]["calibration"]
    assert of_head["serial"] == "T-1234"
    assert (of_head["reference"], of_head["reference_sigma"]) == ("gauge blocks 4711", [1, -6])
    assert "sigma" not in of_head
    assert box.document(messages.GET_CONFIG) == config
    box = boot()
    assert box.document(messages.GET_CONFIG) == config
    assert "fault" not in ident_document(box.boot)


@pytest.mark.parametrize("gain", [1, 2, 32, 64, 128])
def test_the_scale_that_is_told_is_of_the_volts_before_the_gain(boot, gain):
    box = boot()
    answer = box.put(changed(box.document(52), channels__2__gain=gain))
    mantissa, exponent = ident_document(answer)["streams"][0]["channels"][2]["scale"]
    assert float(f"{mantissa}e{exponent}") == 1.2 / 2**23 / gain


def test_an_old_configuration_is_completed_with_the_head_off(boot, flash):
    (flash / "config.json").write_text(json.dumps(OLD))
    box = boot()
    said = ident_document(box.boot)
    assert "fault" not in said
    assert [s["osr"] for s in said["streams"]] == [1024]
    config = box.document(messages.GET_CONFIG)
    assert (config["version"], config["magnetostrictive"]["period_ns"]) == (2, 0)
    assert config["channels"] == OLD["channels"]
    assert box.put(OLD)[0][0] == REPLY


# changes of a configuration, by key or path (channels__1__gain), and words of the refusal
NO_CONFIGURATIONS = [
    ({"version": 3}, "version 3"),
    ({"osr": 1000}, "osr"),
    ({"osr": "4096"}, "osr"),
    ({"channels": []}, "four channels"),
    ({"channels__1": 7}, "a table with a name"),
    ({"channels__1__gain": 3}, "transverse_a: gain"),
    ({"channels__1__scale": [1, 2, 3]}, "mantissa"),
    ({"channels__0__calibration": {"unit": "m", "poly": [[1, 0]], "serial": 5, "date": ""}}, "serial: must be text"),
    ({"magnetostrictive": 7}, "magnetostrictive"),
    *(({"magnetostrictive__blanking_ns": ns}, "blanking_ns") for ns in (4992, 10_001)),
    ({"magnetostrictive__timeout_ns": 10_000}, "timeout_ns"),
    ({"magnetostrictive__period_ns": 503_992}, "period_ns"),
    *(({"magnetostrictive__us_per_inch": number}, "us_per_inch") for number in ([905, -1], [0, 0], [2**63, 0])),
    ({"magnetostrictive__delay_ns": 100_001}, "delay_ns"),
    ({"magnetostrictive__date": 1993}, "date: must be text"),
    *(({"debounce_us": times}, "debounce_us") for times in ([0], [0, -1])),
    *(({"watchdog_ms": ms}, "watchdog_ms") for ms in (20, 9000)),
    ({"note": b"bytes"}, "bytes have no place"),
    ({"channels__3__notes": [{"deep": b""}]}, "bytes have no place"),
    *(({"thermometers": names}, "table of at most 4") for names in ([], {f"t{k}": f"{k:016x}" for k in range(5)})),
    ({"thermometers": {"": "28aa01020304050f"}}, "1 to 32 characters"),
    *(({"thermometers": {"bar": uid}}, "16 hexadecimal digits") for uid in (7, "28AA01020304050F", "28aa01020304050")),
    ({"thermometers": {"bar": "28aa01020304050f", "x": "28aa01020304050f"}}, "the same address"),
    *(
        ({"trigger_ms": limits}, "trigger_ms")
        for limits in ([0, 100], [9, 100], [100, 100], [300, 200], [10, 16001], [10], [-5, 5], "fast", 3)
    ),
]


def test_what_is_no_configuration_is_refused_in_words_and_changes_nothing(boot, flash):
    box = boot()
    before = box.document(messages.GET_CONFIG)
    for changes, text in NO_CONFIGURATIONS:
        (error,) = box.put(changed(before, **changes))
        assert (error[0], error[3]) == (ERROR, messages.ERROR_RANGE), changes
        assert text in error[4], changes
        assert box.document(messages.GET_CONFIG) == before, changes
    assert sorted(p.name for p in flash.glob("config*")) == []


# commands without their id, and the code of the refusal: unknown, malformed, out of range
NO_COMMANDS = {
    messages.ERROR_UNKNOWN: [(60,)],
    messages.ERROR_MALFORMED: [
        *((49,), (49, 0), (49, 0, "4096"), (56,), (56, "0"), (57,), (57, -1)),
        *((PUT_CONFIG, *page) for page in ((0, 1), (0, 1, "x"), ("0", 1, b"x"), (-1, 1, b"x"), ())),
    ],
    messages.ERROR_RANGE: [
        *((49, 0, 1000), (49, 3, 4096), (56, 2), (57, 2)),
        *((49, 1, period) for period in (8, 983_041, 99_992, 500_000, 1_000_000_008, 2**30 - 8)),
        # not from 0; no pages; too many; empty; no CBOR
        *(
            (PUT_CONFIG, *page)
            for page in ((1, 2, b"x"), (0, 0, b"x"), (0, 17, b"x"), (0, 1, b""), (0, 1, b"\xff"), (0, 1, b"\x9f\xff"))
        ),
    ],
}


def test_what_is_no_command_is_refused_by_code(bench):
    req_id = 0
    for code, commands in NO_COMMANDS.items():
        for kind, *values in commands:
            req_id += 1
            (error,) = bench.give(rx=frame.frame(cbor.encode([kind, req_id, *values])))
            assert (error[0], error[2], error[3]) == (ERROR, req_id, code), (kind, values)


def test_refused_while_streaming(bench):
    bench.start()
    for kind, *values in ((49, 0, 4096), (49, 1, 0), (50,), (52,), (53, 0, 1, b"x"), (54,), (55,), (56, 0)):
        (error,) = bench.command(kind, *values)
        assert (error[0], error[3]) == (ERROR, messages.ERROR_STREAMING), kind
        assert bench.answer.end == ""


def test_pages_come_in_order_and_page_0_begins_anew(bench):
    pages = messages.pages(cbor2.dumps({**bench.document(52), "note": "x" * 200}))
    assert len(pages) == 3
    send = [pages[0], pages[1], pages[0], pages[2]]
    answers = [bench.command(PUT_CONFIG, *page)[0] for page in send]
    assert [a[0] for a in answers] == [REPLY, REPLY, REPLY, ERROR]
    assert bench.command(PUT_CONFIG, *pages[1])[0][0] == ERROR, "what was begun is dropped"
    assert [bench.command(PUT_CONFIG, *page)[0][0] for page in pages] == [REPLY] * len(pages)


def test_a_page_that_comes_again_is_answered_again_and_not_taken_twice(bench):
    pages = messages.pages(cbor2.dumps(bench.document(52)))
    for k, page in enumerate(pages):
        first, again = (bench.give(rx=command(PUT_CONFIG, 50 + k, *page)) for _ in range(2))
        assert [f[0] for f in first] == [f[0] for f in again]
        assert first[0][0] == REPLY
    assert [f[0] for f in again[1:]] == [IDENT] * (len(again) - 1) != []


def test_a_full_configuration_fits_the_chip(chip):
    """The longest that is accepted: sixteen pages, whatever is in them; the heap is the chip's."""
    config = chip.document(52)
    config["note"] = "x" * (3200 - 3 - len(cbor2.dumps(config)) - len(cbor2.dumps("note")))
    assert len(cbor2.dumps(config)) == 3200
    for _ in range(3):
        assert chip.put(config)[0][0] == REPLY
    assert chip.document(52) == config


@pytest.mark.parametrize("part", [{}, [], 7, "", {"a": []}], ids=str)
def test_a_configuration_of_many_small_parts_does_not_exhaust_the_heap(chip, part):
    """In memory a part of one byte may take 40. It is refused or it leaves room: the box goes on, and boots with it."""
    config = chip.document(52)
    config["note"] = [part] * ((3190 - len(cbor2.dumps({**config, "note": []}))) // len(cbor2.dumps(part)))
    answer = chip.put(config)
    assert chip.answer.end == ""
    if answer[0][0] == ERROR:
        assert answer[0][3] == messages.ERROR_RANGE
        assert answer[0][4] in ("it takes too much memory", "it is longer than 8000 characters")
    for _ in range(3):
        assert chip.document(52)["version"] == 2
        assert ident_document(chip.command(48))["board"] == "vm"
    chip.start()
    found = [f for _ in range(200) for f in chip.sample(13)]
    assert sum(f[0] == messages.DATA for f in found) == 200


@pytest.mark.parametrize("part", ["{}", "[]", "7"])
def test_a_file_of_many_small_parts_does_not_keep_the_box_from_booting(boot, flash, part):
    config = changed(boot().document(52))
    config["note"] = [json.loads(part)] * 2000
    (flash / "config.json").write_text(json.dumps(config, separators=(",", ":"))[:8000])
    said = ident_document(boot().boot)
    assert said["streams"][0]["osr"] == 4096


# -- what the flash does


def test_a_newer_version_on_flash_is_a_fault_and_the_file_before_it_serves(boot, flash):
    box = boot()
    first = changed(box.document(52), osr=512)
    box.put(first)
    box.put(changed(first, osr=256))
    assert json.loads((flash / "config.json.old").read_text())["osr"] == 512
    (flash / "config.json").write_text(json.dumps(changed(first, version=3)))
    box = boot()
    said = ident_document(box.boot)
    assert said["fault"] == "config: version 3; this firmware knows 2; the one before it is used"
    assert said["streams"][0]["osr"] == 512
    # putting one again mends it, and the damaged file does not take the good one's place
    assert "fault" not in ident_document(box.put(changed(first, osr=128)))
    assert json.loads((flash / "config.json.old").read_text())["osr"] == 512
    assert "fault" not in ident_document(boot().boot)


@pytest.mark.parametrize(
    "text", ["", "{", "[" * 5000, '{"version": 2}', "\x00" * 900, "9" * 9000, '{"a":' * 900 + "1" + "}" * 900]
)
def test_rubbish_on_flash_is_a_fault_and_no_reason_not_to_boot(boot, flash, text):
    (flash / "config.json").write_text(text)
    said = ident_document(boot().boot)
    assert said["fault"].startswith("config: ")
    assert said["fault"].endswith("; the default one is used")


def test_between_the_two_renames_the_old_one_serves(boot, flash):
    box = boot()
    box.put(changed(box.document(52), osr=512))
    (flash / "config.json").rename(flash / "config.json.old")
    (flash / "config.json.new").write_text("{half")
    said = ident_document(boot().boot)
    assert "fault" not in said
    assert said["streams"][0]["osr"] == 512


def test_a_flash_that_takes_nothing_is_an_error_and_the_box_goes_on(boot, flash):
    box = boot()
    before = box.document(52)
    (flash / "config.json.new").mkdir()  # no file can be opened there
    (error,) = box.put(changed(before, osr=512))
    assert (error[0], error[3]) == (ERROR, messages.ERROR_STORAGE)
    assert "flash" in error[4]
    assert box.document(52) == before
    (flash / "config.json.new").rmdir()
    assert box.put(changed(before, osr=512))[0][0] == REPLY


# -- self-test, traceback, ways out


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("converter_id", 0xFFFF, "the converter's ID register: 65535 (must be 9216 to 9471)"),
        ("excitation", 900, "the current of the LVDT's primary: 900 uV"),
        ("noise_2", 0, "the noise of input 2, shorted: 0 nV"),
        ("stops", 3, "stop pulses of 16 interrogations: 3 (must be 15 to 16)"),
        ("rail_5v", 4300, "the supply of 5 V: 4300 mV (must be 4400 to 5500)"),
    ],
)
def test_an_injured_box_says_so_at_boot_and_on_command(name, value, text):
    box = Bench(real_micropython(), self_test={**HEALTHY, name: value})
    assert text in ident_document(box.boot)["fault"]
    results = box.document(messages.SELF_TEST)
    assert [n for n, r in results.items() if not r["ok"]] == [name]
    assert results[name]["value"] == value
    box.box.close()


def test_the_last_traceback_is_told_until_a_reset_by_command(boot):
    box = boot()
    box.start()
    box.sample(26, flags=CRASH)
    assert box.answer.end == "reset"
    for _ in range(2):
        box = boot()
        said = ident_document(box.boot)["last_error"]
        assert said.endswith("RuntimeError: injected by the simulator\n")
    assert [f[0] for f in box.command(messages.RESET, 0)] == [REPLY]
    assert box.answer.end == "reset"
    assert "last_error" not in ident_document(boot().boot)


def test_a_traceback_that_is_no_text_any_more_does_no_harm(boot, flash):
    (flash / "last_error.txt").write_bytes(b"\xff\xfe" * 4000)
    assert ident_document(boot().boot)["boot_id"] == 1


@pytest.mark.parametrize(
    ("values", "end"), [((55,), "prompt"), ((56, 0), "reset"), ((56, 1), "boot loader")], ids=["repl", "reset", "boot"]
)
def test_the_ways_out_answer_first(values, end):
    box = Bench(real_micropython())
    assert [f[0] for f in box.command(*values)] == [REPLY]
    assert box.answer.end == end
    box.box.close()


def test_the_answer_to_a_way_out_waits_for_the_link(chip):
    chip.give(rx=command(56, 5, 0), tx_room=5)
    assert chip.answer.end == ""
    tx = chip.answer.tx
    chip.give()
    assert chip.answer.end == "reset"
    assert [f[0] for f in frames(tx + chip.answer.tx)] == [REPLY]
