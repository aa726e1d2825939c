"""Packages of a Debian suite other than the computer's, without installing anything and without root.

The computer's own ``apt`` works in a private directory, with the computer's package sources under another suite name
and its keyrings, proxies and credentials. No system file is written. Apt verifies downloads as usual. No host name is
fixed here: the sources are those of the computer.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

# Names that a Debian computer's sources use for their own release, in addition to its code name.
SUITE_ALIASES = frozenset({"oldstable", "stable", "testing", "unstable", "sid"})
# What apt on this computer needs to reach its sources; nothing that would weaken the verification of signatures.
ACQUIRE = re.compile(
    r"Acquire::(?:https?|tor\+https?|mirror)::|Acquire::(?:Check-Valid-Until|Check-Date|Force\w+|Retries) ", re.I
)
PROGRAMS = ("apt-get", "apt-config", "dpkg", "dpkg-deb")
# A mirror that is being updated serves lists that do not match their signed index. Seconds until each further attempt.
PAUSES = (5.0, 20.0, 60.0)
RENEWED = re.compile(r"unexpected size|Hash Sum mismatch|Mirror sync")


class DebianError(Exception):
    """Packages are not available here; the text is one line that states why."""


@dataclass(frozen=True)
class Source:
    """One of the computer's package sources: its URIs, its ``Signed-By`` (a file or a key block) or None."""

    uris: str
    signed_by: str | None


def missing_program() -> str | None:
    """Return the first required program that this computer lacks: not every computer runs Debian."""
    return next((program for program in PROGRAMS if shutil.which(program) is None), None)


def native_architecture() -> str:
    """Return Debian's name of the computer's architecture. Raises DebianError."""
    return run(["dpkg", "--print-architecture"]).strip()


# ---- the computer's package sources (pure)


def sources_deb822(text: str, suites: Iterable[str]) -> list[Source]:
    """Return the sources in a ``.sources`` file with the component main for one of ``suites``."""
    found = []
    for stanza in re.split(r"\n[ \t]*\n", text):
        fields = _fields(stanza)
        if (
            "deb" in fields.get("types", "").split()
            and set(suites) & set(fields.get("suites", "").split())
            and "main" in fields.get("components", "").split()
            and fields.get("enabled", "yes").lower() not in ("no", "false", "0", "off", "without", "disable")
        ):
            found.append(Source(fields.get("uris", ""), fields.get("signed-by")))
    return found


def _fields(stanza: str) -> dict[str, str]:
    """Return the fields of a deb822 stanza by lower-case name; continuation lines keep their line breaks."""
    fields: dict[str, str] = {}
    name = ""
    for line in stanza.splitlines():
        if line.startswith("#") or not line.strip():
            continue
        if line[0] in " \t":
            if name:
                fields[name] += "\n" + line
            continue
        name, _, value = line.partition(":")
        name = name.strip().lower()
        fields[name] = value.strip()
    return fields


def sources_one_line(text: str, suites: Iterable[str]) -> list[Source]:
    """Return the sources in a ``sources.list`` (``deb [options] uri suite components``); see :func:`sources_deb822`."""
    found = []
    for line in text.splitlines():
        match = re.match(r"deb\s+(?:\[([^]]*)\]\s+)?(\S+)\s+(\S+)\s+(.*)", line.partition("#")[0].strip())
        if match and match[3] in set(suites) and "main" in match[4].split():
            key = re.search(r"(?:^|\s)signed-by=(\S+)", match[1] or "", re.I)
            found.append(Source(match[2], key[1] if key else None))
    return found


def source_stanza(source: Source, suite: str, types: str = "deb") -> str:
    """Return the deb822 stanza for the same source and another suite, without ``trusted`` of an unsigned source."""
    signed_by = f"Signed-By: {source.signed_by}\n" if source.signed_by else ""
    return f"Types: {types}\nURIs: {source.uris}\nSuites: {suite}\nComponents: main\n{signed_by}"


