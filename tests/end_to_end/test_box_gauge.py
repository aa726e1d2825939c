"""``truearm box gauge`` with a box and an operator who moves the sensors."""

import io
import json
import re
import sys
import time

import numpy as np
import pytest
from tests.end_to_end.box_server import MAG_PERIOD_NS, Stage, box, served
from tests.refusals import ended

from truearm.box.gauge import motion
from truearm.workflows.inputs import sensors_of
from truearm_sim import sensors
from truearm_sim import stage as stages


class Operator(io.StringIO):
    """Standard input of an operator who sets the stage to each reference before typing it."""

    def __init__(self, world, lines, unit=1e-3):
        super().__init__()
        self._world, self._lines, self._unit = world, list(lines), unit

    def readline(self, *_):
        line = self._lines.pop(0) if self._lines else ""
        if line is KeyboardInterrupt:
            raise line
        if isinstance(line, tuple):  # (where the stage is, what is typed)
            self._world.position, line = line[0] * self._unit, line[1]
        return f"{line}\n"


def test_an_lvdt_is_calibrated(tmp_path, monkeypatch, printed):
    """Typed references, there and back: the bend is found, the box then reads the stage."""
    monkeypatch.chdir(tmp_path)
    references = [*np.linspace(-30, 30, 7), *np.linspace(25, -25, 5)]
    with served() as (device, world, _):
        lines = [*((mm, f"{mm}") for mm in references), (3.0, "7"), "undo", "seven", "", "y"]
        monkeypatch.setattr(sys, "stdin", Operator(world, lines))
        by = ("--instrument", "micrometer 164-163", "--uncertainty-um", "2", "--operator", "A. B.")
        said = printed("box", "gauge", "lvdt", "--box", device, "--sample-s", "0.3", "--serial", "LV-1", *by)
        assert "dropped place 13" in said
        assert " mm, such as 12.5" in said
        assert "order 2:" in said.split("← chosen")[0].splitlines()[-1]
        assert "12 places, sigma" in said
        assert f"[y/N] {device}: stored" in said.splitlines()[-1]
        entry = json.loads(printed("box", "info", "--box", device, "--json"))["streams"][0]["channels"][0]
    calibration = entry["calibration"]
    assert (calibration["unit"], calibration["serial"]) == ("m", "LV-1")
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", calibration["date"])
    assert calibration["temperature_mdegc"] == 24_500
    assert calibration["reference"] == "micrometer 164-163"
    assert calibration["reference_sigma"] == [1, -6]  # half of 2 µm, k = 2
    poly = [m * 10.0**e for m, e in calibration["poly"]]
    volts = np.linspace(-0.75, 0.75, 31)
    error = np.polynomial.polynomial.polyval(volts, poly) - np.polynomial.polynomial.polyval(volts, Stage.POLY)
    # 0.3 s are 305 samples of 5 µV or 0.19 µm: a mean is good to 11 nm, and the polynomial too; five times that, and 1 nm of rounding
    assert np.max(np.abs(error)) <= 5 * 11e-9 + 1e-9
    page = (tmp_path / "gauge-lvdt.html").read_text()
    assert "<svg" in page
    assert "residual [µm]" in page
    assert "<script" not in page
    facts = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", page))
    assert facts["sensor"] == "lvdt, serial LV-1"
    assert facts["operator"] == "A. B."
    assert facts["reference instrument"] == "micrometer 164-163"
    assert facts["its uncertainty (k = 2)"] == "2.00 µm"
    (length,) = (value for name, value in facts.items() if "calibrated length" in name)
    assert length == "2.00 µm"  # with the reference; the sensor's own 0.01 µm adds nothing
    assert facts["places"] == "12, from -30.0000 mm to 30.0000 mm"
    assert re.fullmatch(r"\w+, firmware .+", facts["box"])


