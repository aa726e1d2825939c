"""What truearm states, by code."""

from truearm.report.result_findings import result_findings


def listed(document):
    """The values of the findings of a JSON document by code; of several with one code the last."""
    return {entry["code"]: entry["values"] for entry in document["findings"]}


def stated(document):
    """The findings of a result by code; of several with one code the last."""
    return {finding.code: finding for finding in result_findings(document)}
