"""A ball-bar between a sphere on the end and a chuck on the table: one length per observation.

d = ‖T(q)·s − c‖ (Goswami, Quaid, Peshkin 1993, Optimization). The table holds the length computed from the reading with
the bar's declared zero z₀ and gain k₀. With another zero z and gain k, the same reading means d = z + k·(length −
z₀)/k₀, so

    predicted length = z₀ + k₀·(d − z)/k ,

which is d itself while zero and gain are as declared. Where the table holds temperatures, z is z·(1 + α·ΔT) with the
bar's expansion α, and k is k·(1 + κ·ΔT) with the sensor's temperature coefficient κ. ΔT is relative to the temperature
at which zero or gain is valid. ∂d/∂x is the derivative of the sphere's position along the bar's direction.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from truearm.findings import Finding
from truearm.kinds.columns import BAR_TEMPERATURE, LENGTH, SENSOR_TEMPERATURE
from truearm.kinds.group import Fault, Group, KindFault, Linearised, RigNumber, gather, linearised, point_numbers
from truearm.kinds.kind import DwellSensor, Kind, RigUse, Scope, measured, sigmas, use
from truearm.kinds.proposals import NEW, TRIES, Proposal, anywhere, trial_rows
from truearm.kinds.rig_entries import NAME, POINT, SPHERE, by_name
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, along, point_forward, trace_point
from truearm.schema import Entries, SchemaError, Table, keys_of
from truearm.types import BAR_MOUNTED, BallBar, Floats, Indices, Point, Rig
from truearm.units import MM, SMALLEST

SURE = 5.0  # σ: a length is beyond the stroke
AWAY = np.array([0.11, -0.17, 0.07])  # m: offset of a new chuck or sphere from the centroid of the others

# The sensor's zero drifts and jumps, and its gain may be wrong. The bar itself has no fixed position.
BAR_FAULTS = (Fault(slice(0, 1)), Fault(slice(1, 2), step=False))


@dataclass(frozen=True, kw_only=True)
class BallBarRows(Group):
    """n ball-bar observations; indices refer to x followed by ``constants``."""

    COMPONENTS = ("m",)

    q: Floats  # (n, j)
    length: Floats  # (n,) measured, m
    sphere: Indices  # (n, 3)
    chuck: Indices  # (n, 3)
    scale: Indices  # (n, 4) zero, gain, expansion, drift of the gain
    declared: Floats  # (n, 2) zero and gain used to compute ``length``
    warmer: Floats  # (n, 2) K, of bar and sensor; 0 where unknown

    def beside_base(self) -> Indices:
        """Return the chucks."""
        return self.chuck

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (n,) and their derivatives at x (P,)."""
        p = len(chain.parameters)
        trace = trace_point(chain, x[:p], self.q, gather(x, self.constants, self.sphere))
        bar = trace.p_base - gather(x, self.constants, self.chuck)
        d = np.sqrt((bar * bar).sum(axis=1))
        zero, gain, expansion, drift = gather(x, self.constants, self.scale).T
        declared_zero, declared_gain = self.declared.T
        bar_warmer, sensor_warmer = self.warmer.T
        longer, larger = 1.0 + expansion * bar_warmer, 1.0 + drift * sensor_warmer
        ratio = declared_gain / (gain * larger)
        extended = ratio * (d - zero * longer)
        predicted = declared_zero + extended
        # A sphere at the chuck's centre has no direction: such a row has no first-order information.
        u = bar * (ratio / np.where(d > 0.0, d, 1.0))[:, None]
        derivative = along(trace, u[None])
        of_scale = (-ratio * longer, -extended / gain, -ratio * zero * bar_warmer, -extended * sensor_warmer / larger)
        by_scale = self.scale, np.stack(of_scale, axis=1)[None]
        points = (self.sphere, derivative.jac_point), (self.chuck, -u[None])
        return linearised(self.length - predicted, derivative, x, *points, by_scale)

    def faults(self, chain: Chain, x: Floats) -> list[KindFault]:
        """Return what pulls at the bar by its direction (a cable, its weight), and its hysteresis."""
        p = len(chain.parameters)
        point = point_forward(chain, x[:p], self.q, gather(x, self.constants, self.sphere))
        bar = point - gather(x, self.constants, self.chuck)
        length = np.linalg.norm(bar, axis=1)
        u = bar / np.maximum(length, SMALLEST)[:, None]
        azimuth, level = np.arctan2(u[:, 1], u[:, 0]), np.hypot(u[:, 0], u[:, 1])
        out: list[KindFault] = []

        def add(form: str, *columns: Floats) -> None:
            out.append(KindFault("bar", form, "m", np.stack(columns, axis=1)[None]))

        add("azimuth", np.cos(azimuth), np.sin(azimuth))
        add("twice_azimuth", np.cos(2.0 * azimuth), np.sin(2.0 * azimuth))
        add("lean", u[:, 0], u[:, 1])
        add("sag", level**2)
        add("hysteresis", np.sign(np.diff(length, prepend=length[:1])))  # a measured length contains the noise
        return out