def test_readings_survive_an_early_enter_and_an_absurd_reference(tmp_path, monkeypatch, capsys, printed):
    """Neither ends the measurement: with five places there is a calibration, of these five alone."""
    monkeypatch.chdir(tmp_path)
    with served() as (device, world, _):
        first = [*((mm, f"{mm}") for mm in (-20, -10, 0)), "", "999", "-200"]
        then = [(10, "10"), (20, "20"), "", "n"]
        monkeypatch.setattr(sys, "stdin", Operator(world, [*first, *then]))
        said = printed("box", "gauge", "lvdt", "--box", device, "--sample-s", "0.2", "--order", "1")
        assert "places measured: 3, a calibration needs 5" in said
        assert "999.0000 mm and -20.0000 mm" in said
        assert re.search(r"-200.0000 mm and 0.0000 mm .* 200.0000 mm apart", said)
        assert "5 places, sigma" in said
        table = tmp_path / "steps.csv"
        table.write_text("reference_mm\n-20\n-10\n0\n10\n999\n")
        assert box("gauge", "lvdt", "--box", device, "--references", table, "--force") == 2
        assert re.search("steps.csv: 999.0000 mm and -20.0000 mm .* 1019.0000 mm", capsys.readouterr().err)
        table.write_text("reference_mm\n20\n0\n-20\n0\n20\n")  # and none of the kept places
        monkeypatch.setattr(sys, "stdin", Operator(world, ["no"]))
        assert box("gauge", "lvdt", "--box", device, "--references", table, "--force") == 2
        assert "steps.csv: places: 3, a calibration needs 5" in capsys.readouterr().err
        table.write_text("reference_mm\n-20\n-10\n0\n10\n20\n")
        lines = ["no", (-20, ""), "q", *((mm, "") for mm in (-10, 0, 10, 20)), "n"]
        monkeypatch.setattr(sys, "stdin", Operator(world, lines))
        more = ("--references", table, "--sample-s", "0.2", "--order", "1", "--force")
        said = printed("box", "gauge", "lvdt", "--box", device, *more)
        assert "places measured: 1" in said
        assert "5 places, sigma" in said


def test_a_magnetostrictive_head_is_calibrated(tmp_path, monkeypatch, capsys, printed):
    """Its velocity of sound and the delay of its electronics, of which the latter takes up where the reference has its zero."""
    monkeypatch.chdir(tmp_path)
    world = Stage(mag_period_ns=MAG_PERIOD_NS)
    with served(world) as (device, _, _):
        lines = [(mm, f"{mm + 300}") for mm in (-100, -50, 0, 50, 100)]
        monkeypatch.setattr(sys, "stdin", Operator(world, [*lines, ""]))
        by = ("--instrument", "scale 17", "--uncertainty-um", "8")
        assert box("gauge", "magnetostrictive", "--box", device, "--sample-s", "0.5", "--yes", *by) == 0
        capsys.readouterr()
        said = printed("box", "config", "get", "--box", device)
        sensors = sensors_of(json.loads(printed("box", "info", "--box", device, "--json")))
        (head,) = (words for _, words in sensors if "scale 17" in words)
    residuals, uncertainty = map(float, re.findall(r"([\d.]+) µm", head))
    assert uncertainty == 8.0  # k = 2
    assert 0.0 < residuals < 10.0
    speed = float(re.search(r"us_per_inch = ([\d.]+)", said)[1])
    delay = float(re.search(r"delay_us = ([\d.]+)", said)[1])
    # 500 shots with 5.1 µm of noise over 22.5 µm ticks: the noise leaves up to 2.6 µm of the ticks' steps in a mean (truearm_sim/sensors.py)
    # and √(5.1² + 22.5²/12)/√500 = 0.4 µm of its own; over 200 mm that turns the slope by no more than 2 · 3 µm / 200 mm
    assert abs(speed / 9.031 - 1) <= 2 * 3e-6 / 0.2
    # mm/µs; the zero lies 0.4 m beyond the middle, at most
    assert abs(delay - 1.5) * 2.812 <= 1e3 * (3e-6 + 0.4 * 6e-6 / 0.2)


def test_places_that_make_no_reading(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    world = Stage(mag_period_ns=MAG_PERIOD_NS)
    world.magnet = False
    with served(world) as (device, _, _):
        monkeypatch.setattr(sys, "stdin", Operator(world, ["1", ""]))
        assert box("gauge", "magnetostrictive", "--box", device, "--sample-s", "0.2") == 2
        said = capsys.readouterr()
        assert re.search(r"rejected: .* stop pulses .* missing", said.out)
        assert "places measured: 0" in said.err
        world.POLY = (0.0, 1e-3, 0.0)  # 1.5 mm are 1.5 V, beyond the converter
        monkeypatch.setattr(sys, "stdin", Operator(world, [(1.5, "1.5"), ""]))
        assert box("gauge", "lvdt", "--box", device, "--sample-s", "0.2") == 2
        assert "converter's range" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no-rows"),
        ("reference_mm,reference_um\n1,2\n", "given-twice"),
        ("place,reference\n1,2\n", "missing-column"),
        ("reference_cm\n1\n", "wrong-value"),
        ("reference_mm\n", "no-rows"),
        ("reference_mm\none\n", "row 2 column reference_mm: 'one'"),
        ("a,reference_mm\n1\n", "row 2:"),
        ("reference_mm\n1,5\n", "row 2:"),
        ('reference_mm\n"1,5"\n', "row 2 column reference_mm: '1,5'"),
        ("a,reference_mm\n1,\n", "row 2 column reference_mm: "),
        ("reference_mm\nnan\n", "row 2"),
        ("reference_mm\n1e9\n", "row 2"),
        ("reference_mm\n" + "1\n" * 2000, "1 to 1000"),
    ],
)
def test_bad_reference_files(text, says, tmp_path, capsys):
    path = tmp_path / "r.csv"
    path.write_text(text)
    assert box("gauge", "lvdt", "--references", path, "--box", "/dev/gone") == 2
    ended(capsys.readouterr().err, says)


