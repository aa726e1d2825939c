"""``export --format evaluator-c`` and ``evaluator-python``: compiled, run, and compared with truearm's own poses."""

import ctypes
import shutil
import subprocess
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_joint_laws import arm_with_laws

from truearm.export.evaluator import write_c, write_python
from truearm.export.writing import RobotToWrite, predicted
from truearm.model.chain import forward
from truearm.model.robot_file import builtin_robot

POSES = 10_000


def to_write(name, mountings=True):
    """Return a robot off its drawing; "laws" has curves, sag and a payload, "puma560" has gains, "iiwa14" has seven joints."""
    chain = arm_with_laws() if name == "laws" else builtin_robot(name).chain
    rng = np.random.default_rng(3)
    scale = np.where([p.term == "gain" for p in chain.parameters], 1e-3 * (name == "puma560"), 1e-3)
    return RobotToWrite(
        chain, chain.params_nominal, chain.params_nominal + scale * rng.normal(size=scale.size), mountings, "*/ a\nb"
    )


def compiled(text, folder):
    """Return the two functions of a C file, compiled with all warnings as errors."""
    compiler = shutil.which("cc") or pytest.skip("needs a C compiler")
    (folder / "arm.c").write_text(text)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC", "-o", folder / "arm.so"]
    subprocess.run([compiler, *flags, folder / "arm.c", "-lm"], check=True, capture_output=True, text=True)
    library, numbers = ctypes.CDLL(str(folder / "arm.so")), ctypes.POINTER(ctypes.c_double)
    library.truearm_correct.restype = ctypes.c_double

    def forward_of(q):
        out = np.empty((len(q), 3, 4))
        for reading, pose in zip(q, out, strict=True):
            library.truearm_forward(reading.ctypes.data_as(numbers), pose.ctypes.data_as(numbers))
        return out

    def correct(pose, q):
        pose, q = np.ascontiguousarray(pose), q.copy()
        return q, library.truearm_correct(pose.ctypes.data_as(numbers), q.ctypes.data_as(numbers))

    return forward_of, correct


def imported(text):
    module = {}
    exec(compile(text, "arm.py", "exec"), module)
    return module


@pytest.mark.parametrize("name", ["laws", "puma560", "iiwa14"])
def test_the_c_file_is_the_calibrated_arm(tmp_path, name):
    what = to_write(name)
    forward_of, _ = compiled(write_c(what), tmp_path)
    q = np.random.default_rng(1).uniform(-4.0, 4.0, (POSES, len(what.chain.joints)))
    begun = time.perf_counter()
    ends = forward_of(q)
    cost = (time.perf_counter() - begun) / POSES
    wanted = forward(what.chain, what.params, q)
    assert np.abs(ends - wanted[:, :3]).max() < 1e-12
    print(f"{name}: {1e6 * cost:.1f} us a pose through ctypes")


@pytest.mark.parametrize("seed_distance", [0.02, 0.1])
@pytest.mark.parametrize("name", ["laws", "puma560", "iiwa14"])
def test_a_correction_stays_near_its_seed_and_both_files_agree(tmp_path, name, seed_distance):
    what, rng = to_write(name), np.random.default_rng(4)
    _, correct = compiled(write_c(what), tmp_path)
    lower, upper = np.clip(what.chain.limits, -6.0, 6.0)
    q = rng.uniform(lower + 0.1, upper - 0.1, (300, len(lower)))
    seeds = q + rng.uniform(-seed_distance, seed_distance, q.shape)
    wanted = forward(what.chain, what.params, q)
    begun = time.perf_counter()
    results = [correct(pose, seed) for pose, seed in zip(wanted[:, :3], seeds, strict=True)]
    print(f"{name}: {1e6 * (time.perf_counter() - begun) / len(q):.0f} us a correction")
    corrected, errors = np.array([q for q, _ in results]), np.array([error for _, error in results])
    assert errors.max() < 1e-9
    assert np.abs(forward(what.chain, what.params, corrected) - wanted).max() < 1e-8
    assert np.abs(corrected - seeds).max() < 1.5 * seed_distance
    in_python = imported(write_python(what))["correct"]
    for pose, seed, reading in zip(wanted[:10, :3].tolist(), seeds.tolist(), corrected, strict=False):
        again, error = in_python(pose, seed)
        assert error < 1e-9
        np.testing.assert_allclose(again, reading, atol=1e-9)


