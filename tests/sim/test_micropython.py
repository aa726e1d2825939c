"""Finding a MicroPython (a real one runs here), and what is done to the machine's package sources to get one."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from truearm_sim import debian, micropython
from truearm_sim.debian import Source
from truearm_sim.micropython import InterpreterError, find, main, probe

DEB822 = """\
# the base system
Types: deb deb-src
URIs: http://deb.example/debian http://second.example/debian
Suites: bookworm bookworm-updates
Components: main contrib
Signed-By:
 -----BEGIN PGP PUBLIC KEY BLOCK-----
 .
 mQINBF
 -----END PGP PUBLIC KEY BLOCK-----

Types: deb
URIs: http://deb.example/debian-security
Suites: bookworm-security
Components: main

Enabled: no
Types: deb
URIs: http://off.example/debian
Suites: bookworm
Components: main

Types: deb
URIs: http://stable.example/debian
Suites: stable
Components: main
Signed-By: /usr/share/keyrings/some.gpg
"""
ONE_LINE = """\
# deb http://commented.example/debian bookworm main
deb http://deb.example/debian bookworm main contrib # the base system
deb-src http://source.example/debian bookworm main
deb [arch=amd64 signed-by=/etc/apt/keyrings/k.gpg trusted=yes] https://mirror.example/debian  bookworm  main
deb http://deb.example/debian bookworm-updates main
deb http://deb.example/debian bookworm contrib
deb cdrom:[Debian]/ bookworm main
"""


def fake(folder: Path, script: str, name: str = "micropython") -> Path:
    """Return a program in ``folder`` that runs ``script``."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def says(version: str, maxsize: int = 2**63 - 1) -> str:
    return f"echo micropython {version} {maxsize}"


def test_machine_sources_of_both_forms_are_each_taken_once_and_discs_not(tmp_path):
    folder = tmp_path / "sources.list.d"
    folder.mkdir()
    (tmp_path / "sources.list").write_text(ONE_LINE)
    (folder / "a.list").write_text(ONE_LINE + "deb cdrom:[x] bookworm main\n")
    (folder / "b.sources").write_text(DEB822)
    (folder / "c.disabled").write_text(DEB822)
    key = "\n -----BEGIN PGP PUBLIC KEY BLOCK-----\n .\n mQINBF\n -----END PGP PUBLIC KEY BLOCK-----"
    assert debian.machine_sources(tmp_path, ["bookworm", "stable"]) == [
        Source("http://deb.example/debian", None),
        Source("https://mirror.example/debian", "/etc/apt/keyrings/k.gpg"),
        Source("http://deb.example/debian http://second.example/debian", key),
        Source("http://stable.example/debian", "/usr/share/keyrings/some.gpg"),
    ]


@pytest.mark.parametrize("text", [DEB822, ONE_LINE])
def test_the_new_stanza_asks_for_another_suite_of_the_same_source_and_keeps_verification(text):
    parse = debian.sources_deb822 if text is DEB822 else debian.sources_one_line
    for source in parse(text, ["bookworm", "stable"]):
        stanza = debian.source_stanza(source, "trixie")
        assert debian.sources_deb822(stanza, ["trixie"]) == [source]
        assert "trusted" not in stanza.lower()


def test_only_what_reaches_the_sources_is_taken_from_the_machines_apt():
    taken = [
        'Acquire::http::Proxy "http://proxy.example:3128/";',
        'Acquire::https::CaInfo "/etc/ssl/own.pem";',
        'Acquire::Check-Valid-Until "false";',
        'Acquire::ForceIPv4 "true";',
    ]
    left = [
        'Acquire::AllowInsecureRepositories "true";',
        'APT::Get::AllowUnauthenticated "true";',
        'Acquire::IndexTargets::deb::DEP-11::DefaultEnabled "true";',
        'APT::Update::Post-Invoke:: "rm -f /var/cache/apt/archives/*.deb || true";',
    ]
    assert [line for line in taken + left if debian.ACQUIRE.match(line)] == taken


def test_search_order(tmp_path):
    named = fake(tmp_path / "named", says("1 27 0", 2**31 - 1))
    on_path = fake(tmp_path / "bin", says("1 26 1"))
    fetched32 = fake(tmp_path / "fetched", says("1 25 0", 2**31 - 1), "micropython32")
    fetched64 = fake(tmp_path / "fetched", says("1 25 0"), "micropython64")
    path = {"PATH": str(on_path.parent)}
    nowhere = {"PATH": str(tmp_path)}
    folder = tmp_path / "fetched"

    found = find({**path, "TRUEARM_MICROPYTHON": str(named)}, folder)
    assert found is not None
    assert (found.path, found.version, found.bits) == (named, (1, 27, 0), 32)
    assert find({**path, "TRUEARM_MICROPYTHON": ""}, folder) == micropython.Interpreter(on_path, (1, 26, 1), 64)
    assert find(nowhere, folder) == micropython.Interpreter(fetched32, (1, 25, 0), 32)
    fake(tmp_path / "fetched", "exit 126", "micropython32")  # as on a kernel that runs no 32-bit programs
    assert find(nowhere, folder) == micropython.Interpreter(fetched64, (1, 25, 0), 64)
    assert find(nowhere, tmp_path / "empty") is None


