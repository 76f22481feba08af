"""Reconstruction of BALLU's motion: positions, velocities and commands, compared with the simulated robot."""

import dataclasses

import mujoco
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, SIDES, load_model, standing_qpos
from ballu_mjx.ballu.reconstruct import BASE_PITCH, _servo_chunk, complete_joints
from ballu_mjx.ballu.recordings import make_recording
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.capture_noise import add_capture_noise
from ballu_mjx.recordings.csv_format import read_recording, write_recording
from ballu_mjx.recordings.motion import MeasurementGrid, Motion, ReconstructionParameters
from ballu_mjx.recordings.reconstruct import differentiate, reconstruct
from ballu_mjx.recordings.recording import Recording, cut
from ballu_mjx.robots.registry import load_robot

DURATION = 10.0
STEP = 0.01
POSITION_NOISE, ROTATION_NOISE = 5e-4, np.deg2rad(0.3)
MODEL = load_model()
KNEES, HIPS, MOTORS = [9, 12], [8, 11], [10, 13]


@dataclasses.dataclass(frozen=True)
class Truth:
    """States of the nominal robot during a bang-bang gait, every 10 ms."""

    time: np.ndarray
    command: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    sites: np.ndarray  # balloon, base, foot_left, foot_right
    balloon_quaternion: np.ndarray


@pytest.fixture(scope="module")
def truth() -> Truth:
    assert STEP == MODEL.opt.timestep
    data = mujoco.MjData(MODEL)
    data.qpos[:] = standing_qpos(MODEL)
    time = np.arange(round(DURATION / STEP) + 1) * STEP
    phase = time[:, None] / 1.2 + np.array([0.0, 0.5]) + 1e-9
    command = np.where(phase % 1.0 < 0.4, 1.0, 0.0)
    sites = [MODEL.site(name).id for name in ("balloon", "base", "foot_left", "foot_right")]
    qpos, qvel, positions, quaternion = [], [], [], []
    for row in command:
        mujoco.mj_kinematics(MODEL, data)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        positions.append(data.site_xpos[sites].copy())
        quaternion.append(data.body("balloon").xquat.copy())
        data.ctrl[:] = row
        mujoco.mj_step(MODEL, data)
    return Truth(time, command, *(np.array(x) for x in (qpos, qvel, positions, quaternion)))


def capture(
    truth: Truth, *, base: bool = True, noise: float = 1.0, time: np.ndarray | None = None, seed: int = 0
) -> Recording:
    """Return a motion capture recording at `time`, with noise of `noise` times 0.5 mm and 0.3 deg."""
    rng = np.random.default_rng(seed)
    time = truth.time if time is None else time
    sites = CubicSpline(truth.time, truth.sites)(time)
    sites += noise * POSITION_NOISE * rng.normal(size=sites.shape)

    def orientation(values: np.ndarray) -> np.ndarray:
        exact = Rotation.from_quat(CubicSpline(truth.time, values)(time), scalar_first=True)
        error = Rotation.from_rotvec(noise * ROTATION_NOISE * rng.normal(size=(len(time), 3)))
        measured = (exact * error).as_quat(scalar_first=True)
        flips = np.sum(measured[1:] * measured[:-1], axis=1) < 0
        return measured * np.concatenate([[1.0], np.cumprod(np.where(flips, -1.0, 1.0))])[:, None]

    held = np.clip(np.searchsorted(truth.time, time + 1e-9, side="right") - 1, 0, len(truth.time) - 1)
    return make_recording(
        name="made",
        kind="free",
        robot="nominal",
        time=time,
        command=truth.command[held],
        balloon_position=sites[:, 0],
        balloon_quaternion=orientation(truth.balloon_quaternion),
        base_position=sites[:, 1],
        base_quaternion=orientation(truth.qpos[:, 3:7]) if base else None,
        foot_position=sites[:, 2:],
    )


@pytest.fixture(scope="module")
def motion_with_base(truth: Truth) -> Motion:
    return reconstruct(capture(truth), load_robot(), MODEL)


@pytest.fixture(scope="module")
def motion_without_base(truth: Truth) -> Motion:
    return reconstruct(capture(truth, base=False), load_robot(), MODEL)


