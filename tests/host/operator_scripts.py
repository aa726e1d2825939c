"""Operators with human errors, as seeded scripts over a plan: what they mount and type, which poses are skipped or
repeated.

A script is a list of visits in order. ``planned`` is the row of the plan to which the robot goes, ``mounted`` is really
mounted, ``typed`` is what the operator types between the previous visit and this one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from session_stream import BLOCK, CHANNELS, PERIOD_NS, Box, counts_of, renumber, robot_messages

from truearm.kinds.rig_file import format_rig
from truearm.model.chain import Chain, point_forward
from truearm.record.session_writer import SessionWriter
from truearm.types import BAR_MOUNTED, Message, Plan, Rig
from truearm.workflows.record import plan_rows

Pairing = tuple[str, str, str]  # bar, chuck, sphere

# the operator's behaviour at the changes that the plan requires, with probabilities
CHANGES = {
    "right": 0.45,
    "missed": 0.14,  # mounted, not typed
    "doubled": 0.08,  # typed twice
    "late": 0.12,  # typed one to three dwells later
    "wrong word": 0.09,  # mounted, but another pairing is typed
    "wrong part": 0.08,  # another bar, chuck or sphere is mounted; the requested one is typed
    "forgotten": 0.04,  # nothing is changed, but Enter is pressed
}
# the same of an operator who forgets: nothing is typed until a later change is confirmed
FORGETS = {"right": 0.5, "not typed": 0.2, "not mounted": 0.3}
SKIPPED, REPEATED, BACK = 0.05, 0.05, 0.02
NOTICED = (1, 4)  # visits after which a wrong part is noticed and corrected


@dataclass(frozen=True)
class Visit:
    planned: int
    mounted: Pairing
    typed: tuple[Pairing, ...] = ()


def pairing_at(plan: Plan, row: int) -> Pairing:
    return str(plan.bar[row]), str(plan.chuck[row]), str(plan.sphere[row])


def script(seed: int, plan: Plan, rig: Rig) -> list[Visit]:
    """Return the actions of one operator for a plan."""
    rng = np.random.default_rng([seed, 0x0E44])
    on = pairing_at(plan, 0)
    asked = on
    wrong_left = 0  # visits until a wrong part is noticed
    later: list[tuple[int, Pairing]] = []  # to be typed after this many visits
    visits: list[Visit] = []
    for row in _rows(rng, len(plan)):
        typed: list[Pairing] = []
        wanted = pairing_at(plan, row)
        is_back = bool(visits) and row < visits[-1].planned
        if wrong_left:
            wrong_left -= 1
            if not wrong_left:
                on = asked
        if wanted != asked and not is_back:
            asked = wanted
            how = str(rng.choice(list(CHANGES), p=list(CHANGES.values())))
            wrong_left = 0
            if how == "wrong part":
                on, wrong_left = _one_part_other(rng, wanted, rig), int(rng.integers(*NOTICED)) + 1
            elif how == "forgotten":
                wrong_left = int(rng.integers(*NOTICED)) + 1
            else:
                on = wanted
            if how == "late":
                later.append((len(visits) + int(rng.integers(1, 4)), wanted))
            elif how == "wrong word":
                typed.append(_one_part_other(rng, wanted, rig))
            elif how != "missed":
                typed += [wanted] * (1 + (how == "doubled"))
        typed = [words for due, words in later if due == len(visits)] + typed
        visits.append(Visit(row, on, tuple(typed)))
    return visits


def forgetful(seed: int, plan: Plan, types: bool) -> list[Visit]:
    """Return the actions of an operator who at half of the changes types nothing, and at some leaves the bar where it is.

    ``types``: False for one who does not confirm the other changes either.
    """
    rng = np.random.default_rng([seed, 0xF06E])
    on = asked = pairing_at(plan, 0)
    visits = [Visit(0, on, (on,) * types)]
    for row in _rows(rng, len(plan)):
        typed: tuple[Pairing, ...] = ()
        wanted = pairing_at(plan, row)
        if wanted != asked and row >= visits[-1].planned:
            asked = wanted
            how = str(rng.choice(list(FORGETS), p=list(FORGETS.values())))
            if how != "not mounted":
                on = wanted
            if how == "right" and types:
                typed = (wanted,)
        visits.append(Visit(row, on, typed))
    return visits


def _rows(rng: np.random.Generator, n: int) -> list[int]:
    rows: list[int] = []
    for row in range(n):
        if rng.random() < SKIPPED:
            continue
        rows.append(row)
        if rng.random() < REPEATED:
            rows.append(row)
        if len(rows) > 5 and rng.random() < BACK:
            rows += [rows[-int(rng.integers(2, 6))], row]
    return rows


def _one_part_other(rng: np.random.Generator, pairing: Pairing, rig: Rig) -> Pairing:
    part = int(rng.integers(3))
    names = [name for name in (rig.bars, rig.chucks, rig.spheres)[part] if name != pairing[part]]
    if not names:
        return _one_part_other(rng, pairing, rig)
    other = list(pairing)
    other[part] = str(rng.choice(names))
    return other[0], other[1], other[2]


REST_S, MOVE_S = 1.8, 0.7
AWAY = 0.1  # rad, of all joints, on the way to a repeated pose
RAILED = 2**23 - 1


def lengths(visits: list[Visit], plan: Plan, rig: Rig, chain: Chain, params: np.ndarray, seed: int) -> np.ndarray:
    """Return the sensor reading at each visit [m], NaN beyond its stroke."""
    rng = np.random.default_rng([seed, 0x84])
    spheres, chucks = (
        np.array([known[v.mounted[part]].xyz for v in visits]) for part, known in ((2, rig.spheres), (1, rig.chucks))
    )
    q = plan.q[[v.planned for v in visits]]
    bars = [rig.bars[v.mounted[0]] for v in visits]
    length = np.linalg.norm(point_forward(chain, params, q, spheres) - chucks, axis=1)
    extension = length + 84e-6 * rng.standard_normal(len(q)) - [bar.zero for bar in bars]
    return np.where(np.abs(extension) <= [0.5 * bar.travel for bar in bars], extension, np.nan)


def write_session(
    path: Path, visits: list[Visit], plan: Plan, rig: Rig, extension: np.ndarray, seed: int = 0, of: str = ""
) -> None:
    """Write the session that a recorder would have written, without a box, a robot and real time; or a further part ``of`` one."""
    rng = np.random.default_rng([seed, 0x5E55])
    q, start_s, q_path = _motion(plan, visits)
    start_ns = 1e9 * start_s
    end_ns = int(start_ns[-1] + 1e9 * (REST_S + 0.5))
    box = Box(ppm=31.0, boot_host_ns=-3_000_000_000)
    box.ident(1_000_000)
    ident = box.messages
    box.messages = []
    for t in np.arange(5e7, end_ns, 5e8):
        box.sync(int(t), 90e3 + rng.exponential(1e5), 90e3 + rng.exponential(1e5))
    times = np.arange(2 * 10**9, end_ns, PERIOD_NS)
    at = np.searchsorted(start_ns, times - 1_500_000, side="right") - 1
    stands = (at >= 0) & (times - 1_500_000 - start_ns[at] < 1e9 * REST_S)
    shown = np.where(stands, extension[at], np.nan) + 3e-6 * rng.standard_normal(times.size)
    counts = np.zeros((times.size, CHANNELS), np.int64)
    counts[:, 0] = np.where(np.isnan(shown), RAILED, counts_of(np.nan_to_num(shown)))
    for k in range(0, times.size - BLOCK, BLOCK):
        box.data(int(times[k]), counts[k : k + BLOCK])
    frames = renumber(ident + sorted(box.messages, key=lambda m: m.t_host_ns))
    robot = robot_messages(rng, q, 1e9 * q_path, end_ns, 0.0, 1e-5, 25.0)
    typed = [
        Message("/events", int(t - 3e8), _as_json({"kind": "mounted", **dict(zip(BAR_MOUNTED, words, strict=True))}))
        for t, visit in zip(start_ns, visits, strict=True)
        for words in visit.typed
    ]
    with SessionWriter(path, None, overwrite=True) as writer:
        writer.metadata("setup", {"of": of} if of else {})
        writer.attach("rig.toml", format_rig(rig).encode())
        for row in plan_rows(plan):
            writer.add_json("/plan", 0, row)
        for message in sorted(frames + robot + typed, key=lambda m: m.t_host_ns):
            writer.add(*message)
        writer.close({"reason": "duration"})


def _motion(plan: Plan, visits: list[Visit]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the corners of the joints' path (m, j), the start of each visit [s], and each corner's time (m,) [s]."""
    corners, times, start = [plan.q[visits[0].planned] + AWAY], [0.0], list[float]()
    t = 3.0
    for i, visit in enumerate(visits):
        q = plan.q[visit.planned]
        if i and visits[i - 1].planned == visit.planned:
            corners.append(q + AWAY)
            times.append(t + 0.5 * MOVE_S)
        t += MOVE_S
        start.append(t)
        corners += [q, q]
        times += [t, t + REST_S]
        t += REST_S
    return np.array([*corners, corners[-1] + AWAY]), np.array(start), np.array([*times, t + MOVE_S])


def _as_json(row: dict[str, object]) -> bytes:
    return json.dumps(row).encode()
