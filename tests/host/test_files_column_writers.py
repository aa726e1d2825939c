"""CSV tables: numbers are read back bit for bit; NaN is an empty cell."""

import csv
import io
import tracemalloc

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from truearm.workflows.session_files import ArrowTable

floats = arrays(np.float64, 5, elements=st.floats(width=64))
whole = arrays(np.int64, 5, elements=st.integers(-(2**63), 2**63 - 1))


def written(path, *batches):
    table = ArrowTable(path, batches[0])
    for batch in batches:
        table.write(batch)
    table.close()
    header, *rows = csv.reader(io.StringIO(path.read_text(encoding="utf-8"), newline=""))
    assert header == list(batches[0])
    assert table.rows == len(rows)
    return list(zip(*rows, strict=True))


@settings(max_examples=30)
@example(x=np.array([0.0, -0.0, -0.0, 0.0, -0.0]), n=np.zeros(5, dtype=np.int64), text=[""] * 5)
@given(x=floats, n=whole, text=st.lists(st.text('a,"é\n ', max_size=5), min_size=5, max_size=5))
def test_bit_for_bit(tmp_path_factory, x, n, text):
    """Numbers alone go another way than numbers beside text; infinities and the empty batch too."""
    path = tmp_path_factory.mktemp("t") / "t.csv"
    numbers = {"x": x, "n": n}
    for columns in (numbers, {**numbers, "text": np.array(text, dtype=np.str_)}):
        cells = written(path, columns, {title: column[:0] for title, column in columns.items()}, columns)
        read = np.array([np.nan if cell == "" else float(cell) for cell in cells[0]])
        np.testing.assert_array_equal(
            read.view(np.int64)[~np.isnan(read)], np.tile(x, 2).view(np.int64)[~np.isnan(read)]
        )
        np.testing.assert_array_equal(np.isnan(read), np.isnan(np.tile(x, 2)))
        assert [int(cell) for cell in cells[1]] == np.tile(n, 2).tolist()


def test_memory_of_npz_does_not_grow_with_its_rows(tmp_path):
    n, peaks = 50_000, []
    names = np.array(["bar", "gauge ä", ""])[np.arange(n) % 3]
    columns = {"x": np.arange(n) / 7.0, "name": names, "none": np.full(n, "", dtype=np.str_)}
    for batches in (4, 16):
        table = ArrowTable(tmp_path / "t.npz", columns)
        for _ in range(batches):
            table.write(columns)
        tracemalloc.start()
        table.close()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]
    with np.load(tmp_path / "t.npz") as read:
        for title, column in columns.items():
            np.testing.assert_array_equal(read[title], np.tile(column, batches))
