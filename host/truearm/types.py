"""The data that go into an identification: arrays, the rig, tables, plans, joint laws. All are in SI units and frozen.

They only check their shapes: ``n`` rows, ``j`` joints. Public objects are ``Displayed``: one line in a terminal, a
small table in a notebook, a pandas.DataFrame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from html import escape
from typing import Annotated, Any, ClassVar, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from truearm.arguments import Checked
from truearm.errors import InputError, PlanError
from truearm.schema import Choice, Covariance, Direction, List, Matrix, Number, sigma
from truearm.text import counted
from truearm.units import KG, MM

ROWS_SHOWN = 8  # shown of a table
COLUMNS_SHOWN = 10


class Displayed:
    """A base class of objects with a headline and, if they are tables, columns (n,) or (n, k) by title, in SI units.

    Columns without any value are not shown. A column (n, k) becomes k columns, numbered from 1.
    """

    def _headline(self) -> str:
        raise NotImplementedError

    def _columns(self) -> Mapping[str, Any]:
        return {}

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._headline()}>"

    def _repr_html_(self) -> str:
        columns = self._flat()
        shown = dict(list(columns.items())[:COLUMNS_SHOWN])
        n = max(map(len, columns.values()), default=0)
        rows = ["".join(f"<td>{_cell(column[i])}</td>" for column in shown.values()) for i in range(min(n, ROWS_SHOWN))]
        head = "".join(f"<th>{escape(title)}</th>" for title in shown)
        table = "".join(f"<tr>{row}</tr>" for row in (head, *rows))
        counts = f"<p>{counted(n, 'row')}, {counted(len(columns), 'column')}</p>"
        shown_table = f"<table>{table}</table>{counts}" if columns else ""
        return f"<p><b>{type(self).__name__}</b>: {escape(self._headline())}</p>{shown_table}"

    def to_pandas(self) -> Any:
        """Return the columns as a pandas.DataFrame, in SI units. Raises InputError if pandas is not installed."""
        try:
            from pandas import DataFrame
        except ImportError:
            raise InputError("missing-package", place="to_pandas", package="pandas", install="pandas") from None
        return DataFrame(self._flat())

    def _flat(self) -> dict[str, NDArray[Any]]:
        """Return the columns (n,) that have a value."""
        flat: dict[str, NDArray[Any]] = {}
        for title, values in self._columns().items():
            column = np.asarray(values)
            flat |= {title: column} if column.ndim == 1 else {f"{title}{i}": c for i, c in enumerate(column.T, start=1)}
        return {title: column for title, column in flat.items() if not _is_blank(column).all()}


def _is_blank(column: NDArray[Any]) -> NDArray[np.bool_]:
    return np.isnan(column) if column.dtype.kind == "f" else np.asarray(column == "")


def _cell(value: Any) -> str:
    """Return a value as HTML; "" for NaN."""
    return "" if value != value else f"{value:.6g}" if isinstance(value, float) else escape(str(value))


Floats = NDArray[np.float64]
Strings = NDArray[np.str_]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
Ints = NDArray[np.int64]
Residuals = Mapping[str, Floats]  # by SI unit, one per row (n,): signed or a norm; NaN where there is none

# value types of fields; rig files have the same (``schema.values_of``)
SIZE = Number("m", positive=True)
POSITION = List(Number("m"), 3)
SIGMA = sigma("m")
UNKNOWN_SIGMA = sigma("m", unknown=True)
UNKNOWN_TURN_SIGMA = sigma("rad", unknown=True)
Triple = tuple[float, float, float]
JointIndex = Annotated[int, Meta(ge=0, le=63)]  # of a joint law, from 0
MASS = Annotated[float, Number("kg", least=0.0)]  # of a payload
CENTRE = Annotated[Triple, POSITION]

# Reasons why a dwell gives no observation, of those in ``session.dwells``.
MOUNTING = "mounting"  # a stop outside the plan for changing the mounting: not a dwell, nothing lost
DOUBTFUL = "doubtful"  # plan and operator agree on the mounting, but the readings do not support it
NEED_DECISION = ("contradiction", "ambiguous", DOUBTFUL)  # resolved by the operator: truearm session relabel

BAR_MOUNTED = ("bar", "chuck", "sphere")  # what is mounted for a ball-bar reading
REFERENCE_DEGC = 20.0  # reference temperature of lengths, ISO 1
LINE_MOUNTED = ("line", "target")  # what is mounted for a line pass
MOUNTED = (*BAR_MOUNTED, *LINE_MOUNTED)


class Move(StrEnum):
    """The type of a row of a plan."""

    DWELL = "dwell"  # a pose at which the ball-bar is read at rest
    VIA = "via"  # a waypoint, passed through or stopped at
    LINE = "line"  # reached in a straight Cartesian line from the row before, measured on the way


class LinePlacement(StrEnum):
    """Initial placement of a line device without a known pose: from all its points, or from its first two."""

    LEAST_SQUARES = "least_squares"
    TWO_POINT = "two_point"


class DwellLabel(NamedTuple):
    """What was mounted during a dwell, determined after the recording.

    ``mounted`` is empty where this is unknown. Times are those of the host clock.
    """

    begin_ns: int
    end_ns: int
    mounted: Mapping[str, str]  # bar, chuck, sphere, shell
    pose: int | None = None  # row of the plan
    probability: float = float("nan")
    detail: str = ""  # why it is unknown


class Message(NamedTuple):
    """One message of a session file: topic, host arrival time [ns, monotonic], raw bytes."""

    topic: str
    t_host_ns: int
    data: bytes


@dataclass(frozen=True)
class Point(Checked):
    """A chuck, sphere, socket or target: coordinates [m] and their standard deviation [m].

    ``sigma`` is 0 if the point is known exactly, finite for a parameter with that prior, and None for a parameter
    without a prior.

    Examples
    --------
    >>> import truearm
    >>> truearm.Point("s1", (0.0, 0.0, 0.1), sigma=5e-5).xyz[2]
    0.1
    """

    name: str
    xyz: Annotated[Triple, POSITION]
    sigma: Annotated[float, UNKNOWN_SIGMA] | None = 0.0


@dataclass(frozen=True)
class BallBar(Checked):
    """A telescoping ball-bar: length = zero + gain · extension [m].

    The length is the distance from the centre of the bar's ball, in a chuck, to the centre of the sphere in its cup.

    ``travel`` [m] is the full stroke; the extension ranges over ±travel/2. ``sigma`` [m] is the declared repeatability
    of a dwell, added to the noise estimated from the samples. ``zero_sigma`` [m] and ``gain_sigma`` [1] are 0 if the
    value is known exactly, and finite for a parameter with that prior.

    ``zero`` is valid at ``temperature`` [°C]; for each kelvin above it, the bar is longer by the fraction ``expansion``
    [1/K] of ``zero``. The gain is valid at ``sensor_temperature`` [°C]; for each kelvin above it, the extension for the
    same reading is larger by the fraction ``gain_drift`` [1/K]. Both corrections apply to rows that include these
    temperatures. ``expansion_sigma`` and ``gain_drift_sigma`` [1/K] work like ``gain_sigma``.

    Examples
    --------
    >>> import truearm
    >>> truearm.BallBar("bar46", zero=0.46, gain=1.0, travel=0.075, sigma=8.4e-5).zero
    0.46
    """

    name: str
    zero: Annotated[float, SIZE]
    gain: Annotated[float, Number("1", positive=True)]
    travel: Annotated[float, SIZE]
    sigma: Annotated[float, SIZE]
    zero_sigma: Annotated[float, SIGMA] = 0.0
    gain_sigma: Annotated[float, sigma("1")] = 0.0
    temperature: Annotated[float, Number("degc")] = REFERENCE_DEGC
    expansion: Annotated[float, Number("1/K")] = 0.0
    expansion_sigma: Annotated[float, sigma("1/K")] = 0.0
    sensor_temperature: Annotated[float, Number("degc")] = REFERENCE_DEGC
    gain_drift: Annotated[float, Number("1/K")] = 0.0
    gain_drift_sigma: Annotated[float, sigma("1/K")] = 0.0


@dataclass(frozen=True)
class SocketDistance(Checked):
    """The distance [m] between two sockets of a place, known to ``sigma`` [m]. It is the same at every place.

    Examples
    --------
    >>> import truearm
    >>> truearm.SocketDistance(("a", "b"), distance=0.05, sigma=1e-5).distance
    0.05
    """

    sockets: tuple[str, str]
    distance: Annotated[float, SIZE]
    sigma: Annotated[float, SIZE]


@dataclass(frozen=True)
class Device(Checked):
    """A device that measures points in its own axes: a tracker, or one placement of a line device.

    ``sensor_cov`` S_x [m²] is the 3×3 noise covariance in the device's axes; y is the longitudinal axis of a line.
    ``xyz`` [m] and ``rotation`` (rotation vector [rad]) are the device's pose in the base frame. If ``xyz`` is None,
    the device is initially placed from its own readings, which turn it away from ``rotation`` no further than necessary
    (a line with a finite ``turn_sigma`` keeps its roll). ``sigma`` [m] and ``turn_sigma`` [rad] are the standard
    deviations of each of the three components of that pose: 0 if known exactly, finite for a parameter with that prior,
    None for a parameter without a prior. ``rotation_sigma`` [rad] is the standard deviation of each component of a
    measured orientation. It is needed only for rows of kind ``pose`` that do not have their own.

    Examples
    --------
    >>> import truearm
    >>> covariance = ((4e-10, 0.0, 0.0), (0.0, 4e-10, 0.0), (0.0, 0.0, 4e-10))
    >>> truearm.Device("tracker", covariance).xyz is None  # its position is not known
    True
    """

    name: str
    sensor_cov: Annotated[Matrix, Covariance(3)]
    xyz: Annotated[Triple, POSITION] | None = None
    rotation: Annotated[Triple, List(Number("rad"), 3)] = (0.0, 0.0, 0.0)
    sigma: Annotated[float, UNKNOWN_SIGMA] | None = None
    turn_sigma: Annotated[float, UNKNOWN_TURN_SIGMA] | None = None
    rotation_sigma: Annotated[float, Number("rad", positive=True)] | None = None


@dataclass(frozen=True)
class Plane(Checked):
    """A plane that the tool touches.

    ``xyz`` [m] is a point on it and ``normal`` points to the side of positive distances, both in the base frame.
    ``sigma`` [m] is the standard deviation of one touch. ``offset_sigma`` [m] and ``tilt_sigma`` [rad] are those of the
    plane's position along its normal and of its two tilts: 0 if known exactly, finite for a prior, None if unknown.

    Examples
    --------
    >>> import truearm
    >>> truearm.Plane("table", xyz=(0.4, 0.0, 0.0), normal=(0.0, 0.0, 1.0), sigma=2e-5).normal
    (0.0, 0.0, 1.0)
    """

    name: str
    xyz: Annotated[Triple, POSITION]
    normal: Annotated[Triple, Direction()]
    sigma: Annotated[float, SIZE]
    offset_sigma: Annotated[float, UNKNOWN_SIGMA] | None = None
    tilt_sigma: Annotated[float, UNKNOWN_TURN_SIGMA] | None = None


@dataclass(frozen=True, repr=False)
class Rig(Displayed, Checked):
    """The rig around the robot: chucks on the table, spheres on the end, bars, sockets, lines, trackers and planes.

    Chucks are given in the frame of the chuck fixture, which is the base frame of the chain. Spheres and targets (the
    points that lines and trackers measure and that touch planes) are given in the end frame of the chain.
    ``seat_sigma`` [m] is the standard deviation of each coordinate of a ball seated in a socket. ``sockets`` (base
    frame), by place and name, holds the sockets with prior information; all others are placed by their own seats.

    If ``lines`` is empty, rows may name any line, with noise ``line_sigma`` [m] along the device's x, y, z (Renders
    1991, III-C); otherwise ``lines`` must contain every line that rows name. ``line_placement`` is how a line without a
    pose is initially placed, "least_squares" or "two_point" (by its first two points). ``line_travel`` [m] is the full
    range of the device's transverse sensors, which read ±line_travel/2; None means any reading is used.

    ``time_offset`` τ [s] means that the joints were truly at q(t) = q_reading(t + τ); only rows with velocities depend
    on it. ``time_offset_sigma`` works like the ``sigma`` of a Device. ``joint_cov`` S_q [rad², m²] is the covariance
    (j, j) of the joint readings, empty for none. It includes half the ``backlash`` in either direction where the
    approach direction of a joint is unknown. ``backlash`` (j,) [rad, m] is empty for none: each link lags its encoder
    by half of it, on the side that the joint came from. ``backlash_sigma`` (j,) is its standard deviation.

    ``payload`` [kg] is a known mass on the end beyond the tool, and ``payload_centre`` [m] its centre in the end frame.
    A row's own payload takes precedence.

    Examples
    --------
    >>> import truearm
    >>> truearm.read_rig("rig.toml").bars["b"].gain
    1.0
    """

    chucks: Mapping[str, Point] = field(default_factory=dict)
    spheres: Mapping[str, Point] = field(default_factory=dict)
    bars: Mapping[str, BallBar] = field(default_factory=dict)
    socket_distances: tuple[SocketDistance, ...] = ()
    seat_sigma: Annotated[float, SIZE] = 1e-4
    targets: Mapping[str, Point] = field(default_factory=dict)
    lines: Mapping[str, Device] = field(default_factory=dict)
    line_sigma: Annotated[Triple, List(SIZE, 3)] = (62e-6, 100e-6, 62e-6)
    line_placement: Annotated[LinePlacement, Choice(tuple(LinePlacement))] = LinePlacement.LEAST_SQUARES
    line_travel: Annotated[float, SIZE] | None = None
    trackers: Mapping[str, Device] = field(default_factory=dict)
    planes: Mapping[str, Plane] = field(default_factory=dict)
    time_offset: Annotated[float, Number("s")] = 0.0
    time_offset_sigma: Annotated[float, sigma("s", unknown=True)] | None = None
    joint_cov: tuple[()] | Annotated[Matrix, Covariance(singular=True)] = ()
    backlash: tuple[()] | Annotated[tuple[float, ...], List(Number())] = ()
    backlash_sigma: tuple[()] | Annotated[tuple[float, ...], List(sigma())] = ()
    payload: MASS = 0.0
    payload_centre: CENTRE = (0.0, 0.0, 0.0)
    sockets: Mapping[tuple[str, str], Point] = field(default_factory=dict)  # by place and socket
    entries: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # of other types that kinds declare, by name

    def _headline(self) -> str:
        fields = ("chucks", "spheres", "bars", "sockets", "targets", "lines", "trackers", "planes", *self.entries)
        counts = (
            counted(len(self.named(field)), field.removesuffix("s"), field) for field in fields if self.named(field)
        )
        return ", ".join(counts) or "empty"

    def named(self, field: str) -> Any:
        """Return the entries of a type by field name: a field of this class, or a key of ``entries``."""
        return getattr(self, field) if field in self.__dataclass_fields__ else self.entries.get(field, {})

    def mounted(self) -> dict[str, Mapping[str, Any]]:
        """Return what may be mounted: by each word of ``MOUNTED``, the entries by name."""
        return dict(zip(MOUNTED, (self.bars, self.chucks, self.spheres, self.lines, self.targets), strict=True))

    def with_named(self, field: str, entries: Mapping[str, Any]) -> Rig:
        """Return the rig with the entries of one type replaced."""
        own: dict[str, Any] = {field: entries}
        return replace(self, **(own if field in self.__dataclass_fields__ else {"entries": {**self.entries, **own}}))


Rigs = Rig | Mapping[str, Rig]  # one for all rows, or several by the names in a table's column ``rig``


def rigs_by_name(rig: Rigs) -> Mapping[str, Rig]:
    """Return rigs by the names in the column ``rig``; "" is the name of a single one."""
    return {"": rig} if isinstance(rig, Rig) else rig


def _absent() -> Any:
    """Return a placeholder for a column that was not given; the class fills it."""
    return None


def as_column(name: str, given: Any, text: bool | None = None) -> NDArray[Any]:
    """Return a column as an array of text or of float64; ``text`` None: as it is given. Raises TypeError."""
    if np.ma.is_masked(given):
        raise TypeError(f"{name}: has masked values; fill them with NaN, or leave out their rows")
    try:
        array = np.asarray(given)
    except ValueError:  # rows of different lengths
        array = np.empty(0, dtype=object)
    if array.dtype.kind in "OT" and array.size and all(isinstance(item, str) for item in array.flat):
        array = np.array(array.tolist())  # as data frames hold text
    text = array.dtype.kind == "U" if text is None else text
    if array.dtype.kind not in ("U" if text else "fiu") and (array.size or array.dtype.kind == "O"):
        raise TypeError(f"{name}: must be an array of {'text' if text else 'real numbers'}")
    return array.astype(str, copy=False) if text else array.astype(np.float64, copy=False)


@dataclass(frozen=True)
class Plan:
    """The rows that a robot visits: joint vectors, and what is measured at each or on the way to it.

    ``move`` is the type of a row:

    - ``dwell``: a pose at which the ball-bar is read at rest.
    - ``via``: a waypoint, passed through or stopped at. The bar is mounted if the row names bar, chuck and sphere, and
      dismounted if it names none of them.
    - ``line``: reached in a straight Cartesian line from the row before. ``target`` moves at constant ``speed`` along
      the ``line`` device while its sensors measure. Such a row names no bar.

    If ``move`` is not given, all rows are dwells. Raises PlanError if the shapes are inconsistent.
    """

    IDS: ClassVar[tuple[str, ...]] = ("shell", *BAR_MOUNTED)

    q: Floats  # (n, j) rad
    shell: Strings  # (n,)
    bar: Strings  # (n,)
    chuck: Strings  # (n,)
    sphere: Strings  # (n,)
    move: Strings = field(default_factory=_absent)  # (n,) of Move
    line: Strings = field(default_factory=_absent)  # (n,) the line device's placement, "" except on lines
    target: Strings = field(default_factory=_absent)  # (n,) the tool point on the line, "" except on lines
    speed: Floats = field(default_factory=_absent)  # (n,) m/s, NaN except on lines
    robot: Strings = field(default_factory=_absent)  # (n,) the robot that the row was planned for, "" if unknown

    def __post_init__(self) -> None:
        n = self.q.shape[:1]
        for name, value in (("move", Move.DWELL.value), ("line", ""), ("target", ""), ("speed", np.nan), ("robot", "")):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(n, value))
        shapes = {getattr(self, name).shape for name in self.columns()[1:]}
        if self.q.ndim != 2 or shapes != {n}:
            raise PlanError(f"a plan needs q (n, j) and columns (n,), got {self.q.shape} and {sorted(shapes)}")

    def __len__(self) -> int:
        return int(self.q.shape[0])

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Return the names of all columns, ``q`` first."""
        return tuple(column.name for column in fields(cls))

    @property
    def dwells(self) -> NDArray[np.bool_]:
        """Return a mask (n,) of the rows at which the ball-bar is read."""
        return np.asarray(self.move == Move.DWELL)

    @property
    def lines(self) -> NDArray[np.bool_]:
        """Return a mask (n,) of the rows that are approached along the line device while it is read."""
        return np.asarray(self.move == Move.LINE)

    def of_robot(self, name: str) -> Plan:
        """Return the plan labelled as a plan for this robot."""
        return replace(self, robot=np.full(len(self), name))

    def select(self, rows: NDArray[Any]) -> Plan:
        """Return the rows selected by a boolean mask or an index array."""
        return Plan(**{name: getattr(self, name)[rows] for name in self.columns()})


