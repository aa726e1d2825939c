"""The data that passes between the rooms of the house. SI units; frozen; no behaviour beyond checking shapes.

Shapes: ``n`` rows, ``j`` joints, ``p`` parameters, ``m`` scalar residuals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.arguments import check, check_fields
from truearm.bounds import FINITE, SIGMA, TRAVEL
from truearm.errors import Argument, InputError, PlanError

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]
Residuals = Mapping[str, Floats]  # by SI unit: (n,) of rows, signed or a norm; NaN where a row has none of that unit
Matrix = tuple[tuple[float, ...], ...]  # rows of a small constant matrix; unlike an array it can be compared

BAR_MOUNTED = ("bar", "chuck", "sphere")  # what is mounted while the ball-bar is read
REFERENCE_DEGC = 20.0  # of lengths, ISO 1
LINE_MOUNTED = ("line", "target")  # what is mounted while a line is driven


class Move(StrEnum):
    """What a row of a plan is."""

    DWELL = "dwell"  # a pose at which the ball-bar is read at rest
    VIA = "via"  # a place that is passed or stopped at
    LINE = "line"  # reached from the row before straight in Cartesian space, measured on the way


class LinePlacement(StrEnum):
    """How a line device without a pose is first placed: by all its points, or by its first two."""

    LEAST_SQUARES = "least_squares"
    TWO_POINT = "two_point"


class DwellLabel(NamedTuple):
    """What was mounted during a dwell, settled after the recording; ``mounted`` is empty where nobody knows. Times are the host's."""

    begin_ns: int
    end_ns: int
    mounted: Mapping[str, str]  # bar, chuck, sphere, shell
    pose: int | None = None  # row of the plan
    probability: float = float("nan")
    detail: str = ""  # why nobody knows


class Message(NamedTuple):
    """One message of a session file (hop 3): topic, host arrival time [ns, monotonic], bytes as stored."""

    topic: str
    t_host_ns: int
    data: bytes