def machine_sources(etc: Path, suites: Iterable[str]) -> list[Source]:
    """Return the computer's sources for its own release, each once; files that this user may not read are skipped."""
    found = []
    folder = etc / "sources.list.d"
    for path in [etc / "sources.list", *sorted(folder.glob("*.list")), *sorted(folder.glob("*.sources"))]:
        if path.is_file() and os.access(path, os.R_OK):
            parse = sources_deb822 if path.suffix == ".sources" else sources_one_line
            found += parse(path.read_text(encoding="utf-8", errors="replace"), suites)
    return [source for source in dict.fromkeys(found) if not source.uris.startswith("cdrom:")]


def os_release(path: Path = Path("/etc/os-release")) -> dict[str, str]:
    """Return the assignments of an os-release file, unquoted; none if there is no such file."""
    if not path.exists():
        return {}
    words = shlex.split(path.read_text(encoding="utf-8", errors="replace"), comments=True)
    return {name: value for name, sign, value in (word.partition("=") for word in words) if sign}


# ---- a private apt


def private_apt(
    folder: Path,
    suite: str,
    architectures: Iterable[str],
    types: str = "deb",
    pauses: Sequence[float] = PAUSES,
    updates: Iterable[str] = (),
) -> dict[str, str]:
    """Create apt's private directory for ``suite`` in ``folder`` and read the package lists.

    Returns the environment in which apt's programs use it; packages are downloaded to ``folder``/cache/archives.
    ``types`` is "deb", or "deb deb-src" to include sources; ``updates`` are further suites, from those of the
    computer's sources that have them. If the mirror is being updated, the lists are requested again after each of
    ``pauses`` (s).

    Raises:
        DebianError: this computer has no apt or no Debian source, or the lists cannot be loaded or verified.
    """
    if missing := missing_program():
        raise DebianError(f"no {missing}, which Debian has")
    suites = SUITE_ALIASES | {suite, os_release().get("VERSION_CODENAME", suite)}
    sources = machine_sources(Path("/etc/apt"), suites)
    if not sources:
        raise DebianError("no Debian package source under /etc/apt")
    stanzas = [source_stanza(source, suite, types) for source in sources]
    for name in updates:
        stanzas += [source_stanza(source, name, types) for source in machine_sources(Path("/etc/apt"), {name})]
    _write_apt(folder, stanzas, architectures)
    environ = {**os.environ, "APT_CONFIG": str(folder / "apt.conf"), "LC_ALL": "C"}
    for pause in pauses:
        try:
            run(["apt-get", "-qq", "update"], environ)
            return environ
        except DebianError as error:
            if not RENEWED.search(str(error)):
                raise
            time.sleep(pause)
    run(["apt-get", "-qq", "update"], environ)
    return environ


def _write_apt(apt: Path, stanzas: list[str], architectures: Iterable[str]) -> None:
    """Write a private apt directory: own sources, lists, cache, package database; the computer's keys, proxies."""
    for folder in ("none", "sources", "state/lists/partial", "cache/archives/partial"):
        (apt / folder).mkdir(parents=True)
    (apt / "state" / "status").touch()
    for number, stanza in enumerate(stanzas):
        (apt / "sources" / f"{number}.sources").write_text(stanza, encoding="utf-8")
    native = native_architecture()
    machine = run(["apt-config", "dump", "--format", '%f "%v";%n', "--no-empty"]).splitlines()
    lines = [line for line in machine if ACQUIRE.match(line)]
    listed = " ".join(f'"{name}";' for name in dict.fromkeys((native, *architectures)))
    # Dir::Etc remains the computer's: its trusted.gpg.d and auth.conf.d are needed, its hooks and preferences are not.
    lines += [
        f'Dir::Etc::{name} "{apt}/none";' for name in ("main", "parts", "preferences", "preferencesparts", "sourcelist")
    ]
    lines += [
        f'Dir::Etc::sourceparts "{apt}/sources";',
        f'Dir::State "{apt}/state";',
        f'Dir::State::status "{apt}/state/status";',
        f'Dir::Cache "{apt}/cache";',
        f'APT::Architecture "{native}";',
        f"APT::Architectures {{ {listed} }};",
        'APT::Install-Recommends "false";',
        'APT::Sandbox::User "root";',  # for root: the _apt user could not enter every folder that contains a checkout
        'Acquire::Languages "none";',
        'Acquire::Retries "3";',
        'APT::Update::Error-Mode "any";',  # otherwise an unreachable source is only a warning
    ]
    (apt / "apt.conf").write_text("\n".join(lines) + "\n", encoding="utf-8")


