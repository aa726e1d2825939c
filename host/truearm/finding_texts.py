"""The sentence and the remedy of every finding, by code (templates of ``truearm.findings.worded``).

One code for one cause on which a user acts differently. docs/reference/findings.md lists them all.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple


class Severity(StrEnum):
    """How much a finding matters.

    The command ends because of it, the result must not be used, the user must look at it, a remark, what to do next.
    """

    ERROR = "error"
    REFUSAL = "refusal"
    WARNING = "warning"
    NOTE = "note"
    ADVICE = "advice"


class Statement(NamedTuple):
    """The entry of a code: a sentence, and what to do; both are templates of ``truearm.findings.worded``."""

    severity: Severity
    sentence: str
    remedy: str = ""


ERROR, REFUSAL, WARNING, NOTE, ADVICE = Severity

MORE_POSES = "Measure more poses, in more of the workspace"
SHARED = "This is the error in what the rows measure. Errors that all rows share do not show in it."
SHOWN = "The error that the rows show: {error}[ (95 %: {range})], the mean of {n:#pose} {by}."
BY_SIGMAS = "[The sigmas predict a tool error of {tool} RMS over {tool_n:#pose}. They hold only if the declared noise explains the residuals, and they grow if the fit estimates more errors.]"
CHI2_DROP = "χ² falls by {chi2_drop:.4g} with {freedom:#degree of freedom|degrees of freedom}."
SYSTEMATIC = f"[; or, nearly as well supported: {{others}}]. {{estimated}} {CHI2_DROP}[ Other possible explanations: {{same_item}}.]"

PROPOSAL = "[: {@hold_out} {fraction:g}][ {@seed} {seed}][ holds out {rows:#row}][ and leaves at least half the rows of each of the {combinations} combinations of names in the fit]"

IDENTIFICATION: Mapping[str, Statement] = {
    # the verdict
    "better": Statement(
        NOTE,
        "Usable: the mean error of {n:#pose} {by} is {after}, and {before} with the nominal robot.",
    ),
    "held-out": Statement(
        NOTE, "Usable: the RMS of {n:#held-out row} is {after}, and {before} with the nominal robot."
    ),
    "unjudged": Statement(
        NOTE,
        "Usable, but not judged by poses that were not fitted: the RMS of the fitted rows is {after}, and {before} with the nominal robot.",
    ),
    "no-gain": Statement(
        WARNING,
        "The calibration is not significantly better than the nominal robot with base and tool placed: mean error {after} against {before}, for {n:#pose} {by}.",
        f"{MORE_POSES}, or keep the nominal robot.",
    ),
    "worse-than-nominal": Statement(
        REFUSAL,
        "This fit is not usable. It is worse than the nominal robot with base and tool placed: mean error {after} against {before}, for {n:#pose} {by}.",
        f"{MORE_POSES}, free fewer parameters, or keep the nominal robot.",
    ),
    "not-converged": Statement(REFUSAL, "This fit is not usable. It did not converge: {message}."),
    "no-freedom": Statement(
        REFUSAL,
        "This fit is not usable. Its residuals have no degrees of freedom: the parameters fit any readings.",
        "Measure more rows, or free fewer parameters.",
    ),
    "wrong-inputs": Statement(
        REFUSAL, "This fit is not usable. Its inputs are probably wrong. Residuals of {after} RMS remain."
    ),
    "large-residuals": Statement(
        REFUSAL,
        "This fit is not usable. Residuals of {after} RMS remain, more than the errors of any arm.",
        "Check the robot, the units, the order and signs of the joints, the rig and the labels.",
    ),
    "robot-scale": Statement(
        REFUSAL,
        "This fit is not usable. The robot is {factor:.4f} times as large as described (σ {sigma:.2g}, {n} lengths; by chance with a probability of {chance:.0e}). The lengths in the rig and the readings determine the scale. If they are wrong by this ratio, so is every position, and no residual shows it.[ A ratio of {unit} suggests a wrong unit.]",
        "Check them (bars, distances of sockets, positions of chucks, units) and the robot's model.",
    ),
    "simulated": Statement(
        WARNING,
        "SIMULATED: at least one session was recorded with a simulated box, so this says nothing about a real robot.",
    ),
    # what makes inputs right
    "meaningless": Statement(
        WARNING,
        "Its parameters and errors are meaningless.[{line:!} A straight line hardly determines the roll of its device: give the roll in the rig, with turn_sigma_deg.]",
        "Check the units, the order and signs of the joints, and the labels[{limit:!}, or raise {@max_iterations}].",
    ),
    "meaningless-weak": Statement(
        WARNING,
        "Its parameters and errors are meaningless.[{line:!} A straight line hardly determines the roll of its device: give the roll in the rig, with turn_sigma_deg.] Weakly identifiable parameters slow a fit down.",
        "Give {@prior} weak.",
    ),
    "still-joint": Statement(WARNING, "{joint} reads {reading} in all rows: if it moved, its readings are wrong."),
    "labels-unchecked": Statement(
        WARNING,
        "Labels were not checked: the rows have too many different labels to search them all.",
        "Identify fewer at a time.",
    ),
    "explanation": Statement(
        WARNING,
        "{lead}: {explanation} (in a quick fit: RMS {with_change} with this change, {as_given} as given)[; correct this, or give {@leave_out} {leave_out} (rows numbered from 1 over all inputs)][; correct this, or give {@allow} {allow}].",
    ),
    "explanation-by-noise": Statement(
        WARNING,
        "{lead}: {explanation} (RMS {with_change} in a quick fit either way; relative to their declared noise, the residuals are smaller with this change)[; correct this, or give {@leave_out} {leave_out} (rows numbered from 1 over all inputs)][; correct this, or give {@allow} {allow}].",
    ),
    "little-freedom": Statement(
        WARNING,
        "Only {freedom:#degree of freedom|degrees of freedom} for {rank:#parameter}[{rig:!} of the robot, besides the unknowns of the rig]: the residuals say nothing about accuracy.",
        "Measure more rows, and hold some of them out.",
    ),
    "joint-zeros": Statement(
        WARNING,
        "Zeros of joints differ from the description: {joints}. No assembly does that. Either the readings count from another zero than the robot's description: correct its offsets. Or an input is wrong: check the signs and axes.",
        "truearm correct needs a description that the controller shares.",
    ),
    "bad-rows": Statement(
        WARNING,
        "{n} of {fitted:#row} are bad: they disagree significantly with all others, which the declared noise explains (without the bad rows: RMS {after}, χ² per degree of freedom {chi2}): {rows}. They are more than {most:.0%} of the rows, so they are still in the fit, and all figures are for all rows.",
        "Find their cause, then leave them out, or give {@loss} cauchy.",
    ),
    "systematic-rows": Statement(WARNING, f"Systematic error: {{rows}} do not fit the others{SYSTEMATIC}"),
    "systematic-offset": Statement(WARNING, f"Systematic error: {{what}} is off by {{size}} in {{rows}}{SYSTEMATIC}"),
    "systematic-drift": Statement(
        WARNING,
        f"Systematic error: {{what}} drifts linearly[ in {{minutes}} min] by {{size}} over {{rows}}{SYSTEMATIC}",
    ),
    "systematic-thermal-drift": Statement(
        WARNING,
        f"Systematic error: {{what}} drifts with the box's temperature (which varies by {{over}}) by {{size}} over {{rows}}{SYSTEMATIC}",
    ),
    "systematic-backlash": Statement(
        WARNING, f"Systematic error: {{what}} has a backlash of {{size}} over {{rows}}{SYSTEMATIC}"
    ),
    "systematic-settling": Statement(
        WARNING,
        f"Systematic error: {{what}} is off in proportion to its last move: the error changes by {{size}} from the largest negative to the largest positive move (read before the arm stood still?), over {{rows}}{SYSTEMATIC}",
    ),
    "systematic-undetermined": Statement(
        WARNING,
        "These rows hardly determine {numbers}, and the position of the tool depends on {numbers:?it|them}.",
        "Measure {numbers:?it|them}, and correct the rig.",
    ),
    "systematic-apply": Statement(
        WARNING,
        "To apply {n:?it|all of them}:[ {allow:@allow}][ {leave_out:@leave_out}].[ χ² per degree of freedom is then {chi2}][, and the tool moves by {moves} RMS][{undetermined:!}, but the tool is then as uncertain as these estimates].[{little:!} This is less than a tenth of the error to expect.][ The cross-validation error is then {held_out:.3g} times as large.]",
    ),
    "systematic-open": Statement(
        WARNING,
        "The rows do not show which of these explanations is right, and the position of the tool depends on it. With the first explanation[{several:!} of each error]:[ χ² per degree of freedom is {chi2}][, and the tool moves by {moves} RMS][{undetermined:!}, but the tool is then as uncertain as these estimates].[{little:!} This is less than a tenth of the error to expect.][ The cross-validation error is then {held_out:.3g} times as large.]",
        "Check the items that they name, then estimate the error of the one that is wrong with {@allow}.[{certain:!} Until then, apply only what is certain:][ {allow:@allow}][ {leave_out:@leave_out}][{certain:!}.]",
    ),
    "systematic-here": Statement(
        WARNING,
        "These errors are in the rows that judge.[ Without {n:?it|all of them}, χ² per degree of freedom would be {chi2}.]",
        "Correct the error at its source, or judge the result by rows without it.",
    ),
    "copies": Statement(
        WARNING,
        "{n:#row is a copy|rows are copies} of earlier rows, with the same joints, readings and names to the last digit: {rows}. {n:?It is|They are} left out, because a copy is not a new measurement.",
    ),
    "session": Statement(
        NOTE,
        "{session}:[ {used} of {dwells:#dwell} used][ (numbered 1 to {last} with {stops:#stop} for mounting)][; rejected: {rejected}][{relabelled:!} (as relabelled)][{both:!};][ {lines_used} of {lines:#line} used][; rejected: {lines_rejected}][{lines:!} (points are named PASS.POINT)].",
    ),
    "doubtful-dwells": Statement(
        WARNING,
        "{session}: {n} of {dwells:#dwell} need a decision.",
        "truearm session relabel {path}",
    ),
    "no-dwell-fits": Statement(
        WARNING,
        "{session}: none of {dwells:#dwell} fits.",
        "Check that robot and rig are those that were measured; if so, truearm session relabel {path}",
    ),
    "doubtful-residuals": Statement(
        WARNING,
        "Residuals are {factor:.1f} times what the declared sigmas allow: the robot has errors that these parameters do not model, or the sigmas are too small[{prior:!}, or the prior is too tight].[{declared:!} The sigmas of the parameters follow from the declared noise alone.]",
    ),
    # the error of the tool
    "tool-error": Statement(
        NOTE,
        "Tool error predicted from the sigmas: {rms} RMS over {n:#pose}[{relative:!} (excluding the pose of the base)], at most {largest}, at {row}.",
    ),
    "tool-error-unpredictable": Statement(
        WARNING,
        "The tool error cannot be predicted: unidentifiable or weakly identifiable combinations would move the tool.",
    ),
    "tool-error-shown": Statement(
        NOTE,
        f"{{because}}. Expect errors of {{error}}[ (95 %: {{range}})], the mean of {{n:#pose}} {{by}}. {SHARED}",
        BY_SIGMAS,
    ),
    "tool-error-by-sigmas": Statement(
        NOTE,
        f"{{because}}. Expect tool errors of {{tool}} RMS over {{tool_n:#pose}}, as the sigmas predict: the rows show only part of the tool's error. {SHOWN}",
    ),
    "tool-error-systematic": Statement(
        WARNING,
        f"{{because}}. Expect tool errors of at least {{moves}} RMS: the tool moves by that much if these errors are estimated, and their estimates are uncertain too. {SHOWN}",
        BY_SIGMAS,
    ),
    "tool-error-bad-rows": Statement(
        WARNING,
        "Bad rows are in the fit. Expect tool errors of {moves} RMS: the tool moves by that much if they are left out. The error that the rows show includes that of the bad rows themselves: {error}[ (95 %: {range})], the mean of {n:#pose} {by}.",
    ),
    # what was identified
    "identified": Statement(
        NOTE,
        "{robot}: {rank} of {n_free:#parameter} identified from {rows} fitted[, {held_out} held out][; {unseen:#combination is|combinations are} unidentifiable, and no prediction for such poses depends on {unseen:?it|them}][; {weak:#combination is|combinations are} weakly identifiable].",
    ),
    "held-frames": Statement(
        NOTE,
        "Held at the nominal values, because such observations cannot determine them in any pose:[ the pose of the base ({base})][{both:!} and][ the mounting of the tool ({tool})].",
    ),
    "still": Statement(NOTE, "{joint} moves by only {spread}, too little to identify its axis.", "Move it more."),
    "held-with-still": Statement(NOTE, "Therefore also held at the nominal values: {names}."),
    "displaced": Statement(
        NOTE,
        "The fit places {frames}. This is normal if nobody measured {n:?its place|their places}: the rig then defines where {n:?it is|they are}. If {n:?it was|they were} measured, positions in the rig are wrong by as much, and so are the tool positions that the calibration gives. No residual shows this.",
        "Check the positions in the rig.",
    ),
    "time-offset": Statement(
        NOTE,
        "{name}: the joint readings are {offset:.3f} {late} (σ {sigma:.2g}), including the shortest latencies of the links.",
    ),
    "time-offset-unidentifiable": Statement(
        WARNING,
        "{name}: the delay of the joint readings is unidentifiable; along a line driven one way it cannot be distinguished from the position of the line.",
        "Drive lines there and back.",
    ),
    # the residuals
    "chi2": Statement(
        NOTE,
        "χ² per degree of freedom {chi2}[ (rows weighted by the {loss} loss)], {where} its 95 % range of {low:.3g} to {high:.3g}[{less:!}: the rows scatter less than their declared noise].",
    ),
    "noise-explains": Statement(
        NOTE, "Declared noise alone would leave {declared} RMS: nothing[ in {units}] is unexplained."
    ),
    "noise-leaves": Statement(
        NOTE,
        "Declared noise explains {declared} of the RMS after; the rest, {unexplained}, {rest} (their squares add up to that of the RMS).",
    ),
    "pose-error": Statement(
        NOTE,
        "Rows of one pose share an error of {sigma} (σ of each coordinate, from {n:#pose} with several rows). The sigmas include it.",
    ),
    "outliers": Statement(
        NOTE,
        "{n:#row disagrees|rows disagree} significantly with all others[; {left_out} left out of the fit]: {rows}.[ Not left out, because {why}: {kept}.]",
        "[To leave out a row yourself: {first:@leave_out}.]",
    ),
    "too-many-outliers": Statement(
        WARNING,
        "{n} of {fitted:#row} lie farther from the fit than their declared noise allows. These are too many to be outliers: the model is wrong, or the sigmas are too small.",
    ),
    "all-rows-fit": Statement(
        NOTE,
        "[{geometry:!}Geometry alone, fitted][{plain:!}Fitted] to all rows: RMS {after}, χ² per degree of freedom {chi2:.3g}.",
    ),
    "before": Statement(NOTE, '"Before" is the nominal robot[ with {fitted} fitted to these rows].'),
    "before-placed": Statement(
        NOTE, '"Before" is the nominal robot with {fitted} fitted; with base and tool as described: {raw} RMS.'
    ),
    "held-out-larger": Statement(
        WARNING,
        "The held-out error is {ratio:.2g} times the fitted one: too few observations for so many parameters, or errors that the parameters do not model.",
    ),
    "group-held-out": Statement(
        NOTE,
        f"No row with {{names}} is left in the fit.[{{proposed:!}} If you did not intend this, hold out others]{PROPOSAL}[{{proposed:!}}.]",
    ),
    "rig-from-held-out": Statement(
        NOTE, "{n:#unknown of the rig was|unknowns of the rig were} estimated from the held-out rows themselves."
    ),
    "rows-not-judged": Statement(
        NOTE,
        "{n:#held-out row is|held-out rows are} not judged: unknowns of the rig fit such rows exactly.",
    ),
    "no-row-judged": Statement(
        WARNING,
        "No held-out row can be judged: unknowns of the rig fit each of them exactly.",
        "Measure more rows there.",
    ),
    "observability": Statement(NOTE, "Observability of {n:#parameter}: {indices} (larger is better)."),
    "solver": Statement(NOTE, "Solved by {solver} {prior}[, {loss} loss]."),
    "solver-recipe": Statement(WARNING, "The solver {message}."),
    # joint laws
    "law-not-tried": Statement(NOTE, "Joint laws: {reason}."),
    "no-law": Statement(NOTE, "No joint law is used: the geometry alone is fitted."),
    "no-law-kept": Statement(
        NOTE, "No joint law is supported by the evidence ({tried:#law} tried): the geometry alone is used."
    ),
    "sag-kept": Statement(NOTE, "{joint} sag: {rms} RMS, evidence {nats:.0f} nats."),
    "curve-kept": Statement(
        NOTE,
        "{joint} curve: {rms} RMS, evidence {nats:.0f} nats, covered {covered}, [strongest cycles per turn: {periods}; the covered range resolves {resolution:.2g} cycles per turn][{short:!}covered range too short for a spectrum].",
    ),
    "laws-dropped": Statement(NOTE, "Tried and dropped, with their evidence in nats (6 are needed): {laws}."),
    "gravity-assumed": Statement(
        NOTE,
        "Gravity is assumed to point along -z of the base frame; otherwise give gravity in the robot file or the table.",
    ),
    "sag-extrapolated": Statement(
        NOTE,
        "The fitted poses show only part of the sag's range within the joint limits ({joints}): the rest is extrapolated.",
        "Measure poses with other gravity torques if you use them.",
    ),
    "sag-of-payloads": Statement(NOTE, "The sag of the joints depends on the payload, which was {masses} kg."),
    "sag-of-payload": Statement(
        NOTE,
        "The sag of the joints holds for the payload of these rows, {mass} kg: it is the same in all of them.",
    ),
    "law-noise": Statement(NOTE, "Noise learned from the residuals: {terms}."),
    # what to do next
    "measure-next": Statement(
        ADVICE,
        "Next: {what} [{full_rank:!}to determine {n:#more parameter} better than a drawing][{lacking:!}to identify {n:#more parameter}]: {names}.",
    ),
    "correct-next": Statement(ADVICE, "Next: correct what the first lines name, then identify again."),
    "hold-out-next": Statement(
        ADVICE,
        f"Next: judge the result by held-out rows[{{few:!}} of other poses: these are too few to hold any out]{PROPOSAL}.",
    ),
}

# Errors: sentence and remedy; the first ones are the codes of errors that have a text.
REASON = "[{place}: ]{reason}"
ERRORS: Mapping[str, tuple[str, str]] = {
    "failed": (REASON, ""),
    "invalid-input": (REASON, ""),
    "invalid-argument": (REASON, ""),
    "malformed-file": (REASON, ""),
    "cannot-write": (REASON, ""),
    "unsolvable": (REASON, ""),
    "incomplete": (REASON, ""),
    "link-lost": (REASON, ""),
    "link-closed": (REASON, ""),
    "refused-by-box": (REASON, ""),
    "other-protocol": (REASON, ""),
    "usage": ("{reason} (see {command} {@help})", ""),
    # files
    "missing-file": (
        "{place}: no such file[, because the folder {folder} does not exist]",
        "[did you mean {meant}?||check its name and folder]",
    ),
    "not-a-file": ("{place}: is not a regular file", "give the name of a file"),
    "unreadable-file": ("{place}: cannot be read: {reason}", ""),
    "not-text": ("{place}: is not UTF-8 text[ (at byte {byte})]", "save it as UTF-8"),
    "too-large": ("[{place}: ]has more than {most}, the maximum", "check that it is the right file, or split it"),
}

# why a move of a program is not corrected: clauses, about its tool or the like if the values have a subject
UNDETERMINED = (
    "nothing determines in which of its configurations the arm reaches this target, and each needs another correction"
)
REASONS = {
    "absent-routine": "{name} is in none of the files and may change data or displace the program; give {@unchanged} NAME if it does not",
    "aimless": "it has no target in the program",
    "ambiguous": "{name} is declared in several modules, such as in {where}",
    "argument": "{name} is an argument of {function} in {where}, which may change it[{outside:!}; give {@unchanged} NAME if it does not]",
    "arguments": "arguments are missing",
    "assigned": "{name} is assigned in {where}",
    "axis": "its external axis {name} may move the robot's base; give {@unchanged} NAME if it does not",
    "by-name": "{name} in {where} changes data by their names",
    "configuration": f"{UNDETERMINED}; give {{@home}} Q1,Q2,... or, in a URScript, qnear of get_inverse_kin",
    "deep": "it is nested too deeply, or a name leads to itself",
    "displacing": "{name} in {where} displaces the program at run time",
    "element": "{name} has no such element",
    "fixed-tool": "the robot does not hold its tool",
    "frames": "its tool and base are not set in plain steps before it",
    "held-object": "the robot holds its work object",
    "joints": "its joint readings are computed, not written as six plain numbers",
    "locked-axis": "SingArea\\LockAxis4 turns the tool away from its target",
    "many": "it may go to more than {most} targets",
    "method": "{name} may be changed by a method in {where}",
    "moved-object": "a mechanical unit moves its work object",
    "no-value": "{name} is declared without a value",
    "not-written": "its numbers are not all written in one place",
    "other-configuration": "the arm reaches its target in several configurations, which need different numbers",
    "other-numbers": "it needs other numbers in {where} than another move",
    "other-task": "{name}, declared in {where}, is assigned or has another value in another task",
    "parameter": "{name} is a {kind} of a routine",
    "partial": "it does not give all components, so the others keep their last values",
    "path": "its path is corrected at run time",
    "quaternion": "its orientation is no unit quaternion: its norm is {norm:.4g}",
    "range": "its number {number:g} is beyond the reach of any robot",
    "redeclared": "{name} is declared again in {where}",
    "redefined": "{name} is a function of the language, and the program defines it again",
    "register": "it goes to a position register, or to a point by a computed number",
    "relative": "it is relative to where the robot is",
    "run-time": "it is computed at run time",
    "several": "{name} has several values",
    "several-tools": "it may run with several tools",
    "shared-use": "{name} is also used in {where}, which needs its numbers as they are",
    "solution": "{problem}",
    "tool": "no tool is set before it; give {@tool} X,Y,Z,RX,RY,RZ",
    "turns": "its configuration data do not fit the joints with which the arm arrives; give {@home} Q1,Q2,...",
    "type": "it is no {type}",
    "undeclared": "{name} is declared in none of the files[{subject:!}; give {@tool} or {@work} NAME=X,Y,Z,RX,RY,RZ]",
}
PROGRAMS: Mapping[str, Statement] = {
    code: Statement(REFUSAL, f"[its {{subject}}: ]{clause}") for code, clause in REASONS.items()
}

STATEMENTS: Mapping[str, Statement] = {
    **IDENTIFICATION,
    **PROGRAMS,
    **{code: Statement(ERROR, *texts) for code, texts in ERRORS.items()},
}
