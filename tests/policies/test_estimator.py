"""The estimator between motion capture and policy: current features from past frames, with noise and hidden markers."""

import copy
import subprocess
import sys
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.policies.deploy import estimator
from ballu_mjx.policies.deploy.estimator import Capture, estimate
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.observation import euler_angles
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import state_at

EULER = slice(6, 9)
NAMES = ("balloon", "base", "foot_left", "foot_right")
START = np.array([[0.1, -0.2, 1.1], [0.1, -0.2, 0.7], [0.1, -0.1, 0.0], [0.1, -0.3, 0.0]])
VELOCITY = np.array([[0.3, 0.1, -0.05], [0.2, 0.0, 0.1], [0.5, 0.0, 0.2], [0.0, 0.0, 0.0]])
TURNING = np.array([0.1, -0.2, 0.5])
"""Roll, pitch and yaw rates, rad/s."""


def moving(frames: int, euler: tuple[float, float, float] = (0.05, 0.1, 0.2)) -> Capture:
    """Return frames without noise: balloon, base and feet at constant velocities, with constant Euler angle rates."""
    capture = Capture(NAMES)
    for frame in range(frames):
        now = frame * 0.01
        angles = np.array(euler) + TURNING * now
        quaternion = Rotation.from_euler("ZYX", angles[::-1]).as_quat(scalar_first=True, canonical=True)
        capture.time.append(now)
        capture.position.append(START + VELOCITY * now)
        capture.quaternion.append(quaternion)
        capture.command.append(np.zeros(2))
    capture.command.pop()
    return capture


def expected(
    now: float, euler: tuple[float, float, float] = (0.05, 0.1, 0.2), until: float | None = None
) -> np.ndarray:
    """Return the features of `moving` at time `now` (s). With `until`, the motion stops at that time (s)."""
    position = START + VELOCITY * (now if until is None else until)
    velocity = VELOCITY if until is None else 0 * VELOCITY
    kinematics = np.concatenate([position, velocity], axis=1)
    angles = np.array(euler) + TURNING * (now if until is None else until)
    angles = np.arctan2(np.sin(angles), np.cos(angles))
    return np.concatenate([kinematics[0], angles, kinematics[1:].ravel()])


def hide(capture: Capture, frames: range) -> Capture:
    """Return a copy with all markers hidden in `frames`."""
    hidden = copy.deepcopy(capture)
    for values in (hidden.position, hidden.quaternion):
        for frame in frames:
            values[frame] = np.full_like(values[frame], np.nan)
    return hidden


def first(capture: Capture, frames: int) -> Capture:
    """Return the capture as it was after `frames` frames."""
    return Capture(
        capture.names,
        capture.time[:frames],
        capture.command[: frames - 1],
        capture.position[:frames],
        capture.quaternion[:frames],
    )


def test_constant_velocity_is_estimated_exactly():
    np.testing.assert_allclose(estimate(moving(50)), expected(0.49), atol=1e-9)


def test_euler_angles_agree_with_the_training_environment():
    """The controller, the training environment and scipy's intrinsic z-y-x angles agree."""
    for quaternion in Rotation.random(20, rng=np.random.default_rng(0)).as_quat(scalar_first=True):
        angles = estimator.euler_angles(quaternion)
        with jax.enable_x64(True):
            np.testing.assert_allclose(angles, euler_angles(jax.numpy.asarray(quaternion)), atol=1e-9)
        scipys = Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX")[::-1]
        np.testing.assert_allclose(angles, scipys, atol=1e-9)


def test_features_have_the_order_of_the_training_environment():
    """Features of `Simulator.observe` for a moving state agree with estimates from frames of the same motion."""
    model = load_model()
    simulator = Simulator(load_robot(), model=model)
    qpos = standing_qpos(model)
    qvel = np.zeros(model.nv)
    qvel[:3] = 0.3, -0.2, 0.1
    seen, _ = simulator.observe(state_at(jax.numpy.asarray(qpos), jax.numpy.asarray(qvel)))
    data = mujoco.MjData(model)
    capture = Capture(NAMES)
    for frame in range(10):
        data.qpos[:] = qpos
        data.qpos[:3] += qvel[:3] * (frame - 9) * 0.01
        mujoco.mj_forward(model, data)
        capture.time.append(frame * 0.01)
        capture.position.append(np.stack([data.site(name).xpos for name in NAMES]))
        capture.quaternion.append(data.body("balloon").xquat.copy())
    np.testing.assert_allclose(estimate(capture), seen, atol=1e-5)


@pytest.mark.parametrize("frames", range(28, 36))
def test_yaw_is_estimated_across_the_wrap_at_pi(frames: int):
    """One window has frames on both sides of pi, where quaternions also change their sign."""
    euler = (0.05, 0.1, np.pi - 0.153)
    assert abs(expected(0.27, euler)[8]) > 3.1 and abs(expected(0.35, euler)[8]) > 3.1
    assert expected(0.27, euler)[8] > 0 > expected(0.35, euler)[8]
    np.testing.assert_allclose(estimate(moving(frames, euler)), expected((frames - 1) * 0.01, euler), atol=1e-9)


@pytest.mark.parametrize(
    "hidden", [range(47, 49), range(45, 46), range(34, 49), range(48, 50), range(35, 50), range(1, 48)]
)
def test_hidden_frames_do_not_change_the_estimate_of_a_steady_motion(hidden: range):
    """Hidden are some frames in the window, all but the newest, the newest, the whole window, or nearly all frames."""
    np.testing.assert_allclose(estimate(hide(moving(50), hidden)), expected(0.49), atol=1e-9)


