"""Streams of a box for tests of their accounting, and the expected accounts."""

from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from session_stream import CHANNELS, PERIOD_NS, Box, columns_of

from truearm.session.frames import Data, Ident
from truearm.session.streams import BoxReader

BLOCK_NS = 13 * PERIOD_NS
COUNTS = np.arange(13 * CHANNELS).reshape(13, CHANNELS)


def box_with(blocks=20, seq=0):
    """Return a box that sends its ident, then streams, with a heartbeat and a clock exchange in the middle."""
    box = Box(seq=seq)
    box.ident(0)
    for k in range(blocks):
        box.data(k * BLOCK_NS + BLOCK_NS, COUNTS + k)
        if k == blocks // 2:
            box.heartbeat(box.messages[-1].t_host_ns)
            box.sync(box.messages[-1].t_host_ns, 1e5, 1e5)
    return box


class Block(NamedTuple):
    """One row of the reader's blocks."""

    segment: int
    run: int
    gap: bool
    n: int
    channels: int
    data: Data
    counts: Any
    ident: Ident


def singly(blocks):
    """Yield the rows of the blocks of one stream."""
    columns = blocks.table[["n0", "t_us", "period_ns", "n", "run", "flags", "gap"]]
    for row, samples in zip(columns.tolist(), np.split(blocks.counts, blocks.first[1:-1]), strict=True):
        n0, t0_us, period_ns, n, run, flags, gap = row
        data = Data(-1, blocks.stream.id, n0, t0_us, period_ns, samples.tobytes(), flags)
        yield Block(blocks.segment, run, gap, n, samples.shape[1], data, samples, blocks.ident)


def read(messages, ident=None):
    """Return all blocks, and their reader."""
    reader = BoxReader(ident)
    found = [*reader.feed(columns_of(messages)), *reader.finish()]
    return [block for blocks in found for block in singly(blocks)], reader


def account(messages):
    """Return the account as a plain dict of non-zero entries, without those that are always present."""
    losses = asdict(read(messages)[1].losses())
    del losses["box"]
    for name in ("frames", "blocks", "samples", "sync_requests"):
        del losses[name]
    return {name: count for name, count in losses.items() if count}


def data_places(box):
    return [i for i, m in enumerate(box.messages) if m.topic == "/box/adc"]
