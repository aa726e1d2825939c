# mypy: implicit-reexport
# ruff: noqa: F401
"""What additions to truearm are made of: kinds of observation, terms of the joint law, export formats, joint sources.

docs/how-to/extending.md has a recipe for each. What ``import truearm`` exports is not repeated here. Nothing in truearm
imports this module.
"""

from truearm.export.writing import RobotToWrite, check_gains, joint_motion
from truearm.findings import Finding
from truearm.kinds.columns import Quantity
from truearm.kinds.group import (
    Fault,
    Group,
    KindFault,
    Layout,
    Linearised,
    RigNumber,
    Used,
    gather,
    linearised,
    or_inf,
    scatter,
    zero_columns,
)
from truearm.kinds.kind import DwellSensor, Kind, RigUse, Scope, measured, sigmas, use, use_points
from truearm.kinds.proposals import NEW, TRIES, Proposal, anywhere, trial_rows
from truearm.kinds.registry import add_kind
from truearm.kinds.rig_entries import NAME, TARGET, by_name
from truearm.model.chain import Chain, about, along, forward, link_frames, trace_link, trace_point
from truearm.model.chain_structure import Structure
from truearm.model.joint_terms.term import NominalArm, Term
from truearm.model.transforms import axis_of
from truearm.record.links import Clock, Link, TcpLink, UdpLink
from truearm.record.robots.text_lines import DatagramLines, DatagramMessages, LineDialect, LinesLink
from truearm.schema import IDENTIFIER, Entries, Key, List, Number, Table, sigma
from truearm.session.joint_format import format_reading
from truearm.types import Floats, Indices
from truearm.units import DEG, MS
