"""Which files may be overwritten."""

import errno
import os

import pytest
from tests.refusals import refused

from truearm.disk import check_writable, own_folder, same_file, write_atomic
from truearm.errors import ExitCode, InputError, WriteError


def test_inputs_and_files_of_others_are_never_outputs(tmp_path):
    data = tmp_path / "data.csv"
    data.write_text("x")
    (tmp_path / "link.csv").symlink_to(data)
    os.link(data, tmp_path / "hard.csv")
    for name in ("data.csv", "link.csv", "hard.csv", "../" + tmp_path.name + "/data.csv"):
        with refused("given-twice"):
            check_writable(tmp_path / name, inputs=[data])
    assert same_file(tmp_path / "new.csv", tmp_path / "." / "new.csv"), "neither exists, both would be one file"
    check_writable(tmp_path / "other.csv", inputs=[data])
    (tmp_path / "theirs").write_text('[[bar]]\nname = "b46"')
    (tmp_path / "ours").write_text("pose,shell")
    (tmp_path / "empty").write_text("\n")
    with refused("file-exists"):
        check_writable(tmp_path / "theirs", kind="plan")
    for name in ("ours", "empty", "new"):
        check_writable(tmp_path / name, kind="plan")
    with pytest.raises(InputError, match="cannot be written: File name too long"):
        check_writable(tmp_path / ("a" * 300))


def test_devices_and_links_stay_what_they_are(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    for attempt in (check_writable, lambda path: write_atomic(path, "x")):
        with refused("unreadable-file"):
            attempt(tmp_path / "fifo")
    assert not (tmp_path / "fifo").is_file()
    (tmp_path / "file").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    write_atomic(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_text() == "new"


def test_a_folder_of_others_is_not_written_into(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("years of work")
    with refused("file-exists"):
        own_folder(tmp_path / "full", ".mark")
    with pytest.raises(InputError, match="cannot be used"):
        own_folder(tmp_path / "full" / "thesis.tex", ".mark")
    own_folder(tmp_path / "a" / "new", ".mark")
    (tmp_path / "a" / "new" / "report.html").write_text("first run")
    own_folder(tmp_path / "a" / "new", ".mark")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_a_disk_that_fails_is_no_wrong_input(tmp_path, monkeypatch, number):
    (tmp_path / "result.json").write_text("old")

    def fails(descriptor):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises(WriteError, match=f"result.json: cannot be written: {os.strerror(number)}") as caught:
        write_atomic(tmp_path / "result.json", "new")
    assert caught.value.exit_code == ExitCode.FAILED
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]