@dataclass(frozen=True)
class Point:
    """A chuck, sphere or socket: coordinates [m] and their standard deviation [m].

    ``sigma`` 0: known exactly; finite: a parameter with that prior; None: a parameter without prior.

    Examples
    --------
    >>> import truearm
    >>> truearm.Point("s1", (0.0, 0.0, 0.1), sigma=5e-5).xyz[2]
    0.1
    """

    name: str
    xyz: Annotated[tuple[float, float, float], FINITE]
    sigma: Annotated[float, SIGMA] | None = 0.0

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class BallBar:
    """A telescoping ball-bar: length = zero + gain · extension, centre to centre [m].

    ``travel`` is the full stroke [m], extension runs over ±travel/2; ``sigma`` [m] is the repeatability of one
    dwell, declared, added to what the samples say. ``zero_sigma`` [m] and ``gain_sigma`` [1]: 0 known exactly,
    finite a parameter with that prior.

    ``zero`` holds at ``temperature`` [°C]; by ``expansion`` [1/K] of it the bar is longer for each kelvin that it is warmer. The gain holds at
    ``sensor_temperature`` [°C]; by ``gain_drift`` [1/K] of it the extension is larger for the same reading for each kelvin that the sensor is
    warmer. Both count in rows that hold these temperatures; ``expansion_sigma`` and ``gain_drift_sigma`` [1/K] as ``gain_sigma``.

    Examples
    --------
    >>> import truearm
    >>> truearm.BallBar("bar46", zero=0.46, gain=1.0, travel=0.075, sigma=8.4e-5).zero
    0.46
    """

    name: str
    zero: Annotated[float, FINITE]
    gain: Annotated[float, FINITE]
    travel: Annotated[float, TRAVEL]
    sigma: Annotated[float, SIGMA]
    zero_sigma: Annotated[float, SIGMA] = 0.0
    gain_sigma: Annotated[float, SIGMA] = 0.0
    temperature: Annotated[float, FINITE] = REFERENCE_DEGC
    expansion: Annotated[float, FINITE] = 0.0
    expansion_sigma: Annotated[float, SIGMA] = 0.0
    sensor_temperature: Annotated[float, FINITE] = REFERENCE_DEGC
    gain_drift: Annotated[float, FINITE] = 0.0
    gain_drift_sigma: Annotated[float, SIGMA] = 0.0

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class SocketDistance:
    """The distance [m] between two sockets of one place, known with ``sigma`` [m]; it holds at every place.

    Examples
    --------
    >>> import truearm
    >>> truearm.SocketDistance(("a", "b"), distance=0.05, sigma=1e-5).distance
    0.05
    """

    sockets: tuple[str, str]
    distance: Annotated[float, FINITE]
    sigma: Annotated[float, SIGMA]

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Device:
    """A device that measures points in axes of its own: one placement of a line device, or a tracker.

    ``sensor_cov`` S_x [m²] is 3×3 in the device's axes; y is a line's longitudinal axis. ``xyz`` [m] and ``rotation``
    (a rotation vector, rad) are the device's pose in the base frame; where ``xyz`` is None the device is first placed
    by its own readings, which turn it away from ``rotation`` no further than they must (a line of finite ``turn_sigma``
    keeps its roll). ``sigma`` [m] and ``turn_sigma`` [rad] say how well that pose is known, each of its three
    components: 0 exactly, finite a parameter with that prior, None a parameter without. ``rotation_sigma`` [rad] is
    the standard deviation of each component of a measured orientation; only rows of kind ``pose`` without their own need it.

    Examples
    --------
    >>> import truearm
    >>> covariance = ((4e-10, 0.0, 0.0), (0.0, 4e-10, 0.0), (0.0, 0.0, 4e-10))
    >>> truearm.Device("tracker", covariance).xyz is None  # nothing is known of where it stands
    True
    """

    name: str
    sensor_cov: Matrix
    xyz: Annotated[tuple[float, float, float], FINITE] | None = None
    rotation: Annotated[tuple[float, float, float], FINITE] = (0.0, 0.0, 0.0)
    sigma: Annotated[float, SIGMA] | None = None
    turn_sigma: Annotated[float, SIGMA] | None = None
    rotation_sigma: Annotated[float, SIGMA] | None = None

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Plane:
    """A flat that the tool touches. ``xyz`` [m] is a point on it, ``normal`` points to the side where distances count up.

    Both in the base frame. ``sigma`` [m] is of one touch; ``offset_sigma`` [m] and ``tilt_sigma`` [rad] say how well
    the flat's place along its normal and its two tilts are known: 0 exactly, finite a prior, None not at all.

    Examples
    --------
    >>> import truearm
    >>> truearm.Plane("table", xyz=(0.4, 0.0, 0.0), normal=(0.0, 0.0, 1.0), sigma=2e-5).normal
    (0.0, 0.0, 1.0)
    """

    name: str
    xyz: Annotated[tuple[float, float, float], FINITE]
    normal: Annotated[tuple[float, float, float], FINITE]
    sigma: Annotated[float, SIGMA]
    offset_sigma: Annotated[float, SIGMA] | None = None
    tilt_sigma: Annotated[float, SIGMA] | None = None

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Rig:
    """What stands around the robot: chucks on the table, spheres on the endpoint, bars, sockets, lines, trackers, flats.

    Chucks are in the chuck fixture's frame, which is the chain's base frame; spheres and targets (the points that
    lines and trackers measure and flats are touched with) are in the chain's end frame. ``seat_sigma`` [m] is the
    standard deviation of each coordinate of a ball seated in a socket. ``sockets`` [base frame] are those of which
    something is known; all others are placed by their own seats.

    A rig without ``lines`` takes any line that a row names, with ``line_sigma`` [m] along the device's x, y, z (Renders
    1991, III-C); with some, it must have them all. ``line_placement``: how a line without a pose is first
    placed. ``line_travel`` [m]: full range of the device's
    transverse sensors, which run over ±line_travel/2; None: as far as they say anything. ``time_offset`` τ [s]: the joints were truly at
    q(t) = q_reading(t + τ), of which only rows with velocities tell; ``time_offset_sigma`` as a Device's sigma. ``joint_cov`` S_q [rad², m²] is the covariance
    of the joint readings, j×j, empty for none; where a joint came from either side and nobody knows which, half its ``backlash`` either way
    is part of it. ``backlash`` (j) [rad, m], empty for none: the links lie half of it behind their encoders, on the side that the joint came from;
    ``backlash_sigma`` (j): how well it is known.

    Examples
    --------
    >>> import truearm
    >>> truearm.read_rig("rig.toml").bars["b"].zero
    0.46
    """

    chucks: Mapping[str, Point] = field(default_factory=dict)
    spheres: Mapping[str, Point] = field(default_factory=dict)
    bars: Mapping[str, BallBar] = field(default_factory=dict)
    socket_distances: tuple[SocketDistance, ...] = ()
    seat_sigma: Annotated[float, SIGMA] = 1e-4
    targets: Mapping[str, Point] = field(default_factory=dict)
    lines: Mapping[str, Device] = field(default_factory=dict)
    line_sigma: Annotated[tuple[float, float, float], SIGMA] = (62e-6, 100e-6, 62e-6)
    line_placement: LinePlacement = LinePlacement.LEAST_SQUARES
    line_travel: Annotated[float, TRAVEL] | None = None
    trackers: Mapping[str, Device] = field(default_factory=dict)
    planes: Mapping[str, Plane] = field(default_factory=dict)
    time_offset: Annotated[float, FINITE] = 0.0
    time_offset_sigma: Annotated[float, SIGMA] | None = None
    joint_cov: Matrix = ()
    backlash: Annotated[tuple[float, ...], FINITE] = ()
    backlash_sigma: Annotated[tuple[float, ...], SIGMA] = ()
    sockets: Mapping[tuple[str, str], Point] = field(default_factory=dict)  # by place and socket
    entries: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # of other types that kinds declare, by name

    def __post_init__(self) -> None:
        check_fields(self)

    def named(self, field: str) -> Any:
        """The entries of a type, by the name of the field that they stand in: a field of this class, or one of ``entries``."""
        return getattr(self, field) if field in self.__dataclass_fields__ else self.entries.get(field, {})

    def with_named(self, field: str, entries: Mapping[str, Any]) -> Rig:
        """The rig with other entries of a type."""
        own: dict[str, Any] = {field: entries}
        return replace(self, **(own if field in self.__dataclass_fields__ else {"entries": {**self.entries, **own}}))