@pytest.mark.parametrize("script", [says("1 24 1"), "exit 1", "echo Python 3"])
def test_one_on_path_that_cannot_be_used_is_passed_over_but_one_named_is_an_error(tmp_path, script):
    bad = fake(tmp_path / "bin", script)
    good = fake(tmp_path / "fetched", says("1 25 0"), "micropython64")
    path = {"PATH": str(bad.parent)}
    assert find(path, good.parent) == micropython.Interpreter(good, (1, 25, 0), 64)
    with pytest.raises(InterpreterError, match="TRUEARM_MICROPYTHON"):
        find({**path, "TRUEARM_MICROPYTHON": str(bad)}, good.parent)


@pytest.mark.parametrize("named", ["/nowhere/micropython", "no-such-program", sys.executable])
def test_a_bad_variable_is_one_clear_line_and_exit_code_2(monkeypatch, capsys, named):
    monkeypatch.setenv("TRUEARM_MICROPYTHON", named)
    assert main(["--get"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert named in error


def test_without_apt_the_error_says_what_to_do(monkeypatch, capsys, tmp_path):
    monkeypatch.delenv("TRUEARM_MICROPYTHON", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["--get", "--to", str(tmp_path / "to")]) == 2
    assert "set $TRUEARM_MICROPYTHON" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


# An apt whose mirror has stale i386 lists of trixie, as one had for a day: every other list and package comes.
STALE_APT = """\
. "$0.state"
while read -r line; do case $line in APT::Architectures*) listed=$line;; Dir::Cache*) cache=${line#* \\"};; esac; done < "$APT_CONFIG"
cache=${cache%%\\"*}
suite=$(sed -n 's/^Suites: //p' "${APT_CONFIG%/*}/sources/0.sources")
case "$*" in
  *update) [ $((updates += 1)) -le 9 ] && echo "updates=$updates" > "$0.state"
    case "$suite $listed" in trixie*i386*)
      echo "E: Failed to fetch Packages.xz  File has unexpected size (1 != 2). Mirror sync in progress?" >&2; exit 100;; esac;;
  *install*) touch "$cache/archives/micropython_${suite}_${*##*:}.deb";;
esac
"""


@pytest.fixture
def stale_apt(monkeypatch, tmp_path):
    """Return the folder of programs, with that apt, of a machine of amd64; its state counts the updates."""
    folder = tmp_path / "bin"
    for name, script in (("apt-get", STALE_APT), ("dpkg", "echo amd64"), ("apt-config", "true")):
        fake(folder, script, name)
    (folder / "apt-get.state").write_text("updates=0\n")
    monkeypatch.setenv("PATH", str(folder), prepend=":")
    monkeypatch.setattr(debian, "machine_sources", lambda etc, suites: [Source("http://deb.example/debian", None)])
    return folder


@pytest.mark.usefixtures("stale_apt")
def test_an_architecture_whose_lists_are_stale_comes_from_the_next_release(tmp_path):
    said = []
    packages = micropython._download(tmp_path / "apt", said.append)
    assert [path.name for path in packages] == ["micropython_forky_i386.deb", "micropython_trixie_amd64.deb"]
    assert any("not from trixie" in line and "Mirror sync" in line for line in said)


def test_lists_of_a_mirror_that_is_being_renewed_are_asked_for_again(stale_apt, monkeypatch, tmp_path):
    waited = []
    monkeypatch.setattr(debian, "time", SimpleNamespace(sleep=waited.append))  # not the sleep of other threads
    with pytest.raises(debian.DebianError, match="unexpected size"):
        debian.private_apt(tmp_path / "apt", "trixie", ("i386",))
    assert waited == list(debian.PAUSES)
    assert (stale_apt / "apt-get.state").read_text() == f"updates={1 + len(waited)}\n"


def test_the_interpreter_found_here_is_a_micropython():
    found = find()
    assert found is not None, "no MicroPython: make micropython"
    assert found == probe(found.path)
    assert found.version >= micropython.MINIMUM
    source = f"import sys; print(sys.implementation.name, 2 * sys.maxsize + 2 == 1 << {found.bits})"
    done = subprocess.run([found.path, "-c", source], capture_output=True, text=True, timeout=30)
    assert done.stdout.split() == ["micropython", "True"]


def test_the_heap_can_be_capped_as_on_the_chip():
    found = find()
    assert found is not None, "no MicroPython: make micropython"
    free = subprocess.run(
        [found.path, "-X", "heapsize=237k", "-c", "import gc; print(gc.mem_free() + gc.mem_alloc())"],
        capture_output=True,
        text=True,
        timeout=30,
    )
    # Three bits of each block (16 B, or 32 B for 64 bit) are the collector's tables: 2.3 % of the cap at most.
    assert 0.97 * 237 * 1024 < int(free.stdout) <= 237 * 1024
