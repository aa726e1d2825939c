"""``truearm session``: repair session files, and convert them for other programs."""

from __future__ import annotations

from truearm.cli.add_joints import add_joints
from truearm.cli.export_session import export_session
from truearm.cli.output import command_group
from truearm.cli.project import ProjectCommand
from truearm.cli.recover import recover
from truearm.cli.relabel import relabel

app = command_group(
    "session",
    "Repair session files, and convert them for other programs.",
    "Example: truearm session recover session.mcap",
)
app.command("recover", cls=ProjectCommand)(recover)
app.command("relabel", cls=ProjectCommand)(relabel)
app.command("add-joints", cls=ProjectCommand)(add_joints)
app.command("export", cls=ProjectCommand)(export_session)
