"""Read joint states in ROS 2 bags (MCAP or sqlite3) as lines of a session.

The package rosbags decodes the messages. Its readers are not used for the files around them, because they allocate and
decompress as much as a file asks for, and keep all overlapping chunks. MCAP files are read by truearm's own session
reader, sqlite3 files by Python's module with limits; neither holds more than a chunk or a message.

``t`` is the stamp in the message's header, set by the driver on its own clock (usually UTC), ``q`` the position, ``qd``
the velocity and ``effort`` the effort, as far as present, in the order of ``joints``: a driver publishes joints in any
order (Universal Robots' begins with the elbow). A joint state does not contain commanded values.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from truearm.errors import Argument, InputError, SessionError
from truearm.file_names import open_input, reading
from truearm.record.robots.joint_table import NO_ARRIVAL
from truearm.record.robots.sources import AddedReading, FileOptions
from truearm.schema import quoted
from truearm.session.joint_format import MAX_JOINTS, are_joints, format_reading
from truearm.session.session_file import open_session

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

MESSAGE_TYPE = "sensor_msgs/msg/JointState"
MAX_MESSAGE_BYTES = 1 << 20
MAX_FILES = 10_000
SUFFIXES = (".mcap", ".db3")
_ZSTD = b"\x28\xb5\x2f\xfd"


def readings(path: Path, options: FileOptions) -> Iterator[AddedReading]:
    """Yield the joint states on a topic in the order of the bag, with the given ``joints`` in this order.

    Raises InputError if there is no such bag, topic or joint, or rosbags is not installed; SessionError if a file is
    damaged.
    """
    if options.columns:
        raise InputError("no-effect", place=Argument("columns"), reason="a bag has no columns")
    found = 0
    decoder = _decoder()
    for file in bag_files(path):
        for data in _messages(file, options.topic, options.allow_damaged):
            found += 1
            yield _reading(file, found, decoder, data, options.joints)
    if not found:
        raise InputError(
            f"{path}: has no messages on {options.topic}; name the topic of the joint states with ", Argument("topic")
        )


def bag_files(path: Path) -> list[Path]:
    """Return the files of a bag in order: name_0.mcap, name_1.mcap …. Raises InputError."""
    if path.exists() and not path.is_dir():
        return [path]
    with reading(path):
        names = sorted(path.iterdir(), key=_numbered)
    files = [name for name in names if name.suffix.lower() in SUFFIXES]
    if not files:
        packed = any(name.suffix == ".zstd" for name in names)
        why = (
            "its files are compressed as a whole: unpack them with zstd -d"
            if packed
            else "there is no .mcap and no .db3"
        )
        raise InputError(f"{path}: is not a readable bag; {why}")
    if len({file.suffix.lower() for file in files}) > 1 or len(files) > MAX_FILES:
        raise InputError(f"{path}: holds files of several bags; name one file")
    return files


def _numbered(path: Path) -> list[str | int]:
    """Split a name into text and numbers for sorting: name_10 comes after name_9."""
    parts: list[str | int] = list(re.split(r"(\d{1,18})", path.name))
    parts[1::2] = [int(part) for part in parts[1::2]]
    return parts


def _messages(path: Path, topic: str, allow_damaged: bool) -> Iterator[bytes]:
    """Yield the data of the messages on a topic of one file. Raises InputError."""
    if path.suffix.lower() == ".db3":
        yield from _sqlite_messages(path, topic)
        return
    for message in open_session(path, allow_damaged).messages({topic}):
        yield message.data


def _sqlite_messages(path: Path, topic: str) -> Iterator[bytes]:
    """Yield as ``_messages``, ordered by time of reception."""
    open_input(path).close()
    try:
        connection = sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)
    except sqlite3.Error as exc:
        raise InputError(f"{path}: cannot be opened ({exc})") from exc
    try:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
        connection.text_factory = lambda data: data.decode(errors="replace")
        connection.execute("PRAGMA trusted_schema = OFF")
        for table in ("topics", "messages"):
            _check_plain(path, connection, table)
        query = (
            "SELECT messages.data FROM messages JOIN topics ON messages.topic_id = topics.id "
            "WHERE topics.name = ? AND topics.type = ? ORDER BY messages.timestamp, messages.id"
        )
        for (data,) in connection.execute(query, (topic, MESSAGE_TYPE)):
            yield data if isinstance(data, bytes) else b""
    except (sqlite3.Error, UnicodeDecodeError) as exc:  # the latter if an error's own text is damaged
        raise SessionError(
            f"{path}: is not a bag or is damaged ({quoted(str(exc))}); record it again, or repair it with ros2 bag reindex"
        ) from exc
    finally:
        connection.close()


def _check_plain(path: Path, connection: sqlite3.Connection, table: str) -> None:
    """Reject views and computed columns: a few bytes of them could produce any number of rows of any size."""
    (kinds,) = connection.execute(
        "SELECT group_concat(type) FROM sqlite_master WHERE name = ?", (table,)
    ).fetchone() or [None]
    sql = connection.execute("SELECT sql FROM sqlite_master WHERE name = ? AND type = 'table'", (table,)).fetchone()
    computed = kinds == "table" and any(row[6] for row in connection.execute(f"PRAGMA table_xinfo({table})"))
    if kinds != "table" or computed or sql is None or str(sql[0]).lstrip().upper().startswith("CREATE VIRTUAL"):
        raise SessionError(f"{path}: has no plain table {table!r}; is this a ROS 2 bag?")


def _decoder() -> Typestore:
    """Return the decoder of messages. Raises InputError if rosbags is not installed."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as exc:
        raise InputError("missing-package", place="a bag", package="rosbags", install="truearm[ros]") from exc
    return get_typestore(Stores.ROS2_HUMBLE)  # the message is the same in all releases


def _reading(path: Path, number: int, decoder: Typestore, data: bytes, joints: Sequence[str]) -> AddedReading:
    """Return the reading of a message. Raises InputError."""
    from rosbags.serde import SerdeError

    where = f"{path} message {number}"
    if data.startswith(_ZSTD):
        raise InputError(f"{where}: this message is compressed; unpack the bag with ros2 bag convert")
    try:
        state: Any = decoder.deserialize_cdr(data, MESSAGE_TYPE)
    except SerdeError as exc:
        raise SessionError(f"{where}: is not a {MESSAGE_TYPE} or is damaged") from exc
    names = list(state.name)
    if not joints:
        raise InputError(
            f"{path}: name the joints in order from the base, with ",
            *(Argument("joints"), " or ", Argument("model"), f"; the bag has {_listed(names)}"),
        )
    missing = [joint for joint in joints if joint not in names]
    if missing:
        raise InputError(f"{where}: has no joint {missing[0]!r}; it has {_listed(names)}")
    places = [names.index(joint) for joint in joints]
    q, qd, effort = (_picked(values, len(names), places) for values in (state.position, state.velocity, state.effort))
    if q is None:
        raise SessionError(f"{where}: does not have a finite position for each of its {len(names)} joints")
    stamp = state.header.stamp
    t = stamp.sec + 1e-9 * stamp.nanosec
    if stamp.sec < 0 or stamp.nanosec >= 10**9:
        raise SessionError(
            f"{where}: has the stamp {stamp.sec} s and {stamp.nanosec} ns, which is not a valid time; correct the stamps, or leave this message out of the bag"
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