# ---- packages of this computer's release, unpacked


def fetch(folder: Path, packages: Sequence[str], say: Callable[[str], None], backports: bool = False) -> None:
    """Unpack packages of this computer's release into ``folder``/root, with the dependencies it lacks, once.

    :func:`environment` runs their programs. A dependency whose files a program searches beside itself must be named,
    since it may be installed elsewhere. ``backports``: the release's backports take precedence, where it has them.

    Raises:
        DebianError: this computer has no apt, its release has no such package, or it cannot be downloaded or verified.
    """
    if missing := missing_program():
        raise DebianError(f"no {missing}, which Debian has")
    import fcntl  # also missing where there is no apt

    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if is_fetched(folder, packages):
            return
        for name in ("apt", "root"):
            shutil.rmtree(folder / name, ignore_errors=True)
        release = os_release().get("VERSION_CODENAME", "")
        say(f"fetching {', '.join(packages)} of Debian {release}{'-backports' if backports else ''}")
        environ, target = _release_apt(folder / "apt", release, backports)
        # Dependencies that this computer has are not downloaded; the packages are, although dpkg may list them.
        shutil.copyfile("/var/lib/dpkg/status", folder / "apt" / "state" / "status")
        run(["apt-get", "-y", "-qq", "install", *target, "--reinstall", "--download-only", *packages], environ)
        for package in sorted((folder / "apt" / "cache" / "archives").glob("*.deb")):
            run(["dpkg-deb", "-x", str(package), str(folder / "root")])
        shutil.rmtree(folder / "apt")
        (folder / "done").write_text("\n".join(packages) + "\n", encoding="utf-8")


def _release_apt(folder: Path, release: str, backports: bool) -> tuple[dict[str, str], list[str]]:
    """Return the environment of a private apt for the release, and apt's option that prefers backports."""
    # What is installed may be of these, and newer than what the release itself has.
    updates = (f"{release}-updates", f"{release}-security")
    if backports:
        suite = f"{release}-backports"
        try:
            return private_apt(folder, f"{release} {suite}", (), updates=updates), ["-t", suite]
        except DebianError:  # a release that is new enough has no backports yet
            shutil.rmtree(folder)
    return private_apt(folder, release, (), updates=updates), []


def is_fetched(folder: Path, packages: Sequence[str]) -> bool:
    """Return whether :func:`fetch` unpacked these packages; a folder that an older version filled may lack some."""
    done = folder / "done"
    return done.exists() and done.read_text(encoding="utf-8").split() == list(packages)


def environment(folder: Path) -> dict[str, str]:
    """Return this process's environment, with the programs and libraries that :func:`fetch` unpacked in front."""
    root = folder / "root"
    patterns = [f"{prefix}lib/*-linux-gnu*{below}" for prefix in ("", "usr/") for below in ("", "/*")]
    libraries = [str(path) for pattern in patterns for path in sorted(root.glob(pattern)) if any(path.glob("lib*.so*"))]
    first = {"PATH": [str(root / "usr" / "bin")], "LD_LIBRARY_PATH": libraries}
    joined = {name: ":".join([*paths, *filter(None, [os.environ.get(name)])]) for name, paths in first.items()}
    return {**os.environ, **joined}


def run(command: list[str], environ: Mapping[str, str] | None = None, folder: Path | None = None) -> str:
    """Return the standard output of a command of apt or dpkg, run in ``folder``.

    Raises:
        DebianError: it failed; the text quotes apt, and is clearer if a key is missing.
    """
    done = subprocess.run(
        command, capture_output=True, text=True, errors="replace", env=environ, cwd=folder, stdin=subprocess.DEVNULL
    )
    if done.returncode == 0:
        return done.stdout
    if re.search(r"NO_PUBKEY|is not signed|Missing key|EXPKEYSIG", done.stderr):
        raise DebianError(
            "the packages cannot be verified: this machine's keyring does not know their keys; "
            "update the package debian-archive-keyring"
        )
    lines = [line for line in done.stderr.splitlines() if line.startswith("E:")] or done.stderr.splitlines()
    raise DebianError(f"'{' '.join(command)}' failed: {(lines or ['no message'])[0]}")
