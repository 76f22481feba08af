"""Reading of actuator sweeps: their content, and the errors for recordings that are not a usable sweep."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ballu_mjx.ballu.leg_residuals import leg_data
from ballu_mjx.ballu.recordings import make_recording
from ballu_mjx.ballu.sweep import read_sweep
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.registry import load_robot

PATH = Path("sweep.csv")


def exponential_sweep(
    levels: np.ndarray, hold: float = 1.0, rate: float = 100.0, settle: float = 0.05, robot: str = "robot"
) -> Recording:
    """Return a sweep whose motor angles (rad) approach 0.5 + command exponentially, and knees the same plus 0.1."""
    count = round(hold * rate)
    time = np.arange(len(levels) * count) / rate
    command = np.repeat(levels, count, axis=0)
    since = np.tile(np.arange(count) / rate, len(levels))[:, None]
    before = np.repeat(np.concatenate([levels[:1], levels[:-1]]), count, axis=0)
    angle = 0.5 + command + (before - command) * np.exp(-since / settle)
    return make_recording(
        name="sweep", kind="suspended", robot=robot, time=time, command=command, motor=angle, knee=angle + 0.1,
    )  # fmt: skip


def both_legs(count: int = 20) -> np.ndarray:
    return np.repeat(np.linspace(0, 1, count)[:, None], 2, axis=1)


def test_sweep_has_holds_settled_angles_and_motion() -> None:
    sweep = read_sweep({PATH: exponential_sweep(both_legs())})
    assert sweep.command == pytest.approx(both_legs())
    assert sweep.settled[:, 0] == pytest.approx(0.5 + both_legs(), abs=1e-4)
    assert sweep.settled[:, 1] == pytest.approx(0.6 + both_legs(), abs=1e-4)
    assert sweep.drift == pytest.approx(0, abs=1e-4)
    assert sweep.means(sweep.motion) == pytest.approx(sweep.settled, abs=1e-4)
    # Each hold begins at the settled angle of the previous hold and ends at its settled angle.
    first = np.flatnonzero(np.diff(sweep.hold, prepend=-1))
    assert sweep.motion[first[1:]] == pytest.approx(sweep.settled[:-1], abs=1e-4)
    assert sweep.motion[first[1:] - 1] == pytest.approx(sweep.settled[:-1], abs=1e-4)
    assert sweep.motion[first[1:] + 20, 0] == pytest.approx(0.5 + both_legs()[1:] - np.exp(-4) / 19, abs=1e-3)


def test_clock_jitter_and_origin_do_not_change_the_sweep() -> None:
    steady = exponential_sweep(both_legs(), rate=200.0)
    rng = np.random.default_rng(0)
    kept = np.sort(rng.choice(len(steady.time), round(0.7 * len(steady.time)), replace=False))
    angles = {joint: angle[kept] for joint, angle in steady.joint_angles.items()}
    time, command = steady.time[kept] + 1234.5, steady.command[kept]
    jittered = dataclasses.replace(steady, time=time, command=command, joint_angles=angles)
    expected, sweep = read_sweep({PATH: steady}), read_sweep({PATH: jittered})
    assert sweep.settled == pytest.approx(expected.settled, abs=1e-3)
    length = min(len(sweep.motion), len(expected.motion))
    # Samples dropped at a change of command move the change by 5 ms each. A step of 0.053 rad decays in 50 ms.
    assert sweep.motion[:length] == pytest.approx(expected.motion[:length], abs=0.02)


def test_commands_that_change_between_two_samples_of_the_motion_have_their_effect_in_time() -> None:
    recording = exponential_sweep(both_legs(), hold=1.003, rate=1000.0)
    after_rest = leg_data(read_sweep({PATH: recording}))
    given = after_rest.commanded[0, after_rest.counts]
    exact = np.cumsum(recording.command[:, 0])[9::10] / 1000  # integral up to each time but the first
    assert np.cumsum(given)[: len(exact)] * 0.01 == pytest.approx(exact, abs=1e-6)


def test_legs_swept_one_after_the_other_make_one_sweep() -> None:
    up, zero = np.linspace(0, 1, 20), np.zeros(20)
    left, right = exponential_sweep(np.stack([up, zero], 1)), exponential_sweep(np.stack([zero, up], 1))
    sweep = read_sweep({Path("left.csv"): left, Path("right.csv"): right})
    assert len(sweep.command) == 40
    assert sweep.hold[np.flatnonzero(sweep.begins)].tolist() == [0, 20], "each recording must begin a new motion"
    assert sweep.settled[19, 0] == pytest.approx([1.5, 0.5], abs=1e-4)


def test_drift_measures_the_creep_of_joints() -> None:
    sweep = read_sweep({PATH: exponential_sweep(both_legs(), hold=1.5, settle=0.4)})
    # Difference of the means of exp(-t / 0.4 s) over the halves of the last 0.5 s, for a step of 1/19 rad.
    expected = (1 / 19) * 0.4 * (np.exp(-2.5) - 2 * np.exp(-3.125) + np.exp(-3.75)) / 0.25
    assert sweep.drift[1:] == pytest.approx(expected, rel=0.05)
    assert sweep.drift[0] == pytest.approx(0, abs=1e-9)


def test_slow_creep_is_accepted_and_reported() -> None:
    assert read_sweep({PATH: exponential_sweep(both_legs())}).creep is None
    recording = exponential_sweep(both_legs(), hold=2.0)
    since = np.arange(len(recording.time)) % 200 / 100
    creeping = np.where(recording.command[:, 0] > 0.99, np.deg2rad(3.2) * (since - 2.0), 0.0)
    knee = recording.joint_angles["knee_right"] + creeping  # drift of 0.8 deg between the halves of the last 0.5 s
    angles = {**recording.joint_angles, "knee_right": knee}
    sweep = read_sweep({PATH: dataclasses.replace(recording, joint_angles=angles)})
    assert np.rad2deg(sweep.drift[-1, 1, 1]) == pytest.approx(0.8, abs=0.02)
    assert sweep.creep is not None
    assert sweep.creep.startswith("1 of 20 holds end with a joint that still creeps, by up to 0.8 deg (knee_right)")


def test_settled_without_leaves_out_holds_and_motion() -> None:
    sweep = read_sweep({PATH: exponential_sweep(both_legs())})
    shorter = sweep.settled_without([3])
    assert len(shorter.command) == 19
    assert shorter.command == pytest.approx(np.delete(both_legs(), 3, axis=0))
    assert shorter.settled == pytest.approx(np.delete(sweep.settled, 3, axis=0))
    assert len(shorter.motion) == 0


@pytest.mark.parametrize(
    ("recording", "message"),
    [
        (exponential_sweep(both_legs(12)), "12 levels of command_left; 20"),
        (exponential_sweep(np.stack([np.linspace(0, 1, 20), np.zeros(20)], 1)), "the right leg was not swept"),
        (exponential_sweep(0.6 * both_legs()), "spread the levels over"),
        (exponential_sweep(both_legs(), hold=0.3), "held for 0.29 s only"),
        (exponential_sweep(np.random.default_rng(0).permutation(both_legs()), settle=1.0), "still moves by"),
        (dataclasses.replace(exponential_sweep(both_legs()), kind="free"), "is a free recording"),
    ],
)  # fmt: skip
def test_unusable_sweeps_are_refused(recording: Recording, message: str) -> None:
    with pytest.raises(InputError, match="sweep.csv") as refusal:
        read_sweep({PATH: recording})
    assert message in str(refusal.value)


def test_fewer_levels_are_accepted_on_request() -> None:
    assert len(read_sweep({PATH: exponential_sweep(both_legs(12))}, levels=12).command) == 12


def test_recordings_of_two_robots_are_refused() -> None:
    with pytest.raises(InputError, match="several robots"):
        read_sweep(
            {PATH: exponential_sweep(both_legs()), Path("other.csv"): exponential_sweep(both_legs(), robot="other")}
        )


def test_bundled_sweep_holds_twenty_commands_for_both_legs() -> None:
    sweep = read_sweep({path: read_recording(path, load_robot()) for path in list_bundled("suspended")})
    assert sweep.command == pytest.approx(both_legs(), abs=1e-4)
    assert np.all(np.diff(sweep.settled[:, 0], axis=0) > 0), "motor angles must increase with the command"