def _absent() -> Any:
    """Stands for a column that was not given; ObservationTable fills it in."""
    return None


_NUMBERS = ("value", "sigma", "time", "temperature")  # columns (n,) of a table that are no text


@dataclass(frozen=True)
class ObservationTable:
    """Observations of one or several kinds, a row each (hop 5): what tables and sessions both become.

    ``kind`` is one of ``kinds.registry.NAMES``. ``value`` [m]: the measured length
    of a ball-bar row, the distance from the flat of a plane row (NaN: touched, 0), NaN for other kinds. ``xyz`` [m]: the
    measured point of a line, position or pose row in the device's axes; ``rotation`` [rad]: the measured rotation vector
    of a pose row; ``q_rate``: the joints' velocities, NaN where the robot stood or nobody measured; ``side``: in which direction
    each joint last moved before the robot stood, −1 or 1, NaN where nobody knows. ``sigma``: the
    standard deviation of each residual in the (first) unit of the row's kind, m or rad, NaN where the rig's figure is to be used; ``xyz_sigma`` [m]: of this point's own
    noise along the device's axes, beside that figure, NaN for none. ``time`` [s]: when it was measured, by any clock; ``temperature`` [°C]: of the box then;
    NaN where nobody knows. The identifier columns hold ""
    where a row has none. ``rig`` says which of several rigs a row belongs to, ``source`` where a row comes from, for
    messages ("poses.csv row 17"; not given, "table[16]"). ``more`` are the columns that only other kinds have, (n,) or (n, c), by the name that the kind
    declares. Columns that are not given are filled with NaN or "". Raises TypeError and InputError for a column that has another type or shape.

    Examples
    --------
    >>> import truearm
    >>> table = truearm.read_table("poses.csv", truearm.load_robot("puma560"))
    >>> len(table.select(table.chuck == "c1"))
    30
    """

    q: Floats  # (n, j) joint readings, rad or m
    kind: Strings  # (n,)
    value: Floats = field(default_factory=_absent)  # (n,)
    sigma: Floats = field(default_factory=_absent)  # (n,)
    bar: Strings = field(default_factory=_absent)  # (n,)
    chuck: Strings = field(default_factory=_absent)  # (n,)
    sphere: Strings = field(default_factory=_absent)  # (n,)
    socket: Strings = field(default_factory=_absent)  # (n,)
    place: Strings = field(default_factory=_absent)  # (n,)
    shell: Strings = field(default_factory=_absent)  # (n,)
    source: Strings = field(default_factory=_absent)  # (n,)
    xyz: Floats = field(default_factory=_absent)  # (n, 3)
    xyz_sigma: Floats = field(default_factory=_absent)  # (n, 3)
    rotation: Floats = field(default_factory=_absent)  # (n, 3)
    q_rate: Floats = field(default_factory=_absent)  # (n, j) rad/s or m/s
    side: Floats = field(default_factory=_absent)  # (n, j)
    time: Floats = field(default_factory=_absent)  # (n,) s
    temperature: Floats = field(default_factory=_absent)  # (n,) °C
    target: Strings = field(default_factory=_absent)  # (n,)
    line: Strings = field(default_factory=_absent)  # (n,)
    tracker: Strings = field(default_factory=_absent)  # (n,)
    plane: Strings = field(default_factory=_absent)  # (n,)
    rig: Strings = field(default_factory=_absent)  # (n,)
    more: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", _column("q", self.q, text=False))
        if self.q.ndim != 2:
            raise InputError(Argument("q"), f" must be (n, j), is {self.q.shape}")
        n = self.q.shape[0]
        shapes = {
            **dict.fromkeys(self.fields(), (n,)),
            **dict.fromkeys(("q", "q_rate", "side"), self.q.shape),
            **dict.fromkeys(("xyz", "xyz_sigma", "rotation"), (n, 3)),
        }
        for name, shape in shapes.items():
            if getattr(self, name) is None:
                blank = np.nan if len(shape) == 2 or name in _NUMBERS else ""
                rows = (
                    [f"table[{i}]" for i in range(n)] if name == "source" else np.broadcast_to(np.array(blank), shape)
                )
                object.__setattr__(self, name, rows)
            is_text = len(shape) == 1 and name not in _NUMBERS
            object.__setattr__(self, name, _column(name, getattr(self, name), is_text))
            if getattr(self, name).shape != shape:
                raise InputError(Argument(name), f" must be {shape}, is {getattr(self, name).shape}")
        check("more", self.more, Mapping[str, Any])
        for name, column in self.more.items():
            if np.shape(column)[:1] != (n,):
                raise InputError(Argument(name), f" must have {n} rows, is {np.shape(column)}")
        object.__setattr__(self, "more", {name: np.asarray(column) for name, column in self.more.items()})

    def __len__(self) -> int:
        return int(self.q.shape[0])

    @classmethod
    def fields(cls) -> tuple[str, ...]:
        """The columns that every table has."""
        return tuple(column.name for column in fields(cls) if column.name != "more")

    def column(self, name: str, absent: float | str = "") -> NDArray[Any]:
        """A column, one of ``more`` too; filled with ``absent`` where the table does not have it."""
        if name in self.fields():
            return np.asarray(getattr(self, name))
        return self.more[name] if name in self.more else np.full(len(self), absent)

    def select(self, rows: NDArray[Any]) -> ObservationTable:
        """The rows of a boolean mask or an index array."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in self.fields()}
        return ObservationTable(**columns, more={name: column[rows] for name, column in self.more.items()})

    @classmethod
    def joined(cls, tables: Sequence[ObservationTable]) -> ObservationTable:
        """The rows of several tables one after the other. Raises ValueError where their joints differ in number."""
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(table, name) for table in tables]) for name in cls.fields()
        }
        more = {
            name: np.concatenate([_like(column, table.more.get(name), len(table)) for table in tables])
            for name, column in {name: column for table in tables for name, column in table.more.items()}.items()
        }
        return cls(**columns, more=more)


def _column(name: str, given: Any, text: bool) -> NDArray[Any]:
    """A column as an array of text or of floats. Raises TypeError."""
    try:
        array = np.asarray(given)
    except ValueError:  # rows of different lengths
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in ("U" if text else "fiu") and (array.size or array.dtype.kind == "O"):
        raise TypeError(f"{name}: must be an array of {'text' if text else 'real numbers'}")
    return array.astype(str if text else float) if array.dtype.kind != ("U" if text else "f") else array


def _like(column: NDArray[Any], own: NDArray[Any] | None, n: int) -> NDArray[Any]:
    """A table's ``own`` column; where it has none, n rows without a value."""
    blank = np.nan if column.dtype.kind == "f" else ""
    return np.full((n, *column.shape[1:]), blank) if own is None else own


