"""What an option of ``identify`` or ``plan`` is where nobody gives it. The command line, the records of options in ``workflows``
and with them the Python API take it from here.

Whoever takes them checks them, names included. ``--help`` reads this, so it imports nothing.
"""

from typing import Final

SEED: Final = 0  # of every command that draws

# identify
SOLVER: Final = "lm"
LOSS: Final = "linear"
JOINT_LAWS: Final = "auto"
MAX_ITERATIONS: Final = 50

# plan
CRITERION: Final = "I"
DWELL: Final = 2.0  # s, a rest at a pose

# plan ballbar
BAR_CANDIDATES: Final = 5000  # poses to choose from
SPREAD: Final = 0.0  # m, by which the bar's length varies about mid-travel
VISITS: Final = 1  # of every mount
CHECK_POSES: Final = 10
DESIGN_RESERVE: Final = 22e-3  # m of travel for what the model does not know
RESULT_RESERVE: Final = 3e-3  # m, with the model of a result

# plan line
LINE_CANDIDATES: Final = 120  # lines to choose from
LINE_LENGTH: Final = 0.5  # m, the device's reach
TRANSVERSE_RANGE: Final = 15e-3  # m, full range of the transverse sensors
LINE_SPEED: Final = 50e-3  # m/s
LINE_POINTS: Final = 12  # of a way that count as measured
PASSES: Final = 1  # there and back

# plan characterize
APPROACH_POSES: Final = 4
ROUNDS: Final = 4  # a pose is reached from each side so often
LONG_DWELL: Final = 20.0  # s, a rest at each pose, for the noise