def rms(values: Floats) -> float:
    """Return the root mean square of all values; NaN if there are none."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else math.nan


def thinned(n: int, limit: int) -> NDArray[np.intp]:
    """Return an evenly spaced selection of ``limit`` of n rows, or all if there are fewer."""
    return np.unique(np.linspace(0, n - 1, min(n, limit)).astype(np.intp))


def not_left_out(weight: Floats) -> NDArray[np.bool_]:
    """Return a mask (n,) of the rows whose weight is not 0; of all rows if every weight is."""
    mask = np.asarray(weight != 0.0)
    return mask if mask.any() else ~mask


def rms_of_columns(values: Floats) -> Floats:
    """Return the root mean square (k,) of each column of values (n, k)."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


class CurveKnots(Struct, frozen=True, tag_field="term", tag="curve"):
    """The error curve of one joint: ``count`` coefficients ``spacing`` [rad] apart, repeating if ``periodic``.

    ``covered`` [rad]: the intervals of readings near fitted ones, in ascending order. Elsewhere the curve is unknown.
    """

    joint: JointIndex
    first: Annotated[float, Meta(ge=-100.0, le=100.0)] = msgspec.field(name="first_rad")
    spacing: Annotated[float, Meta(gt=0.0, le=100.0)] = msgspec.field(name="spacing_rad")
    count: Annotated[int, Meta(ge=4, le=2000)]
    periodic: bool
    covered: tuple[tuple[float, float], ...] = msgspec.field(name="covered_rad", default=())

    def covers(self, q: Floats) -> NDArray[np.bool_]:
        """Return a mask like q [rad] of covered readings; readings a full turn apart are equivalent."""
        out = np.zeros(q.shape, dtype=bool)
        for low, high in self.covered:
            out |= np.mod(q - low, 2.0 * math.pi) <= high - low
        return out

    @property
    def size(self) -> int:
        """The number of its parameters."""
        return self.count


class Payload(NamedTuple):
    """A known mass [kg] on the end, beyond what always belongs to the tool, and its centre [m] in the end frame."""

    mass: Annotated[float, KG]
    centre: Annotated[tuple[float, float, float], MM] = (0.0, 0.0, 0.0)

    def is_like(self, payload: Payload) -> bool:
        """Return whether masses and centres are equal to a gram and 0.1 mm; without mass, any centre is."""
        distance = max(abs(a - b) for a, b in zip(self.centre, payload.centre, strict=True))
        return abs(self.mass - payload.mass) < 1e-3 and (distance < 1e-4 or self.mass < 1e-3)


class SagMasses(Struct, frozen=True, tag_field="term", tag="sag"):
    """The sag of one joint: the frames with unit masses at their origins, and gravity's direction in the base frame.

    With ``payload``, the torque of the known payload acts too, times one more parameter: the joint's compliance.
    """

    joint: JointIndex
    frames: tuple[Annotated[int, Meta(ge=1, le=64)], ...]
    gravity: tuple[float, float, float] = (0.0, 0.0, -1.0)
    payload: bool = False

    @property
    def size(self) -> int:
        """The number of its parameters."""
        return len(self.frames) + self.payload


Law = CurveKnots | SagMasses
