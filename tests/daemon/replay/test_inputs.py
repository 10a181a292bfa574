"""Inputs of the estimator as text: back to the last bit, and damaged bytes are our error."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ceilvo.calibration import CeilingShape
from ceilvo.daemon.replay.inputs import (
    FrameInput,
    Input,
    LoadMap,
    Reset,
    SetPose,
    Silence,
    check_plausible,
    input_json,
    read_input,
)
from ceilvo.errors import FileFormatError
from ceilvo.senses.heard import NOTHING, Heard, Turn
from ceilvo.types import Frame, Landmarks, Pose, WheelMotion

floats = st.floats(allow_nan=False, allow_infinity=False)
poses, covs = arrays(np.float64, 3, elements=floats), arrays(np.float64, (3, 3), elements=floats)
wheels = st.none() | st.builds(WheelMotion, poses, covs)
counts = st.integers(0, 2**62)
gained = st.none() | arrays(np.float64, 2, elements=floats)
heard = st.just(NOTHING) | st.builds(Heard, st.none() | st.builds(Turn, floats, floats, floats, floats, gained))
texts = st.text(max_size=30)


@st.composite
def landmarks(draw: st.DrawFn) -> Landmarks:
    n = draw(st.integers(0, 4))
    ints = arrays(np.int64, n, elements=st.integers(-(2**62), 2**62))
    xy, cov = arrays(np.float64, (n, 2), elements=floats), arrays(np.float64, (n, 2, 2), elements=floats)
    return Landmarks(draw(ints), draw(xy), draw(cov), draw(ints), draw(ints))


frames = st.builds(Frame, counts, counts, st.just(np.zeros((0, 0), np.uint8)))
inputs = st.one_of(
    st.builds(FrameInput, frames, wheels, heard),
    st.builds(Silence, counts, texts, wheels, heard),
    st.builds(
        LoadMap,
        landmarks(),
        floats,
        poses,
        covs,
        floats | st.just(math.inf),
        floats,
        ceiling=st.builds(
            CeilingShape, st.lists(floats, max_size=3).map(tuple), st.just(()) | st.tuples(*[floats] * 3)
        ),
    ),
    st.builds(SetPose, poses, covs, texts),
    st.builds(Reset, st.booleans()),
)


@given(inputs, counts)
def test_inputs_come_back_to_the_last_bit(given: Input, number: int) -> None:
    data = input_json(given, number)
    again_number, again = read_input(data, lambda seq, stamp: Frame(seq, stamp, np.zeros((0, 0), np.uint8)))
    assert again_number == number and type(again) is type(given)
    assert flat(again) == flat(given)


def flat(value: object) -> object:
    """Nested tuples that compare by bits."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if hasattr(value, "__slots__"):
        return tuple(flat(getattr(value, name)) for name in value.__slots__)
    return repr(value)


@pytest.mark.parametrize(
    ("turn", "says"),
    [
        (Turn(np.nan, 0.0, 0.1), "not finite"),
        (Turn(0.1, -1.0, 0.1), "below 0"),
        (Turn(0.1, 0.0, 0.1, 0.0, np.zeros(3)), "gained_mps has the shape"),
        (Turn(0.1, 0.0, 0.1, 0.0, np.zeros(2)), ""),
    ],
)
def test_a_turn_that_no_gyro_says_is_damage(turn: Turn, says: str) -> None:
    given_ = Silence(1, "dark", None, Heard(turn))
    if not says:
        check_plausible(given_)
        return
    with pytest.raises(FileFormatError, match=says):
        check_plausible(given_)


@given(st.binary(max_size=80) | st.text(max_size=80).map(str.encode) | inputs.map(lambda g: input_json(g, 0)[:-9]))
def test_any_bytes_are_an_input_or_our_error(data: bytes) -> None:
    try:
        read_input(data, lambda seq, stamp: Frame(seq, stamp, np.zeros((0, 0), np.uint8)))
    except FileFormatError as e:
        assert "damaged" in str(e)


@given(landmarks())
def test_a_map_of_an_older_recording_has_not_counted_expectations(m: Landmarks) -> None:
    body = json.loads(input_json(LoadMap(m, 0.0, Pose(np.zeros(3)), np.eye(3)), 0))
    del body["landmarks"]["expected"]
    _, again = read_input(json.dumps(body).encode(), lambda seq, stamp: Frame(seq, stamp, np.zeros((0, 0), np.uint8)))
    assert isinstance(again, LoadMap)
    assert again.landmarks.expected.tolist() == m.sightings.tolist()


def test_a_stored_pose_of_an_older_recording_was_not_doubted_more_than_by_itself() -> None:
    none = Landmarks(*(np.zeros((0, *shape)) for shape in ((), (2,), (2, 2), (), ())))
    body = json.loads(input_json(LoadMap(none, 0.0, Pose(np.zeros(3)), np.eye(3), 7.0, 0.9), 0))
    assert body.pop("ago_s") == 7.0 and body.pop("elsewhere") == 0.9
    _, again = read_input(json.dumps(body).encode(), lambda seq, stamp: Frame(seq, stamp, np.zeros((0, 0), np.uint8)))
    assert isinstance(again, LoadMap)
    assert (again.ago_s, again.elsewhere) == (math.inf, 0.0)
    body["recent"] = True
    _, again = read_input(json.dumps(body).encode(), lambda seq, stamp: Frame(seq, stamp, np.zeros((0, 0), np.uint8)))
    assert isinstance(again, LoadMap) and again.ago_s == 60.0
