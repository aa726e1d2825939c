"""Errors and findings by code and values, which tests ask for instead of sentences."""

from contextlib import contextmanager

import pytest

from truearm.cli import main as cli
from truearm.cli import output
from truearm.errors import TruearmError
from truearm.finding_texts import STATEMENTS

findings = []  # with which commands ended in this process
_complain = cli._complain


def _kept(message, finding=None, arguments=()):
    findings.append(finding)
    _complain(message, finding, arguments)


cli._complain = _kept
shown = {}  # the values of the findings by code that the last command printed in this process
_show = output.show


def _show_and_keep(printed, *arguments, **options):
    shown.clear()
    shown.update({finding.code: dict(finding.values) for finding in printed})
    _show(printed, *arguments, **options)


output.show = _show_and_keep


@contextmanager
def refused(*expected, **values):
    """Expect an error as ``check`` describes it."""
    with pytest.raises(TruearmError) as caught:
        yield caught
    check(caught.value.finding, str(caught.value), *expected, **values)


def ended(err, *expected, **values):
    """Check the error with which the last command ended in this process, and which it printed on standard error."""
    check(findings[-1], err, *expected, **values)


def check(finding, text, *expected, **values):
    """Check an error: the code or words of its text that are expected, and values: equal, or part of a text."""
    assert finding is not None, text
    for word in expected:
        assert finding.code == word if word in STATEMENTS else str(word) in text, (finding, text)
    for name, value in values.items():
        actual = finding.values[name]
        assert value == actual or (isinstance(actual, str) and str(value) in actual), finding
