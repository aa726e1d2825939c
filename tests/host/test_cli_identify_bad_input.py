"""Messages of ``truearm identify`` on bad input, and --help."""

import re
import subprocess
import sys

import pytest
from command_line import Outcome, Run, process, told

from truearm.estimate.solvers import SOLVERS, Loss
from truearm.model.builtin import builtin_names

BAD_ARGUMENTS = {
    "no such option": (["--nonsense"], "--nonsense"),
    "not a number": (["--max-iterations", "many"], "--max-iterations"),
    "below its range": (["--max-iterations", "0"], "--max-iterations"),
    "no such prior": (["--prior", "strong"], "'--prior': 'strong'"),
    "no such solver": (["--solver", "magic"], "renders-1991"),
    "no such loss": (["--loss", "l1"], "cauchy"),
    "a loss for a solver without": (["--solver", "recursive", "--loss", "huber"], "--loss huber"),
    "a prior for a solver without": (["--solver", "ls", "--prior", "weak"], "which knows no prior"),
    "no such robot": (["--model", "puma561"], "did you mean puma560?"),
    "tip of no URDF": (["--tip", "ball"], "--base and --tip"),
    "no such folder": (["--out", "/none/result.json"], "missing-file"),
    "line breaks in a name": (["--out", "a\nb\x1b[31m/r.json"], "a b\\x1b[31m"),
}


@pytest.mark.parametrize(("arguments", "message"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS.keys())
def test_bad_arguments(run: Run, good: list[object], arguments: list[str], message: str) -> None:
    told(run(*good, *arguments), message)


def test_a_rig_that_is_not_there_and_bad_input_as_the_shell_sees_it(run, good, tmp_path):
    told(run(*good[:4], "--rig", "none.toml"), "none.toml: no such file")
    told(run(*good[:4], "--rig", "mon=none.toml"), "none.toml: no such file")
    told(run(*good[:4], "--rig", "a\nb\x1b[31m.toml"), "a b\\x1b[31m.toml")
    told(process("identify"), "Missing argument")
    (tmp_path / "t.csv").write_bytes(b"\x89MCAP0\r\n\0\0")
    told(process("identify", tmp_path / "t.csv", *good[2:]), "its name must end in .mcap")


def test_version_help_and_no_command(run):
    assert run().code == 0
    assert run("--version").out.startswith("truearm ")
    words = set(re.findall(r"[\w-]+", run("identify", "--help").out))
    assert {*builtin_names(), *SOLVERS, *Loss} <= words
    code = "import sys, truearm.cli.main as cli; cli.main(['--help']); print({'numpy', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.splitlines()[-1] == "set()"


def test_interruption_is_one_line_and_130(run: Run, good: list[object], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    def interrupted_while_importing(*_: object, **__: object) -> None:
        raise ImportError("initialization failed") from KeyboardInterrupt()

    def faulty(*_: object, **__: object) -> None:
        raise ImportError("no such module")

    for raises in (interrupted, interrupted_while_importing):
        monkeypatch.setattr("truearm.workflows.identify.identified", raises)
        assert run(*good) == Outcome(130, "", "truearm: interrupted\n")
    monkeypatch.setattr("truearm.workflows.identify.identified", faulty)
    with pytest.raises(ImportError, match="no such module"):
        run(*good)


def test_a_reader_that_leaves_is_no_traceback(good: list[object]) -> None:
    command = [sys.executable, "-m", "truearm", *map(str, good), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        child.stdout.close()
        assert child.stderr.read() == b""
    assert child.returncode == 1