@dataclass(frozen=True)
class Plan:
    """What a robot visits, row by row: joint vectors, and what is measured there or on the way there.

    ``move`` says what a row is. ``dwell``: a pose at which the ball-bar is read at rest. ``via``: a place that is passed or
    stopped at; with the bar on if the row names bar, chuck and sphere, with it off if it names none. ``line``: reached from the
    row before straight in Cartesian space, ``target`` at constant ``speed`` along the ``line`` device while its sensors
    measure; such a row names no bar. Columns that are not given: all rows are dwells.

    Raises PlanError where the shapes disagree.
    """

    IDS: ClassVar[tuple[str, ...]] = ("shell", *BAR_MOUNTED)

    q: Floats  # (n, j) rad
    shell: Strings  # (n,)
    bar: Strings  # (n,)
    chuck: Strings  # (n,)
    sphere: Strings  # (n,)
    move: Strings = field(default_factory=_absent)  # (n,) of Move
    line: Strings = field(default_factory=_absent)  # (n,) the line device's placement, "" but on lines
    target: Strings = field(default_factory=_absent)  # (n,) the tool point on the line, "" but on lines
    speed: Floats = field(default_factory=_absent)  # (n,) m/s, NaN but on lines
    robot: Strings = field(default_factory=_absent)  # (n,) the robot that the row was planned for, "" where nobody says

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
        """Names of all columns, ``q`` first."""
        return tuple(column.name for column in fields(cls))

    @property
    def dwells(self) -> NDArray[np.bool_]:
        """(n,) the rows at which the ball-bar is read."""
        return np.asarray(self.move == Move.DWELL)

    @property
    def lines(self) -> NDArray[np.bool_]:
        """(n,) the rows on the way to which the line device is read."""
        return np.asarray(self.move == Move.LINE)

    def of_robot(self, name: str) -> Plan:
        """The plan as one for a robot."""
        return replace(self, robot=np.full(len(self), name))

    def select(self, rows: NDArray[Any]) -> Plan:
        """The rows of a boolean mask or an index array."""
        return Plan(**{name: getattr(self, name)[rows] for name in self.columns()})


