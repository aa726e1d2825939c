"""What every worker shares: CPU time and peak memory of its own process, told in one line of JSON. Needs nothing but Python."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any


def peak_mb() -> float:
    """Peak resident memory of this process. Not ru_maxrss: that begins with what the parent had when it forked."""
    with open("/proc/self/status") as status:
        line = next(line for line in status if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def timed(job: Callable[[], Any], runs: int = 1, afresh: Callable[[], object] = lambda: None) -> tuple[Any, float]:
    """What the job returns and the least CPU seconds of some runs: what else the machine does only ever adds.

    ``afresh``, not timed, makes each run forget what the one before has remembered.
    """
    least = float("inf")
    for _ in range(runs):
        afresh()
        started = time.process_time()
        out = job()
        least = min(least, time.process_time() - started)
    return out, least


def tell(**figures: object) -> None:
    print("RESULT " + json.dumps(figures | {"peak_mb": round(peak_mb(), 1)}))