def test_added_noise_changes_states_as_much_as_measurement_noise(truth: Truth):
    """Noise added to a recording changes its states by as much as its measurement noise did.

    The error of a simulation due to its starting states can therefore be estimated without the true states.
    """
    recording = capture(truth)
    once = reconstruct(recording, load_robot(), MODEL).qpos
    again = [reconstruct(add_capture_noise(recording, MODEL, seed=seed), load_robot(), MODEL).qpos for seed in (1, 2)]
    error = once[2:-2] - truth.qpos[::5][: len(once)][2:-2]
    for noisy in again:
        columns = [*range(3), *HIPS]  # coordinates that joint stops do not clip
        ratio = np.std((noisy - once)[2:-2], axis=0)[columns] / np.std(error, axis=0)[columns]
        assert np.all(ratio > 0.5) and np.all(ratio < 1.4), ratio
    assert np.abs(again[0] - again[1]).max() > 1e-4


def at_control_rate(values: np.ndarray, motion: Motion, shift: int = 0) -> np.ndarray:
    """Return true values `shift` samples after the motion's times.

    Both ends are left out, so that all shifts use the same number of samples.
    """
    return values[5 * np.arange(2, len(motion.time) - 2) + shift]


def position_errors(truth: Truth, motion: Motion) -> dict[str, np.ndarray]:
    """Return absolute errors of positions: in mm for `base`, in deg for the others."""
    qpos = at_control_rate(truth.qpos, motion)
    found = motion.qpos[2:-2]
    rotation = Rotation.from_quat(qpos[:, 3:7], scalar_first=True).inv() * Rotation.from_quat(
        found[:, 3:7], scalar_first=True
    )
    pitch = np.rad2deg(rotation.as_rotvec()[:, 1])
    degrees = np.abs(np.rad2deg(found - qpos))
    return {
        "base": 1e3 * np.linalg.norm(found[:, :3] - qpos[:, :3], axis=1),
        "pitch": np.abs(pitch),
        "hips": degrees[:, HIPS],
        "knees": degrees[:, KNEES],
        "motors": degrees[:, MOTORS],
        "legs": leg_angles(qpos, found),
    }


