"""The sentence and the remedy of every finding, by code (templates of ``truearm.findings.worded``).

One code for one cause on which a user acts differently. docs/reference/findings.md lists them all.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from functools import partial
from typing import NamedTuple

from truearm.text import page


class Severity(StrEnum):
    """What a finding is.

    The command ends because of it, the result must not be used, the user must look at it, the answer, a remark, what to
    do next.
    """

    ERROR = "error"
    REFUSAL = "refusal"
    WARNING = "warning"
    RESULT = "result"
    NOTE = "note"
    ADVICE = "advice"


class Statement(NamedTuple):
    """The entry of a code: a sentence, and what to do; both are templates of ``truearm.findings.worded``."""

    severity: Severity
    sentence: str
    remedy: str = ""


error, refusal, warning, result, note, advice = (partial(Statement, severity) for severity in Severity)

MORE_POSES = "Measure more poses, in more of the workspace"
HARDWARE = page("Build the box: parts, wiring, accuracy")
SHARED = "This is the error in what the rows measure. Errors that all rows share do not show in it."
SHOWN = "The error that the rows show: {error}[ (95 %: {range})], the mean of {n:#pose} {by}."
CHI2_DROP = "χ² falls by {chi2_drop:.4g} with {freedom:#degree of freedom|degrees of freedom}."
PARTS = "[ Of it, {parameters} come from the parameters][, {unnamed} from faults that the rows neither show nor exclude][, {scatter} from the arm's own scatter][, {faults} from one of: {names}][{parameters:!}.]"

PROPOSAL = "[: {@hold_out} {fraction:g}][ {@seed} {seed}][ holds out {rows:#row}][ and leaves at least half the rows of each of the {combinations} combinations of names in the fit]"

QUICK_FIT = "([{as_given:!}in a quick fit: RMS {with_change} with this change, {as_given} as given||RMS {with_change} in a quick fit either way][{place:!}, but as given, the robot or an item of the rig would be far from where it is described][{noise:!}; relative to their declared noise, the residuals are smaller with this change])."
CORRECT = "Correct this."
CORRECT_OR_LEAVE_OUT = "Correct this, or give {leave_out:@leave_out} (rows numbered from 1 over all inputs)."

INPUTS: Mapping[str, tuple[str, str]] = {
    "wrong-unit": ("{what} are in {are}, not in {called}", CORRECT),
    "wrong-robot": ("the observations are of robot {robot}, not of {other}", CORRECT),
    "other-rotations": ("the rotations are {are}, not {called}", CORRECT),
    "shifted-rows": ("the joint readings in each row belong to the row {side} it", CORRECT),
    "joints-ordered": ("the joints' columns are in another order: {order}", CORRECT),
    "joint-signs": ("the {joints:?sign|signs} of {joints} {joints:?is|are} reversed", CORRECT),
    "left-handed-readings": (
        "the axes of the readings of x, y and z are left-handed: two are exchanged, or one has the wrong sign[{rotations:!}, also in the rotations]",
        CORRECT,
    ),
    "left-handed-rig": ("the {axis} of {what} in the rig has the wrong sign", CORRECT),
    "names-exchanged": (
        "names are exchanged in all rows: {names}",
        "Correct this[{bar:!}, and the lengths that follow from the bar].",
    ),
    "wrong-labels": (
        "{n:#row was|rows were} measured with other parts than named: {runs}",
        "Correct this (a session with truearm session relabel)[{bar:!}, and the lengths that follow from the bar], or give {leave_out:@leave_out} (rows numbered from 1 over all inputs).",
    ),
    "rows-apart": (
        "{n:#row does|rows do} not fit the other {others}, which fit together ({runs}): something in the set-up moved in between, a joint's zero jumped, or the labels of these rows are wrong",
        CORRECT_OR_LEAVE_OUT,
    ),
    "stuck-joint": (
        "the reading of {joint} is stuck: it is the same in {n:#row} from {first} to {last}, while others move",
        CORRECT_OR_LEAVE_OUT,
    ),
    "wrong-constant": ("{item} differs from the rig in all rows: {off}", "Correct this, or give {@apply} {apply}."),
    "held-parameters": (
        "{names:#parameter} that the robot has free by default {names:?is|are} held: {names}",
        "Free more parameters.",
    ),
}

IDENTIFICATION: Mapping[str, Statement] = {
    # the verdict
    "usable": result(
        "Usable[{unjudged:!}, but not judged by poses that were not fitted][, but expect tool errors of {expected} RMS by a fault that it does not contain][, and with {applied} applied expect tool errors of {remaining} RMS]: the [mean error of {n:#pose} {by}][RMS of {rows}] is {after}, and {before} with the nominal robot."
    ),
    "no-gain": warning(
        "The calibration is not significantly better than the nominal robot with base and tool placed: mean error {after} against {before}, for {n:#pose} {by}.",
        f"{MORE_POSES}, or keep the nominal robot.",
    ),
    "worse-than-nominal": refusal(
        "This fit is not usable. It is worse than the nominal robot with base and tool placed: mean error {after} against {before}, for {n:#pose} {by}.",
        f"{MORE_POSES}, free fewer parameters, or keep the nominal robot.",
    ),
    "not-converged": refusal("This fit is not usable. It did not converge: {message}."),
    "no-freedom": refusal(
        "This fit is not usable. Its residuals have no degrees of freedom: the parameters fit any readings.",
        "Measure more rows, or free fewer parameters.",
    ),
    "wrong-inputs": refusal(
        "This fit is not usable. [{large:!}Residuals of {after} RMS remain, more than the errors of any arm.||Its inputs are probably wrong. Residuals of {after} RMS remain.]",
        "[{large:!}Check the robot, the units, the order and signs of the joints, the rig and the labels.]",
    ),
    "robot-scale": refusal(
        "This fit is not usable. The robot is {factor:.4f} times as large as described (σ {sigma:.2g}, {n} lengths; by chance with a probability of {chance:.0e}). The lengths in the rig and the readings determine the scale. If they are wrong by this ratio, so is every position, and no residual shows it.[ A ratio of {unit} suggests a wrong unit.]",
        "Check them (bars, distances of sockets, positions of chucks, units) and the robot's model.",
    ),
    "simulated": warning(
        "SIMULATED: at least one session was recorded with a simulated box, so this says nothing about a real robot."
    ),
    # what makes inputs right
    "meaningless": warning(
        "Its parameters and errors are meaningless.[{line:!} A straight line hardly determines the roll of its device: give the roll in the rig, with turn_sigma_deg.][{weak:!} Weakly identifiable parameters slow a fit down.]",
        "[{weak:!}Give {@prior} weak.||Check the units, the order and signs of the joints, and the labels.][{limit:!} Or raise {@max_iterations}.]",
    ),
    "still-joint": warning("{joint} reads {reading} in all rows: if it moved, its readings are wrong."),
    # interpretations of the inputs that explain the observations
    **{code: warning(f"{{lead}}: {sentence} {QUICK_FIT}", remedy) for code, (sentence, remedy) in INPUTS.items()},
    "little-freedom": warning(
        "Only {freedom:#degree of freedom|degrees of freedom} for {rank:#parameter}[{rig:!} of the robot, besides the unknowns of the rig]: the residuals say nothing about accuracy.",
        "Measure more rows, and hold some of them out.",
    ),
    "joint-zeros": warning(
        "Zeros of joints differ from the description: {joints}. No assembly does that. Either the readings count from another zero than the robot's description: correct its offsets. Or an input is wrong: check the signs and axes.",
        "truearm correct needs a description that the controller shares.",
    ),
    "bad-rows": warning(
        "{n} of {fitted:#row} are bad: they disagree significantly with all others, which the declared noise explains (without the bad rows: RMS {after}, χ² per degree of freedom {chi2}): {rows:6}. They are more than {most:.0%} of the rows, so they are still in the fit, and all figures are for all rows.",
        "Find their cause, then leave them out, or give {@loss} cauchy.",
    ),
    "fault": warning(
        f"Fault: {{what}}[ by {{size}}][, {{rows}}].[ Or, because these rows do not decide: {{others}}.][ No measurement at these poses can distinguish it from {{aliases}}.] {CHI2_DROP}[ With it, {{gain}}.]"
    ),
    "fault-choice": warning(
        "The result does not contain it[. {choices}||, and nothing is offered to apply][{few:!}: rows of at least three places would have to confirm it][{worse:!}: left-out rows would be predicted worse][{lasting:!}: it stays in the arm, and only joint laws ({@joint_laws} auto) can describe it].[ If all {every} are off, their positions are known to {sigma} only: declare that as their sigma.]",
        "[Measure {deciding} again to decide.][{deciding:!}{first:!} ][To apply it: {@apply} {first}.]",
    ),
    "faults-here": warning(
        "{n:#fault is|faults are} in the rows that judge.",
        "Correct it at its source, or judge the result by rows without it.",
    ),
    "faults-applied": note(
        "Applied to the parameters: {names}. The residuals are those of the fit before, as the readings are.[ The errors of {held:#held-out row} contain what this did to their readings.]"
    ),
    "faults-unseen": note(
        "These rows need not show, and twice the stated error does not contain: {faults}; nor what is larger."
    ),
    "noise-learned": note(
        "The residuals are not as declared: {noise}, {factor:.2g} times the declared size. A fault is then named only if it predicts rows that were left out.[ Not named for that reason: {refused:6}.]"
    ),
    "copies": warning(
        "{n:#row is a copy|rows are copies} of earlier rows, with the same joints, readings and names to the last digit: {rows:5}. {n:?It is|They are} left out, because a copy is not a new measurement."
    ),
    "session": note(
        "{session}:[ {used} of {dwells:#dwell} used][ (numbered 1 to {last} with {stops:#stop} for mounting)][; rejected: {rejected}][{relabelled:!} (as relabelled)][{used:!}{lines:!};][ {lines_used} of {lines:#line} used][; rejected: {lines_rejected}][{lines:!} (points are named PASS.POINT)]."
    ),
    "doubtful-dwells": warning(
        "{session}: [{none_fits:!}none of {dwells:#dwell} fits||{n} of {dwells:#dwell} need a decision].",
        "[{none_fits:!}Check that robot and rig are those that were measured; if so, ]truearm session relabel {path}",
    ),
    "doubtful-residuals": warning(
        "Residuals are {factor:.1f} times what the declared sigmas allow: the robot has errors that these parameters do not model, or the sigmas are too small[{prior:!}, or the prior is too tight].[{declared:!} The sigmas of the parameters follow from the declared noise alone.]"
    ),
    "outside-prior": warning(
        "{names:4} differ from the nominal robot by up to {times:.0f} times the sigma of the prior, which holds them back towards it.",
        "Check robot, units and zeros of the joints; if the arm is so far from its drawing, [{wide:!}give {@prior} none||give {@prior} wide].",
    ),
    # the error of the tool
    "tool-error": result(
        f"Expect tool errors of {{rms}} RMS over {{n:#pose}}[{{relative:!}} (excluding the pose of the base)], at most {{largest}}, at {{row}}.{PARTS}"
    ),
    "tool-error-unpredictable": warning(
        "The tool error cannot be predicted: unidentifiable or weakly identifiable combinations would move the tool."
    ),
    "tool-error-shown": result(
        f"{{because}}. Expect errors of {{error}}[ (95 %: {{range}})], the mean of {{n:#pose}} {{by}}. {SHARED}",
        "[The parameters' part of the tool error is {tool} RMS over {tool_n:#pose}.]",
    ),
    "tool-error-by-sigmas": result(
        f"{{because}}. Expect tool errors of {{tool}} RMS over {{tool_n:#pose}}: the rows show only part of the tool's error.{PARTS} {SHOWN}"
    ),
    "tool-error-bad-rows": warning(
        "Bad rows are in the fit. Expect tool errors of {moves} RMS: the tool moves by that much if they are left out. The error that the rows show includes that of the bad rows themselves: {error}[ (95 %: {range})], the mean of {n:#pose} {by}."
    ),
    # what was identified
    "identified": result(
        "{robot}: {rank} of {n_free:#parameter} identified from {rows} fitted[, {held_out} held out][; {unseen:#combination is|combinations are} unidentifiable, and no prediction for such poses depends on {unseen:?it|them}][; {weak:#combination is|combinations are} weakly identifiable]."
    ),
    "held-frames": note(
        "Held at the nominal values, because such observations cannot determine them in any pose:[ the pose of the base ({base})][{base:!}{tool:!} and][ the mounting of the tool ({tool})]."
    ),
    "still": note(
        "{joint} moves by only {spread}, too little to identify its axis[; therefore also held at the nominal values: {held}].",
        "Move it more.",
    ),
    "time-offset": note(
        "{name}: the joint readings are {offset:.3f} {late} (σ {sigma:.2g}), including the shortest latencies of the links."
    ),
    "time-offset-unidentifiable": warning(
        "{name}: the delay of the joint readings is unidentifiable; along a line driven one way it cannot be distinguished from the position of the line.",
        "Drive lines there and back.",
    ),
    # the residuals
    "chi2": note(
        "χ² per degree of freedom {chi2}[ (rows weighted by the {loss} loss)], {where} its 95 % range of {low:.3g} to {high:.3g}[{less:!}: the rows scatter less than their declared noise]."
    ),
    "noise-share": note(
        "Declared noise [explains {declared} of the RMS after; the rest, {unexplained}, {rest} (their squares add up to that of the RMS)||alone would leave {declared} RMS: nothing is unexplained]."
    ),
    "pose-error": note(
        "The rows of a pose err alike, so the arm scatters: {terms} (σ, from {n:#pose} with several rows). The sigmas include it."
    ),
    "outliers": note(
        "{n:#row disagrees|rows disagree} significantly with all others[; {left_out} left out of the fit][; the {loss} loss gives {ignored} of them less than {share} of their weight]: {rows:6}.[ Not left out, because {why}: {kept:6}.][ Fitted to all rows: RMS {after}, χ² per degree of freedom {chi2:.3g}][{geometry:!} (geometry alone)][{after:!}.]",
        "[To leave out a row yourself: {first:@leave_out}.]",
    ),
    "too-many-outliers": warning(
        "{n} of {fitted:#row} lie farther from the fit than their declared noise allows. These are too many to be outliers: the model is wrong, or the sigmas are too small."
    ),
    "audit": result(
        "On rows not fitted: controller's model {controller} RMS, drawing {drawing}, identified {identified}."
    ),
    "before": note(
        '"Before" is the nominal robot[ with {fitted} fitted][{placed:!}; with base and tool as described: {raw} RMS].',
    ),
    "folds": result("Held out in turn, each in a fit of its own: {together} RMS together; {errors}."),
    "held-out-larger": warning(
        "The held-out error is {ratio:.2g} times the fitted one: too few observations for so many parameters, or errors that the parameters do not model."
    ),
    "group-held-out": note(
        f"No row with {{names}} is left in the fit.[{{fraction:!}} If you did not intend this, hold out others]{PROPOSAL}[{{fraction:!}}.]"
    ),
    "rig-unknowns": note(
        "[{left_out:#row is|rows are} not judged: unknowns of the rig fit such rows exactly.||{n:#unknown of the rig was|unknowns of the rig were} {how}.]"
    ),
    "no-row-judged": warning(
        "No held-out row can be judged: unknowns of the rig fit each of them exactly.",
        "Measure more rows there.",
    ),
    "solver": note(
        "Solved by {solver} {prior}[, {loss} loss].[ Observability of {n:#parameter}: {indices} (larger is better).]"
    ),
    "solver-recipe": warning("The solver {message}."),
    # joint laws
    "no-law": note(
        "[Joint laws: {reason}.][No joint laws: they are fitted with the solvers lm and map and the linear loss, not with {solver} and {loss}.][No joint laws: {rows:#row} are too few; {freedom} degrees of freedom beyond the geometry are needed.][No joint laws: {explained_by}, named above, explain the residuals; correct them first.][{larger:!}No joint laws: with them, larger residuals remain than with the geometry alone.][Tried and dropped for too little evidence (fewer than 6 nats) or because they make regions left out worse, with their evidence in nats: {dropped}.][{tried:!}No joint law is supported by the evidence ({tried:#law} tried): the geometry alone is fitted.][{none:!}No joint law is used: the geometry alone is fitted.]"
    ),
    "no-sag": note(
        "[Gravity is up to {apart:.1f} from its mean direction over the rows, and sag is fitted to one mounting at a time.||The torque of gravity does not vary at any joint: sag is unidentifiable.]"
    ),
    "no-curve": note(
        "{joint} [covers {span:.1f}: too little for an error curve||is prismatic: it has no error curve].",
        "[{span:!}Move it more.]",
    ),
    "law-kept": note(
        "{joint} {term}: {rms} RMS, evidence {nats:.0f} nats[, covered {covered}][, strongest cycles per turn: {periods}; the covered range resolves {resolution:.2g} cycles per turn][{short:!}, covered range too short for a spectrum]."
    ),
    "gravity-assumed": note(
        "Gravity is assumed to point along -z of the base frame; otherwise give gravity in the robot file or the table."
    ),
    "sag-extrapolated": note(
        "The fitted poses show only part of the sag's range within the joint limits ({joints}): the rest is extrapolated.",
        "Measure poses with other gravity torques if you use them.",
    ),
    "sag-payload": note(
        "The sag of the joints [{several:!}depends on the payload||holds for the payload of {holder}][: {mass} kg][; it was measured under {masses} kg]."
    ),
    "payload-beyond": warning(
        "A payload of {mass} kg is beyond those of the calibration ({masses} kg): the sag under it is extrapolated.",
        "Identify with rows under such a payload.",
    ),
    "law-noise": note("Noise learned from the residuals: {terms}."),
    # what to do next
    "measure-next": advice(
        "Next: measure {what} [{full_rank:!}to determine {n:#more parameter} better than a drawing||to identify {n:#more parameter}]: {names:4}."
    ),
    "correct-next": advice("Next: correct what the first lines name, then identify again."),
    "hold-out-next": advice(
        f"Next: judge the result by held-out rows[{{fraction:!}}|| of other poses: these are too few to hold any out]{PROPOSAL}."
    ),
}

# Errors: sentence and remedy; the first ones are the codes of errors that have a text.
REASON = "[{place}: ]{reason}"
ERRORS: Mapping[str, tuple[str, str]] = {
    "invalid-input": (REASON, ""),
    "malformed-file": (REASON, ""),
    "cannot-write": (REASON, ""),
    "unsolvable": (REASON, ""),
    "no-plan": (REASON, ""),
    "unsuited-robot": (REASON, ""),
    "uncorrectable": (REASON, "[{home:!}give joints near those of this target with {@home}]"),
    "incomplete": (REASON, ""),
    "link-lost": (
        "[{place}: ][{closed:!}the robot closed its stream without a joint reading][the box was gone at the end, and {gone}][the box sent {n} of {needed} samples of {stream} in {seconds:.0f} s][{reason}]",
        "[{needed:!}test the box with truearm box test]",
    ),
    "refused-by-box": (REASON, ""),
    "other-protocol": (REASON, ""),
    "usage": ("{reason} (see {command} {@help})", ""),
    # files
    "missing-file": (
        "{place}: [the folder {folder} does not exist||no such file]",
        "[did you mean {meant}?||check its name and folder]",
    ),
    "unreadable-file": ("{place}: [cannot be read: {reason}||is not a regular file]", "give the name of a file"),
    "not-text": ("{place}: is not UTF-8 text[ (at byte {byte})]", "save it as UTF-8"),
    "too-large": ("[{place}: ]has more than {most}, the maximum", "check that it is the right file, or split it"),
    "file-exists": (
        "{place}: [{folder:!}holds other files||exists][{foreign:!} and is not a file that this command writes]",
        "choose another name[{may_force:!} or give {@force}][{folder:!} or an empty folder]",
    ),
    "wrong-plug-in": ("{place}: {reason}", "correct or uninstall this addition to truearm"),
    "wrong-suffix": ("{place}: is not a name for this kind of file", "give a name that ends in {suffixes}"),
    "in-use": ("{place}: is still being written", "end that recording first, or give another name"),
    # names and options
    "wrong-value": ("{place}[: {value!r}] [needs {form}||is not one of {names}]", "[did you mean {meant}?]"),
    "not-in-rig": (
        "{place}: {what} {name!r} is not in the rig[, which has {names}]",
        "correct the name, or give a rig that has it",
    ),
    "given-twice": ("{place}: [{what} is given twice||is already an input or output of this command]", "keep one"),
    "exclusive": (
        "[{neither:!}neither {first} nor {second} is given||{first} and {second} exclude each other]",
        "give one of them",
    ),
    "needs-option": ("{place} needs {needed}", ""),
    "no-effect": ("{place} has no effect: {reason}", "leave it out"),
    "missing-package": ("{place} needs the package {package}", "install it: pip install '{install}'"),
    # tables
    "no-rows": ("{place}: has no rows", "write one row for each measurement, pose or target below the header"),
    "missing-column": (
        "[{place}: ]has no column {column}[ (its header begins with {header})]",
        "[expected a header such as {example}||check that it is the right file, and its first row a header]",
    ),
    "unknown-column": ("{place}: is not a known column", "{remedy}"),
    # robots and results
    "other-robot": (
        "{place}: [has {joints} joints, the robot has {expected}||belongs to another robot][, {robot}][: {difference}]",
        "give the robot that was measured[{difference:!}, its file as {@robot}]",
    ),
    "unusable-result": (
        "{place}: the fit is not usable ({reason})",
        "correct its inputs and identify again (truearm report says why), or give {@allow_unusable}",
    ),
    "nothing-left": ("[{place}: ]no {what} are left to fit", "hold out, leave out or freeze fewer"),
    # sessions and projects
    "not-a-session": ("{place}: is not an MCAP file", "give a session (.mcap) recorded by truearm record"),
    "no-observation": (
        "{place}: [no observation from {rejected}||no dwell and no motion along a line was found]",
        "[{none_fits:!}check that robot and rig are those that were measured; if so, ][{undecided:!}decide what was mounted with truearm session relabel {file}][{others:!}; truearm inspect {file} shows why the others were rejected][{unexplained:!}truearm inspect {file} shows why]",
    ),
    "damaged-session": (
        "{place}: is damaged {where}",
        "copy it again from where it was recorded, or, to use the intact part, give {@allow_damaged}",
    ),
    "no-rig": ("{place}: was recorded without a rig", "give one as {@rig}"),
    "no-project": ("no {file} here or in a folder above", "create one with truearm init"),
    "no-arm": ("{place}: no {file} in it or below", "name folders of projects, or create one with truearm init"),
    "not-measured": ("{place}: holds no session yet", "make one with truearm record"),
    # box and robot
    "no-box": ("{place}: not found", "plug the box in"),
    "no-box-plugged-in": (
        "no box is plugged in: no serial port has a Pico's USB identity",
        "plug it in (a new Pico: truearm box flash), name its port with {@box}, or try all with truearm box list {@@all}; without hardware, truearm simulate simulates a box",
    ),
    "several-boxes": ("{boxes:#box is|boxes are} plugged in: {boxes}", "name one with {@box}"),
    "no-answer": (
        "{place}: no answer to {request!r} in {seconds:g} s",
        "is this a truearm box, and is its firmware running?",
    ),
    "place-beyond": (
        "[{place}: ]{first} and {second} are {apart} apart, more than the sensor's stroke of {stroke}",
        "check reading and unit",
    ),
    "few-places": (
        "[{place}: ]places[{measured:!} measured]: {distinct}[ ({n:#reading}; those of the same sensor value count once)], a calibration needs {least} or more",
        "measure more of them, over the whole travel",
    ),
    "no-channel": (
        "the box has no channel {channel} (it has {names})",
        "[{switch:!}switch it on with truearm box config set magnetostrictive.period_us=983.04 {device:@@box}||to rename one, save what truearm box config get {device:@@box} prints as box.toml, edit it, and run truearm box config set box.toml {device:@@box}]",
    ),
    "unusable-channel": (
        "channel {channel} cannot be used: {fault}",
        "correct it with truearm box config set channel.{channel}.KEY=VALUE {device:@@box}",
    ),
    "unready-box": ("{problems:;}; nothing was started", "{@unchecked} records anyway"),
    "old-firmware": ("[{place}: ]the box {reason}", "update its firmware with truearm box flash"),
    # programs
    "no-program": (
        "{place}: holds [no program||programs of several languages ({names})]",
        "give the programs of one robot ({suffixes})",
    ),
    "no-move": (
        "{place}: contains no move[{kept:!} besides those to joint values, which are kept]",
        "there is nothing to correct",
    ),
    "redundant": ("{place}: poses do not determine {joints} joints", "correct a table with joints (q1_deg, q2_deg, …)"),
    "joint-moves": ("{place}: moves to joint values, in {lines:#line}", "give {@joint_moves} keep or correct"),
    "frame": (
        "the calibration uses frame {frame}; the pose of the controller's {what} in this frame is not known",
        "give it as {argument} X,Y,Z,RX,RY,RZ, or as 0,0,0,0,0,0 if the two frames are the same[{may_use_own:!}, or use the robot's own frames with {@own_frames}]",
    ),
    "uncertain-moves": (
        "{place}: {good} of {n:#move} can be corrected, so nothing was written",
        "change the program as the reasons say[{good:!}, or correct the {good} alone with {@partial}]",
    ),
    "reread": ("{reason}, so nothing was written", "this is a fault in truearm: report it with this program"),
    # plans
}

# why a move of a program is not corrected: clauses, about its tool or the like if the values have a subject
UNDETERMINED = (
    "nothing determines in which of its configurations the arm reaches this target, and each needs another correction"
)
REASONS = {
    "absent-routine": "{name} is in none of the files and may change data or displace the program; add the file that defines it, or leave out {@strict}",
    "aimless": "it has no target in the program",
    "ambiguous": "{name} is declared in several modules, such as in {where}",
    "argument": "{name} is an argument of {function} in {where}, which may change it[{outside:!}; give {@unchanged} NAME if it does not]",
    "arguments": "arguments are missing",
    "assigned": "{name} is assigned in {where}",
    "axis": "its external axis {name} may move the robot's base; give {@unchanged} NAME if it does not",
    "by-name": "{name} in {where} changes data by their names",
    "configuration": f"{UNDETERMINED}; give {{@home}} Q1,Q2,... or, in a URScript, qnear of get_inverse_kin",
    "deep": "[{circular:!}a name on the way to its value leads to itself||it is nested too deeply]",
    "displacing": "{name} in {where} displaces the program at run time",
    "element": "{name} has no such element",
    "fixed-tool": "the robot does not hold its tool",
    "frames": "its tool and base are not set in plain steps before it",
    "joints": "its joint readings are computed, not written as six plain numbers",
    "locked-axis": "SingArea\\LockAxis4 turns the tool away from its target",
    "many": "it may go to more than {most} targets",
    "method": "{name} may be changed by a method in {where}",
    "moved-object": "the robot or a mechanical unit moves its work object",
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
    "run-time": "it is computed at run time[ in {where}]",
    "several": "{name} has several values",
    "several-tools": "it may run with several tools",
    "shared-use": "{name} is also used in {where}, which needs its numbers as they are",
    "solution": "{problem}",
    "tool": "it may run before a tool is set; give {@tool} X,Y,Z,RX,RY,RZ",
    "turns": "its configuration data do not fit the joints with which the arm arrives; give {@home} Q1,Q2,...",
    "type": "it is no {type}",
    "undeclared": "{name} is declared in none of the files[{subject:!}; give {@tool} or {@work} NAME=X,Y,Z,RX,RY,RZ]",
}

READING: Mapping[str, Statement] = {  # of the observations, while they are read
    "rows-reordered": warning(
        "{place}: the rows are not in the order of time_s. They are used in that order, and row numbers count in it."
    ),
    "doubtful-rows": warning("{reason}."),  # of a kind that a plug-in adds
    "beyond-stroke": warning(
        "Bar {bar}: {n} of its {rows:#row} are beyond its stroke of {low:.1f} to {high:.1f} (first {first}: {length:.1f}).",
        "Check the bar in these rows, and its zero_mm and travel_mm in the rig.",
    ),
    "other-distance": warning(
        "The distance of sockets {sockets} is {declared:.6g} in the rig, and about {nominal:.6g} by the nominal robot.",
        "Correct its unit (distance_mm or distance_m) in the rig, or the joints.",
    ),
    "repeated-distance": warning(
        "Rigs {rigs}: each has the same distance of sockets {sockets}, which counts as a measurement of each.",
        "If it was measured once, give one rig for all rows.",
    ),
    "other-temperature": warning(
        "{place}: the box was up to {difference:.1f} [{warmer:!}warmer||colder] than when {channel} was calibrated, and no thermometer was read on the bar: lengths may be off by {error} ({expansion:g} ppm/K of {length:.0f}, {drift:g} ppm/K of {travel:.1f}).",
        "Put a thermometer on the bar ({page}), or calibrate the box at this temperature.",
    ),
}

WAIT = "Wait longer at each pose ({@dwell_s} of the plan)."
LINK = "Close other programs that use the port, use a shorter USB cable, or a faster computer."

SESSION: Mapping[str, Statement] = {
    # the verdict
    "session-usable": result(
        "Usable:[ {observations:#observation} from {dwells:#dwell}][ ({planned:#pose} planned)][{observations:!}{points:!}, and][ {points:#point} from {passes:#pass|passes} along lines][ ({planned_passes} planned)]."
    ),
    "no-box-data": refusal("Not usable: the box {problem}.", "Check it with truearm box test, and record again."),
    "no-joint-readings": refusal(
        "[{place}:||Not usable:] no joint readings[; the robot sent {bytes:#byte that is no reading|bytes that are no readings}].",
        "Add them with truearm session add-joints.",
    ),
    "no-stops": refusal("Not usable: the robot never stood still.", WAIT),
    "session-not-evaluated": warning("Not evaluated:[ {dwells:#stop} and] no observation, because {reason}."),
    "no-observations": refusal(
        "Not usable: no observation[ from {dwells:#dwell}][ ({planned:#pose} planned)][, none from {passes:#pass|passes} along lines]."
    ),
    "recording": result(
        "{file}: {duration:.1f}[, {streams}][, {readings:#joint reading}][; clock error at most {clock:.0f}]."
    ),
    # the file
    "session-incomplete": warning(
        "[{place}: the||The] file is incomplete: what followed is lost, or its recorder is still running.",
        "Save what it holds with truearm session recover[{place:!}, or give {@allow_damaged}].",
    ),
    "session-damaged": warning(
        "[{place}: damaged||Damaged][{headers:!}: a CRC of the file does not match, although those of all its parts do; a header or the summary may be wrong.|| at byte {at}: {lost_s:.1f} of {of_s:.1f} s lost, from {from_s:.1f} s on.]",
        "Copy the file again.[ There are {more:#more such place}.]",
    ),
    "session-intact": result("{place}: is intact; there is nothing to recover, and nothing was written."),
    "recovered": result(
        "Saved: {messages:#message} over {duration:.1f}, [{samples:#sample}||no sample that can be used][, attached: {attachments}]. Lost: {lost:#message} by their numbers[, and what followed{cut_off:!}: at most a second if the recorder was killed][; {undescribed:#block} of samples without the box's description]. {unread_bytes:#byte is|bytes are} outside intact records."
    ),
    "further-parts": warning(
        "{session} continues in {parts}, which were not read.",
        "Give each part to this command[, and name each new file to later commands: they do not find parts from {out}].",
    ),
    "joints-added": result("{place}: {n:#joint reading} added, placed by their own times[{utc:!}|| and {@zero_s}]."),
    "tables-written": result("{folder}: {tables:40}."),
    "foreign-datagrams": warning(
        "{n:#datagram|datagrams} from other addresses than the robot's not stored.",
        "Stop the program that sends them, or use another port.",
    ),
    "session-made": note(
        "Recorded by truearm {version}[ ({clock} clock)][; firmware {firmware}][; attached: {attached}].[ Recovered from {recovered}: {lost} messages are known to be lost.][ The joint readings were added from {joints}: their arrival was not observed. Controller time: {time}; its error is unknown.][ Temperature: {ranges}.]"
    ),
    # what did not arrive
    "lost-on-link": warning(
        "Lost on the link: {frames_lost:#frame} and {samples_lost:#sample}[; the box was silent from {periods}, and {missing:#sample is|samples are} missing by the nominal rate].",
        LINK,
    ),
    "lost-in-box": warning(
        "{samples_overrun:#sample} overrun in the box ({overruns} by its own count), {dropped:#frame} dropped by it.",
        "Record with a lower {@rate}, or use a faster computer.",
    ),
    "box-faults": warning(
        "Faults of the box:[ {restarts:#restart}][ {converter_faults:#block} with faults of the converter][ {crc_errors:#damaged frame} of the converter][ {converter_resets:#reset} of the converter by itself][ {thermometer_errors:#failed reading} of a thermometer].",
        "Check its plugs and supply with truearm box test; fit a smaller pull-up resistor to a thermometer on a long cable.",
    ),
    "missing-stop-pulses": warning(
        "{missing_stops:#interrogation} of the magnetostrictive head without a stop pulse.",
        "Bring the magnet closer to the rod.",
    ),
    "malformed-plan": warning(
        "[{place}: ]{plan_events_malformed:#row of the plan or event is|rows of the plan or events are} malformed and not used.",
        "Check what was mounted with truearm session relabel.",
    ),
    "received": note(
        "[{complete:!}Nothing lost, nothing duplicated, no restart: ]{frames:#frame} received, {samples:#sample} in {blocks:#block}[; also counted: {counts}]."
    ),
    # time
    "box-clock": note(
        "Clock, segment {segment}: host − box {offset:.6f} s; the host counts {rate}. Error at most {bound:.1f}; of this, {half_asymmetry:.1f} is half the shortest round trip, because the two directions may differ. {exchanges:#exchange} ({rejected} rejected); round trip {rtt_min:.1f} (shortest), {rtt_median:.1f} (median)."
    ),
    "clock-stepped": warning(
        "The clock of the host or of the box was set or slewed: host − box changed by {change:+.1f} between {begin:.3f} s and {end:.3f} s of the box's clock."
    ),
    "robot-clock": note(
        "Clock of the robot: the host counts {rate}; readings arrive {jitter:.0f} later than the fastest one (mean); a constant latency cannot be determined."
    ),
    "trigger": note(
        "Trigger on input {input}[{inverted:!}, inverted][{in_use:!}, in use][{arrivals:!}, not used, because arrivals are more accurate]: {used} of {edges} edges agree[; {unseen} not visible in any reading][; {unclear} with several possible matches][; {rejected} contradicting the others][; {stray:#change} of the input without an edge]. Error of robot to box at most {to_box:.0f} (median), of robot to host at most {bound:.0f}, without a filter of the input; shortest latency of the link {shortest_latency:.0f}[; falling edges are delayed by {least:.0f} to {most:.0f} more than rising ones]."
    ),
    "trigger-unseen": warning(
        "No input of the robot follows the box's trigger ({edges:#edge}).",
        "Check its wire, and that the readings contain the inputs.",
    ),
    # the robot
    "joint-readings": note(
        "{readings:#reading} of {joints:#joint} at {rate_hz:.2f} Hz; {late} late, {duplicated} duplicated[, {lost} lost]."
    ),
    "joint-readings-lost": warning(
        "{readings:#reading} of {joints:#joint}:[ {lost} lost,] {gaps:#gap}, {malformed} malformed, {restarts:#restart} ({late} late, {duplicated} duplicated); dwells in gaps are rejected.",
        "Connect the robot by a cable, or let it send fewer readings per second.",
    ),
    # dwells and passes
    "rejected-unsettled": warning("Rejected, because they were not at rest: {rejected}.", WAIT),
    "rejected-sensor": warning(
        "Rejected, because of the sensor's samples: {rejected}.",
        "Check its plug with truearm box test, and what shakes the table.",
    ),
    "rejected-out-of-range": warning(
        "Rejected, because the sensor was out of its range: {rejected}.",
        "Seat the bar, and plan poses within its travel; drive a line closer to the rod, with the magnet near it.",
    ),
    "rejected-clock": warning("Rejected, because the box's clock is not known well enough: {rejected}.", LINK),
    "rejected-unlabelled": warning(
        "Rejected, because nothing says what was mounted: {rejected}.",
        "Decide it with truearm session relabel, and confirm what is mounted while you record.",
    ),
    "rejected-off-plan": note(
        "{rejected} rejected: the robot stood where the plan has no pose, probably between two poses."
    ),
    "rejected-line": warning(
        "Rejected, because they do not follow the line: {rejected}.",
        "Check its speed, and which line the plan and the rig name.",
    ),
    "pass-timing": note(
        "Each point of a line uses {window:.2f} of samples; its time is known to {time:.0f} ({distance:.0f} at this speed). A constant delay remains, which identify estimates from lines driven there and back."
    ),
    "stops": note(
        "Stops:[ settled after {median:.2f} (median), {longest:.2f} (longest);] {stops} for mounting[; events: {events}]."
    ),
}

REPEATABILITY: Mapping[str, Statement] = {
    "repeatability": result(
        "Repeatability along the bar, approached from one side: {along}, 1 sigma[ (without the joints' scatter {alone})]; largest backlash: {backlash}, {joint}. From {visits:#visit} of {poses:#pose} in {sides} combinations of pose and approach direction, bar {bar} (in brackets: 95 % intervals)."
    ),
    "noise-to-use": result(
        "For truearm identify {@@noise}: sigma of bar {bar} {sigma}, in place of the rig's {declared}; sigmas of the joints, which include half the backlash. For dwells of sessions, identify corrects the backlash instead."
    ),
    "backlash-varies": warning(
        "One backlash per joint does not explain the differences between sides (probability {probability:.1e}): it changes with the pose. The sigma of the bar includes the remainder."
    ),
    "settling-measured": note(
        "Dwells begin {median:.2f} (median) after the joints stop, {largest:.2f} at most.[ Settled within {bands}. A visit counts if the length was, on the way, at least four times this distance from its final value, and its noise is below a sixth of it.]"
    ),
    "noise-measured": note(
        "Joint readings at the noisiest joint: noise {reading}, resolution {step}; sigma of a dwell's mean {mean} from the noise, {rounding} from the resolution. Sensor: noise of a sample {sample}, a sample every {period}; samples that are {independent} apart are independent[; lowest Allan deviation {floor}][ in means over {over:.2g} s]."
    ),
}

RECORDING: Mapping[str, Statement] = {
    "labels": result(
        "{sessions}: {dwells:#dwell}, {with_reading} with a reading within the stroke; [{left_out:#dwell} left out||none is left out]."
    ),
    "dwell-left-out": warning("{session} dwell {dwell}: {detail}."),
    "labels-next": advice(
        "Nothing was written.", "Give {@trust}, or what was mounted, as {@mounted} 12:14=BAR,CHUCK,SPHERE."
    ),
    "labels-written": advice("Later commands use these labels.", "To undo this, delete the file."),
    "init-next": advice(
        "Next: [print {block} and place it as {drawing} shows||put what you measured of the rig into {rig}]; then {step}."
    ),
    # what comes next in a project: why, and the command
    "rig-next": advice(f"the rig is not described yet; {page('Build and measure the rig')}", "write {rig}"),
    "seats-next": advice(
        "{n:#row has|rows have} no joints yet; delete a row that you do not measure",
        "write the joints of each seat of places.csv into {seats}, or truearm seats LOG",
    ),
    "plan-next": advice("there is no plan yet", "truearm plan ballbar {@@minutes} 30"),
    "record-next": advice(
        "[{simulated:!}the last result says nothing about a real robot: its session is simulated||nothing is recorded yet; truearm simulate rehearses it without hardware]",
        "truearm record",
    ),
    "recording-next": advice("the recording is under way", "type q and Enter in truearm record"),
    "recover-next": advice("its recording was cut off", "truearm session recover {session}"),
    "move-next": advice(
        "it was recorded for {robot}, and truearm identify reads all sessions there", "move {session} out of {folder}"
    ),
    "identify-next": advice("{file} is not identified yet", "truearm identify {@@hold_out} {hold_out}"),
    "cause-next": advice(
        "the last fit [{unusable:!}is not usable||did not converge]",
        "[truearm inspect {session}||truearm identify {@@details}]",
    ),
    "use-next": advice(
        "the robot is identified; if no rows were held out, judge it first with truearm validate",
        "truearm correct {result} PROGRAM {@@out} CORRECTED",
    ),
    "recorded": result(
        "{file}: {duration:.1f}, {samples:#sample}, {lost:#frame} lost[, {readings:#robot message}][; {dwells:#dwell}: {usable} usable][, {need_decision:#needs|need} a decision][, {unusable}]; ended: {ended}[ ({why})]."
    ),
    "robot-too-fast": warning(
        "the robot sent more than could be stored[: {n:#reading is|readings are} missing||, so readings may be missing]",
        "let it send fewer per second",
    ),
    "poses-lost": warning("{n:#visited pose} of the plan gave no observation", "truearm inspect {session} says why"),
    "seats-filled": result("{place}: {n:#row} filled with the joints of {n:#rest} of {shortest:.1f} to {longest:.1f}."),
    "controller-read": result(
        "{place}: the controller computes with [{as_drawn:!}the drawing of {model}||its own calibration, which differs from the drawing of {model} by {rms:.2f} RMS, at most {largest:.2f} and {turn:.3f}, over {n:#random pose}][; checksums {checksums}]."
    ),
    "controller-unread": warning(
        "{reason}. The kinematics of the controller [{stored:!}could not be compared with {model}||were not read, so that the project has the drawing of {model}].",
        "Read them with truearm robot read before you correct a program for this controller.",
    ),
    "controller-changed": warning(
        "{place}: the kinematics of the controller changed since {model} was read: the {joints:?checksum of joint|checksums of joints} {joints} {joints:?differs|differ}.",
        "Read them again with truearm robot read, then measure and identify again: a result corrects for the kinematics it was identified with.",
    ),
    "recording-disturbed": warning("Disturbed by: {events}.", "What was lost is shown by truearm inspect."),
}

BOX: Mapping[str, Statement] = {
    # the self-test
    "box-failed": refusal(
        "The box fails its self-test: {failed} failed, {warned} with a warning, {passed} passed. {box}."
    ),
    "box-passed": result(
        "The box passes its self-test: {passed} passed, {warned} with a warning, {failed} failed. {box}."
    ),
    **{
        code: warning("{verdict}: {title}: [{value}||not measured][{near:!}, near its limit].", remedy)
        for code, remedy in {
            "test-converter": f"Check its supply and the SPI wires: DOUT, CS, SCLK, DIN ({HARDWARE}).",
            "test-excitation": f"Check the LVDT's plug, primary and supply ({HARDWARE}). Without an LVDT, run truearm box config set channel.NAME.over= {{device:@@box}} for each channel that has the key 'over' (the channel to divide by).",
            "test-noise": "Check the analogue ground and the 3.3 V supply; keep USB and motor cables away from the converter.",
            "test-stops": "Check the head's supply, that the magnet is on its rod, both RS-422 pairs, and blanking_us and timeout_us, which truearm box config get {device:@@box} prints. Without such a head, run truearm box config set magnetostrictive.period_us=0 {device:@@box}.",
            "test-supply": "Use another port or a shorter cable, or a powered hub.",
            "test-temperature": "Cool or warm the box.",
            "test-thermometers": "Check the wires at J1 and the addresses: truearm box config get {device:@@box} prints those of the configuration, truearm box config set thermometers.NAME=ADDRESS {device:@@box} changes one.",
            "test-unknown": "The box's firmware is newer than this truearm: update truearm.",
        }.items()
    },
    "test-unreadable": warning(
        "{verdict}: {title}: the box's answer cannot be read.", "Update its firmware with truearm box flash."
    ),
    "test-passed": result("{verdict}: {title}: {value}."),
    "box-fault": warning("[{recorded:!}||warning: ]{fault}[{recorded:!}; its samples are recorded anyway]"),
    "flashed": result(
        "{drive}: {image} written ({size} KiB for the {chip}: [{other:!}a MicroPython without the box's firmware, or something else||the box's firmware][ {version}])[; the box answers: {box}]."
    ),
    "box-traceback": note("its last traceback", "truearm box reset clears it"),
    "place-rejected": warning(
        "rejected: [the sensor moved by {moved} while it was sampled][{missing} of {n} stop pulses are missing][{at_end:!}the input is at the end of the converter's range]",
        "[{moved:!}do not touch it, and measure this place again][{missing:!}check that the magnet is on the rod][{at_end:!}move the sensor, or lower the channel's gain with truearm box config set]",
    ),
    "boot-drive": advice("{drive}: a chip in its boot loader", "flash it with truearm box flash {@@drive} {drive}"),
    "other-firmware": warning(
        "The image has {image}, but the box runs {box}: firmware files on its flash take precedence."
    ),
    # whether it can measure
    "uncalibrated-channel": refusal(
        "channel {channel} is not calibrated to a length",
        "calibrate it with truearm box gauge {channel} {device:@@box}",
    ),
    "nothing-calibrated": warning(
        "no channel of the box is calibrated to a length, so truearm identify cannot use this session",
        "calibrate one with truearm box gauge CHANNEL {device:@@box}",
    ),
    "old-calibration": warning(
        "channel {channel} was calibrated {days} days ago, on {date}",
        "calibrate it again with truearm box gauge {channel} {device:@@box}",
    ),
    "future-calibration": warning(
        "channel {channel} was calibrated on {date}, which is in the future", "check the date of this computer"
    ),
    "other-rate": warning("stream {stream} samples at oversampling ratio (osr) {osr}, not {requested} as requested"),
    "box-temperature": warning(
        "the box is {difference:.1f} [{warmer:!}warmer||colder] than when {channel} was calibrated, and reads no thermometer on the bar: lengths may be off by about {error:.2f} (a steel bar of {length:.0f})",
        "put a thermometer on the bar, or wait",
    ),
}

LIVE: Mapping[str, Statement] = {  # of a recording that is under way: clauses after the name of a row of the view
    "box-lost": warning("lost; trying to open it again"),
    "box-silent": warning("silent for 3 s", "check whether it is stuck"),
    "no-samples": warning("NO SAMPLES"),
    "lost-so-far": warning("so far"),
    "near-travel-end": warning("near the end of its travel"),
    "beyond-travel": warning("BEYOND ITS TRAVEL"),
    "robot-closed": warning("closed its stream"),
    "robot-lost": warning("lost; trying to reach it again"),
    "robot-silent": warning("silent for {time:.0f}"),
    "file-loss": warning("{loss}"),
    "sensor-silent": warning("{place}: the LVDT gives no values", "check that the bar is on, and its wires"),
    "dwell-taken": note("{place}: {length:+.4f}, noise {noise:.1f}"),
    "not-settled": warning("{place}: {length:+.4f}, noise {noise:.1f}, drift {drift:+.1f}: NOT settled"),
    "other-mounted": warning(
        "{place} needs {needed}, but {confirmed} was confirmed",
        "name what is mounted, or correct the dwells with truearm session relabel",
    ),
    "mount-next": advice("at the next pose, mount {what}", "then press Enter"),
    "plan-complete": advice("the plan is complete", "type q and Enter to end the recording"),
    "damaged-part": warning(
        "{place}: is damaged or has no end, so other commands refuse it and its further parts",
        "to avoid this, end this recording, run truearm session recover {place}, and record with {@@resume} {copy}",
    ),
}

RMS_ERRORS = "{after} RMS, and {before} without the calibration"
MORE_VARIED = "Identify from more varied poses."

VALIDATION: Mapping[str, Statement] = {
    # the verdict
    "validation-holds": result(
        f"The calibration holds: errors of {RMS_ERRORS}, in {{n:#row}}. They are consistent with declared noise and the calibration's uncertainty ({{expected:.3f}})."
    ),
    "validation-uncertain": warning(
        f"The calibration holds, but its uncertainty here is {{parameters:.3f}}: errors of {RMS_ERRORS}, in {{n:#row}}.",
        MORE_VARIED,
    ),
    "validation-changed": warning(
        f"The calibration helps, but [{{unexplained:.3f}} RMS is unexplained||the errors do not fit the declared noise, row by row][, most of it in {{region}}]: errors of {RMS_ERRORS}, in {{n:#row}}. Declared noise and the calibration's uncertainty explain {{expected:.3f}}. The arm, its tool or its load has changed, the rig is not as described, here or in the identification, or the arm has errors that the parameters do not model."
    ),
    "validation-unjudged": warning(
        f"The calibration helps, but these rows cannot show how accurate it is: errors of {RMS_ERRORS}, in {{n:#row}}.",
        "Declare the noise in the rig, or measure more rows.",
    ),
    "validation-own-rows": warning(
        f"No verdict, because the identification used {{files}} too: errors of {RMS_ERRORS}, in {{n:#row}}.",
        "Validate with other measurements.",
    ),
    "validation-no-help": refusal(
        f"The calibration does not help here: errors of {RMS_ERRORS}, in {{n:#row}}[{{implausible:!}}; more than those of any plausible arm].",
        "Check that these measurements are of this robot, with this rig, and in these units, or identify again, from measurements of this place and tool.",
    ),
    # its limits
    "rig-missing": warning(
        "No rig was given, but the identification used one ({rig}). What it says of the fixtures and of the points on the end is not used here.",
        "Give the rig of these measurements.",
    ),
    "rows-unseen": warning(
        "{n:#row depends|rows depend} on combinations of parameters that the identification could not determine, such as the pose of base or tool, or a joint that did not move.",
        MORE_VARIED,
    ),
    "regions-worse": warning("Worse than without the calibration: {regions}."),
    "few-rows": warning(
        "{n:#row} cannot show how accurate the calibration is at other poses.",
        "Validate with {enough} or more.",
    ),
    # notes
    "validation-terms": note(
        '"Expected" is the error that declared noise and the calibration\'s uncertainty explain.[{by_place:!} "Radius" is the distance of the end from the z axis of the base frame, "z" its height in this frame; each is split at its median.][ χ² per degree of freedom {chi2}; declared noise alone leaves it below {limit:.3g} (99 %).]',
    ),
}

CERTIFIED = "{error:.3g}[, twice the RMS error of {rows:#row}|| (k = 2) at the tool in the measured region][ (the larger of the expanded uncertainty, {uncertainty:.3g}, and of twice the RMS error of {held_out:#held-out row}, {twice:.3g})]"

CERTIFICATE: Mapping[str, Statement] = {
    # the decision
    "certified": result(f"[{{tolerance:!}}PASS: ]{CERTIFIED}[, tolerance {{tolerance:g}}||; no tolerance was given]."),
    "tolerance-exceeded": refusal(f"FAIL: {CERTIFIED}, tolerance {{tolerance:g}}."),
    "not-decided": warning(
        "NOT DECIDED: [{reused:!}the identification used these measurements||the observations do not determine the error of the tool].",
        "[{reused:!}Validate with other measurements.]",
    ),
    "calibration-unusable": refusal(
        "NOT USABLE: {because}.", "Do not correct by it: mend the cause, and identify again."
    ),
    # what the error does not include
    "excludes-conditions": note(
        "The error leaves out other poses, payloads and temperatures than those of the measurement. It leaves out the arm in motion (its controller's path errors, vibration), and the mounting of base and tool in the cell. Steel expands by about {steel:g} µm per metre and kelvin, aluminium by {aluminium:g}."
    ),
    "excludes-repeatability": note(
        "The error leaves out the arm's own repeatability, as far as the measured rows do not show it.",
        "Measure it with truearm characterize.",
    ),
    "excludes-displacement": note(
        "The error leaves out a common displacement of all poses: the observations do not determine where the base stands."
    ),
    "excludes-lengths": note(
        "The error leaves out errors of the length of {bars:3}, taken as exact: 10 µm on 0.5 m scale the arm by 20 µm per metre.",
        "Give the sigma of each in the rig.",
    ),
    "excludes-other-poses": note(
        "The error leaves out errors that only other poses would show: nothing was held out.", "Use truearm validate."
    ),
    "excludes-directions": note(
        "The error leaves out directions in which nothing was measured: a length shows only the error along it."
    ),
}

CALIBRATION: Mapping[str, Statement] = {  # of commands that use a calibration
    "mounting-held": warning(
        "The {what} ({names}) was held at its nominal value, because [{items:!}the positions of the {items} are unknown||such observations cannot determine it in any pose]. An error in it [{base:!}moves and turns all targets together, as one body||is the same offset in the end's frame at every pose].",
        "[{items:!}Measure the {items}, write them into the rig with their standard deviations, and identify again.||To determine it, use another kind of observation.]",
    ),
    "own-frames-next": advice(
        "For targets relative to the robot's own base, run truearm correct or truearm map with {@@own_frames}."
    ),
    "null-space-moves-end": warning(
        "Unidentifiable combinations of parameters move the end (weights in m, rad and 1): {terms:3}. Their nominal values are used.",
        "Measure what the lines “Next:” of truearm identify propose.",
    ),
    "other-payload": warning(
        "{n} of {rows:#row have|rows have} another payload ({payload} kg) than the rows of the calibration ({masses} kg), which does not know how a payload acts on the robot.",
        "Identify with rows under different payloads.",
    ),
}

MAP: Mapping[str, Statement] = {
    "map-error": result(
        "Error without calibration: {least:.3f} to {most:.3f}, RMS {rms:.3f}, over {cells:#cell} of {cell:g}."
    ),
    "task-place": result("Best place for a task of {task} mm: {place}; error at most {most:.3f}, RMS {rms:.3f}."),
    "task-nowhere": refusal(
        "A task of {task} mm fits nowhere in the part of this section that the arm reaches.",
        "Give a smaller task, a larger {@within}, or another section with {@at}.",
    ),
    "map-sigma": result(
        "Error with calibration, from the parameters' covariance: {least:.3f} to {most:.3f} (standard deviation[, relative to {relative_to}])."
    ),
    "map-sigma-unknown": warning("Error with calibration: unknown in {n} of {cells:#cell}."),
    "joints-outside": warning(
        '[Outside in every cell: {joints}.||In {n:#cell} a joint is outside the readings that the calibration was identified from ("covered" is 0 in the table; pale in the picture).]',
        "[{joints:!}Give other readings with {@at}][{given:!}, or leave it out][{joints:!}.]",
    ),
}

MOUNTINGS = "robot's base in frame {base_frame}: {base}; frame {end_frame} relative to the nominal one: {end}."
TARGETS = "Targets are poses of {end_frame} in {base_frame}"

CORRECTION: Mapping[str, Statement] = {
    # the verdict
    "corrected": result(
        "{n:#target} corrected: by the identified robot, the errors of {point} are {before} RMS before and {after} after. Its own uncertainty is not included."
    ),
    "partly-corrected": warning(
        "{n:#target} corrected, but {refused:#move} not: by the identified robot, the errors of {point} are {before} RMS before and {after} after, at the corrected ones."
    ),
    # before the program is run
    "correction-worse": warning(
        "The corrected targets are farther off than the uncorrected ones, {after} RMS and not {before}.",
        "Use another {@method}.",
    ),
    "fit-not-converged": warning(
        "The fit of this result did not converge.",
        "Check the result with truearm report before you use the corrected targets.",
    ),
    "range-unknown": warning(
        "The result does not say which joint readings it was identified from.",
        "Identify again, so that targets outside them can be named.",
    ),
    "targets-outside": warning(
        "{n:#target} outside the joint readings that the calibration was identified from, in {joints}: {places}.[{curves:!} Error curves are unknown there. Their corrections fade to zero; geometry and sag are still corrected.]"
    ),
    "moves-bent": warning(
        "{n:#straight move} [{worst:!}will deviate from a straight path by more than {limit:.1f}||may pass a joint limit, a singularity or another configuration between the ends]: {places}.[ The largest deviation is {worst:.2f} ({place}).]",
        "Add targets between the ends.",
    ),
    "moves-unchecked": warning(
        "{n:#straight move was|straight moves were} not checked between the ends, because the program does not say at which joints it starts, or no joints reach that target.",
        "Begin the program with a joint move.",
    ),
    "home-decides": warning(
        "The program does not determine the position from which the robot moves to line {lines}. The arm's configuration there is the one nearest to {@home}."
    ),
    "configuration-data": warning(
        "The configuration data of {n:#robtarget differs|robtargets differ} from the quarter turns of the axes by this model: {details}.",
        "Correct the data before you run the program, or the controller may stop.",
    ),
    "other-configurations": warning(
        "Only the joints near the first target determine the configuration; in the arm's other ones the corrections would differ by up to {spread}[, and the expected error is between {least} and {most}]."
    ),
    # frames, and what is left as it is
    "targets-frames": note(
        f"[{{own:!}}Targets are in the robot's own base and flange frames||{TARGETS}].[{{own:!}} These mountings are not corrected: {MOUNTINGS}][{{held:!}} The mountings of robot and tool were held at their nominal values, so they are not corrected.][{{corrected:!}} The mountings are corrected as far as they were identified: {MOUNTINGS}]"
    ),
    "controller-frames": note("The controller's base is {base}. Its flange is {flange}."),
    "routines-absent": warning(
        "None of the files defines {names}: taken not to displace the program and not to change its data. Moves within them are not corrected.",
        "Give {@strict} if that may be wrong.",
    ),
    "joint-moves-kept": note("{n:#move} to joint values kept as {n:?it is|they are}."),
    "moves-in-texts": warning("{n:#text} with moves, such as in {place}: texts are not corrected."),
}

EXPORT: Mapping[str, Statement] = {
    "exported": result(
        "[{exact:!}The file holds everything that was identified; no refit was needed.||The file differs from the identified robot by {left:.3f} RMS ({largest:.3f} at most) and {left_turn:.4f} RMS][{refitted:!}, after a refit over {n:#pose}; without it by {dropped:.3f} and {dropped_turn:.4f}][{exact:!}||.]"
    ),
    "format-lacks": warning("The format {format} has no place for {names}."),
    "file-mountings": result(f"Mountings, which the file [{{contained:!}}contains||does not contain]: {MOUNTINGS}"),
    "refit-next": advice("For the best fit where you work, give {@over} FILE, a plan or a table of poses there."),
}

PLAN: Mapping[str, Statement] = {
    # the verdict
    "planned": result(
        "[{poses:#pose}][{lines:#line}] in {minutes:#minute}[, with {mounts:#mount} of the bar][ and {via_points:#via point}][, every mount visited {visits} times][, {checks:#pose} of the first mount visited again half-way and at the end, and as many of another at the end]: the error in the region will be [{rms} RMS and {largest} at the worst pose||unknown, because an unidentifiable combination moves the tool][{relative:!} (excluding the pose of the base)]."
    ),
    "planned-seats": result(
        "{seats:#seat} at {places:#place} that are up to {span:.0f} apart: the tool error over these seats will be [{rms} RMS and {largest} at the worst pose, excluding the pose of the base||unknown, because an unidentifiable combination moves the tool]. From all of them, identify will state about the same if seats repeat to {sigma} per coordinate, the rig is as accurate as rig.toml declares, and the arm has errors in its geometry only."
    ),
    "planned-approaches": result(
        "{poses:#pose} of bar {bar} from {chuck} to {sphere} in {minutes:#minute}, with {via_points:#approach point}.",
        "Record the plan, then run truearm characterize on the session.",
    ),
    # what it determines
    "planned-rank": result(
        "Rank {rank} after {rows:#observation}[; {unseen:#combination is|combinations are} unidentifiable][; {weak:#combination is|combinations are} weakly identifiable]."
    ),
    "few-poses": warning(
        "{n:#pose is|poses are} fewer than the unknowns.",
        "Plan more {@poses}, or fewer mounts with {@bar} NAME.",
    ),
    "planned-held": note(
        "[Held, because their joints hardly move: {lost}. ][With a weak prior, because they are weakly identifiable: {believed}.]"
    ),
    "fewer-checks": warning(
        "{@check_poses} {asked}: {planned:#check pose} planned[{visits:!}: with several visits of every mount there are none||: at most one per 36 poses, and none below 108 poses]."
    ),
}

READ = {*READING, "session-damaged", "malformed-plan"}  # stated before anything is computed

STATEMENTS: Mapping[str, Statement] = {
    **IDENTIFICATION,
    **{code: error(*texts) for code, texts in ERRORS.items()},
    **READING,
    **SESSION,
    **RECORDING,
    **BOX,
    **LIVE,
    **REPEATABILITY,
    **VALIDATION,
    **CERTIFICATE,
    **CALIBRATION,
    **MAP,
    **CORRECTION,
    **EXPORT,
    **PLAN,
}
