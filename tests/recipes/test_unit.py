"""A new unit, the newton, in two lines of one file: in tables, in keys and on the screen."""

import json

from tests.recipes.recipes import Copy

PROGRAM = """
import json
from truearm.kinds import quantities
quantities.CIRCUMSTANCES += (quantities.Quantity("force", ("force",), "N"),)
from truearm.errors import TableError
from truearm.files.observation_table import format_table, parse_table
from truearm.schema import Key, Number, SchemaError
from truearm.units import number, title

def refused(call, error):
    try:
        call()
    except error as exc:
        return str(exc)

def table(column, value):
    return parse_table(f"kind,q1_rad,place,socket,{column}\\nseat,0,a,0,{value}\\n", "t.csv")

key = Key("force", Number("N"))
print(json.dumps({
    "read": table("force_n", 12.5)["force"].tolist(),
    "written": format_table(table("force_n", 12.5), ("rad",)).splitlines()[0],
    "no unit": refused(lambda: table("force", 1), TableError),
    "other unit": refused(lambda: table("force_kg", 1), TableError),
    "too large": refused(lambda: table("force_n", 1e6), TableError),
    "key": [key.parse(12.5, "force_n"), list(key.spellings)],
    "key too large": refused(lambda: key.parse(1e6, "force_n"), SchemaError),
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
        "no unit": "t.csv column 5 ('force') is not one of force_n",
        "other unit": "t.csv column 5 ('force_kg') is not one of force_n",
        "too large": "t.csv row 2 column force_n: '1000000.0' is too large for n; is the column in another unit?",
        "key": [12.5, ["force_n"]],
        "key too large": "force_n: 1e+06 N is not between -100000 and 100000 N; is the unit right?",
        "shown": "force [N] 12.50",
    }
