"""A new unit, the newton, in two lines of one file: in tables, in keys and on the screen."""

import json

from tests.recipes.recipes import Copy

PROGRAM = """
import json, re
from truearm.kinds import quantities
quantities.CIRCUMSTANCES += (quantities.Quantity("force", ("force",), "N"),)
from truearm.errors import TableError
from truearm.files.observation_table import format_table, parse_table
from truearm.schema import Key, Number, SchemaError
from truearm.units import number, title

def refused(call):
    try:
        call()
    except TableError as exc:
        return exc.finding.code, exc.finding.values["place"]
    except SchemaError as exc:
        return re.findall("[-0-9]+ N", str(exc))

def table(column, value):
    return parse_table(f"kind,q1_rad,place,socket,{column}\\nseat,0,a,0,{value}\\n", "t.csv")

key = Key("force", Number("N"))
print(json.dumps({
    "read": table("force_n", 12.5)["force"].tolist(),
    "written": format_table(table("force_n", 12.5), ("rad",)).splitlines()[0],
    "no unit": refused(lambda: table("force", 1)),
    "other unit": refused(lambda: table("force_kg", 1)),
    "too large": refused(lambda: table("force_n", 1e6)),
    "key": [key.parse(12.5, "force_n"), list(key.spellings)],
    "key too large": refused(lambda: key.parse(1e6, "force_n")),
    "shown": f"{title('force', 'N')} {number(12.5, 'N')}",
}))
"""


def test_a_unit_is_in_tables_keys_and_titles(tmp_path):
    copy = Copy(tmp_path)
    copy.apply("A unit")
    assert copy.changes() == {"host/truearm/units.py": "+2 -0"}
    assert json.loads(copy.python("-c", PROGRAM).out) == {
        "read": [12.5],
        "written": "kind,q1_rad,force_n,place,socket",
        "no unit": ["wrong-value", "t.csv column 5 ('force')"],
        "other unit": ["wrong-value", "t.csv column 5 ('force_kg')"],
        "too large": ["malformed-file", "t.csv row 2 column force_n"],
        "key": [12.5, ["force_n"]],
        "key too large": ["06 N", "100000 N"],
        "shown": "force [N] 12.50",
    }