def bar_numbers(name: str, bar: BallBar) -> list[RigNumber]:
    """Return zero and gain of a bar, its expansion, and the temperature drift of its gain."""
    zero = RigNumber(f"{name}.zero", "m", bar.zero, bar.zero_sigma)
    gain = RigNumber(f"{name}.gain", "1", bar.gain, bar.gain_sigma)
    expansion = RigNumber(f"{name}.expansion", "1/K", bar.expansion, bar.expansion_sigma)
    return [zero, gain, expansion, RigNumber(f"{name}.gain_drift", "1/K", bar.gain_drift, bar.gain_drift_sigma)]


def warmer(table: ObservationTable, bars: Sequence[BallBar], which: Indices) -> Floats:
    """Return how much warmer [K] bar and sensor of each row are than the temperatures of zero and gain, (n, 2).

    ``which`` (n,) of the bars each row is of. 0 where the table does not hold the temperature.
    """
    holds = np.array([(bar.temperature, bar.sensor_temperature) for bar in bars])[which]
    read = [table[quantity.field] for quantity in (BAR_TEMPERATURE, SENSOR_TEMPERATURE)]
    return np.asarray(np.nan_to_num(np.stack(read, axis=1) - holds))


def use_rig(scope: Scope, rows: Indices) -> RigUse:
    """Return what the rows use of the rig: chucks, spheres and bars."""
    table, rig = scope.table, scope.rig
    chucks = use(scope, rows, "chuck", rig.chucks, point_numbers)
    spheres = use(scope, rows, "sphere", rig.spheres, point_numbers)
    bars = use(scope, rows, "bar", rig.bars, bar_numbers, BAR_FAULTS)
    declared = np.array([[number.value for number in bar[:2]] for bar in bars.numbers])[bars.which]
    entries = [rig.bars[str(label)] for label in bars.labels]
    sigma = np.array([bar.sigma for bar in entries])[bars.which]
    return RigUse.of(
        BallBarRows,
        scope,
        rows,
        sigmas(scope, rows, sigma[:, None]) ** 2,
        chuck=chucks,
        sphere=spheres,
        scale=bars,
        length=measured(scope, rows, LENGTH),
        declared=declared,
        warmer=warmer(table.select(rows), entries, bars.which),
    )


def beyond_stroke(rows: ObservationTable, rig: Rig, _: Chain) -> list[Finding]:
    """Return a warning for each bar with lengths that its stroke does not reach, by more than its zero may be off."""
    out = []
    for name in np.unique(rows.bar).tolist():
        bar, of_bar = rig.bars[name], rows.select(rows.bar == name)
        reach = 0.5 * abs(bar.gain) * bar.travel
        beyond = np.flatnonzero(np.abs(of_bar.value - bar.zero) > reach + SURE * math.hypot(bar.sigma, bar.zero_sigma))
        if beyond.size:
            sizes = {"low": bar.zero - reach, "high": bar.zero + reach, "length": float(of_bar.value[beyond[0]])}
            lengths = {size: {"mm": MM.of(length)} for size, length in sizes.items()}
            values = {"bar": name, "n": beyond.size, "rows": len(of_bar), "first": str(of_bar.source[beyond[0]])}
            out.append(Finding("beyond-stroke", {**values, **lengths}))
    return out


