"""CRC and survey of the converter's driver, and the model's answers, compared with published observations of real parts."""

import json
import subprocess
import sys
from pathlib import Path

from truearm_sim import micropython, node

ROOT = Path(__file__).parents[2]
CHECK = Path(__file__).with_name("check_ads131m04.py")
WORDS = ROOT / "hil_sim" / "chip" / "ads131m04_words.mjs"
TRANSCRIPTS = Path(__file__).with_name("ads131m04_model.mjs")
VECTORS = Path(__file__).with_name("ads131m04_vectors.json")


def check(command: list[str]) -> str:
    done = subprocess.run([*command, str(CHECK), str(ROOT), str(VECTORS)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_crc_and_survey_on_cpython():
    assert check([sys.executable]).startswith("5 vectors, 0 failed")


def test_crc_and_survey_on_micropython():
    interpreter = micropython.find()
    assert interpreter is not None, "make micropython gets one"
    assert check([str(interpreter.path)]).startswith("5 vectors, 0 failed")


def test_the_model_answers_as_real_parts_did():
    done = subprocess.run([str(node.ready().path), str(TRANSCRIPTS)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr


def test_crc_of_the_model():
    script = f"import({json.dumps(WORDS.as_uri())}).then(({{crc16}}) => console.log(JSON.stringify({VECTORS.read_text()}.map((v) => crc16(Buffer.from(v.hex, 'hex'))))))"
    done = subprocess.run([str(node.ready().path), "-e", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [vector["crc"] for vector in json.loads(VECTORS.read_text())]
