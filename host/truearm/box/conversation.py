"""Open and share a conversation with a box."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from truearm.box.control import BoxControl
from truearm.errors import Argument, RefusedError
from truearm.record.links import HostClock, SerialLink
from truearm.record.requests import RETRIES
from truearm.session.box_ident import Ident
from truearm_wire.messages import START, STOP

STREAMING = 4  # error code, protocol/SPEC.md §4


@contextmanager
def conversation(device: str, stop: bool = False, retries: int = RETRIES) -> Iterator[BoxControl]:
    """Open a conversation with the box at ``device``, identify it, and with ``stop`` end its streaming.

    Raises LinkError, ProtocolError. If the box refuses because it is streaming, the error tells the user what to do.
    """
    clock = HostClock()
    link = SerialLink(device, clock)
    try:
        box = BoxControl(link, clock)
        box.identify(retries)
        if stop:
            box.command(STOP)
        yield box
    except RefusedError as exc:
        if exc.code == STREAMING:
            advice = (Argument("stop"), " if nothing records it")
            raise RefusedError(
                STREAMING, f"{device}: the box is streaming; end the recording first, or give ", *advice
            ) from exc
        raise
    finally:
        link.close()


@contextmanager
def streaming(box: BoxControl) -> Iterator[None]:
    """Start the box, and stop it at the end, also after Ctrl-C while it starts; not if it refuses to start.

    A box that refuses streams for a recording already.
    """
    with ExitStack() as stack:
        stack.callback(box.command, STOP)
        try:
            box.command(START)
        except RefusedError:
            stack.pop_all()
            raise
        yield


def one_line_of(ident: Ident) -> str:
    """Describe a box in a few words."""
    document = ident.document
    board = f" on {document['board']}" if isinstance(document.get("board"), str) else ""
    return f"truearm box {document.get('uid', '')!s:.32}, firmware {ident.firmware:.32}{board[:40]}"
