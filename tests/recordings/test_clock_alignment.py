"""Tests of the alignment of two clocks: known offsets are recovered, and ambiguous offsets have a low confidence."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ballu_mjx.ballu import gaits
from ballu_mjx.ballu.leg_alignment import measured_response, nominal_response
from ballu_mjx.ballu.model import CONTROL_TIMESTEP
from ballu_mjx.cli.record import LEAST_CONFIDENCE
from ballu_mjx.recordings.clock_alignment import align
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.registry import load_robot


def wave(time: np.ndarray) -> np.ndarray:
    """Return signals of two legs whose sum does not repeat itself."""
    left = np.sin(3.1 * time) + np.sin(np.sqrt(29) * time)
    return np.stack([left, 3 * np.cos(np.sqrt(17) * time) + np.sin(7 * time)], axis=1)


@settings(max_examples=40, deadline=None)
@given(offset=st.floats(-1e4, 1e4), sign=st.sampled_from([1, -1]), seed=st.integers(0, 1000), jitter=st.booleans())
def test_known_offsets_are_recovered_between_grid_points(offset: float, sign: int, seed: int, jitter: bool):
    """The error stays below a tenth of a control step. The signals differ in clock, rate, unit and sign, and have noise
    and drop-outs."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.005, 0.015, 2500) if jitter else np.full(2500, 0.01))
    motion = sign * 0.02 * wave(time) + 0.002 * rng.standard_normal((len(time), 2)) + 0.7
    motion[300:330, 0] = motion[900:1000] = np.nan
    log = np.arange(4.0, 20.0, 0.02)
    found = align(time, motion, log - offset, wave(log))
    assert found is not None
    assert found.best.offset == pytest.approx(offset, abs=CONTROL_TIMESTEP / 10)
    assert np.sign(found.best.correlation) == sign and abs(found.best.correlation) > 0.95
    assert found.confidence > 0.8


def test_periodic_signals_have_low_confidence_unless_the_range_is_narrow():
    """A sine wave fits at every period. A narrower search range makes the offset unique."""
    time, log = np.arange(0, 20, 0.01), np.arange(2, 14, 0.05)

    def legs(t: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(2 * np.pi * t / 1.3), np.cos(2 * np.pi * t / 1.3)], axis=1)

    found = align(time, legs(time), log - 5.0, legs(log))
    assert found is not None and found.second is not None
    assert found.confidence < 0.05
    apart = (found.best.offset - found.second.offset) / 1.3
    assert apart == pytest.approx(round(apart), abs=0.02)
    narrow = align(time, legs(time), log - 5.0, legs(log), within=(4.5, 5.5))
    assert narrow is not None and narrow.best.offset == pytest.approx(5.0, abs=0.003) and narrow.second is None


def test_leg_at_rest_does_not_affect_the_offset():
    time = np.arange(0, 15, 0.01)
    motion = wave(time)
    motion[:, 1] = 1e-6 * np.random.default_rng(0).standard_normal(len(time))
    predicted = wave(time) * [1.0, 0.0]
    found = align(time, motion, time + 3.0, predicted)
    assert found is not None and found.best.offset == pytest.approx(-3.0, abs=0.005)
    assert found.best.correlation > 0.95


def test_signals_at_rest_or_with_little_overlap_give_no_offset():
    time = np.arange(0, 10, 0.01)
    assert align(time, np.ones((len(time), 2)), time, wave(time)) is None
    assert align(time, wave(time), time, np.zeros((len(time), 2))) is None
    assert align(time, np.full((len(time), 2), np.nan), time, wave(time)) is None
    assert align(time, wave(time), time, wave(time), within=(9.0, 11.0)) is None


@functools.cache
def telegraph() -> Recording:
    """Return a recording of 25 s with random steps of the commands, and with motion capture only."""
    (path,) = [path for path in list_bundled("test") if path.name.startswith("far-1")]
    return read_recording(path, load_robot())


@pytest.mark.parametrize("offset", [0.0, -37.123, 1234.567])
def test_command_log_is_aligned_by_the_leg_motion(offset: float):
    """The remaining error, from delay of the servos and of the estimate, does not depend on the offset. The command
    states an error of at most 0.05 s for nine in ten recordings."""
    recording = telegraph()
    rows = slice(200, 2200)
    motion = measured_response(recording)
    assert motion is not None
    log = recording.time[::5] - offset
    grid, legs = nominal_response(log, recording.command[::5], "free", knees=False)
    found = align(recording.time[rows], motion[rows], grid, legs)
    assert found is not None and found.confidence > 0.7
    assert 0.0 <= found.best.offset - offset <= 0.05 + 0.05
    again = align(recording.time[rows], motion[rows], grid + 0.0213, legs)
    assert again is not None
    assert found.best.offset - again.best.offset == pytest.approx(0.0213, abs=0.002)


def test_section_of_steady_walking_is_ambiguous():
    (path,) = [path for path in list_bundled("test") if path.name.startswith("near-1")]
    recording = read_recording(path, load_robot())
    motion = measured_response(recording)
    assert motion is not None
    grid, legs = nominal_response(recording.time, recording.command, "free", knees=False)
    found = align(recording.time[500:1700], motion[500:1700], grid, legs)
    assert found is not None and found.second is not None
    assert found.confidence < LEAST_CONFIDENCE
    period = 1.2
    apart = (found.best.offset - found.second.offset) / period
    assert apart == pytest.approx(round(apart), abs=0.1)


def test_sweep_is_aligned_by_knee_angles_within_a_tenth_of_a_second():
    (path,) = list_bundled("suspended")
    recording = read_recording(path, load_robot())
    motion = measured_response(recording)
    assert motion is not None and np.array_equal(motion[:, 0], recording.joint_angles["knee_left"])
    grid, legs = nominal_response(recording.time, recording.command, "suspended", knees=True)
    found = align(recording.time, motion, grid, legs, within=(-1.0, 1.0))
    assert found is not None and found.best.correlation > 0.9
    assert 0.0 < found.best.offset < 0.1


def test_gaits_have_the_requested_length_and_valid_range():
    for name, gait in gaits.GAITS.items():
        commands = gait(7.0)
        assert commands.shape == (140, 2), name
        assert commands.min() >= 0 and commands.max() <= 1 and np.ptp(commands) > 0.5, name
