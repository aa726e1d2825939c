"""The file result.json: its fields, and how it is read and written (docs/reference/result-format.md).

The file is strict JSON (RFC 8259): a number that does not exist is ``null``, never NaN. It is written atomically. A
checksum over its content detects damage, and a content with the right checksum is believed: only types and bounds are
checked. ``result_document`` makes a ``Result`` of an estimate.
"""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType
from numpy.typing import NDArray

from truearm.disk import read_text, sha256, write_atomic
from truearm.errors import InputError
from truearm.estimate.solvers import Loss, Prior
from truearm.results import Addition, Defaults, NullDirection, Unusable
from truearm.text import strict_json
from truearm.types import Floats, Law, Payload
from truearm.units import MM, UNITS

if TYPE_CHECKING:
    from truearm.model.chain import Chain

FORMAT: Final = "truearm-result"
FORMAT_VERSION: Final = 4
SINCE_CHECKSUM = 3  # version
CHECKSUM = "checksum"
MAX_BYTES = 64 * 2**20

Name = Annotated[str, Meta(max_length=500)]
Names = Annotated[tuple[Name, ...], Meta(max_length=20_000)]
Size = Annotated[float, Meta(ge=0.0)]
RESOLUTION = 2.0**-30  # of the numbers of a root, whose columns have the norm 1
Count = Annotated[int, Meta(ge=0, le=10**12)]
Residual = Size | None | UnsetType  # in the unit at the end of its name, absent if no residual has it
Figures = dict[Name, Count | Size | None]  # by key; those of residuals end in a unit
Scalar = str | bool | int | float | None
# statistics for people; docs/reference/result-format.md has their keys
Entry = dict[Name, Scalar | dict[Name, Scalar] | tuple[Scalar | tuple[float, ...] | dict[Name, Scalar], ...]]


class Input(Struct, frozen=True):
    """An input file of an identification: its role, its name without folders, its SHA-256."""

    role: Name  # "observations" | "labels" | "rig" | "noise" | "robot"
    name: Name
    sha256: Name


def input_of(role: str, path: Path) -> Input:
    """Return the name and hash of an input file.

    Folders are omitted: they reveal where someone works, not what was read.
    """
    return Input(role, path.name.encode(errors="backslashreplace").decode(), sha256(path))


class RobotFrames(Struct, frozen=True):
    """The identified chain: its name, frames, and joint units."""

    name: Name
    base_frame: Name
    end_frame: Name
    joint_units: tuple[Annotated[str, Meta(pattern=r"^(rad|m)\Z")], ...]

    @classmethod
    def of(cls, chain: Chain) -> RobotFrames:
        """Return those of a chain."""
        return cls(chain.name, chain.base_frame, chain.end_frame, chain.joint_units)


class Covariance(Struct, frozen=True):
    """The covariance of the free parameters: their sigmas, and a root of the correlations C = RᵀR.

    ``upper`` is the upper triangle of R by rows, as little-endian int32 in units of 2⁻³⁰, deflated. A root needs half
    the digits of C, and RᵀR has no negative variance. Most of it is zeros where many coefficients of curves are not
    measured.
    """

    names: Names
    units: Names
    sigma: Annotated[tuple[Size | None, ...], Meta(max_length=20_000)]
    upper: bytes  # in base64 in the file

    def __post_init__(self) -> None:
        n = len(self.names)
        if {len(self.units), len(self.sigma)} != {n} or len(_inflated(self.upper, n)) != 2 * n * (n + 1):
            raise ValueError(f"upper needs {n * (n + 1) // 2} numbers for {n} names, units and sigmas")

    @classmethod
    def of(cls, names: Collection[str], units: Collection[str], matrix: Floats) -> Covariance:
        """Return that of a matrix (n, n)."""
        sigma = np.sqrt(np.diag(matrix))
        scale = np.where(sigma > 0.0, sigma, np.inf)
        variance, directions = np.linalg.eigh(np.nan_to_num(matrix / scale[:, None] / scale))
        root: Floats = np.linalg.qr((directions * np.sqrt(np.maximum(variance, 0.0))).T)[1]
        upper = np.rint(root[np.triu_indices(len(root))] / RESOLUTION).astype("<i4")
        sigmas = tuple(value if math.isfinite(value) else None for value in sigma.tolist())
        return cls(tuple(names), tuple(units), sigmas, zlib.compress(upper.tobytes(), 9))

    @property
    def matrix(self) -> Floats:
        """Return the matrix (n, n)."""
        root = np.zeros((len(self.names), len(self.names)))
        root[np.triu_indices(len(root))] = np.frombuffer(_inflated(self.upper, len(root)), "<i4") * RESOLUTION
        root *= np.array(self.sigma, dtype=float)
        return root.T @ root


def _inflated(upper: bytes, n: int) -> bytes:
    """Return the numbers of an upper triangle (n, n), and hardly more than these; nothing if they are damaged."""
    try:
        return zlib.decompressobj().decompress(upper, 2 * n * (n + 1) + 1)
    except zlib.error:
        return b""