def longitude(chain: Chain, params: Floats, rig: Rig, rows: ObservationTable) -> Floats:
    """Return the longitude (n,) [rad] of the sphere about its chuck."""
    spheres, chucks = (
        np.array([points[str(name)].xyz for name in names])
        for points, names in ((rig.spheres, rows.sphere), (rig.chucks, rows.chuck))
    )
    vector = point_forward(chain, params, rows.q, spheres) - chucks
    return np.asarray(np.arctan2(vector[:, 1], vector[:, 0]))


def proposals(chain: Chain, rig: Rig, table: ObservationTable, rng: np.random.Generator) -> Iterator[Proposal]:
    """Propose further poses, each unmeasured pairing, and one more chuck or sphere."""
    bars = table.select(table.kind == "ball_bar")
    bar = str(bars.bar[0])
    pairings = list(dict.fromkeys(zip(bars.chuck.tolist(), bars.sphere.tolist(), strict=True)))
    chucks, spheres = list(dict.fromkeys(c for c, _ in pairings)), list(dict.fromkeys(s for _, s in pairings))
    readings = bars.q[:: max(len(bars) // TRIES, 1)][:TRIES]

    def rows(q: Floats, pairs: Sequence[tuple[str, str]]) -> ObservationTable:
        """Return rows of each pair at q (n, j), of any length: the derivatives do not depend on the reading."""
        chuck, sphere = np.repeat(pairs, len(q), axis=0).T
        return trial_rows(np.tile(q, (len(pairs), 1)), "ball_bar", value=1.0, bar=bar, chuck=chuck, sphere=sphere)

    varied = rows(anywhere(chain, TRIES, rng), pairings)
    yield Proposal("poses", "measure more varied poses with the same chucks and spheres", rig, varied)
    for chuck in rig.chucks:
        for sphere in rig.spheres:
            if (chuck, sphere) not in pairings:
                text = f"measure with chuck {chuck}, sphere {sphere} too"
                yield Proposal("pairing", text, rig, rows(readings, [(chuck, sphere)]), (chuck, sphere))
    more_chucks = replace(rig, chucks={**rig.chucks, NEW: _another([p.xyz for p in rig.chucks.values()])})
    more_spheres = replace(rig, spheres={**rig.spheres, NEW: _another([p.xyz for p in rig.spheres.values()])})
    text = "measure with one more {}, not in line with the others,"
    yield Proposal("chuck", text.format("chuck"), more_chucks, rows(readings, [(NEW, s) for s in spheres]))
    yield Proposal("sphere", text.format("sphere"), more_spheres, rows(readings, [(c, NEW) for c in chucks]))


def _another(points: Sequence[tuple[float, float, float]]) -> Point:
    middle = np.mean(points, axis=0) + AWAY
    return Point(NEW, (float(middle[0]), float(middle[1]), float(middle[2])))


def _bar(gain: float = 1.0, **values: Any) -> BallBar:
    bar = BallBar(gain=gain, **values)
    if bar.zero <= 0.5 * bar.travel:
        raise SchemaError(
            f"zero, the length at mid-travel from ball to ball, is {MM.text(bar.zero, 'g')}, and half the travel is "
            f"{MM.text(0.5 * bar.travel, 'g')}: no length would be left at its end; were metres written where mm are meant?"
        )
    return bar


def dwell_sensor(rig: Rig, mounted: Mapping[str, str]) -> tuple[DwellSensor]:
    """Return the bar that is mounted."""
    bar = rig.bars[mounted["bar"]]
    return (DwellSensor(mounted, bar.zero, bar.gain, bar.sigma, bar.travel),)


CHUCK = Entries("chuck", POINT, "chucks", by_name)
BAR = Entries("bar", Table((NAME, *keys_of(BallBar, "gain")), _bar), "bars", by_name)
KIND = Kind(
    group=BallBarRows,
    use_rig=use_rig,
    needs=(*BAR_MOUNTED, LENGTH),
    may=(BAR_TEMPERATURE, SENSOR_TEMPERATURE),
    entries=(CHUCK, SPHERE, BAR),
    channels=(("lvdt",),),
    dwell=dwell_sensor,
    point="sphere",
    labels=("bar", "chuck", "sphere"),
    grouped_by=("chuck", "sphere"),
    regions=("bar",),
    name="ball-bar",
    residual={"m": "measured minus predicted length of the bar"},
    proposals=proposals,
    longitude=longitude,
    doubts=beyond_stroke,
)
