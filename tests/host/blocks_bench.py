"""Streams of a box for tests of their accounting, and the account."""

from dataclasses import asdict

import numpy as np
from session_stream import CHANNELS, PERIOD_NS, Box

from truearm.session.sample_blocks import BoxReader

BLOCK_NS = 13 * PERIOD_NS
COUNTS = np.arange(13 * CHANNELS).reshape(13, CHANNELS)


def box_with(blocks=20, seq=0):
    """A box that says its ident, then streams, with a heartbeat and a clock exchange in the middle."""
    box = Box(seq=seq)
    box.ident(0)
    for k in range(blocks):
        box.data(k * BLOCK_NS + BLOCK_NS, COUNTS + k)
        if k == blocks // 2:
            box.heartbeat(box.messages[-1].t_host_ns)
            box.sync(box.messages[-1].t_host_ns, 1e5, 1e5)
    return box


def read(messages, ident=None):
    reader = BoxReader(ident)
    blocks = [block for message in messages for block in reader.feed(message)]
    blocks += reader.finish()
    return blocks, reader


def account(messages):
    """The account as a plain dict of what is not zero, without what is always there."""
    losses = asdict(read(messages)[1].losses())
    del losses["box"]
    for name in ("frames", "blocks", "samples", "sync_requests"):
        del losses[name]
    return {name: count for name, count in losses.items() if count}


def data_places(box):
    return [i for i, m in enumerate(box.messages) if m.topic == "/box/adc"]