def rms(values: Floats) -> float:
    """Root mean square of all values; NaN of none."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else math.nan


def rms_of_columns(values: Floats) -> Floats:
    """Root mean square (k,) of each column of values (n, k)."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


class Figures(NamedTuple):
    """RMS, mean and largest size of the residuals of n rows, in one SI unit; NaN of no rows.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("poses.csv", robot), truearm.read_rig("rig.toml")
    >>> held_out = truearm.identify(robot, table, rig, hold_out="shell=outer").estimate.held_out
    >>> figures = held_out.figures["m"]
    >>> figures.rms <= figures.max, figures.n
    (True, 20)
    """

    rms: float
    mean: float
    max: float
    n: int

    @classmethod
    def of(cls, residual: Floats) -> Figures:
        """Of residuals of one unit, those that are NaN left out."""
        size = np.abs(residual[~np.isnan(residual)])
        if not size.size:
            return cls(math.nan, math.nan, math.nan, 0)
        return cls(rms(size), float(size.mean()), float(size.max()), size.size)

    @classmethod
    def by_unit(cls, residuals: Residuals, rows: NDArray[Any] | slice = slice(None)) -> dict[str, Figures]:
        """Of some rows, for each SI unit that any of them has."""
        every = {unit: cls.of(residual[rows]) for unit, residual in residuals.items()}
        return {unit: figures for unit, figures in every.items() if figures.n}


@dataclass(frozen=True)
class HeldOut:
    """Errors on ``n`` rows that were not used to fit, by SI unit.

    ``n_settled`` unknowns of the rig (the places of sockets that no fitted row touches) were estimated on these very rows;
    ``n_left_out`` rows are not among the ``n``, because they fit such unknowns whatever they say.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("poses.csv", robot), truearm.read_rig("rig.toml")
    >>> held_out = truearm.identify(robot, table, rig, hold_out="shell=outer").estimate.held_out
    >>> held_out.n, list(held_out.figures)
    (20, ['m'])
    """

    figures: Mapping[str, Figures]
    n: int
    n_settled: int = 0
    n_left_out: int = 0


@dataclass(frozen=True)
class NullDirection:
    """A combination of free parameters that the observations cannot see: names and weights (largest 1)."""

    names: tuple[str, ...]
    weights: tuple[float, ...]


class Observability(NamedTuple):
    """How well the identified parameters are seen; ``estimate.identifiability`` defines the four."""

    o1: float
    o2: float
    o3: float
    o4: float


class Addition(NamedTuple):
    """Something more to measure, and what of the robot would be seen then."""

    kind: str  # as the kind of observation calls it that proposes it: "poses", "pairing"
    names: tuple[str, ...]  # identifiers of the rig that it is about; empty for what is new
    rank: int  # of the robot's free parameters, with it
    parameters: tuple[str, ...]  # those that could be told apart in addition
    text: str  # what to do, as a command to a person


class Relabelling(NamedTuple):
    """Rows that fit other things of the rig than they name."""

    rows: tuple[int, ...]  # of the table
    columns: tuple[str, ...]  # of a table, such as chuck and sphere
    was: tuple[str, ...]  # names in these columns
    fits: tuple[str, ...]
    rms_before: float  # m, of the whole fit with the labels as they are
    rms_after: float  # m, with this label and all others found beside it put right