def test_places_outlive_a_run_that_ends_early(tmp_path, monkeypatch, capsys):
    """The next run of the same command continues from them, and both together give what one run does."""
    monkeypatch.chdir(tmp_path)
    kept, page = tmp_path / "gauge-lvdt.places.json", tmp_path / "gauge-lvdt.html"
    with served() as (device, world, _):

        def ends(code, *lines):
            monkeypatch.setattr(sys, "stdin", Operator(world, lines))
            assert box("gauge", "lvdt", "--box", device, "--sample-s", "0.3", "--order", "2") == code
            said = capsys.readouterr()
            assert said.err == ("truearm: interrupted\n" if code == 130 else "")
            return said.out

        said = ends(130, *((mm, f"{mm}") for mm in (-30, -15, 0, 3)), "undo", KeyboardInterrupt)
        assert "gauge-lvdt.places.json keeps " in said
        assert len(json.loads(kept.read_text())["places"]) == 3
        assert not page.exists()
        # at the last question: the page is written, the box unchanged
        said = ends(130, "", *((mm, f"{mm}") for mm in (15, 30)), "", KeyboardInterrupt)
        assert "gauge-lvdt.places.json: 3 places from" in said
        assert "  3: 0.0000 mm at " in said
        assert kept.exists()
        assert page.exists()
        said = ends(0, "y", "", "y")
        assert "5 places, sigma" in said
        assert "stored" in said
        assert not kept.exists()


def test_places_of_listed_references_are_not_asked_for_again(tmp_path, monkeypatch, capsys, printed):
    """There and back, a reference stands in the list twice and has been measured once."""
    monkeypatch.chdir(tmp_path)
    table = tmp_path / "steps.csv"
    table.write_text("reference_mm\n-20\n-10\n0\n10\n20\n0.1\n-20\n")
    with served() as (device, world, _):
        command = ("gauge", "lvdt", "--box", device, "--sample-s", "0.2", "--order", "1", "--references", table)
        monkeypatch.setattr(sys, "stdin", Operator(world, [(-20, ""), (-10, ""), "s", "q", "q"]))
        assert box(*command) == 2
        said = capsys.readouterr()
        assert "gauge-lvdt.places.json keeps " in said.out
        assert "places measured: 2" in said.err
        lines = ["", (0, ""), (10, ""), (20, ""), (0.1, ""), (-20, ""), "y"]
        monkeypatch.setattr(sys, "stdin", Operator(world, lines))
        said = printed("box", *command)
        assert re.findall(r"(\d) \w+ 7: set", said) == list("34567")
        assert "7 places, sigma" in said


def test_kept_places_of_something_else_are_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    kept, lvdt = tmp_path / "gauge-lvdt.places.json", '{"uid": "u", "channel": "lvdt", "unit": "V", "scale": 1.0'
    with served() as (device, _, _):
        for text, says in (
            ("\0", "holds no places"),
            ('{"channel"', "truncated"),
            ("{}", "`uid`"),
            (f"{lvdt}}}", "box 'u'"),
            (
                f'{lvdt}, "places": [{{"reference": null, "mean": [0, 0, 0, 0], "temperature": 0}}]}}',
                "places[0].reference",
            ),
            (
                f'{lvdt}, "places": [{{"reference": 0, "mean": [0, -1, 0, 9, 9, 0, 0], "temperature": 0}}]}}',
                "places[0].mean[1]",
            ),
            (f'{{"a": {"[" * 90_000}{"]" * 90_000}}}', "recursion"),
        ):
            kept.write_text(text)
            assert box("gauge", "lvdt", "--box", device) == 2
            assert says in capsys.readouterr().err
            assert kept.read_text() == text


