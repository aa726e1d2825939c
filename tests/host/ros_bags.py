"""Real bags of joint states for the tests, written by rosbags' own writer."""

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPE = "sensor_msgs/msg/JointState"
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}


def joint_state(t_ns, names, q, qd=(), effort=()):
    """Return a message as bytes (CDR)."""
    time, header, state = (STORE.types[name] for name in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header", TYPE))
    stamp = time(sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    arrays = (np.array(values, dtype=np.float64) for values in (q, qd, effort))
    return bytes(STORE.serialize_cdr(state(header(stamp, ""), list(names), *arrays), TYPE))


def write_bag(path, storage, messages, compress=None, topic="/joint_states"):
    """Write a bag at ``path`` (a folder) of (received [ns], bytes); ``compress`` is a mode of the writer."""
    writer = Writer(path, version=9, storage_plugin=STORAGES[storage])
    if compress:
        writer.set_compression(CompressionMode[compress], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(topic, TYPE, typestore=STORE)
        other = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=STORE)
        for received_ns, data in messages:
            writer.write(connection, received_ns, data)
            writer.write(other, received_ns, b"\0\1\0\0\2\0\0\0x\0")
    return path
