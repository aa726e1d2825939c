"""How the test suite runs: the number of workers, the order of files, and which tests are skipped if no image can be built."""

import gc
import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

from truearm_sim import micropython

# The matrices are small: threads inside the linear algebra cost several times what they gain. Set before numpy is
# imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Under nohup or in the background of a script, signals are ignored, and so they are in all processes of the tests.
for number in (signal.SIGHUP, signal.SIGINT) if os.name == "posix" else ():
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
# A busy machine is no failure: what is fast enough is measured in bench/.
settings.register_profile("no deadline", settings(), deadline=None)
settings.load_profile("no deadline")
# Folders with long files, about a minute each, and other long files. They run first, so that no worker is left alone with
# one at the end.
LONG = ("recipes/", "end_to_end/", "chip/", "firmware/", "host/test_wrong_inputs.py", "test_architecture.py")


def pytest_xdist_auto_num_workers(config):
    """Use two workers more than cores: many tests wait for a process, a port or real time while others compute."""
    return int(os.environ.get("PYTEST_XDIST_AUTO_NUM_WORKERS", 2 + (os.cpu_count() or 1)))


def pytest_collection_modifyitems(items):
    items.sort(key=rank)
    if reason := left_out("chip"):
        skip_chip_level(items, reason)


def pytest_collection_finish():
    """Exclude imported objects from all later garbage collections: the firmware requests one whenever it starts."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def printed(capsys):
    """Return a function that runs a command, which must succeed, and returns what it prints."""
    from truearm.cli.main import main

    def call(*arguments):
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        assert code == 0, err
        return out

    return call


def rank(item):
    path = item.nodeid.removeprefix("tests/")
    return next((place for place, name in enumerate(LONG) if path.startswith(name)), len(LONG))


def pytest_configure():
    """Skip whatever asks for a MicroPython, if make could not get one."""
    if reason := left_out("micropython"):
        micropython.find = lambda *_, **__: pytest.skip(reason)


def left_out(name):
    """Return why make could not fetch what these tests need, or nothing."""
    path = Path(__file__).parents[1] / "build" / "left-out" / name
    return path.read_text().strip() if path.exists() else ""


def skip_chip_level(items, reason):
    """Skip the tests that need the image or the emulator. A missing image that could be built is an error of the test."""
    for item in items:
        parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
        if "tests/chip/" in item.nodeid or "chip" in parameters:
            item.add_marker(pytest.mark.skip(reason=reason))