class WrongInput(StrEnum):
    """What of the inputs may be read wrongly (``estimate.wrong_inputs``)."""

    UNITS = "units"
    ROBOT = "robot"
    JOINTS = "joints"
    LABELS = "labels"
    SET_UP = "set-up"
    HELD = "held parameters"  # no mistake: few were freed


class Unusable(StrEnum):
    """Why a fit is not usable."""

    NOT_CONVERGED = "not converged"
    WRONG_INPUTS = "wrong inputs"  # residuals that another reading of the inputs explains
    RESIDUALS = "residuals"  # that nothing explains


class Explanation(NamedTuple):
    """Another reading of the inputs that explains the observations far better.

    ``rms_given`` and ``rms`` are those of quick fits of some rows, by SI unit, as given and so read. ``apply`` are rows to leave out,
    "" where that is no help. ``chance`` that a right reading seems so wrong.
    """

    what: WrongInput
    text: str
    apply: str
    n: int  # rows that it explains
    rms_given: Mapping[str, float]
    rms: Mapping[str, float]
    chance: float


class DriftWith(StrEnum):
    """What a drift is linear in."""

    TIME = "time"  # of the rows; their order, where they have no times
    TEMPERATURE = "temperature"  # of the box

    @property
    def ending(self) -> str:
        """How names of a drift's parameters end."""
        return ".drift" if self is DriftWith.TIME else ".thermal_drift"


@dataclass(frozen=True)
class Effect:
    """A systematic error: ``what`` is off in the rows ``first`` to before ``last`` (None: to the end), counted from 0.

    ``what`` is a thing of a rig ("chuck.c2", "bar.b46.zero"), a joint, or "base". It is off by an offset in these rows or, if
    it ``drifts_with`` something, by a part that is linear in that.

    Examples
    --------
    >>> import truearm
    >>> str(truearm.Effect("chuck.c2", first=182))
    'chuck.c2@183'
    """

    what: str
    first: int = 0
    last: int | None = None
    drifts_with: DriftWith | None = None

    def __str__(self) -> str:
        return self.parameter(self.what)

    def parameter(self, number: str) -> str:
        """The name of the parameter that says by how much a ``number`` of the thing is off; rows count from 1 there."""
        end = "" if self.last is None else f":{self.last}"
        rows = f"@{self.first + 1}{end}" if self.first or end else ""
        return f"{number}{self.drifts_with.ending if self.drifts_with else ''}{rows}"


class OffBy(NamedTuple):
    """By how much a number is off: the rig's, a joint's or the base's; NaN where the observations cannot tell."""

    name: str
    unit: str
    value: float
    sigma: float


class ErrorForm(StrEnum):
    """How something is off."""

    OFFSET = "offset"
    DRIFT = "drift"
    ROWS = "rows"  # a block of rows does not fit, whatever the cause


@dataclass(frozen=True)
class SystematicError:
    """Something that is off beyond chance in the rows of a fit (``estimate.systematic``).

    ``effect`` is None where a block of rows does not fit the rest, whatever the cause. ``rows``: the first, and the one after the
    last. ``size`` ± ``sigma`` is the norm of those ``off_by`` that share the first one's ``unit``. ``drop`` is by how much χ² falls if it is a parameter (or these rows are left out), with ``freedom`` degrees of freedom;
    ``chance`` that clean data give such a finding anywhere. ``rivals`` explain the same nearly as well.
    """

    effect: Effect | None
    rows: tuple[int, int]
    off_by: tuple[OffBy, ...]
    unit: str  # SI; "" of a block of rows
    size: float
    sigma: float
    drop: float
    freedom: int
    chance: float
    rivals: tuple[str, ...] = ()

    @property
    def form(self) -> ErrorForm:
        """How it is off."""
        if self.effect is None:
            return ErrorForm.ROWS
        return ErrorForm.DRIFT if self.effect.drifts_with else ErrorForm.OFFSET


@dataclass(frozen=True)
class SystematicErrors:
    """All that was found to be off in a fit, and what the fit would be with it as parameters, to first order.

    ``shift`` (P,) is by how much the parameters would move, ``moves`` [m] by how much the end then moves over the fitted
    poses, in the root mean square. ``held_out_ratio`` is the RMS, in σ, of rows that are held out in whole stretches of the order of
    measurement, over what it is without them as parameters; rows that would be left out do not count.
    """

    found: tuple[SystematicError, ...]
    chi2_reduced: float
    shift: Floats
    moves: float = math.nan
    held_out_ratio: float = math.nan