class Rehearsal(io.StringIO):
    """Standard input of somebody at `truearm simulate --stage`: sets the carriage, waits for it to arrive or not, types what it reads."""

    def __init__(self, stage, lines):
        super().__init__()
        self._stage, self._lines = stage, list(lines)

    def readline(self, *_):
        line = self._lines.pop(0) if self._lines else ""
        if isinstance(line, tuple):
            mm, waits = line
            self._stage.move_to(1e-3 * mm)
            end = time.monotonic() + 20.0
            while waits and self._stage.position(np.array([self._stage.now_s]))[0] != 1e-3 * mm:
                assert time.monotonic() < end
                time.sleep(0.02)
            line = f"{mm}"
        return f"{line}\n"


def test_a_gauging_is_rehearsed_on_the_simulated_stage(tmp_path, monkeypatch, capsys, printed):
    """Five places make a calibration, four do not; a carriage that still moves makes no place; the hidden curve is found."""
    monkeypatch.chdir(tmp_path)
    places = [-10, -5, 0, 5, 10]
    stage = stages.Stage(3)
    with served(stage) as (device, _, _):
        command = ["gauge", "lvdt", "--box", device, "--sample-s", "0.3", "--order", "2", "--yes"]
        monkeypatch.setattr(sys, "stdin", Rehearsal(stage, [*((mm, True) for mm in places[:4]), (-5, True), ""]))
        assert box(*command) == 2
        said = capsys.readouterr()
        assert "places measured: 4 (5 readings" in said.err
        monkeypatch.setattr(sys, "stdin", Rehearsal(stage, ["n", (40, False), *((mm, True) for mm in places), ""]))
        said = printed("box", *command)
        assert re.search(r"rejected: the sensor moved by [-+][\d.e-]+ V ", said)
        assert "5 places, sigma" in said
        entry = json.loads(printed("box", "info", "--box", device, "--json"))["streams"][0]["channels"][0]
    m, e = entry["calibration"]["sigma"]
    assert m * 10.0**e > 0.1e-6  # the simulator's means all have one error here, and five residuals show none of it
    found = np.array([m * 10.0**e for m, e in entry["calibration"]["poly"]])
    curve, at = stage.curves[0], 1e-3 * np.linspace(-10.0, 10.0, 9)
    # a sample's 3 µm over √305 is 0.17 µm a place; five places, a parabola: 0.17 µm times 0.94 at the ends, four times that
    error = np.polynomial.polynomial.polyval(curve.volts(at), found) - at
    assert np.abs(error).max() < 4 * 0.17e-6
    assert (
        abs(
            np.polynomial.polynomial.polyval(curve.volts(at), (sensors.POLY[0][0] * 1e-7, sensors.POLY[1][0] * 1e-7))
            - at
        ).max()
        > 2e-5
    )


@pytest.mark.parametrize("n", [16, 60, 500, 2000])
def test_a_sensor_that_stands_still_is_never_said_to_move(n):
    """White noise, noise below one step of the converter, and slow noise of a third of a sample's own: 400 draws each."""
    rng = np.random.default_rng(3)
    for _ in range(400):
        white = 77e-6 * rng.standard_normal(n)
        slow = 26e-6 * np.cumsum(rng.standard_normal(n)) / np.sqrt(n)
        assert motion(0.4 + white) == motion(0.4 + white + 0.3 * slow) == 0.0
    assert motion(np.full(n, 0.4)) == motion(np.where(np.arange(n) % 7 == 3, 0.4, 0.4 + 1e-7)) == 0.0


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("n", [60, 500])
def test_a_sensor_that_moves_during_any_part_is_seen(n, share):
    """It arrives, or leaves, after a tenth, half or nine tenths of the samples; it goes there and comes back."""
    rng = np.random.default_rng(4)
    t = np.linspace(0.0, 1.0, n)
    for path in (
        np.clip(t - share, 0.0, None),
        np.clip(share - t, 0.0, None),
        np.where(abs(t - share) < 0.1, 0.1, 0.0),
    ):
        moved = motion(0.05 * path + 77e-6 * rng.standard_normal(n))
        assert abs(moved) > 1e-3
    assert motion(0.05 * np.clip(t - share, 0.0, None)) > 0.0 > motion(-0.05 * np.clip(t - share, 0.0, None))
