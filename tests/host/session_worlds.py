"""Random worlds of a box's messages: restarts, holes of every critical length, and pieces lost, doubled, late or changed."""

import numpy as np
from session_stream import CHANNELS, PERIOD_NS, Box

from truearm.types import Message

FRAMES = [1, 2, 15, 16, 17, 63, 64, 65, 511, 512, 513, 999, 1000, 1001, 1023, 1024, 1025]  # around every constant
HOLES = [*FRAMES, 3000, 70_000, 2**31 - 1, 2**31, 2**31 + 1]
SECONDS = [0.001, 0.1, 1.9, 2.1, 60.0]


def world(rng: np.random.Generator) -> list[Message]:
    """Return messages as they arrive."""
    messages = _sent(rng)
    for _ in range(int(rng.integers(0, 7))):
        if len(messages) > 2:
            _disturb(rng, messages)
    return messages or [Message("/box/adc", 0, b"")]


def _sent(rng: np.random.Generator) -> list[Message]:
    box = Box(seq=int(rng.choice([0, 0, 17, 700, 2**31 - 40, 2**32 - 90, 2**32 - 700])))
    spacing_ns = int(rng.choice([10**6, 13 * PERIOD_NS, 10**8, 5 * 10**8]))
    beats = float(rng.choice([0.0, 0.01, 0.1, 0.4]))
    t = 0
    _ident(rng, box, t)
    for _ in range(int(rng.integers(1, 5))):
        for _ in range(int(rng.choice([1, 3, 40, 65, 90, 300, 514]))):
            t += spacing_ns
            kind = rng.random()
            if kind < beats:
                box.heartbeat(t)
            elif kind < beats + 0.03:
                box.sync(t, 1e5, 1e5)
            else:
                box.data(t, np.full((1, CHANNELS), t % 1000), int(rng.random() < 0.02))
        match int(rng.integers(7)):
            case 0 | 1:
                t += int(1e9 * rng.choice(SECONDS))
                box.reboot(t)
                box.boot_id -= int(rng.random() < 0.1)  # the same boot id
                _ident(rng, box, t)
                box.seq += int(rng.random() < 0.3) * int(rng.choice(HOLES))
            case 2:
                box.seq = (box.seq + int(rng.choice(HOLES))) % 2**32
            case 3:
                box.seq = (box.seq - int(rng.choice(HOLES))) % 2**32
            case 4:
                box.boot_id += int(rng.choice([-1, 1]))
            case 5:
                t += int(1e9 * rng.choice(SECONDS))
            case _:
                _ident(rng, box, t)
    return box.messages


def _ident(rng: np.random.Generator, box: Box, t: int) -> None:
    """Add the pages of an ident, or some of them."""
    begin = len(box.messages)
    box.ident(t)
    if rng.random() < 0.5:
        box.messages[begin:] = [message for message in box.messages[begin:] if rng.random() < 0.6]


def _disturb(rng: np.random.Generator, messages: list[Message]) -> None:
    """Lose, double, move, reverse, hold up or flip a piece of the messages, often beside one that states a boot id."""
    at = int(rng.integers(len(messages)))
    stating = [k for k, message in enumerate(messages) if message.topic in ("/box/ident", "/box/heartbeat")]
    if stating and rng.random() < 0.5:
        at = max(0, int(rng.choice(stating)) + int(rng.integers(-4, 5)))
    end = at + int(rng.choice([1, 2, 3, 30] if rng.random() < 0.6 else FRAMES))
    piece, later = messages[at:end], at + int(rng.choice(FRAMES))
    match int(rng.integers(6)):
        case 0:
            del messages[at:end]
        case 1:
            messages[later:later] = piece
        case 2:
            del messages[at:end]
            messages[later:later] = piece
        case 3:
            messages[at:end] = piece[::-1]
        case 4:
            held_ns = int(1e9 * rng.choice(SECONDS))
            messages[at:] = [message._replace(t_host_ns=message.t_host_ns + held_ns) for message in messages[at:]]
        case _:
            if piece and piece[0].data:
                data = bytearray(piece[0].data)
                data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
                messages[at] = piece[0]._replace(data=bytes(data))
