"""What ``truearm box monitor`` shows: thermometers by name, the difference from the calibration's temperature, the clock."""

import dataclasses
import re
from types import SimpleNamespace

import pytest
from record_live import box

from truearm.box.control import Sent
from truearm.box.monitor import Watch, clock_words, rows_of
from truearm.record.requests import FrameCount
from truearm_wire.messages import TEMPERATURE

CALIBRATED = {"unit": "m", "poly": [[0, 0], [4, -2]], "serial": "", "date": "2026-01-01", "temperature_mdegc": 21_000}


def beaten(watch, mdegc=26_000):
    heartbeat = {"temperature_mdegc": mdegc, "loop_max_us": 1000}
    return dict(rows_of(watch, 1.0, SimpleNamespace(frame_count=FrameCount(), heartbeat=heartbeat)))


def test_thermometers_are_shown_by_their_names_or_missed():
    watch = Watch(dataclasses.replace(box(calibration=CALIBRATED), thermometers=("bar", "sensor")))
    watch.take(Sent(0, TEMPERATURE, None, {"thermometer": 1, "temperature_mdegc": 24_062}))
    rows = beaten(watch)
    assert rows["thermometers"] == "bar not read yet, sensor 24.06 °C"
    assert "temperature" not in rows  # lengths are corrected
    rows = beaten(Watch(box(calibration=CALIBRATED)))
    assert "5.0 °C warmer" in rows["temperature"]
    assert "thermometers" not in rows
    assert "temperature" not in beaten(Watch(box(calibration=CALIBRATED)), 22_900)
    assert "temperature" not in beaten(Watch(box()))


@pytest.mark.parametrize(("seconds", "rates"), [(2, []), (40, ["host 37.0 ppm"])])
def test_the_rate_of_the_clocks_is_shown_once_the_exchanges_bound_it(seconds, rates):
    """Round trips of 1.2 ms bound the rate to 600 ppm in 2 s, and to 30 ppm in 40 s."""
    watch = Watch(box())
    for k in range(4 * seconds):
        host_ns = 250_000_000 * k
        device_us = round(250_000 * k * (1.0 + 37e-6))
        watch.exchanges.append((host_ns, device_us + 600, device_us + 605, host_ns + 1_205_000))
    assert re.findall(r"\w+ [\d.]+ ppm", clock_words(watch)) == rates
