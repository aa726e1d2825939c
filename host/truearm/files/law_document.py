"""The joint laws in result.json (docs/reference/result-format.md): written and read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from truearm.results import JointLaws, LawStep, TriedLaw
from truearm.schema import Choice, Flag, Key, List, Number, ReadOnly, Table, Whole, as_table, at
from truearm.types import CurveKnots, Law, Payload, SagMasses
from truearm.units import DEG, MM, MRAD, key, shown

MAX_LAWS = 200
MAX_COEFFICIENTS = 2000
MAX_JOINT = 63


def law_document(found: JointLaws | None, held_out: Any, units: Sequence[str]) -> dict[str, Any] | None:
    """Return the field ``joint_laws``; ``held_out`` makes an entry of a HeldOut, ``units`` are of the residuals."""
    if found is None:
        return None
    return {
        "mode": found.mode,
        "reasons": list(found.reasons),
        "gravity": list(found.gravity),
        "gravity_known": found.gravity_known,
        "payloads": [
            {"mass_kg": one.mass, "centre_mm": MM.of(np.array(one.centre)).tolist()} for one in found.payloads
        ],
        "laws": [_law(law) for law in found.kept],
        "tried": [_tried(law) for law in found.tried],
        "steps": [_step(step, held_out, units) for step in found.steps],
        "noise": {
            "factor": _finite(found.noise_factor),
            "shared_mm": _finite(shown(found.noise_shared, "m")),
            "joint_mrad": _finite(MRAD.of(found.noise_joint)),
        },
    }


def _law(law: Law) -> dict[str, Any]:
    if isinstance(law, CurveKnots):
        return {
            "term": "curve",
            "joint": law.joint,
            "first_rad": law.first,
            "spacing_rad": law.spacing,
            "count": law.count,
            "periodic": law.periodic,
            "covered_rad": [list(interval) for interval in law.covered],
        }
    return {
        "term": "sag",
        "joint": law.joint,
        "frames": list(law.frames),
        "gravity": list(law.gravity),
        "payload": law.payload,
    }


def _tried(law: TriedLaw) -> dict[str, Any]:
    return {
        "joint": law.joint,
        "term": law.term,
        "nats": _finite(law.nats),
        "kept": law.kept,
        "rms_mrad": _finite(MRAD.of(law.rms)),
        "range_share": _finite(law.range_share),
        "covered_deg": [[DEG.of(end) for end in interval] for interval in law.covered],
        "resolution_cycles": _finite(law.resolution),
        "periods": [{"cycles": one.cycles, "amplitude_mrad": MRAD.of(one.amplitude)} for one in law.periods],
    }


def _step(step: LawStep, held_out: Any, units: Sequence[str]) -> dict[str, Any]:
    after = {key("rms_after", si): _finite(shown(step.rms_after.get(si, float("nan")), si)) for si in units}
    return {"name": step.name, **after, "held_out": held_out(step.held_out, units)}


def _finite(value: float) -> float | None:
    return float(value) if abs(value) < float("inf") else None


class _LawValue(ReadOnly):
    """A joint law as stored; its keys depend on its term."""

    def parse(self, raw: Any, suffix: str = "") -> Law:
        table = as_table(raw)
        with at("term"):
            term = TERM.parse(table.get("term"))
        return Table((Key("term", TERM), *KEYS[term]), _MAKE[term], unknown_keys=True).parse(table)


def _curve(
    term: str, joint: int, first: float, spacing: float, count: int, periodic: bool, covered: Sequence[Sequence[float]]
) -> CurveKnots:
    return CurveKnots(joint, first, spacing, count, periodic, tuple((low, high) for low, high in covered))


def _sag(
    term: str, joint: int, frames: tuple[int, ...], gravity: tuple[float, float, float], payload: bool = False
) -> SagMasses:
    return SagMasses(joint, frames, gravity, payload)


TERM = Choice(("curve", "sag"))
_JOINT = Key("joint", Whole(0, MAX_JOINT))
_RAD = ("rad",)
KEYS: Mapping[str, tuple[Key, ...]] = {
    "curve": (
        _JOINT,
        Key("first", Number("rad", spelled=_RAD)),
        Key("spacing", Number("rad", positive=True, spelled=_RAD)),
        Key("count", Whole(4, MAX_COEFFICIENTS)),
        Key("periodic", Flag()),
        Key("covered", List(List(Number("rad", spelled=_RAD), 2), least=0, most=MAX_COEFFICIENTS)),
    ),
    "sag": (
        _JOINT,
        Key("frames", List(Whole(1, MAX_JOINT + 1), least=0)),
        Key("gravity", List(Number("1"), 3)),
        Key("payload", Flag(), optional=True),
    ),
}
_MAKE: Mapping[str, Callable[..., Law]] = {"curve": _curve, "sag": _sag}
PAYLOAD = Table((Key("mass", Number("kg", least=0.0)), Key("centre", List(Number("m"), 3))), Payload, unknown_keys=True)
LAWS: Table[dict[str, Any]] = Table(
    (
        Key("laws", List(_LawValue(), least=0, most=MAX_LAWS)),
        Key("payloads", List(PAYLOAD, least=0), optional=True),
    ),
    dict,
    unknown_keys=True,
)
