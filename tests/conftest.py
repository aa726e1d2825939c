"""How the suite is run: how many workers, which files first, and what is skipped where no image can be built."""

import gc
import os
import shutil
import sys

import pytest

# The matrices are small: threads inside the linear algebra cost several times what they bring. Before numpy is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Folders whose files take long, a minute some. They come first, so that no worker is left alone with one of them.
LONG = ("recipes", "end_to_end", "chip", "firmware")


def pytest_xdist_auto_num_workers(config):
    """Two workers more than cores: many tests wait for a process, a port or real time, and others compute meanwhile."""
    return int(os.environ.get("PYTEST_XDIST_AUTO_NUM_WORKERS", 2 + (os.cpu_count() or 1)))


def pytest_collection_modifyitems(items):
    items.sort(key=folder_rank)
    skip_chip_level_without_apt(items)


def pytest_collection_finish():
    """Keep what is imported out of every later garbage collection: the firmware asks for one whenever it starts."""
    gc.collect()
    gc.freeze()


def folder_rank(item):
    folder = item.nodeid.split("/")[1]
    return LONG.index(folder) if folder in LONG else len(LONG)


def skip_chip_level_without_apt(items):
    """Where there is no apt no image can be built: said, and skipped. Anywhere else a missing image is an error of the test."""
    if sys.platform == "linux" and shutil.which("apt-get") is not None:
        return
    for item in items:
        parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
        if "tests/chip/" in item.nodeid or "chip" in parameters:
            item.add_marker(pytest.mark.skip(reason="the box's image is built of Debian's packages"))
