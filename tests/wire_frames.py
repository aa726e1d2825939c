"""Frames of the wire as written and read by the box's tests."""

from truearm.session.frames import Data, conforms, data_of, decode
from truearm_wire import frame, messages


def frames(tx: bytes) -> list[list]:
    """Return the frames of sent bytes, decoded; anything else stays bytes."""
    found = []
    for run in tx.split(b"\0"):
        if run:
            payload = frame.unframe(run)
            found.append(messages.decode_payload(payload) if payload else run)
    return found


def command(*values: object) -> bytes:
    """Return a command's frame."""
    return frame.frame(messages.encode_payload(list(values)))


def data_frame(payload: bytes) -> Data | None:
    """Return a data frame; None if it is none, or violates the specification."""
    elements = decode(payload)
    return data_of(elements) if elements and elements[0] == messages.DATA and conforms(elements) else None
