"""Arrays kept on the disk are those that were added, and a full disk is one clear error."""

from pathlib import Path

import numpy as np
import pytest

from truearm.errors import SessionError
from truearm.session import samples as spool_module
from truearm.session.samples import Spool


@pytest.mark.parametrize("in_memory_bytes", [1, 1 << 20])
def test_arrays_are_those_that_were_added(monkeypatch, in_memory_bytes):
    monkeypatch.setattr(spool_module, "IN_MEMORY_BYTES", in_memory_bytes)
    rng, spool = np.random.default_rng(1), Spool()
    added = [(rng.random((k, 2)), rng.integers(0, 9, k).astype(np.int32)[::2], rng.random(k) < 0.5) for k in range(5)]
    for k, arrays in enumerate(added):
        spool.append(arrays, (0, k, k + 1))
    assert [span for _, *span in spool.spans] == [[k, k + 1] for k in range(5)]
    for k in (4, 0, 3, 3, 1, 2):
        for array, expected in zip(spool.load(k), added[k], strict=True):
            assert array.dtype == expected.dtype
            np.testing.assert_array_equal(array, expected)


@pytest.mark.skipif(not Path("/dev/full").is_char_device(), reason="needs Linux's full disk")
def test_a_full_disk_says_what_to_do(monkeypatch):
    monkeypatch.setattr(
        spool_module.tempfile, "SpooledTemporaryFile", lambda **_: open("/dev/full", "w+b", buffering=0)
    )
    with pytest.raises(SessionError, match="TMPDIR"):
        Spool().append([np.zeros(9)], (0, 0, 1))