def test_a_marker_hidden_for_long_is_estimated_at_rest():
    """Its last motion is continued for `EXTRAPOLATION_LIMIT`. Then the estimate rests."""
    last = 0.29
    seen = estimate(hide(moving(200), range(30, 200)))
    np.testing.assert_allclose(seen, expected(1.99, until=last + estimator.EXTRAPOLATION_LIMIT), atol=1e-9)


def test_velocity_is_zero_after_a_single_frame():
    np.testing.assert_allclose(estimate(moving(1)), expected(0.0, until=0.0), atol=1e-12)
    np.testing.assert_allclose(estimate(hide(moving(5), range(1, 5))), expected(0.04, until=0.0), atol=1e-12)


@pytest.mark.parametrize(
    ("place", "name"), [(0, "balloon"), (None, "balloon's orientation"), (1, "base"), (2, "foot_left")]
)
def test_error_names_a_marker_that_was_never_seen(place: int | None, name: str):
    capture = moving(20)
    for frame in range(20):
        hidden = capture.quaternion[frame] if place is None else capture.position[frame][place]
        hidden[:] = np.nan
    with pytest.raises(ValueError, match=f"not seen the {name} in any of 20 frames"):
        estimate(capture)


def test_a_robot_with_one_marker_is_estimated():
    whole = moving(30)
    alone = Capture(("hull",), whole.time, whole.command, [place[:1] for place in whole.position], whole.quaternion)
    np.testing.assert_allclose(estimate(alone), expected(0.29)[:9], atol=1e-9)


def test_estimates_do_not_read_old_frames():
    """Old frames are replaced by arrays of another size. Reading any of them would raise an error."""
    capture, whole = moving(10_000), estimate(moving(10_000))
    for name in ("time", "command", "position", "quaternion"):
        values: list[Any] = getattr(capture, name)
        values[:-60] = [float("nan") if name == "time" else np.zeros(7)] * len(values[:-60])
    np.testing.assert_array_equal(estimate(capture), whole)


@pytest.fixture(scope="module")
def walk() -> tuple[Capture, Float[np.ndarray, "steps 27"], Float[np.ndarray, "steps 27"]]:
    """A virtual robot walks for 3 s. Return the final capture, the features estimated at each control step, and the
    true features."""
    steps = np.arange(60) * CONTROL_TIMESTEP / 0.9
    commands = np.where((steps[:, None] + [0.0, 0.5]) % 1.0 < 0.35, 0.9, 0.0)
    after_backlash = iter(commands)
    captures, seen = [], []

    def watched(capture: Capture) -> np.ndarray:
        captures.append(capture)
        seen.append(estimate(capture))
        return next(after_backlash)

    virtual = virtual_robot.draw_robot(1)
    qpos, qvel = virtual_robot.record_truth(virtual, virtual_robot.draw_trial(40), watched, 3.0)
    model = virtual_robot.build(virtual)
    truth = [true_features(model, *state) for state in zip(qpos[:-1:5], qvel[:-1:5], strict=True)]
    return captures[-1], np.array(seen), np.array(truth)


def true_features(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    kinematics = []
    for name in ("balloon", "base", "foot_left", "foot_right"):
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, model.site(name).id)
        kinematics += [data.site(name).xpos.copy(), jacobian @ qvel]
    yaw, pitch, roll = Rotation.from_quat(data.body("balloon").xquat, scalar_first=True).as_euler("ZYX")
    return np.concatenate([*kinematics[:2], [roll, pitch, yaw], *kinematics[2:]])


def test_estimates_of_a_walk_are_accurate(walk: tuple):
    """Limits are about 1.5 times the errors in 12 trials of 10 s on ten robots. Noise causes a velocity error of
    16 mm/s. The rest is lag and, at the feet, the sudden change of velocity at footfall, which
    a fitted line cannot follow."""
    _, seen, truth = walk
    error = seen - truth
    error[:, EULER] = np.arctan2(np.sin(error[:, EULER]), np.cos(error[:, EULER]))
    position = {"balloon": [0, 1, 2], "base": [9, 10, 11], "feet": [15, 16, 17, 21, 22, 23]}
    limits = {"balloon": (0.7e-3, 0.028), "base": (0.7e-3, 0.033), "feet": (1.0e-3, 0.095)}
    for marker, entries in position.items():
        at, speed = error[:, entries], error[:, np.array(entries) + 3]
        assert np.sqrt(np.mean(at**2)) < limits[marker][0], marker
        assert np.sqrt(np.mean(speed**2)) < limits[marker][1], marker
    assert np.sqrt(np.mean(error[:, EULER] ** 2)) < np.deg2rad(0.3)
    # The feet's speed is well above the noise.
    assert np.sqrt(np.mean(truth[:, 18:21] ** 2)) > 0.12


def test_estimates_do_not_depend_on_later_frames(walk: tuple):
    """Estimates from the final capture, cut off at each control step, equal those made during the walk."""
    capture, seen, _ = walk
    assert len(capture.time) == 301 and len(seen) == 60
    for step, features in enumerate(seen):
        np.testing.assert_array_equal(estimate(first(capture, 5 * step + 1)), features)


def test_estimator_imports_neither_jax_nor_mujoco():
    """The estimator runs on the robot, which has neither JAX nor MuJoCo."""
    script = "import sys, ballu_mjx.policies.deploy.estimator as _; print({'jax', 'mujoco'} & set(sys.modules) or [])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
