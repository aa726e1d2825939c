"""The defaults of the options of ``init``, ``identify``, ``correct`` and ``plan``.

The command line and the records of options in ``workflows`` use them.

Through those records the Python API uses them too. The users of these values check them, including names. ``--help``
reads this, so it imports nothing.
"""

from typing import Final

SEED: Final = 0  # of identify and plan; simulated worlds (simulate, demo) begin with 1

# init: how well chucks, spheres and bars are known [m], by what measured them
NOTHING: Final = "nothing"
INSTRUMENTS: Final = {"tape": 1e-3, "calliper": 1e-4, "machine": 2e-5}

# identify
SOLVER: Final = "lm"
LOSS: Final = "linear"
JOINT_LAWS: Final = "auto"
MAX_ITERATIONS: Final = 50

# correct
MARGIN: Final = 0.05  # smallest singular value: an error of 20 mm then requires at most 0.8 rad

# plan
CRITERION: Final = "I"
DWELL: Final = 2.0  # s, at rest at a pose

CHECK_POSES: Final = 10
DESIGN_RESERVE: Final = 22e-3  # m of travel reserved for errors of the model
RESULT_RESERVE: Final = 3e-3  # m, with the model of a result
