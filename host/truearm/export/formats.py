"""The formats to export by name. Imports nothing slow, so that ``--help`` can list them.

To add a format, write a module with a function that returns the text of a ``writing.RobotToWrite``, and add its line to
FORMATS. The module is imported when it is used. Other packages add a ``Format`` by an entry point of the group
``truearm.formats``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from truearm.additions import with_additions


class Format(NamedTuple):
    """A format: its writer, its text in ``--help``, and what it can hold.

    The writer is written as "module:function", where ".module" is one of this package.

    ``suffix``: of its files. ``holds``: the terms of the joint law (``joint_law.terms``) that its writer writes. Other
    terms are neutral in the robot passed to the writer: the remaining parameters are refitted, and the remaining error
    is computed and printed. ``mountings``: the format can store the mountings of base and tool.
    """

    writer: str
    suffix: str
    summary: str
    holds: tuple[str, ...]
    mountings: bool = True


OWN: Mapping[str, Format] = {
    "urdf": Format(".urdf:write", ".urdf", "the robot's own URDF with other origins, or a new one", ("offset",)),
    "mjcf": Format(".urdf:write_mjcf", ".xml", "MuJoCo's MJCF", ("offset",)),
    "ur": Format(".ur:ur_yaml", ".yaml", "Universal Robots' kinematics", ("offset",), mountings=False),
    "calibration-conf": Format(
        ".ur:write_conf", ".conf", "Universal Robots' controller's own file", ("offset",), mountings=False
    ),
    "dh": Format(".toml_tables:dh_table", ".toml", "Denavit-Hartenberg rows", ("offset", "gain")),
    "dh-hayati": Format(
        ".toml_tables:dh_hayati_table",
        ".toml",
        "the same, with Hayati's β where axes are nearly parallel",
        ("offset", "gain"),
    ),
    "mdh": Format(".toml_tables:modified_dh_table", ".toml", "Craig's rows", ("offset", "gain")),
    "evaluator-c": Format(
        ".evaluator:write_c", ".c", "the arm with its joint laws as a C99 file", ("offset", "gain", "curve", "sag")
    ),
    "evaluator-python": Format(
        ".evaluator:write_python", ".py", "the same as a Python file", ("offset", "gain", "curve", "sag")
    ),
    "sheth-uicker": Format(".toml_tables:sheth_uicker_table", ".toml", "links of six constants", ("offset", "gain")),
}
FORMATS = with_additions("formats", OWN, lambda fields: Format(*fields))


def formats_help() -> str:
    """Return one sentence per format."""
    return " ".join(f"{name}: {form.summary} ({form.suffix})." for name, form in FORMATS.items())
