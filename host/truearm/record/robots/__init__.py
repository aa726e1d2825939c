"""Joint sources, one file each. A source is a ``Link`` with readings as lines (docs/reference/session-format.md).

Each reading has the host's arrival time (from the link), the controller's time ``t``, a sequence number ``seq`` if
there is one, and the measured joints ``q``. If the robot provides them, it also has the commanded joints ``q_cmd``,
velocities ``qd``, ``current`` or ``effort``, and digital ``inputs``. Measured and commanded joints are kept separate. A
line that is not such an object is kept as console text. The recorder knows nothing else about a source.
"""
