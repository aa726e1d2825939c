"""A conversation with a box, which what talks to one shares."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from truearm.errors import Argument, RefusedError

if TYPE_CHECKING:
    from truearm.box.control import BoxControl
    from truearm.session.box_ident import Ident

RETRIES = 10  # half a second each
STREAMING = 4  # the error's code, protocol/SPEC.md §4


@contextmanager
def conversation(device: str, stop: bool = False, retries: int = RETRIES) -> Iterator[BoxControl]:
    """A conversation with the box at ``device``, which has said what it is; with ``stop`` it does not stream any more.

    Raises LinkError, ProtocolError; a refusal because the box streams says what to do.
    """
    from truearm.box.control import BoxControl
    from truearm.record.links import HostClock, SerialLink
    from truearm_wire.messages import STOP

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


def ident_of(box: BoxControl) -> Ident:
    """What the box said of itself when the conversation began, or since."""
    return box.ident or box.identify()


def one_line_of(ident: Ident) -> str:
    """A box in a few words."""
    document = ident.document
    board = f" on {document['board']}" if isinstance(document.get("board"), str) else ""
    return f"truearm box {document.get('uid', '')!s:.32}, firmware {ident.firmware:.32}{board[:40]}"
