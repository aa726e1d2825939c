"""Errors by code and values, which tests ask for instead of sentences."""

from contextlib import contextmanager

import pytest

from truearm.errors import TruearmError


@contextmanager
def refused(code, *words, **values):
    """Expect an error with this code, these words in its values, and these values: equal, or part of a text."""
    with pytest.raises(TruearmError) as caught:
        yield caught
    check(caught.value.finding, code, *words, **values)


def check(finding, code, *words, **values):
    """Check a finding as ``refused`` checks that of an error."""
    assert finding is not None
    assert finding.code == code, finding
    shown = "\n".join(map(str, finding.values.values()))
    assert [word for word in words if str(word) not in shown] == [], finding
    for name, value in values.items():
        actual = finding.values[name]
        assert value == actual or (isinstance(actual, str) and str(value) in actual), finding
