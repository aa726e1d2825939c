"""What truearm states about a result, by code."""

from truearm.report.result_findings import result_findings


def stated(document):
    """The findings of a result by code; of several with one code the last."""
    return {finding.code: finding for finding in result_findings(document)}
