"""What the 3-D view of a page shows: of a calibration, a map, a correction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from truearm.correct.correction import ModelPair, believed, reached
from truearm.correct.error_map import ErrorMap
from truearm.estimate.prediction import measured_points, nominal_gap, point_covariance
from truearm.estimate.validation import Judgement, judge
from truearm.kinds.group import unit_columns
from truearm.kinds.table import ObservationTable
from truearm.model.chain import forward, joint_frames, point_forward, point_jacobians
from truearm.model.transforms import axis_of
from truearm.plan.measurement_limits import Sizes, along_joints
from truearm.report.figures import row_name
from truearm.report.page import MOST_POINTS, Points, Scene
from truearm.types import Floats, Rigs, rigs_by_name, thinned
from truearm.units import MM
from truearm.workflows.calibration import Calibration, Identification
from truearm.workflows.correction_findings import COVERAGE, CorrectedTargets

FEWEST = 4  # poses between which errors are predicted
BEFORE, AFTER, EXPECTED = "error before", "residual after", "expected after (k = 2)"


def calibration_scene(identification: Identification) -> Scene:
    """Return the measured poses with their errors before and after, and the errors predicted between them."""
    e, rows = identification.estimate, thinned(len(identification.table), MOST_POINTS)
    table, n = identification.table.select(rows), rows.size
    chain, rig, params = identification.chain, identification.rig, identification.identified
    judged = judge(chain, rig, table, params, dict(zip(e.parameter_names, e.value, strict=True)))
    fixtures = _fixtures(rig, judged)
    labels = [row_name(source) for source in table.source]
    names = {name: k for k, name in enumerate(fixtures)}
    rig_prefix = np.where(table.rig == "", "", np.char.add(table.rig, "."))
    chucks = [names.get(f"{prefix}chuck.{label}", -1) for prefix, label in zip(rig_prefix, table.chuck, strict=True)]
    # A pose between two measured ones is within the limits of the joints, and within the measured readings.
    order = np.random.default_rng(0).permutation(n)
    both = table.select(np.concatenate([np.arange(n), order]))
    both = both.replace(q=np.concatenate([table.q, 0.5 * (table.q[order] + table.q)]))
    places, _ = measured_points(rig, both, e)
    xyz, gap = point_forward(chain, params, both.q, places), nominal_gap(chain, rig, both, e)
    size = np.linalg.norm(gap, axis=1)
    values, vectors = {BEFORE: size[:n]}, {BEFORE: gap[:n]}
    if "m" in e.residual:
        values = {AFTER: np.abs(e.residual["m"][rows]), **values}
        vectors[AFTER] = _residual_vectors(identification, table, judged, places[:n])
    clouds = [Points("measured poses", xyz[:n], table.q, labels, values, vectors, chucks)]
    covariance = point_covariance(chain, rig, both, e) if n >= FEWEST else None
    if n >= FEWEST:
        field = {BEFORE: size[n:]}
        if covariance is not None:
            variances = np.trace(covariance.covariances, axis1=1, axis2=2)[n:]
            field[EXPECTED] = COVERAGE * np.sqrt(variances)
        clouds.append(Points("between the poses", xyz[n:], both.q[n:], ["predicted"] * n, field, {}))
    caption = (
        "Error before: from where the nominal robot, with base and tool placed, has the measured point to where the identified robot has it, in all directions; a row may see only a part of it, as a ball-bar the part along the bar. "
        "Residual after: from the predicted to the measured point, as far as the row measures it."
    )
    if covariance is not None and covariance.relative:
        caption += " What is expected leaves out the pose of the base, which the rows do not determine."
    return _scene(identification, caption, clouds, fixtures, _tools(rig, judged))


def map_scene(calibration: Calibration, pair: ModelPair, mapped: ErrorMap) -> Scene:
    """Return the cells of a map that the arm reaches."""
    reachable = np.argwhere(~np.isnan(mapped.error))
    i, j = reachable[thinned(len(reachable), 2 * MOST_POINTS)].T
    q, labels = mapped.q[i, j], ["cell"] * i.size
    values = {BEFORE: mapped.error[i, j], EXPECTED: COVERAGE * mapped.sigma[i, j]}
    gap = (reached(pair, q) - believed(pair, q))[:, :3, 3]
    points = Points("cells", mapped.point[i, j], q, labels, values, {BEFORE: gap})
    return _scene(calibration, "Error before: from the commanded to the reached position of the end.", [points])


def correction_scene(
    calibration: Calibration, pair: ModelPair, targets: CorrectedTargets, document: Mapping[str, Any]
) -> Scene:
    """Return the targets that were corrected, of which ``document`` holds what is expected."""
    done, all_rows = targets.correction, np.flatnonzero(np.isfinite(targets.correction.q).all(axis=1))
    rows = all_rows[thinned(all_rows.size, MOST_POINTS)]
    q, tools = done.q[rows], targets.tools[rows]
    reached_points, gap = (reached(pair, q) @ tools)[:, :3, 3], (believed(pair, q) @ tools)[:, :3, 3]
    expected = np.array([row["expected_mm"] for row in document["targets"]], dtype=float)[rows]
    values = {BEFORE: done.before[rows, 0], EXPECTED: MM.to_si(expected)}
    labels = [targets.places[row] for row in rows]
    points = Points("targets", reached_points, q, labels, values, {BEFORE: reached_points - gap})
    return _scene(
        calibration, "Error before: where the arm would go without the correction, from the target.", [points]
    )


def _scene(
    calibration: Calibration,
    caption: str,
    points: list[Points],
    fixtures: Mapping[str, Floats] | None = None,
    tools: Floats | None = None,
) -> Scene:
    chain, params = calibration.chain, calibration.identified
    zero = np.zeros(len(chain.joints))
    frames = joint_frames(chain, params, zero)
    rows = zip(chain.motions, frames, strict=True)
    joints = np.array([[motion[0] == "r", *frame[:3, 3], *frame[:3, axis_of(motion)]] for motion, frame in rows])
    capsules = calibration.robot.capsules or along_joints(chain, params, Sizes().link)
    carried = np.concatenate([np.eye(4)[None], frames])[list(capsules.joint)]
    ends = capsules.ends @ carried[:, :3, :3].swapaxes(1, 2) + carried[:, None, :3, 3]
    links = np.column_stack([capsules.joint, ends.reshape(-1, 6), capsules.radius])
    end = forward(chain, params, zero)
    drawn = [
        [len(zero), *start, *(end[:3, :3] @ tool + end[:3, 3]), radius]
        for tool in (np.zeros((0, 3)) if tools is None else tools)
        for start, radius in ((end[:3, 3], 0.005), (end[:3, :3] @ tool + end[:3, 3], 0.0125))
    ]
    return Scene(chain.name, caption, joints, links, np.array(drawn).reshape(-1, 8), fixtures or {}, points)


def _residual_vectors(
    identification: Identification, table: ObservationTable, judged: Judgement, places: Floats
) -> Floats:
    """Return the smallest displacements (n, 3) of the measured points that the lengths' residuals are.

    NaN for rows without any.

    Rows depend on the joints only by the point that they measure, so ∂(row)/∂(point) follows from ∂(row)/∂q.
    """
    vectors = np.full((len(table), 3), np.nan)
    _, _, by_joints = point_jacobians(identification.chain, identification.identified, table.q, places)
    for group in judged.problem.groups:
        lengths, row = unit_columns(group.COMPONENTS).get("m"), group.row
        if lengths and row is not None:
            linearised = group.evaluate(judged.problem.chain, judged.x)
            by_point = linearised.by_joints[lengths].swapaxes(0, 1) @ np.linalg.pinv(by_joints[row])
            residual = linearised.residual.reshape(row.size, -1)[:, lengths]
            vectors[row] = (np.linalg.pinv(by_point) @ residual[:, :, None])[..., 0]
    return vectors


def _identified(judged: Judgement, stem: str, start: Floats) -> Floats:
    """Return a point of the rig as estimated, where it is an unknown."""
    values = dict(zip(judged.problem.names, judged.x, strict=True))
    return np.array([values.get(f"{stem}.{axis}", value) for axis, value in zip("xyz", start, strict=True)])


def _fixtures(rig: Rigs, judged: Judgement) -> dict[str, Floats]:
    """Return chucks and sockets (3,) [m] in the base frame by name, as estimated where the rig does not know them."""
    chucks = {}
    for name, entries in rigs_by_name(rig).items():
        prefix = f"{name}." if name else ""
        for label, chuck in entries.chucks.items():
            chucks[f"{prefix}chuck.{label}"] = np.array(chuck.xyz)
    stems = {name[:-2] for name in judged.problem.names if name.endswith(".x")}
    sockets = {stem: np.zeros(3) for stem in sorted(stems) if "socket" in stem.split(".")[:2]}
    return {stem: _identified(judged, stem, start) for stem, start in {**chucks, **sockets}.items()}


def _tools(rig: Rigs, judged: Judgement) -> Floats:
    """Return spheres and targets (s, 3) in the end frame."""
    points = [
        _identified(judged, f"{name}." * bool(name) + f"{word}.{label}", np.array(point.xyz))
        for name, entries in rigs_by_name(rig).items()
        for word, named in (("sphere", entries.spheres), ("target", entries.targets))
        for label, point in named.items()
    ]
    return np.array(points).reshape(-1, 3)
