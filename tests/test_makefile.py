"""What `make test` says and does where a tool cannot be fetched."""

import shutil
import subprocess
from pathlib import Path

import pytest

from truearm_sim import debian

MAKEFILE = Path(__file__).parents[1] / "Makefile"


@pytest.fixture
def make(tmp_path):
    """Return a function that runs make in a folder of its own, with ``rule`` as the goal "x"."""
    shutil.copy(MAKEFILE, tmp_path)
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv" / "python").touch()

    def run(*arguments, rule=":"):
        (tmp_path / "rule.mk").write_text(f"include Makefile\nx:\n\t{rule}\n", encoding="utf-8")
        command = ["make", "--no-print-directory", "-f", "rule.mk", *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)

    return run


FETCH = "$(call fetch,chip,echo error: no apt here >&2; exit {code},the tests at chip level)"


@pytest.mark.parametrize("code", [0, 1, 2, 3])
def test_only_what_cannot_be_fetched_is_left_out(make, tmp_path, code):
    done = make("x", rule=FETCH.format(code=code))
    assert (done.returncode == 0) == (code in (0, 3))
    assert "no apt here" in done.stderr
    assert (tmp_path / "build" / "left-out" / "chip").exists() == (code == 3)


@pytest.mark.parametrize(
    ("left_out", "last"),
    [((), "make test: passed"), (("a (no b)", "c (no d)"), "make test: passed; LEFT OUT: a (no b); c (no d)")],
)
def test_the_last_line_names_what_was_left_out(make, tmp_path, left_out, last):
    script = tmp_path / "inner"
    lines = [f"echo '{text}' >build/left-out/{number}" for number, text in enumerate(left_out)]
    script.write_text("\n".join(["#!/bin/sh", "mkdir -p build/left-out", *lines]), encoding="utf-8")
    script.chmod(0o755)
    (tmp_path / "build" / "left-out").mkdir(parents=True)
    (tmp_path / "build" / "left-out" / "of-an-earlier-run").touch()
    done = make("test", f"MAKE={script}")
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, last)


def test_a_failure_is_no_omission(make):
    assert make("test", "MAKE=false").returncode == 2


def test_without_apt_nothing_is_fetched(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(debian.DebianError, match="apt-get"):
        debian.fetch(tmp_path / "tools", ["cmake"], print)
    assert not (tmp_path / "tools").exists()


def test_unpacked_programs_and_libraries_come_first(tmp_path, monkeypatch):
    libraries = tmp_path / "root" / "usr" / "lib" / "x86_64-linux-gnu"
    (libraries / "blas").mkdir(parents=True)
    (libraries / "empty").mkdir()
    for path in (libraries / "libz.so.1", libraries / "blas" / "libblas.so.3"):
        path.touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", "/own")
    environ = debian.environment(tmp_path)
    assert environ["LD_LIBRARY_PATH"].split(":") == [str(libraries), str(libraries / "blas"), "/own"]
    assert environ["PATH"].split(":")[0] == str(tmp_path / "root" / "usr" / "bin")
