"""The latencies that the simulators assume, all of them.

A clock exchange over full-speed USB takes 170 to 300 µs at best (a phone and a Teensy 3.5, forum.pjrc.com, thread
46702: "Low USB connection latency on Teensy 3.5"); ``TO_BOX`` and ``FROM_BOX`` take 275 µs together. The exponential
parts and the stalls, those of a desktop computer that is not idle, are assumptions without a measurement, and so is
``FROM_ROBOT``, of a quiet local network.

In real time (``serve.py``) latencies are those of the computer that simulates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# A packet of 64 bytes: at most 19 fit a frame of 1 ms (USB 2.0, 5.8.4). The emulated chip's link is started with it,
# and takes this time itself, each way.
USB_PACKET_NS = 53_000


@dataclass(frozen=True)
class Latency:
    """The latency of a link in one direction [ns]: at least ``least``, plus an exponential part, sometimes a stall."""

    least: float
    mean_extra: float
    stall: float = 0.0
    stall_probability: float = 0.0

    def draw(self, rng: np.random.Generator) -> int:
        extra = self.mean_extra * rng.standard_exponential()
        if self.stall_probability and rng.random() < self.stall_probability:
            extra += self.stall * rng.standard_exponential()
        return int(self.least + extra)


TO_BOX = Latency(125e3, 80e3, 5e6, 0.01)
FROM_BOX = Latency(150e3, 120e3, 8e6, 0.01)
FROM_ROBOT = Latency(300e3, 200e3, 20e6, 0.005)
