"""A disk that gets full while a session is written: one line, exit code 1, and what was written stays readable.

Two kinds of small disk: a file system of its own (where the tests may mount one, or may be root of a user name space), and a limit
on the size of files, which every user can set.
"""

import os
import random
import shutil
import subprocess
import sys

import pytest
from record_files import received
from record_real import box_on_a_socket
from test_record_command import RIG, posix
from test_session import written

from truearm.session.session_file import open_session

pytestmark = posix

KIB = 40  # of the small disk; what is written before the first sample is 12 KiB, of which the rig is most
RUN = "import sys; from truearm.cli.main import main; sys.exit(main(sys.argv[1:]))"
LIMIT = f"import resource, signal; resource.setrlimit(resource.RLIMIT_FSIZE, ({KIB << 10}, {KIB << 10}))\n"


class SmallDisk:
    """Runs truearm with a small disk at ``path``; what is on it is copied to ``copy``."""

    def __init__(self, kind, path, copy):
        self.kind, self.path, self.copy = kind, path, copy
        self.temporary = path.with_name("temporary")
        self.temporary.mkdir()

    def run(self, *arguments):
        if self.kind == "limit":
            command = [sys.executable, "-c", LIMIT + RUN, *map(str, arguments)]
        else:  # the mount lives as long as the shell
            script = 'mount -t tmpfs -o size="$1" none "$2" || exit 77; disk=$2 copy=$3; shift 3; "$@"; code=$?; '
            script += 'cp -a "$disk/." "$copy"; exit $code'
            options = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script, "sh"]
            command = [*options, f"{KIB}k", self.path, self.copy, sys.executable, "-c", RUN, *map(str, arguments)]
        environment = os.environ | {"TMPDIR": str(self.temporary)}
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
        if self.kind == "limit":
            shutil.copytree(self.path, self.copy, dirs_exist_ok=True)
        if done.returncode == 77:
            pytest.skip("no file system of one's own here")
        return done


@pytest.fixture(params=["file system", "limit"])
def disk(request, tmp_path):
    if request.param == "file system" and shutil.which("unshare") is None:
        pytest.skip("needs unshare")
    path, copy = tmp_path / "disk", tmp_path / "copy"
    path.mkdir()
    copy.mkdir()
    return SmallDisk(request.param, path, copy)


def test_recording(disk, tmp_path):
    """The recorder stops, and what came until then is in the file, frame by frame."""
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG + "".join(f"# {random.Random(k).getrandbits(256):x}\n" for k in range(150)))
    with box_on_a_socket(waits=True) as (box, device):
        arguments = ["--unchecked", "--box", device, "--rig", rig, "--out", disk.path / "s.mcap", "--duration-s", "30"]
        done = disk.run("record", *arguments)
        sent = box.sent
    assert done.returncode == 4, done.stderr
    *_, said = done.stderr.splitlines()  # before it the recorder's own words of the box
    assert said.startswith("truearm: ")
    assert "cannot be written any more" in said
    assert "remain readable" in said
    assert "Traceback" not in done.stderr
    assert list(disk.temporary.iterdir()) == []  # a failed write is no other program's
    file = disk.copy / "s.mcap"
    assert file.stat().st_size <= KIB << 10
    mended = tmp_path / "recovered.mcap"
    recovered = subprocess.run(
        [sys.executable, "-c", RUN, "session", "recover", file, "--out", mended],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert recovered.returncode == 0, recovered.stderr
    assert " 0 bytes" not in recovered.stdout
    found = received(mended)
    assert len(list(open_session(mended).messages({"/box/adc"}))) > 100
    assert sent.replace(b"\0", b"").startswith(found)
    assert open_session(mended).attachments["rig.toml"] == rig.read_bytes()


def big_session(path):
    """A cut session of 100 KiB that does not compress."""
    written(path, 10)
    from record_box import Lab

    from truearm.record.session_writer import SessionWriter

    rng = random.Random(1)
    lab = Lab()
    writer = SessionWriter(path, lab, overwrite=True)
    for k in range(500):
        writer.add("/box/adc", lab.now + 10_000_000 * k, rng.randbytes(200))
    writer.close()
    path.write_bytes(path.read_bytes()[:-100])


def test_recovering(disk, tmp_path):
    """Nothing is left of the new file, and the damaged one is as it was."""
    source = tmp_path / "cut.mcap"
    big_session(source)
    before = source.read_bytes()
    done = disk.run("session", "recover", source, "--out", disk.path / "new.mcap")
    assert done.returncode == 1, done.stderr
    assert done.stderr.count("\n") == 1
    assert f"{disk.path / 'new.mcap'}: cannot be written: " in done.stderr
    assert os.listdir(disk.copy) == []
    assert source.read_bytes() == before