def leg_angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles (deg) between the directions of femurs and tibias (world frame) in two sets of states."""

    def directions(qpos: np.ndarray) -> np.ndarray:
        data = mujoco.MjData(MODEL)
        found = []
        for row in qpos:
            data.qpos[:] = row
            mujoco.mj_kinematics(MODEL, data)
            found.append(
                [data.body(f"{part}_{side}").xmat.reshape(3, 3)[:, 2] for part in ("femur", "tibia") for side in SIDES]
            )
        return np.array(found)

    cosine = np.sum(directions(a) * directions(b), axis=-1)
    return np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))


@pytest.mark.parametrize("motion_name", ["motion_with_base", "motion_without_base"])
def test_reconstructed_positions_match_the_simulated_robot(truth, motion_name, request):
    motion = request.getfixturevalue(motion_name)
    errors = position_errors(truth, motion)
    assert np.median(errors["knees"]) < 0.3  # required: 1 deg for knees and legs, 2 mm for the base
    assert np.median(errors["legs"]) < 0.3
    assert np.median(errors["base"]) < 0.6
    assert np.percentile(errors["knees"], 95) < 1.5
    assert np.percentile(errors["base"], 95) < 2.0
    assert np.median(errors["motors"]) < 0.5
    assert np.isfinite(motion.qpos).all() and np.isfinite(motion.qvel).all()
    np.testing.assert_allclose(np.linalg.norm(motion.qpos[:, 3:7], axis=1), 1.0, atol=1e-9)


def test_hip_angles_and_base_pitch_match_with_and_without_a_measured_base(truth, motion_with_base, motion_without_base):
    errors = position_errors(truth, motion_with_base)
    assert np.median(errors["hips"]) < 0.3
    assert np.rad2deg(motion_with_base.uncertainty[BASE_PITCH]) < 0.3
    # The markers of one sample determine the pitch to 7 deg. The torque balance is exact here and reduces the error.
    errors = position_errors(truth, motion_without_base)
    assert np.median(errors["hips"]) < 1.0
    assert np.median(errors["pitch"]) < 1.0
    assert 0.5 < np.rad2deg(motion_without_base.uncertainty[BASE_PITCH]) < 2.0
    assert np.sqrt(np.mean(errors["pitch"] ** 2)) < 2 * np.rad2deg(motion_without_base.uncertainty[BASE_PITCH])


def test_measured_base_orientation_overrides_the_torque_balance(truth):
    """A base that is measured 10 deg away from its equilibrium is reconstructed there."""
    recording = capture(truth, noise=0.0)
    tilt = Rotation.from_rotvec([0.0, np.deg2rad(10.0), 0.0])
    base = Rotation.from_quat(recording.orientations["base"], scalar_first=True) * tilt
    neck = Rotation.from_quat(truth.qpos[:, 3:7], scalar_first=True).apply(MODEL.body("balloon").pos)
    moved = neck - base.apply(MODEL.body("balloon").pos)
    recording = dataclasses.replace(
        recording,
        orientations={"base": base.as_quat(scalar_first=True)},
        points={site: place + moved for site, place in recording.points.items()},
    )
    motion = reconstruct(recording, load_robot(), MODEL)
    change = np.rad2deg(motion.qpos - truth.qpos[::5])
    assert np.median(np.abs(change[:, HIPS] + 10.0)) < 0.2
    assert np.median(np.abs(change[:, 7] + 10.0)) < 0.2
    assert np.median(np.abs(change[:, KNEES])) < 0.2


def test_reconstructed_velocities_have_no_time_lag(truth, motion_with_base, motion_without_base):
    """The error is smallest relative to the true velocity at the same time, not 10 ms before or after.

    A foot lands or a knee meets its stop in one sample of ten. These samples dominate the mean square error, but hardly
    depend on the lag. The lag is therefore measured on the other samples.
    """
    bounds = (([0, 1, 2], 0.02, 0.008), ([3, 5], 0.04, 0.02), ([4], 0.35, 0.12), ([7, 10], 0.4, 0.15))
    for motion in (motion_with_base, motion_without_base):
        for columns, limit, usual_limit in (*bounds, ([8, 11], 1.3, 0.4)):
            error = {}
            for shift in range(-3, 4):
                difference = np.abs(motion.qvel[2:-2] - at_control_rate(truth.qvel, motion, shift))[:, columns].ravel()
                if shift == 0:
                    assert np.sqrt(np.mean(difference**2)) < limit, columns
                usual = np.sort(difference)[: len(difference) * 9 // 10]
                error[shift] = np.sqrt(np.mean(usual**2))
            assert error[0] < usual_limit, columns
            if columns != [3, 5]:  # roll and yaw rates vary too slowly to show a shift
                assert min(error, key=lambda shift: error[shift]) == 0, (columns, error)


def test_velocities_follow_mujocos_qvel_conventions(truth):
    """Rotating the world by 130 deg rotates only the linear velocity. Integrating qvel gives the next qpos."""
    plain = capture(truth, noise=0.0)
    assert plain.tracked_position is not None and plain.tracked_quaternion is not None
    rotation = Rotation.from_euler("z", 130.0, degrees=True)

    def rotated(quaternion: np.ndarray) -> np.ndarray:
        return (rotation * Rotation.from_quat(quaternion, scalar_first=True)).as_quat(scalar_first=True)

    recording = dataclasses.replace(
        plain,
        tracked_position=rotation.apply(plain.tracked_position),
        tracked_quaternion=rotated(plain.tracked_quaternion),
        points={site: rotation.apply(place) for site, place in plain.points.items()},
        orientations={site: rotated(quaternion) for site, quaternion in plain.orientations.items()},
    )
    motion, reference = reconstruct(recording, load_robot(), MODEL), reconstruct(plain, load_robot(), MODEL)
    np.testing.assert_allclose(motion.qvel[:, :3], rotation.apply(reference.qvel[:, :3]), atol=1e-6)
    np.testing.assert_allclose(motion.qvel[:, 3:], reference.qvel[:, 3:], atol=1e-5)

    error, rate = [], np.zeros(MODEL.nv)
    for k in range(5, len(motion.time) - 5):
        # Mean velocity over the physics step before the state.
        mujoco.mj_differentiatePos(MODEL, rate, STEP, truth.qpos[5 * k - 1], truth.qpos[5 * k])
        error.append(reference.qvel[k] - rate)
    typical = np.median(np.abs(error), axis=0)
    assert typical[:6].max() < 0.05
    assert typical[6:].max() < 0.15


def test_fast_rotations_and_quaternion_sign_changes_are_handled(truth):
    """A body rotates at 3 rad/s about a tilted body axis. Its quaternion changes sign on the way."""
    time = np.arange(0.0, 4.0, STEP)
    rate = np.array([0.3, 0.0, 3.0])
    tilt = Rotation.from_euler("y", 20.0, degrees=True)
    spin = (tilt * Rotation.from_rotvec(np.outer(time, rate))).as_quat(scalar_first=True)
    qpos = np.tile(standing_qpos(MODEL), (len(time), 1))
    qpos[:, 3:7] = spin
    found, velocity = differentiate(qpos, MODEL, load_robot(), STEP, ReconstructionParameters())
    np.testing.assert_allclose(velocity[:, 3:6], np.tile(rate, (len(time), 1)), atol=0.05)
    np.testing.assert_allclose(np.abs(np.sum(found[:, 3:7] * spin, axis=1)), 1.0, atol=1e-5)
    assert np.all(np.sum(found[1:, 3:7] * found[:-1, 3:7], axis=1) > 0.9)


def test_fit_errors_are_of_the_size_of_the_measurement_noise(motion_with_base, motion_without_base):
    for motion in (motion_with_base, motion_without_base):
        assert set(motion.fit_error_mm) == {"balloon", "base", "foot_left", "foot_right"}
        # Noise of 0.5 mm along three axes is 0.87 mm. Fitting eleven unknowns per sample removes a part of it.
        assert all(0.1 < value < 0.87 for value in motion.fit_error_mm.values())


def test_fit_errors_reveal_a_model_with_wrong_dimensions(truth):
    longer = load_model()
    longer.body_pos[longer.body("balloon").id, 2] += 0.02
    motion = reconstruct(capture(truth, noise=0.0), load_robot(), longer)
    assert motion.fit_error_mm["balloon"] > 3.0


def test_simulations_from_reconstructed_states_stay_near_the_truth(truth, motion_with_base, motion_without_base):
    """Rollouts of 1 s from reconstructed states, with the recorded commands, stay near the true motion."""
    for motion in (motion_with_base, motion_without_base):
        distance, heading = [], []
        for k in range(4, len(motion.time) - 24, 6):
            data = mujoco.MjData(MODEL)
            data.qpos[:], data.qvel[:] = motion.qpos[k], motion.qvel[k]
            for command in motion.command[k : k + 20]:
                data.ctrl[:] = command
                mujoco.mj_step(MODEL, data, 5)
            mujoco.mj_kinematics(MODEL, data)
            end = 5 * (k + 20)
            distance.append(np.linalg.norm(data.site("balloon").xpos - truth.sites[end, 0]))
            rotation = Rotation.from_quat(truth.balloon_quaternion[end], scalar_first=True).inv() * Rotation.from_quat(
                data.body("balloon").xquat, scalar_first=True
            )
            heading.append(abs(rotation.as_rotvec(degrees=True)[2]))
        assert np.median(distance) < 0.02
        assert np.median(heading) < 1.5


def test_knees_exceed_their_soft_stops_by_half_a_degree_at_most(motion_with_base):
    stop = MODEL.joint("knee_left").range[0]
    assert motion_with_base.qpos[:, KNEES].min() > stop - np.deg2rad(0.51)
    assert motion_with_base.qpos[:, KNEES].min() < stop


@pytest.mark.parametrize("rate", [60.0, 100.0, 130.0])
def test_capture_rates_of_60_to_130_hz_with_jitter_are_resampled(truth, rate):
    rng = np.random.default_rng(1)
    time = np.arange(0.0, DURATION - 0.02, 1.0 / rate)
    time = 7.0 + time + np.concatenate([[0.0], rng.uniform(-0.3, 0.3, len(time) - 1) / rate])
    recording = dataclasses.replace(capture(truth, time=time - 7.0), time=time)
    motion = reconstruct(recording, load_robot(), MODEL)
    np.testing.assert_allclose(motion.time, np.arange(len(motion.time)) * CONTROL_TIMESTEP)
    errors = position_errors(truth, motion)
    assert np.median(errors["knees"]) < 0.5
    assert np.median(errors["legs"]) < 0.5
    assert np.median(errors["base"]) < 1.0
    velocity = motion.qvel[2:-2] - at_control_rate(truth.qvel, motion)
    assert np.sqrt(np.mean(velocity[:, :3] ** 2)) < 0.03
    assert np.sqrt(np.mean(velocity[:, 5] ** 2)) < 0.04


def test_short_marker_dropouts_are_interpolated(truth, tmp_path):
    recording = capture(truth, base=False)
    balloon = np.array(recording.tracked_position)
    points = {site: place.copy() for site, place in recording.points.items()}
    balloon[200:205], points["foot_right"][400:403], points["foot_left"][700:705] = np.nan, np.nan, np.nan
    recording = dataclasses.replace(recording, tracked_position=balloon, points=points)
    write_recording(recording, tmp_path / "walk.csv", load_robot())
    motion = reconstruct(read_recording(tmp_path / "walk.csv", load_robot()), load_robot(), MODEL)
    assert motion.interpolated["balloon_x"] == 5 and motion.interpolated["foot_left_z"] == 5
    errors = position_errors(truth, motion)
    assert np.median(errors["knees"]) < 0.3
    assert max(errors["base"].max(), errors["knees"].max()) < 10.0


def test_measured_joint_angles_determine_the_joints(truth):
    recording = capture(truth)
    joints = {"motor_left": MOTORS[0], "motor_right": MOTORS[1], "knee_left": KNEES[0], "knee_right": KNEES[1]}
    angles = {joint: truth.qpos[:, place] + 0.1 * joint.startswith("motor") for joint, place in joints.items()}
    recording = dataclasses.replace(recording, joint_angles=angles)
    precise = ReconstructionParameters(joint_noise=1e-4)
    motion = reconstruct(recording, load_robot(), MODEL, precise)
    change = np.median(np.abs(motion.qpos[:, MOTORS] - truth.qpos[::5, MOTORS]))
    assert abs(change - 0.1) < 0.01
    assert np.median(position_errors(truth, motion)["knees"]) < 0.03


def test_commands_are_averaged_over_each_control_step(truth):
    recording = capture(truth, noise=0.0)
    command = np.zeros_like(recording.command)
    command[12:27, 0] = 1.0  # from 0.12 s to 0.27 s
    motion = reconstruct(dataclasses.replace(recording, command=command), load_robot(), MODEL)
    np.testing.assert_allclose(motion.command[:7, 0], [0.0, 0.0, 0.6, 1.0, 1.0, 0.4, 0.0], atol=1e-9)
    np.testing.assert_array_equal(motion.command[:, 1], 0.0)
    assert len(motion.command) == len(motion.qpos) - 1 == len(motion.time) - 1


def test_recordings_of_different_lengths_share_one_compiled_program(truth, motion_without_base):
    before = _servo_chunk._cache_size()  # pyright: ignore[reportFunctionMemberAccess, reportAttributeAccessIssue]
    recording = capture(truth, base=False)
    motion = reconstruct(cut(recording, slice(333)), load_robot(), MODEL)
    assert len(motion.qpos) == 67
    assert _servo_chunk._cache_size() == before  # pyright: ignore[reportFunctionMemberAccess, reportAttributeAccessIssue]
    np.testing.assert_allclose(motion.qpos[5:50, 7:], motion_without_base.qpos[5:50, 7:], atol=np.deg2rad(1.0))


def test_slack_cables_do_not_load_the_servos():
    """The swinging knees are bent so far that the cables stay slack. The motors move as in a model without cables."""
    time = np.arange(200) * STEP
    command = np.where(time[:, None] % 1.0 < 0.5, 0.3, 0.0) * np.ones(2)
    grid = MeasurementGrid(STEP, 5, command, {}, {}, {})
    qpos = np.tile(standing_qpos(MODEL), (len(time), 1))
    qpos[:, KNEES] = np.deg2rad(75 + 10 * np.sin(2 * np.pi * 2.0 * time))[:, None]
    uncabled = load_model()
    uncabled.tendon_stiffness[:] = uncabled.tendon_damping[:] = 0
    found, without_cables = (
        complete_joints(model, grid, qpos, np.zeros((len(time), 14)))[0] for model in (MODEL, uncabled)
    )
    assert np.ptp(without_cables[:, MOTORS]) > 0.3
    np.testing.assert_allclose(found[:, MOTORS], without_cables[:, MOTORS], atol=1e-12)


def test_models_with_damped_cables_are_refused():
    """The reconstruction simulates cables without damping. In MuJoCo, damping would also act on slack cables."""
    damped = load_model()
    robot = load_robot()
    assert robot.adapter.check(robot, damped) is None
    damped.tendon_damping[1] = 1.0
    problem = robot.adapter.check(robot, damped)
    assert problem is not None and "cable_right" in problem


def test_suspended_and_short_recordings_are_refused(truth):
    recording = capture(truth)
    with pytest.raises(ValueError, match="suspended"):
        reconstruct(dataclasses.replace(recording, kind="suspended"), load_robot(), MODEL)
    with pytest.raises(InputError, match="lasts 0.070 s; give recordings of two control steps or more"):
        reconstruct(cut(recording, slice(8)), load_robot(), MODEL)
