"""Read joint states in ROS 2 bags (MCAP or sqlite3) as lines of a session, with the package rosbags.

``t`` is the stamp in the message's header, set by the driver on its own clock (usually UTC), ``q`` the position, ``qd``
the velocity and ``effort`` the effort, as far as present, in the order of ``joints``: a driver publishes joints in any
order (Universal Robots' begins with the elbow). A joint state does not contain commanded values.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from truearm.disk import open_input
from truearm.errors import Argument, InputError, SessionError
from truearm.record.robots.sources import AddedReading, FileOptions
from truearm.record.robots.text_lines import NO_ARRIVAL
from truearm.schema import quoted
from truearm.session.joint_format import MAX_JOINTS, are_joints, format_reading

MESSAGE_TYPE = "sensor_msgs/msg/JointState"


def readings(path: Path, options: FileOptions) -> Iterator[AddedReading]:
    """Yield the joint states on a topic in the order of the bag, with the given ``joints`` in this order.

    Raises InputError if there is no such bag, topic or joint, or rosbags is not installed; SessionError if a file is
    damaged.
    """
    if options.columns:
        raise InputError("no-effect", place=Argument("columns"), reason="a bag has no columns")
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as exc:
        raise InputError("missing-package", place="a bag", package="rosbags", install="truearm[ros]") from exc
    if not path.is_dir():
        open_input(path).close()
    number = 0
    try:
        store = get_typestore(Stores.ROS2_HUMBLE)  # the message is the same in all releases
        with AnyReader([path], default_typestore=store) as bag:
            named = [c for c in bag.connections if c.topic == options.topic and c.msgtype == MESSAGE_TYPE]
            for number, (_, _, data) in enumerate(bag.messages(named) if named else (), start=1):
                yield _reading(path, number, store.deserialize_cdr(data, MESSAGE_TYPE), options.joints)
    except InputError:
        raise
    except Exception as exc:  # rosbags raises errors of many types for damaged bags
        place = f"{path} message {number}" if number else path
        raise SessionError(
            f"{place}: is not a bag of {MESSAGE_TYPE} or is damaged ({quoted(str(exc))}); repair it with ros2 bag reindex"
        ) from exc
    if not number:
        raise InputError(
            f"{path}: has no messages on {options.topic}; name the topic of the joint states with ", Argument("topic")
        )


def _reading(path: Path, number: int, state: Any, joints: Sequence[str]) -> AddedReading:
    """Return the reading of a message. Raises InputError."""
    place = f"{path} message {number}"
    names = list(state.name)
    if not joints:
        raise InputError(
            f"{path}: name the joints in order from the base, with ",
            *(Argument("joints"), " or ", Argument("model"), f"; the bag has {_listed(names)}"),
        )
    missing = [joint for joint in joints if joint not in names]
    if missing:
        raise InputError(f"{place}: has no joint {missing[0]!r}; it has {_listed(names)}")
    places = [names.index(joint) for joint in joints]
    q, qd, effort = (_picked(values, len(names), places) for values in (state.position, state.velocity, state.effort))
    if q is None:
        raise SessionError(f"{place}: does not have a finite position for each of its {len(names)} joints")
    stamp = state.header.stamp
    t = stamp.sec + 1e-9 * stamp.nanosec
    if stamp.sec < 0 or stamp.nanosec >= 10**9:
        raise SessionError(
            f"{place}: has the stamp {stamp.sec} s and {stamp.nanosec} ns, which is not a valid time; correct the stamps, or leave this message out of the bag"
        )
    return AddedReading(t, format_reading(t, None, q, qd=qd, effort=effort, **NO_ARRIVAL))


def _picked(values: Any, n: int, places: Sequence[int]) -> list[float] | None:
    """Return the values at these positions; None if there are not n of them, or they are not numbers."""
    if len(values) != n:
        return None
    picked = [float(values[place]) for place in places]
    return picked if are_joints(picked) else None


def _listed(names: Sequence[str]) -> str:
    return ",".join(names[:MAX_JOINTS])[:400] or "none"
