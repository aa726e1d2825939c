"""Find KiCad 9 and ngspice, or download them from the Debian release's backports without installing and without root.

The packages go into build/kicad of the checkout. Only packages missing on this computer are downloaded; other
dependencies must be installed, according to apt. The download is about 120 MB, unpacked to 800 MB, once.

    python -m hardware get
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "hil_sim"))  # it need not be installed

from truearm_sim import debian  # noqa: E402

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
    environ = {**debian.environment(folder), "OMP_NUM_THREADS": "1", "LC_ALL": "C.UTF-8"}
    fetched = debian.is_fetched(folder, PACKAGES)
    if fetched:
        home = folder / "home"
        home.mkdir(exist_ok=True)
        environ |= {
            "KICAD_STOCK_DATA_HOME": str(usr / "share" / "kicad"),
            "KICAD9_SYMBOL_DIR": str(usr / "share" / "kicad" / "symbols"),
            "KICAD9_FOOTPRINT_DIR": str(usr / "share" / "kicad" / "footprints"),
            "SPICE_LIB_DIR": str(usr / "share" / "ngspice"),
            "SPICE_SCRIPTS": str(usr / "share" / "ngspice" / "scripts"),
            "HOME": str(home),
            "XDG_CONFIG_HOME": str(home),
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


def get(folder: Path = HOME, say: Callable[[str], None] = print) -> Tools:
    """Download missing tools. Raises NoTools if there is no apt or no such release."""
    try:
        return find(folder)
    except NoTools:
        pass
    try:
        debian.fetch(folder, PACKAGES, say, backports=True)
    except (debian.DebianError, OSError) as error:
        raise NoTools(str(error)) from error
    return find(folder)
