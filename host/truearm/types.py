"""The data that passes between the rooms of the house. SI units; frozen; no behaviour beyond checking shapes.

Shapes: ``n`` rows, ``j`` joints, ``p`` parameters, ``m`` scalar residuals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]


class Message(NamedTuple):
    """One message of a session file (hop 3): topic, host arrival time [ns, monotonic], bytes as stored."""

    topic: str
    t_host_ns: int
    data: bytes


@dataclass(frozen=True)
class Point:
    """A chuck, sphere or socket: coordinates [m] and their standard deviation [m].

    ``sigma`` 0: known exactly; finite: a parameter with that prior; None: a parameter without prior.
    """

    name: str
    xyz: tuple[float, float, float]
    sigma: float | None = 0.0


@dataclass(frozen=True)
class BallBar:
    """A telescoping ball-bar: length = zero + gain · extension, centre to centre [m].

    ``travel`` is the full stroke [m], extension runs over ±travel/2; ``sigma`` [m] is the repeatability of one
    dwell, declared, added to what the samples say. ``zero_sigma`` [m] and ``gain_sigma`` [1]: 0 known exactly,
    finite a parameter with that prior.
    """

    name: str
    zero: float
    gain: float
    travel: float
    sigma: float
    zero_sigma: float = 0.0
    gain_sigma: float = 0.0


@dataclass(frozen=True)
class SocketDistance:
    """The distance between two sockets of one place, known with ``sigma`` [m]; it holds at every place."""

    sockets: tuple[str, str]
    distance: float
    sigma: float


@dataclass(frozen=True)
class Rig:
    """What stands around the robot: chucks on the table, spheres on the endpoint, bars, sockets.

    Chucks are in the chuck fixture's frame, which is the chain's base frame; spheres are in the chain's end frame.
    ``seat_sigma`` [m] is the standard deviation of each coordinate of a ball seated in a socket.
    """

    chucks: Mapping[str, Point] = field(default_factory=dict)
    spheres: Mapping[str, Point] = field(default_factory=dict)
    bars: Mapping[str, BallBar] = field(default_factory=dict)
    socket_distances: tuple[SocketDistance, ...] = ()
    seat_sigma: float = 1e-4


@dataclass(frozen=True)
class ObservationTable:
    """Observations of one or several kinds, a row each (hop 5): what tables and sessions both become.

    ``kind`` is ``ball_bar`` or ``seat``. ``value`` [m]: the measured length of a ball-bar row, NaN for a seat.
    ``sigma`` [m]: its standard deviation, NaN where the rig's figure is to be used. The identifier columns hold ""
    where a row has none. ``source`` says where a row comes from, for messages ("poses.csv row 17").
    """

    q: Floats  # (n, j) joint readings, rad or m
    kind: Strings  # (n,)
    value: Floats  # (n,)
    sigma: Floats  # (n,)
    bar: Strings  # (n,)
    chuck: Strings  # (n,)
    sphere: Strings  # (n,)
    socket: Strings  # (n,)
    place: Strings  # (n,)
    shell: Strings  # (n,)
    source: Strings  # (n,)

    def __post_init__(self) -> None:
        n = self.q.shape[0]
        if self.q.ndim != 2:
            raise ValueError(f"q must be (n, j), is {self.q.shape}")
        for name in ("kind", "value", "sigma", "bar", "chuck", "sphere", "socket", "place", "shell", "source"):
            if getattr(self, name).shape != (n,):
                raise ValueError(f"{name} must be ({n},), is {getattr(self, name).shape}")

    def __len__(self) -> int:
        return int(self.q.shape[0])

    def select(self, rows: NDArray[Any]) -> ObservationTable:
        """The rows of a boolean mask or an index array."""
        return ObservationTable(**{name: getattr(self, name)[rows] for name in self.__dataclass_fields__})


@dataclass(frozen=True)
class HeldOut:
    """Errors on rows that were not used to fit; norms of each observation's residual [m].

    ``n_settled`` unknowns of the rig (the places of sockets that no fitted row touches) were estimated on these very rows;
    ``n_left_out`` rows are not among the ``n``, because they fit such unknowns whatever they say.
    """

    rms: float
    mean: float
    max: float
    n: int
    n_settled: int = 0
    n_left_out: int = 0


@dataclass(frozen=True)
class NullDirection:
    """A combination of free parameters that the observations cannot see: names and weights (largest 1)."""

    names: tuple[str, ...]
    weights: tuple[float, ...]


@dataclass(frozen=True)
class Estimate:
    """The result of an identification (hop 7).

    Arrays run over all parameters of the problem: the robot's first, then the rig's (nuisance) parameters.
    ``sigma`` is NaN where the observations see nothing of a parameter or it was not free. ``covariance`` is (p, p),
    zero rows where not free; ``identifiable`` is False where a parameter takes part in a null direction.
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
    rms_before: float  # m
    rms_after: float  # m
    rms_history: tuple[float, ...]  # m, one an iteration, first is before
    chi2_reduced: float
    held_out: HeldOut | None
    held_out_before: HeldOut | None
    residual: Floats  # (n,) m, after; norm for 3-vector kinds, signed for ball_bar
    residual_before: Floats  # (n,) m
    fitted: NDArray[np.bool_]  # (n,) True for fitting rows, False for held-out
    seconds: float