class StillJoint(NamedTuple):
    """A joint that does not move enough to show its axis; rad or m."""

    joint: str
    unit: str
    spread: float  # from the least to the largest reading
    at: float  # the median reading


@dataclass(frozen=True)
class Defaults:
    """What an identification holds or believes because the user did not say otherwise, as names of the robot's parameters.

    ``base`` and ``tool`` are held since they are a choice of frame, along the directions ``frames``; ``lost`` since the joints ``still`` do not move enough;
    ``believed`` have a prior, the weak one, since the data tell them less well.
    """

    base: tuple[str, ...] = ()
    tool: tuple[str, ...] = ()
    frames: tuple[NullDirection, ...] = ()
    still: tuple[StillJoint, ...] = ()
    lost: tuple[str, ...] = ()
    believed: tuple[str, ...] = ()


class MeanError(NamedTuple):
    """The mean error of ``n`` poses that were not fitted, held out or left out in turn, and where it lies with 95 %."""

    mean: float
    low: float
    high: float
    n: int
    held_out: bool


class ResidualParts(NamedTuple):
    """RMS of the fitted rows' residuals in one SI unit: what the declared noise makes of them, and what it does not explain."""

    declared: float
    unexplained: float


class PoseError(NamedTuple):
    """Errors that the rows of one pose share (``estimate.pose_effect``): what several rows of a pose say beside noise of their own."""

    sigma: float  # m, of each component of a translation of the end
    row: float  # variance of a row's own noise over the declared one, 1 or more
    n: int  # poses with several rows


class WithOutliers(NamedTuple):
    """The fit of all rows, where ``n`` of them were found to be bad and the estimate rests on the others."""

    n: int
    value: Floats  # (p,) of all parameters
    rms_after: Mapping[str, float]  # by SI unit
    chi2_reduced: float


@dataclass(frozen=True)
class CurveKnots:
    """The error curve of one joint: ``count`` coefficients, a ``spacing`` apart [rad]; it repeats where ``periodic``."""

    joint: int
    first: float
    spacing: float
    count: int
    periodic: bool

    @property
    def size(self) -> int:
        """Its parameters."""
        return self.count


@dataclass(frozen=True)
class SagMasses:
    """The sag of one joint: the frames at whose origins unit masses sit, and the direction of gravity in the base frame."""

    joint: int
    frames: tuple[int, ...]
    gravity: tuple[float, float, float] = (0.0, 0.0, -1.0)

    @property
    def size(self) -> int:
        """Its parameters."""
        return len(self.frames)


Law = CurveKnots | SagMasses


class Period(NamedTuple):
    """A sine in an error curve: its cycles a turn and its amplitude [rad]."""

    cycles: float
    amplitude: float


@dataclass(frozen=True)
class TriedLaw:
    """A law that was tried. ``nats``: by how much it raises the log evidence; it is ``kept`` where that is enough.

    ``rms`` [rad] is of what it adds to the joint's angle over the fitted poses, about its mean, and ``covered`` [rad] the
    least and the largest reading; both of kept ones only, else NaN. ``periods``: the strongest of a curve.
    """

    joint: str
    term: str  # "curve" | "sag"
    nats: float
    kept: bool
    rms: float = math.nan
    covered: tuple[float, float] = (math.nan, math.nan)
    periods: tuple[Period, ...] = ()


class LawStep(NamedTuple):
    """A fit beside the others: "geometry", "sag" or "curves", with its RMS of the fitted rows and its held-out error."""

    name: str
    rms_after: Mapping[str, float]  # by SI unit
    held_out: HeldOut | None


@dataclass(frozen=True)
class JointLaws:
    """What an identification learned of joint laws beyond offset and gain.

    ``kept`` are the laws whose parameters follow the robot's own in the estimate; ``reasons`` say in sentences why others,
    or all, were not tried. The noise a pose is what evidence makes of the residuals: a factor on the declared variances, a displacement
    shared by the rows of a pose [m] and an error of every joint [rad], both standard deviations.
    """

    mode: str  # one of ``estimate.solvers.LawMode``
    kept: tuple[Law, ...]
    tried: tuple[TriedLaw, ...]
    steps: tuple[LawStep, ...]
    reasons: tuple[str, ...]
    gravity: tuple[float, float, float]
    gravity_known: bool  # from the robot file; else z is taken to be up
    noise_factor: float = math.nan
    noise_shared: float = math.nan
    noise_joint: float = math.nan


