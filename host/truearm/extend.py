"""What additions to truearm are made of: kinds of observation, terms of the joint law, export formats, joint sources.

docs/how-to/extending.md has a recipe for each. What ``import truearm`` exports is not repeated here. Nothing in truearm
imports this module.
"""

from truearm.export.link_frames import check_gains as check_gains
from truearm.export.link_frames import joint_motion as joint_motion
from truearm.export.writing import RobotToWrite as RobotToWrite
from truearm.findings import Finding as Finding
from truearm.kinds.group import Group as Group
from truearm.kinds.group import KindFault as KindFault
from truearm.kinds.kind import DwellSensor as DwellSensor
from truearm.kinds.kind import Kind as Kind
from truearm.kinds.linearised import Linearised as Linearised
from truearm.kinds.linearised import gather as gather
from truearm.kinds.linearised import linearised as linearised
from truearm.kinds.linearised import scatter as scatter
from truearm.kinds.linearised import zero_columns as zero_columns
from truearm.kinds.proposals import NEW as NEW
from truearm.kinds.proposals import TRIES as TRIES
from truearm.kinds.proposals import Proposal as Proposal
from truearm.kinds.proposals import anywhere as anywhere
from truearm.kinds.proposals import trial_rows as trial_rows
from truearm.kinds.quantities import Quantity as Quantity
from truearm.kinds.registry import add_kind as add_kind
from truearm.kinds.rig_entries import NAME as NAME
from truearm.kinds.rig_entries import TARGET as TARGET
from truearm.kinds.rig_entries import by_name as by_name
from truearm.kinds.rig_references import RigUse as RigUse
from truearm.kinds.rig_references import Scope as Scope
from truearm.kinds.rig_references import measured as measured
from truearm.kinds.rig_references import sigmas as sigmas
from truearm.kinds.rig_references import use as use
from truearm.kinds.rig_references import use_points as use_points
from truearm.kinds.unknowns import Fault as Fault
from truearm.kinds.unknowns import Layout as Layout
from truearm.kinds.unknowns import RigNumber as RigNumber
from truearm.kinds.unknowns import Used as Used
from truearm.kinds.unknowns import or_inf as or_inf
from truearm.model.chain import Chain as Chain
from truearm.model.chain import about as about
from truearm.model.chain import along as along
from truearm.model.chain import forward as forward
from truearm.model.chain import link_frames as link_frames
from truearm.model.chain import trace_link as trace_link
from truearm.model.chain import trace_point as trace_point
from truearm.model.chain_structure import Structure as Structure
from truearm.model.joint_terms.nominal_arm import NominalArm as NominalArm
from truearm.model.joint_terms.term import Term as Term
from truearm.model.transforms import axis_of as axis_of
from truearm.record.links import Clock as Clock
from truearm.record.links import Link as Link
from truearm.record.links import TcpLink as TcpLink
from truearm.record.robots.text_lines import LineDialect as LineDialect
from truearm.record.robots.text_lines import LinesLink as LinesLink
from truearm.schema import IDENTIFIER as IDENTIFIER
from truearm.schema import Entries as Entries
from truearm.schema import Key as Key
from truearm.schema import List as List
from truearm.schema import Number as Number
from truearm.schema import Table as Table
from truearm.schema import sigma as sigma
from truearm.session.joint_format import format_reading as format_reading
from truearm.types import Floats as Floats
from truearm.types import Indices as Indices
from truearm.units import DEG as DEG
from truearm.units import MS as MS
