"""The board's measurements in its self-test, evaluated.

converter_id        the ADS131M04's ID register, 24xx
excitation          µV on the channel by which another is divided: the current of the LVDT's primary, demodulated
                    (docs/how-to/hardware.md)
noise_0 … noise_3   nV RMS with the inputs shorted, at gain 1 and osr 4096: about 3000 by the datasheet; 0: the
                    converter does not run
stops               of 16 interrogations
rail_5v             mV; USB allows 4.4 to 5.5 V
temperature         thousandths of a degree Celsius
thermometers_missing  those named in the configuration but not found
"""

LIMITS = {  # name: unit, low, high
    "converter_id": ("", 0x2400, 0x24FF),
    "excitation": ("uV", 40000, 1200000),
    "noise_0": ("nV", 1, 20000),
    "noise_1": ("nV", 1, 20000),
    "noise_2": ("nV", 1, 20000),
    "noise_3": ("nV", 1, 20000),
    "stops": ("", 15, 16),
    "rail_5v": ("mV", 4400, 5500),
    "temperature": ("mdegC", -20000, 70000),
    "thermometers_missing": ("", 0, 0),
}

WORDS = {
    "converter_id": "the converter's ID register",
    "excitation": "the current of the LVDT's primary",
    "noise_0": "the noise of input 0, shorted",
    "noise_1": "the noise of input 1, shorted",
    "noise_2": "the noise of input 2, shorted",
    "noise_3": "the noise of input 3, shorted",
    "stops": "stop pulses of 16 interrogations",
    "rail_5v": "the supply of 5 V",
    "temperature": "the chip's temperature",
    "thermometers_missing": "thermometers of the configuration that do not answer",
}


def judge(measured):
    """Return the results (SPEC §5) of measurements by name."""
    results = {}
    for name in measured:
        value = measured[name]
        unit, low, high = LIMITS[name]
        results[name] = {"ok": 1 if low <= value <= high else 0, "value": value, "unit": unit, "low": low, "high": high}
    return results


def failure(results):
    """Return the failed results in words, or None."""
    bad = []
    for name in sorted(results):
        r = results[name]
        if not r["ok"]:
            what = "%s: %d %s" % (WORDS[name], r["value"], r["unit"])
            bad.append("%s (must be %d to %d)" % (what.strip(), r["low"], r["high"]))
    return "self-test: " + "; ".join(bad) if bad else None
