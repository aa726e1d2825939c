"""The elements of every frame after its type. Written by protocol/make_layout.py from frames.cddl: do not edit.

"name:u32" and "name:u64" are of fixed width, all other integers are shortest; "name:counter", "name:largest" and
"name:smallest" say what becomes of an element over a session.
"""

LAYOUT = {
    16: (
        "seq:u32",
        "stream",
        "n0:u64",
        "t0_us:u64",
        "period_ns:u32",
        "samples",
        "flags",
    ),
    17: (
        "seq:u32",
        "line",
        "t_us:u64",
        "edge",
    ),
    18: (
        "seq:u32",
        "boot_id:u32",
        "t_us:u64",
        "sent:counter",
        "dropped:counter",
        "short_writes:counter",
        "overruns:counter",
        "bad_frames:counter",
        "loop_max_us:largest",
        "gc_max_us:largest",
        "heap_free:smallest",
        "temperature_mdegc",
        "reset_cause",
        "streaming",
        "crc_errors:counter",
        "converter_resets:counter",
        "missing_stops:counter",
        "thermometer_errors:counter",
    ),
    19: (
        "seq:u32",
        "req_id",
        "page",
        "pages",
        "data",
    ),
    20: (
        "seq:u32",
        "t_us:u64",
        "thermometer",
        "temperature_mdegc",
    ),
    33: (
        "seq:u32",
        "id",
        "t1_us:u64",
        "t2_us:u64",
    ),
    64: (
        "seq:u32",
        "req_id",
        "page",
        "pages",
        "data",
    ),
    65: (
        "seq:u32",
        "req_id",
        "code",
        "text",
    ),
    32: ("id",),
    48: ("req_id",),
    49: (
        "req_id",
        "stream",
        "rate",
    ),
    50: ("req_id",),
    51: ("req_id",),
    52: ("req_id",),
    53: (
        "req_id",
        "page",
        "pages",
        "data",
    ),
    54: ("req_id",),
    55: ("req_id",),
    56: (
        "req_id",
        "mode",
    ),
    57: (
        "req_id",
        "level",
    ),
}

# elements at the end of a layout that minor versions appended: an older box does not send them
APPENDED = {18: 4}
