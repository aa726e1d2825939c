"""The findings about joint laws, from the content of result.json."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

from truearm.findings import Finding, stated
from truearm.text import counted, one_line

WORDS = {"shared": "shared by the rows of a pose", "turned": "of rotation shared by the rows of a pose"}
SMALL_SHARE = 0.5  # of the range of a sag: it is extrapolated by more than it was measured


def law_findings(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Return what was learned about joint laws; empty if they were not requested."""
    laws = document["joint_laws"]
    if laws is None:
        return
    for reason in laws["reasons"]:
        yield Finding("no-law", {"reason": reason})
    kept_laws = [law for law in laws["tried"] if law["kept"]]
    dropped = [law for law in laws["tried"] if not law["kept"]]
    if not kept_laws:
        yield Finding("no-law", {"tried": len(dropped), "none": not dropped})
        return
    for law in kept_laws:
        yield _law_kept(law)
    if dropped:
        names = [f"{law['joint']} {law['term']} {round(law['nats'], 1) + 0.0:.1f}" for law in dropped]
        yield Finding("no-law", {"dropped": ", ".join(map(one_line, names))})
    sags = [law for law in kept_laws if law["term"] == "sag"]
    if sags and not laws["gravity_known"]:
        yield Finding("gravity-assumed")
    shares = [(law["joint"], law.get("range_share")) for law in sags]  # earlier results do not have it
    small = [f"{joint} {share:.0%}" for joint, share in shares if share is not None and share < SMALL_SHARE]
    if small:
        yield Finding("sag-extrapolated", {"joints": small})
    payloads = laws.get("payloads", [])
    masses = [f"{mass:g}" for mass in sorted({payload["mass_kg"] for payload in payloads})]
    if sags and any(payload["mass_kg"] for payload in payloads):
        values = {"masses": masses, "several": len(payloads) > 1, "holder": "the calibration"}
        yield Finding("sag-payload", values)
    terms = [f"{laws['noise']['factor']:.2g} times the declared variances", *scatter_terms(laws["noise"])]
    yield Finding("law-noise", {"terms": terms})


def scatter_terms(sizes: Mapping[str, float]) -> list[str]:
    """Return the arm's scatter in words: the sizes in the field ``noise`` of joint laws, or in ``pose_error``."""
    terms = []
    for name, sigma in sizes.items():
        quantity, _, unit = name.rpartition("_")
        if sigma and (unit == "mm" or quantity == "turned"):
            terms.append(f"{sigma:.2g} {unit} {WORDS.get(quantity, f'at the tool by {one_line(quantity)}')}")
    return terms


def _law_kept(law: Mapping[str, Any]) -> Finding:
    rms = {"mrad": float(f"{law['rms_mrad']:.2g}")}
    if law["term"] != "curve":
        return stated("law-kept", law, rms=rms)
    periods = [f"{period['cycles']:.0f} ({period['amplitude_mrad']:.2g} mrad)" for period in law["periods"]]
    values = {"covered": intervals_text(law["covered_deg"]), "periods": periods, "short": not periods}
    return stated("law-kept", law, rms=rms, **values, resolution=law["resolution_cycles"])


Document = Mapping[str, Any]
MOST_GAPS = 4  # named


def intervals_text(intervals: Sequence[Sequence[float]]) -> str:
    """Return ascending intervals [deg] as their whole range and its widest gaps."""
    if not intervals:
        return "nowhere"
    text = f"{intervals[0][0]:.0f} to {intervals[-1][1]:.0f} deg"
    gaps = [(a[1], b[0]) for a, b in pairwise(intervals)]
    named = sorted(sorted(gaps, key=lambda gap: gap[0] - gap[1])[:MOST_GAPS])
    if not named:
        return text
    listed = ", ".join(f"{low:.0f} to {high:.0f}" for low, high in named)
    smaller_gaps = f" and {counted(len(gaps) - len(named), 'smaller gap')}" * (len(gaps) > len(named))
    return f"{text} except {listed} deg{smaller_gaps}"