class JointRange(Struct, frozen=True):
    """The lowest and highest reading [rad or m] of each joint among the fitted observations."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]


class Carried(Struct, frozen=True):
    """A payload."""

    mass_kg: Size
    centre_mm: tuple[float, float, float]


class LawsEntry(Struct, frozen=True):
    """The joint laws beyond offset and gain."""

    laws: Annotated[tuple[Law, ...], Meta(max_length=200)]
    payloads: tuple[Carried, ...] = ()
    mode: Name = ""
    reasons: tuple[dict[Name, Any] | str, ...] = ()  # findings; texts in earlier files
    gravity: tuple[float, float, float] | None = None
    gravity_known: bool = False
    tried: tuple[Entry, ...] = ()
    steps: tuple[Entry, ...] = ()
    noise: Figures = {}


class ParameterEstimate(Struct, frozen=True, kw_only=True):
    """A parameter in its SI unit, before and after.

    ``sigma`` is None unless it is free and the observations determine it.

    ``of`` is "robot" or "rig". ``value`` is None if it does not exist, ``seen`` is False if ``sigma`` is None.

    Examples
    --------
    >>> import truearm
    >>> length = truearm.read_result("result.json").parameters["link2.x"]
    >>> length.unit, length.free, length.of, length.sigma > 0.0
    ('m', True, 'robot', True)
    """

    name: Name
    unit: Annotated[str, Meta(pattern=rf"^({'|'.join(UNITS)})\Z")]
    nominal: float
    value: float | None
    sigma: Size | None
    free: bool
    seen: bool = False
    of: Literal["robot", "rig"]
    law: bool | UnsetType = UNSET


class Result(Struct, frozen=True, kw_only=True):
    """The content of result.json. What earlier versions do not have is optional."""

    format: Literal["truearm-result"] = FORMAT
    format_version: Literal[4] = FORMAT_VERSION
    truearm_version: Name = ""
    inputs: tuple[Input, ...] = ()
    simulated: bool = False
    findings: tuple[dict[Name, Any], ...] = ()
    robot: RobotFrames
    status: Literal["converged", "max_iterations", "stalled"]
    message: str = ""
    solver: Name = ""
    loss: Loss = Loss.LINEAR
    prior: Prior = Prior.NONE
    iterations: Count = 0
    n_observations: Count = 0
    joint_range: JointRange | None = None
    observations: tuple[Entry, ...] = ()
    n_free: Count = 0
    rank: Count = 0
    rank_gap: Size | None = None
    free: Names = ()
    defaults: Defaults = Defaults()
    suggested_free: Names = ()
    null_space: tuple[NullDirection, ...]
    hardly_seen: tuple[NullDirection, ...] = ()
    observability: Figures | None = None
    additions: tuple[Addition, ...] = ()
    alternatives_tried: Count = 0
    usable: bool = True
    unusable_because: Unusable | None = None
    explanations: tuple[dict[Name, Any], ...] = ()
    residual_units: Names = ()
    rms_before_mm: Residual = UNSET
    rms_before_deg: Residual = UNSET
    rms_raw_mm: Residual = UNSET
    rms_raw_deg: Residual = UNSET
    rms_after_mm: Residual = UNSET
    rms_after_deg: Residual = UNSET
    rms_declared_mm: Residual = UNSET
    rms_declared_deg: Residual = UNSET
    rms_unexplained_mm: Residual = UNSET
    rms_unexplained_deg: Residual = UNSET
    pose_error: Figures | None = None
    rms_history_mm: tuple[Size | None, ...] | UnsetType = UNSET
    rms_history_deg: tuple[Size | None, ...] | UnsetType = UNSET
    chi2_reduced: Size | None = None
    chi2_band: tuple[Size | None, Size | None] | None = None
    chi2_freedom: Size | None = None
    suspect: tuple[Entry, ...] = ()
    scale: Figures | None = None
    faults: tuple[Entry, ...] = ()
    claim: dict[str, Any] | None = None
    applied: Names = ()
    unexplained: Entry | None = None
    mean_change: Entry | None = None
    with_outliers: Entry | None = None
    without_bad_rows: Entry | None = None
    held_out_by: Names = ()
    held_out: Figures | None = None
    held_out_before: Figures | None = None
    held_out_drawing: Figures | None = None
    folds: tuple[Entry, ...] = ()
    predicted_error: Entry | None = None
    joint_laws: LawsEntry | None = None
    parameters: Annotated[tuple[ParameterEstimate, ...], Meta(max_length=20_000)]
    covariance: Covariance
    sessions: tuple[Entry, ...] = ()
    copies: tuple[Entry, ...] = ()
    made_with: dict[Name, str | int | bool | tuple[str, ...] | None] | None = None
    all_held_out: Names = ()
    hold_out_proposal: Figures | None = None

    def __post_init__(self) -> None:
        names, n_joints = {parameter.name for parameter in self.parameters}, len(self.robot.joint_units)
        if len(names) != len(self.parameters) or not names >= {*self.covariance.names}:
            raise ValueError("parameters: their names are not unique, or the covariance has others")
        if self.joint_range and {len(self.joint_range.lower), len(self.joint_range.upper)} != {n_joints}:
            raise ValueError(f"joint_range: needs {n_joints} numbers each, one per joint")

    def column(self, name: str) -> NDArray[Any]:
        """Return a field of all parameters (p,); NaN for null."""
        fields = (getattr(parameter, name) for parameter in self.parameters)
        return np.array([math.nan if field is None else field for field in fields])

    @property
    def laws(self) -> tuple[Law, ...]:
        """Return the joint laws, whose parameters follow the robot's own."""
        return self.joint_laws.laws if self.joint_laws else ()

    @property
    def payloads(self) -> tuple[Payload, ...]:
        """Return the different payloads of the fitted rows, empty if joint laws were not tried."""
        carried = self.joint_laws.payloads if self.joint_laws else ()
        return tuple(Payload(payload.mass_kg, tuple(map(MM.to_si, payload.centre_mm))) for payload in carried)

    @property
    def document(self) -> dict[str, Any]:
        """Return the content as JSON has it, with its checksum."""
        content: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(self))
        return {**content, CHECKSUM: checksum(content)}


