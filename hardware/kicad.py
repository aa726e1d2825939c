"""Find KiCad 9 and ngspice, or download them from the Debian release's backports without installing and without root.

The packages go into build/kicad of the checkout. Only packages missing on this computer are downloaded; other
dependencies must be installed, according to apt. The download is about 120 MB, unpacked to 800 MB, once.

    python -m hardware get
"""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HOME = ROOT / "build" / "kicad"
PACKAGES = ("kicad", "kicad-symbols", "kicad-footprints", "ngspice")
MINIMUM = 9


class NoTools(Exception):
    """KiCad or ngspice is not available here; the text is one line that states why."""


@dataclass(frozen=True)
class Tools:
    """The two programs, their environment, and KiCad's own libraries of symbols and footprints."""

    kicad: str
    ngspice: str
    environ: dict[str, str]
    symbols: Path
    footprints: Path

    def run_kicad(self, *arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [self.kicad, *arguments], capture_output=True, text=True, env=self.environ, cwd=folder, timeout=170
        )


def find(folder: Path = HOME) -> Tools:
    """Return the tools downloaded by :func:`get`, otherwise the computer's own. Raises NoTools."""
    usr = folder / "root" / "usr"
    environ = {**os.environ, "OMP_NUM_THREADS": "1", "LC_ALL": "C.UTF-8"}
    fetched = _fetched(folder)
    if fetched:
        libraries = [usr / "lib" / machine for machine in sorted(p.name for p in (usr / "lib").glob("*-linux-gnu"))]
        paths = [str(path / sub) for path in libraries for sub in ("", "blas", "lapack")]
        home = folder / "home"
        home.mkdir(exist_ok=True)
        environ |= {
            "LD_LIBRARY_PATH": ":".join(paths),
            "KICAD_STOCK_DATA_HOME": str(usr / "share" / "kicad"),
            "KICAD9_SYMBOL_DIR": str(usr / "share" / "kicad" / "symbols"),
            "KICAD9_FOOTPRINT_DIR": str(usr / "share" / "kicad" / "footprints"),
            "SPICE_LIB_DIR": str(usr / "share" / "ngspice"),
            "SPICE_SCRIPTS": str(usr / "share" / "ngspice" / "scripts"),
            "HOME": str(home),
            "XDG_CONFIG_HOME": str(home),
            "PATH": f"{usr / 'bin'}:{os.environ.get('PATH', os.defpath)}",
        }
        environ.pop("DISPLAY", None)
    programs = [shutil.which(name, path=environ.get("PATH")) for name in ("kicad-cli", "ngspice")]
    if None in programs:
        raise NoTools("no kicad-cli or no ngspice here; python -m hardware get fetches both on Debian")
    done = subprocess.run([programs[0] or "", "version"], capture_output=True, text=True, env=environ)
    if not done.stdout.strip().startswith(f"{MINIMUM}."):
        raise NoTools(f"kicad-cli {done.stdout.strip() or 'does not run'}; version {MINIMUM} is wanted")
    share = usr / "share" / "kicad" if fetched else Path("/usr/share/kicad")
    for name in ("symbols", "footprints"):
        if not (share / name).is_dir():
            raise NoTools(f"no {share / name}; on Debian it is in the package kicad-{name}")
    return Tools(programs[0] or "", programs[1] or "", environ, share / "symbols", share / "footprints")


def _fetched(folder: Path) -> bool:
    """Return whether all packages are in the folder; one that an older version filled lacks some."""
    done = folder / "done"
    return done.exists() and done.read_text(encoding="utf-8").split() == list(PACKAGES)


def get(folder: Path = HOME, say: Callable[[str], None] = print) -> Tools:
    """Download missing tools. Raises NoTools if there is no apt or no such release."""
    try:
        return find(folder)
    except NoTools:
        pass
    sys.path.insert(0, str(ROOT / "hil_sim"))
    from truearm_sim import debian

    if sys.platform != "linux" or debian.missing_program():
        raise NoTools(f"no {debian.missing_program() or 'Linux'} here")
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not _fetched(folder):
            try:
                _fetch(folder, say)
            except (debian.DebianError, OSError) as error:
                raise NoTools(str(error)) from error
    return find(folder)


def _fetch(folder: Path, say: Callable[[str], None]) -> None:
    from truearm_sim import debian

    release = debian.os_release().get("VERSION_CODENAME", "")
    if not release:
        raise debian.DebianError("/etc/os-release names no release")
    for name in ("apt", "root"):
        shutil.rmtree(folder / name, ignore_errors=True)
    say(f"fetching {', '.join(PACKAGES)} of {release}-backports")
    try:
        suite = f"{release}-backports"
        environ = debian.private_apt(folder / "apt", f"{release} {suite}", ())
        target = ["-t", suite]
    except debian.DebianError:  # a release that is new enough has no backports yet
        shutil.rmtree(folder / "apt", ignore_errors=True)
        environ = debian.private_apt(folder / "apt", release, ())
        target = []
    # Packages that the computer already has need not be downloaded again.
    shutil.copyfile("/var/lib/dpkg/status", folder / "apt" / "state" / "status")
    debian.run(
        ["apt-get", "-y", "-qq", "install", *target, "--download-only", "--no-install-recommends", *PACKAGES], environ
    )
    for package in sorted((folder / "apt" / "cache" / "archives").glob("*.deb")):
        debian.run(["dpkg-deb", "-x", str(package), str(folder / "root")])
    shutil.rmtree(folder / "apt")
    (folder / "done").write_text("\n".join(PACKAGES) + "\n", encoding="utf-8")
