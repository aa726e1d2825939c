"""What every method of the open benchmark shares: it reads a data set, fits, predicts, and prints one line of JSON.

    PYTHON bench/methods/NAME.py FILE.npz

FILE holds q (n, j) [rad], the measured points y (n, 3) [m] about in the base frame of the drawing, the held-out q_held and
y_held, the drawing as standard Denavit-Hartenberg rows dh (j, 4): offset, d, a, alpha, the target on the last link (3,)
[m], and ``robot``, the path of truearm's robot file. The exact places of base and target are unknown. A method returns
a function from readings (n, j) to points (n, 3); it does not see y_held.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from importlib.metadata import version

import numpy as np


def run(package: str, fit: Callable[[dict[str, np.ndarray]], Callable[[np.ndarray], np.ndarray]]) -> None:
    """Fit the data set that the command line names, and print the held-out errors [mm], CPU seconds and peak memory."""
    data = dict(np.load(sys.argv[1]))
    q, points = data.pop("q_held"), data.pop("y_held")
    begun = time.process_time()
    predict = fit(data)
    seconds = time.process_time() - begun
    error = 1e3 * np.linalg.norm(predict(q) - points, axis=1)
    with open("/proc/self/status") as status:
        peak = next(int(line.split()[1]) / 1024 for line in status if line.startswith("VmHWM"))
    figures = {"version": version(package), "mean_mm": error.mean(), "max_mm": error.max(), "seconds": seconds}
    print("RESULT " + json.dumps(figures | {"peak_mb": peak}))
