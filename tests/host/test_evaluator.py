"""``export --format evaluator-c`` and ``evaluator-python``: compiled, run, and compared with truearm's own poses."""

import ctypes
import shutil
import subprocess
import time

import numpy as np
import pytest
from test_joint_laws import arm_with_laws

from truearm.export.evaluator import write_c, write_python
from truearm.export.link_frames import predicted
from truearm.export.writing import RobotToWrite
from truearm.model.chain import forward
from truearm.model.robot import builtin_robot

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
    forward_of, correct = compiled(write_c(what), tmp_path)
    q = np.random.default_rng(1).uniform(-4.0, 4.0, (POSES, len(what.chain.joints)))
    begun = time.perf_counter()
    ends = forward_of(q)
    cost = (time.perf_counter() - begun) / POSES
    wanted = forward(what.chain, what.params, q)
    assert np.abs(ends - wanted[:, :3]).max() < 1e-12
    begun = time.perf_counter()
    results = [correct(pose, reading + 2e-3) for pose, reading in zip(wanted[:300, :3], q[:300], strict=True)]
    spent = (time.perf_counter() - begun) / len(results)
    print(f"{name}: {1e6 * cost:.1f} us a pose through ctypes, {1e6 * spent:.0f} us a correction")
    reached = np.array([error < 1e-9 for _, error in results])
    assert reached.mean() > 0.99  # singular poses aside
    corrected = np.array([q for q, _ in results])
    assert np.abs(forward(what.chain, what.params, corrected) - wanted[:300])[reached].max() < 1e-8


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
    corrected, error = module["correct"](wanted[0, :3].tolist(), (q[0] + 2e-3).tolist())
    assert error < 1e-9
    assert np.abs(forward(what.chain, what.params, np.array([corrected])) - wanted[:1]).max() < 1e-8


def test_what_cannot_be_reached_has_an_error_that_shows_it(tmp_path):
    what = to_write("laws")
    far = np.array([[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    _, correct = compiled(write_c(what), tmp_path)
    assert correct(far, np.full(6, 0.3))[1] > 1.0
    assert imported(write_python(what))["correct"](far.tolist(), [0.3] * 6)[1] > 1.0


def test_without_mountings_the_files_are_of_the_arm_between_its_own_frames():
    what = to_write("laws", mountings=False)
    q = np.random.default_rng(5).uniform(-2.0, 2.0, (20, 6))
    module = imported(write_python(what))
    ends = np.array([module["forward"](reading.tolist()) for reading in q])
    np.testing.assert_allclose(ends, predicted(what.robot, q)[:, :3], atol=1e-12)
