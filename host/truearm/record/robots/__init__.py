"""Joint sources: a file each. A source is a ``Link`` whose bytes are lines, readings as docs/session-format.md describes them.

It yields, reading by reading, the host's arrival (of the link), the controller's time ``t``, a number ``seq`` that counts the
readings if there is one, the measured joints ``q`` and, as far as the robot says them, the commanded ones ``q_cmd``, velocities ``qd``,
``current`` or ``effort``, and digital ``inputs``. Measured and commanded joints are kept apart. A line that is no such object is kept
as console text. The recorder knows nothing of a source but that.
"""
