"""An arm with only a pendant: joints noted pose by pose, and rests detected from the sensor."""

import json
from itertools import chain

import numpy as np
import pytest
from session_stream import RIG, session, stream_of

from truearm.session.observations import observations, survey
from truearm.types import Message


@pytest.fixture(scope="module")
def recorded():
    """Return ten dwells of 4 s without a robot, and the plan."""
    messages, truth = session(np.random.default_rng(6), dwells=10, rest_s=4.0)
    return [m for m in messages if m.topic != "/robot/joints"], truth


def noted(truth, at, shift=0.0):
    """Return readings as inserted by ``add-joints``: at a share of each rest, rounded to 0.01°."""
    lines = []
    for q, start, end in zip(truth.q, truth.start_ns, truth.end_ns, strict=True):
        t_ns = round(start + at * (end - start) + 1e9 * shift)
        rounded = np.deg2rad(np.round(np.rad2deg(q), 2)).tolist()
        lines.append(
            Message("/robot/joints", t_ns, json.dumps({"t": 1e-9 * t_ns, "q": rounded, "arrival": False}).encode())
        )
    return lines


def synced(*parts):
    return observations(survey(stream_of(sorted(chain(*parts), key=lambda m: m.t_host_ns))), RIG)


def test_each_note_is_of_the_rest_in_which_it_was_taken(recorded):
    messages, truth = recorded
    result = synced(messages, noted(truth, 0.6))
    assert result.reasons == {}
    assert np.allclose(result.table.q, truth.q, rtol=0.0, atol=np.deg2rad(0.005) + 1e-12)
    error = result.table.value - truth.length
    assert np.all(np.abs(error) < 5.0 * np.sqrt([dwell.value_var for dwell in result.dwells]))
    assert (
        min(dwell.n_samples for dwell in result.dwells) > 3000
    )  # of the 4068 samples of a rest, not of the note's moment


def test_notes_on_the_way_alone_or_without_a_sensor(recorded):
    messages, truth = recorded
    result = synced(messages, noted(truth, 1.0, shift=0.35)[:9])  # after the last rest nothing moves
    assert result.reasons == {"still moving": 9}
    assert result.dwells[0].detail
    messages, truth = recorded
    assert len(synced(messages, noted(truth, 0.5)[4:5]).table) == 1
    messages, truth = recorded
    without = [m for m in messages if m.topic != "/box/adc"]
    assert synced(without, noted(truth, 0.5)).reasons == {"still moving": 10}
    unclocked = [m for m in messages if m.topic not in ("/sync", "/box/sync")]
    assert len(synced(unclocked, noted(truth, 0.5)).table) == 0


def test_two_poses_in_one_rest_are_ambiguous_the_same_twice_is_one(recorded):
    messages, truth = recorded
    twice = noted(truth, 0.3)[:3] + noted(truth, 0.6)
    assert len(synced(messages, twice).table) == 10
    other = noted(truth, 0.3)[2]
    q = json.loads(other.data)
    moved = other._replace(data=json.dumps({**q, "q": [q["q"][0] + 0.1, *q["q"][1:]]}).encode())
    result = synced(messages, [moved], noted(truth, 0.6))
    assert result.reasons == {"ambiguous": 2}
    assert len(result.table) == 9