@pytest.mark.parametrize("name", ["laws", "puma560", "iiwa14"])
def test_the_python_file_is_the_calibrated_arm(name):
    what = to_write(name)
    text = write_python(what)
    assert [line for line in text.splitlines() if "import" in line] == [
        "from __future__ import annotations",
        "import math",
    ]
    module = imported(text)
    q = np.random.default_rng(2).uniform(-3.0, 3.0, (100, len(what.chain.joints)))
    wanted = forward(what.chain, what.params, q)
    begun = time.perf_counter()
    ends = [module["forward"](reading.tolist()) for reading in q]
    print(f"{name}: {1e6 * (time.perf_counter() - begun) / len(q):.0f} us a pose in Python")
    assert np.abs(np.array(ends) - wanted[:, :3]).max() < 1e-12


@pytest.fixture(params=["c", "python"], scope="module")
def arm_file(request, tmp_path_factory):
    """Return an arm with all joint laws, and the function that corrects readings in C or in Python."""
    what = to_write("laws")
    if request.param == "c":
        return what, compiled(write_c(what), tmp_path_factory.mktemp("arm"))[1]
    correct = imported(write_python(what))["correct"]
    return what, lambda pose, q: correct(pose.tolist(), q.tolist())


def turn_about(axis, angle):
    """Return the rotation matrix about a coordinate axis."""
    return Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()


UNREACHED = {
    "far away": lambda pose: np.c_[pose[:, :3], pose[:, 3] + [5.0, 0.0, 0.0]],
    "half a turn about x": lambda pose: np.c_[pose[:, :3] @ turn_about(0, np.pi), pose[:, 3]],
    "half a turn about z": lambda pose: np.c_[pose[:, :3] @ turn_about(2, np.pi), pose[:, 3]],
    "179.9 deg about y": lambda pose: np.c_[pose[:, :3] @ turn_about(1, np.radians(179.9)), pose[:, 3]],
    "no rotation": lambda pose: np.c_[2.0 * pose[:, :3], pose[:, 3]],
    "beyond numbers": lambda pose: np.c_[pose[:, :3], [1e300, 0.0, 0.0]],
}


@pytest.mark.parametrize("change", UNREACHED.values(), ids=UNREACHED)
def test_what_cannot_be_reached_near_the_seed_has_the_error_of_its_readings(arm_file, change):
    what, correct = arm_file
    seed = np.full(6, 0.3)
    pose = change(forward(what.chain, what.params, seed[None])[0, :3])
    q, error = correct(pose, seed)
    assert np.abs(q - seed).max() <= 0.5 + 1e-12
    change = pose - forward(what.chain, what.params, np.array([q]))[0, :3]
    assert error > 0.5
    if error < 1e100:
        assert error == pytest.approx(
            max(np.linalg.norm(change[:, 3]), np.linalg.norm(change[:, :3]) / np.sqrt(2)), rel=1e-9
        )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_no_success_and_leaves_the_readings(arm_file, value):
    what, correct = arm_file
    seed = np.full(6, 0.3)
    pose = forward(what.chain, what.params, seed[None])[0, :3]
    for row, column in np.ndindex(3, 4):
        changed = pose.copy()
        changed[row, column] = value
        q, error = correct(changed, seed)
        assert error == np.inf
        np.testing.assert_array_equal(q, seed)
    seed[4] = value
    q, error = correct(pose, seed)
    assert error == np.inf
    np.testing.assert_array_equal(q, seed)


def test_readings_outside_the_joint_limits_are_not_accepted(arm_file):
    what, correct = arm_file
    lower, upper = what.chain.limits
    seed = np.full(6, 0.3)
    seed[5] = upper[5] - 0.05
    beyond = seed + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.1])
    q, error = correct(forward(what.chain, what.params, beyond[None])[0, :3], seed)
    assert error > 0.01
    assert ((lower <= q) & (q <= upper)).all()
    far = seed + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    q, error = correct(forward(what.chain, what.params, far[None])[0, :3], far)
    assert error == np.inf
    np.testing.assert_array_equal(q, far)


@pytest.mark.parametrize("count", [0, 5, 7])
def test_the_python_file_refuses_readings_of_another_arm(count):
    module = imported(write_python(to_write("laws")))
    with pytest.raises(ValueError, match="6 joints"):
        module["forward"]([0.3] * count)
    with pytest.raises(ValueError, match="6 joints"):
        module["correct"](np.eye(4).tolist(), [0.3] * count)


def test_without_mountings_the_files_are_of_the_arm_between_its_own_frames():
    what = to_write("laws", mountings=False)
    q = np.random.default_rng(5).uniform(-2.0, 2.0, (20, 6))
    module = imported(write_python(what))
    ends = np.array([module["forward"](reading.tolist()) for reading in q])
    np.testing.assert_allclose(ends, predicted(what.robot, q)[:, :3], atol=1e-12)