class PredictedError(NamedTuple):
    """How far the measured point of the robot's end errs by the parameters' covariance, over poses that were measured.

    ``relative``: without the part that moves all poses as one body, which observations by a device of unknown pose, or in
    sockets, cannot see.
    """

    rms: float  # m, over the poses
    largest: float  # m, expected norm at the worst pose
    source: str  # the row of the worst pose
    n: int  # poses
    relative: bool


@dataclass(frozen=True)
class Estimate:
    """The result of an identification (hop 7).

    Arrays run over all parameters of the problem: the robot's first, then the rig's (nuisance) parameters.
    ``sigma`` is NaN where the observations see nothing of a parameter or it was not free. ``covariance`` is (p, p),
    zero rows where not free; ``identifiable`` is False where a parameter takes part in a null direction. ``distance``
    is standardised: χ of the row's number of residuals for a clean row, NaN where a row was held out.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("poses.csv", robot), truearm.read_rig("rig.toml")
    >>> estimate = truearm.identify(robot, table, rig).estimate
    >>> estimate.status, estimate.sigma.shape == estimate.value.shape
    ('converged', True)
    """

    status: str  # "converged" | "max_iterations" | "stalled"
    message: str
    solver: str
    iterations: int
    parameter_names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: Floats  # (p,)
    value: Floats  # (p,)
    sigma: Floats  # (p,)
    free: NDArray[np.bool_]  # (p,)
    identifiable: NDArray[np.bool_]  # (p,)
    covariance: Floats  # (p, p)
    n_robot_parameters: int
    n_observations: int
    rank: int
    rank_gap: float  # smallest kept / largest dropped singular value
    null_space: tuple[NullDirection, ...]
    rms_before: Mapping[str, float]  # by SI unit, of the fitting rows, once base and tool are placed
    rms_after: Mapping[str, float]
    rms_history: Mapping[str, tuple[float, ...]]  # one an iteration, first is rms_raw
    chi2_reduced: float
    held_out: HeldOut | None
    held_out_before: HeldOut | None
    residual: Residuals  # after; a kind's one component of a unit with its sign, the norm of several
    residual_before: Residuals
    fitted: NDArray[np.bool_]  # (n,) True for fitting rows, False for held-out
    seconds: float
    rms_raw: Mapping[str, float] = field(
        default_factory=dict
    )  # of the robot as described, where the rig says it stands
    loss: str = "linear"
    chi2_band: tuple[float, float] = (float("nan"), float("nan"))  # of chi2_reduced, 95 %, if σ and model are right
    chi2_freedom: float = float("nan")  # effective: residuals less what the fit follows them with
    distance: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) of a row from what all others say of it, in σ
    weight: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) 1 as declared, 0 left out, else a robust loss's
    suspect: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n,) beyond the gate
    observability: Observability | None = None  # of the suggested free set
    suggested_free: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n_robot_parameters,)
    hardly_seen: tuple[NullDirection, ...] = ()  # seen, but to less than a drawing tells (estimate.identifiability)
    additions: tuple[Addition, ...] = ()  # where something free is unseen, else where it is hardly seen
    relabellings: tuple[Relabelling, ...] = ()
    relabelling_search: str = "not needed"  # | "done" | "too many groups" (estimate.relabel)
    explanations: tuple[Explanation, ...] = ()  # of a fit that is absurd, the most probable first
    unusable: Unusable | None = None  # why, if it is (estimate.wrong_inputs)
    left_out: NDArray[np.bool_] = field(
        default_factory=lambda: np.zeros(0, dtype=bool)
    )  # (n,) neither fitted nor held out
    systematic: SystematicErrors | None = None  # what is off beyond chance; None: nothing, or it was not looked for
    unexplained: Mapping[str, MeanError] = field(default_factory=dict)  # by SI unit, where χ² is above its band
    with_outliers: WithOutliers | None = None  # all rows, where bad ones were left out of the fit (estimate.outliers)
    parts: Mapping[str, ResidualParts] = field(default_factory=dict)  # of ``rms_after``, without rows left out
    pose_error: PoseError | None = None  # what the rows of a pose share beyond chance; ``covariance`` holds it
    joint_laws: JointLaws | None = None  # what was learned beyond offset and gain; None: nothing was asked for

    @property
    def law_parameters(self) -> range:
        """Where the parameters of joint laws stand, the last of the robot's."""
        laws = self.joint_laws.kept if self.joint_laws else ()
        return range(self.n_robot_parameters - sum(law.size for law in laws), self.n_robot_parameters)