def checksum(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a result's content, independent of its layout. Raises ValueError for non-finite numbers."""
    content = {name: value for name, value in document.items() if name != CHECKSUM}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def read_result(path: Path) -> Result:
    """Read a result.json of this format version or an older one. Raises InputError that names file and field."""
    return parse_result(read_text(path, MAX_BYTES, InputError), str(path))


def parse_result(text: str, name: str) -> Result:
    """Parse the text of a result.json; see ``read_result``. Unknown fields, from later versions, are skipped."""
    try:
        document = msgspec.json.decode(text)
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise InputError(f"{name}: is not a result of truearm identify (its format is not {FORMAT!r})")
        header = msgspec.convert(document, _Header)
        if header.format_version > FORMAT_VERSION:
            versions = f"format version {header.format_version}, this truearm reads up to {FORMAT_VERSION}"
            raise InputError(f"{name}: has {versions}; update truearm")
        if (header.checksum or header.format_version >= SINCE_CHECKSUM) and header.checksum != checksum(document):
            mismatch = "was changed or damaged: its checksum does not match"
            raise InputError(f"{name}: {mismatch}; copy it again or identify again")
        return msgspec.convert(_converted(document), Result)
    except RecursionError as exc:
        raise InputError(f"{name}: is nested too deeply; give a result of truearm identify") from exc
    except msgspec.ValidationError as exc:
        reason, _, place = str(exc).replace("`", "").partition(" - at $.")
        prefix = f"{name}: {place}" if place else name
        raise InputError(f"{prefix}: {reason[0].lower()}{reason[1:]}; copy it again or identify again") from exc
    except msgspec.MsgspecError as exc:
        raise InputError(f"{name}: is not strict JSON: {exc}; give a result of truearm identify") from exc


def write_result(path: Path, result: Result) -> None:
    """Write result.json atomically. Raises InputError if it cannot be written there."""
    write_atomic(path, strict_json(result.document) + "\n")


# results of the format versions 1 to 3, and of early versions 4


class _Header(Struct, frozen=True):
    format_version: Annotated[int, Meta(ge=1, le=10**6)]
    checksum: str | None = None


class _Matrix(Struct, frozen=True):
    names: Names
    units: Names
    matrix: tuple[tuple[float | None, ...], ...]


class _EarlierResult(Struct, frozen=True):
    covariance: _Matrix


RENAMED = {  # keys of entries, also in results of version 4 that are older than the names
    "pose_error": {"sigma_mm": "shared_mm", "row_variance": "factor"},
    "made_with": {"allow": "apply"},
}


def _converted(document: dict[str, Any]) -> dict[str, Any]:
    """Return the content of a result in the form of version 4. Raises msgspec.ValidationError."""
    for field, names in RENAMED.items():
        if isinstance(entry := document.get(field), dict):
            document[field] = {names.get(key, key): value for key, value in entry.items()}
    if document["format_version"] == FORMAT_VERSION:
        return document
    names, units, matrix = msgspec.structs.astuple(msgspec.convert(document, _EarlierResult).covariance)
    n = len(names)
    if [len(units), *map(len, matrix)] != [n] * (n + 1):
        raise msgspec.ValidationError(f"needs {n} units and {n} rows of {n} numbers, one per name - at `$.covariance`")
    packed = Covariance.of(names, units, np.array(matrix, dtype=float).reshape(n, n))
    for options in (document, document.get("made_with")):
        if isinstance(options, dict) and options.get("prior") == "default":
            options["prior"] = Prior.WHERE_NEEDED
    is_converged = document.get("status") == "converged"
    verdict = {"usable": is_converged, "unusable_because": None if is_converged else Unusable.NOT_CONVERGED}
    changed = {"format_version": FORMAT_VERSION, "covariance": msgspec.to_builtins(packed), "explanations": []}
    return {**verdict, "residual_units": ["mm"], **document, **changed}  # explanations were texts
