"""From a recording to the robot's full generalized state at the control rate.

1. Measurements are brought to a uniform grid at their own rate, of which the control grid is a part.
2. Positions: a batched least-squares inverse kinematics, one small problem a sample.
3. The base's pitch: with the neck's lever of 15 mm, markers show it to some 7 deg a sample. Unless the base's
   orientation is recorded, it is fitted over the whole recording at once to markers and the base's torque balance.
4. Velocities: a centred (hence lag-free) Savitzky-Golay differentiator, widest for the balloon's rotation: it is slow,
   and its rates matter most to what a simulator does next.
5. Motor angles: the model's own servo, driven by the recorded commands and held back by the cable at the knee angles
   found, so that motor, cable and knee agree. A recording's motor columns, where there are any, are taken instead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optimistix as optx
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Array, Float
from scipy.signal import savgol_coeffs
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, HIPS, KNEES, MOTORS, SIDES
from ballu_mjx.recordings.filters import (
    control_grid,
    interpolate,
    mean_command,
    odd_window,
    savitzky_golay,
    sign_continuous,
    smooth_rotation,
)
from ballu_mjx.recordings.motion import Motion, ReconstructionParameters
from ballu_mjx.recordings.recording import Recording

_CHUNK = 512
"""Samples in a compiled call: recordings of any length share one program."""
_MAX_STEPS = 15
"""Levenberg-Marquardt steps. Four suffice; only a base pitch that one sample cannot show goes on wandering."""
_PITCH_HELD = 1e4
"""Weight (1/rad) by which the second pass holds the base's pitch where the first two have found it."""
_SERVO_SUBSTEP = 1e-3
"""Longest step (s) of the servo's simulation, whose fastest time constant is about 9 ms."""
_SETTLING = 0.5
"""Seconds for which the first command is held before the recording starts, for the servo to arrive."""
_STOP_GIVE = float(np.deg2rad(0.5))
"""How far (rad) below its stop a knee may be: the stop is soft, and the spring holds the knee 0.35 deg inside."""

_Smoothing = tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]


def reconstruct_ballu(
    recording: Recording, model: mujoco.MjModel, parameters: ReconstructionParameters | None = None
) -> Motion:
    """States and commands at the control rate from a free recording.

    **Arguments**

    - `recording`: as `csv_format.read_recording` gives it: no missing values. Its floor is at z = 0.
    - `model`: the robot to be simulated from these states; lengths, servo, cable, stops and masses are taken from it.
    - `parameters`: noise and filters; the defaults suit motion capture of 0.5 mm and 0.3 deg.

    **Raises** `ValueError` for a suspended recording, and for one shorter than two control steps.
    """
    parameters = parameters or ReconstructionParameters()
    grid = _resample(recording)
    skeleton = _Skeleton.of(model)

    fitted = _inverse_kinematics(skeleton, grid, parameters)
    if grid.base_quaternion is None:
        held, pitch_deviation = _base_pitch(model, skeleton, grid, fitted, parameters)
        fitted = _inverse_kinematics(skeleton, grid, parameters, held)
    else:
        window = odd_window(parameters.position_window, grid.step, parameters.order, len(fitted))
        shrinkage = np.linalg.norm(savgol_coeffs(window, parameters.order))
        pitch_deviation = float(parameters.rotation_noise * shrinkage)

    qpos, qvel = _differentiate(fitted, grid.step, parameters)
    # A semi-implicit integrator's velocity is the mean over the time step that led to the position.
    qvel -= np.gradient(qvel, grid.step, axis=0) * model.opt.timestep / 2
    knees = qpos[:, 7:][:, KNEES]
    stops = np.array([model.joint(f"knee_{side}").range for side in SIDES])
    knees[:] = np.clip(knees, stops[:, 0] - _STOP_GIVE, stops[:, 1])
    if grid.motor is None:
        qpos[:, 7:][:, MOTORS], qvel[:, 6:][:, MOTORS] = _servos(model, grid, knees)

    states = slice(None, None, grid.samples_per_step)
    count = len(qpos[states])
    edges = np.arange(count) * CONTROL_TIMESTEP
    return Motion(
        name=recording.name,
        time=edges,
        command=mean_command(recording, edges),
        qpos=qpos[states],
        qvel=qvel[states],
        residual_mm=_residuals(skeleton, grid, fitted),
        interpolated=dict(recording.interpolated),
        robot=recording.robot,
        pitch_deviation=pitch_deviation,
    )


# 1. Measurements on a uniform grid


@dataclasses.dataclass(frozen=True)
class _Grid:
    """A free recording at uniform times from 0, `step` (s) apart; `samples_per_step` of them to a control step."""

    step: float
    samples_per_step: int
    command: Float[np.ndarray, "T 2"]
    balloon_position: Float[np.ndarray, "T 3"]
    balloon_quaternion: Float[np.ndarray, "T 4"]
    base_position: Float[np.ndarray, "T 3"]
    base_quaternion: Float[np.ndarray, "T 4"] | None
    foot_position: Float[np.ndarray, "T 2 3"]
    motor: Float[np.ndarray, "T 2"] | None
    knee: Float[np.ndarray, "T 2"] | None


def _resample(recording: Recording) -> _Grid:
    """Linear interpolation: with noise, jittered samples close together would make a spline overshoot."""
    balloon_position, balloon_quaternion = recording.balloon_position, recording.balloon_quaternion
    base_position, foot_position = recording.base_position, recording.foot_position
    if (
        recording.kind != "free"
        or balloon_position is None
        or balloon_quaternion is None
        or base_position is None
        or foot_position is None
    ):
        raise ValueError(f"{recording.name}: a suspended recording has no walk to reconstruct; give a free one.")
    time = recording.time - recording.time[0]
    per_step, grid = control_grid(recording)

    linear = partial(interpolate, grid, time)

    def unit(values: np.ndarray) -> np.ndarray:
        values = linear(values)
        return values / np.linalg.norm(values, axis=-1, keepdims=True)

    command = mean_command(recording, grid)
    return _Grid(
        step=CONTROL_TIMESTEP / per_step,
        samples_per_step=per_step,
        command=np.concatenate([command, command[-1:]]),
        balloon_position=linear(balloon_position),
        balloon_quaternion=unit(balloon_quaternion),
        base_position=linear(base_position),
        base_quaternion=None if recording.base_quaternion is None else unit(recording.base_quaternion),
        foot_position=linear(foot_position),
        motor=None if recording.motor is None else linear(recording.motor),
        knee=None if recording.knee is None else linear(recording.knee),
    )


# 2. Inverse kinematics


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Skeleton:
    """Places (m) of joints and sites in their parents' frames; pairs are (left, right). All hinges turn about y."""

    neck: Float[Array | np.ndarray, " 3"]
    balloon: Float[Array | np.ndarray, " 3"]
    hips: Float[Array | np.ndarray, "2 3"]
    knees: Float[Array | np.ndarray, "2 3"]
    feet: Float[Array | np.ndarray, "2 3"]

    @staticmethod
    def of(model: mujoco.MjModel) -> _Skeleton:
        return _Skeleton(
            neck=model.body("balloon").pos.copy(),
            balloon=model.site("balloon").pos.copy(),
            hips=np.stack([model.body(f"femur_{side}").pos for side in SIDES]),
            knees=np.stack([model.body(f"tibia_{side}").pos for side in SIDES]),
            feet=np.stack([model.site(f"foot_{side}").pos for side in SIDES]),
        )


def _multiply(a: Float[Array, " 4"], b: Float[Array, " 4"]) -> Float[Array, " 4"]:
    vector = a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])
    return jnp.concatenate([(a[0] * b[0] - a[1:] @ b[1:])[None], vector])


def _rotate(quaternion: Float[Array, " 4"], vector: Float[Array | np.ndarray, " 3"]) -> Float[Array, " 3"]:
    w, axis, vector = quaternion[0], quaternion[1:], jnp.asarray(vector)
    return vector + 2.0 * jnp.cross(axis, jnp.cross(axis, vector) + w * vector)


def _turn(quaternion: Float[Array, " 4"], angle: Float[Array, ""]) -> Float[Array, " 4"]:
    """`quaternion`, then `angle` about its own y axis."""
    zero = jnp.zeros_like(angle)
    return _multiply(quaternion, jnp.stack([jnp.cos(angle / 2), zero, jnp.sin(angle / 2), zero]))


def _forward_kinematics(
    skeleton: _Skeleton, qpos: Float[Array, " nq"]
) -> tuple[Float[Array, " 3"], Float[Array, " 4"], Float[Array, "2 3"]]:
    """Balloon's position and quaternion, and the feet, in the world.

    MJX's kinematics for the few points that are measured: it compiles in a tenth of the time and runs a hundred times
    faster, which pays for every sample's Jacobians.
    """
    base, quaternion, hinges = qpos[:3], qpos[3:7], qpos[7:]
    balloon_quaternion = _turn(quaternion, hinges[0])
    balloon = base + _rotate(quaternion, skeleton.neck) + _rotate(balloon_quaternion, skeleton.balloon)

    def foot(hip: Array, knee: Array, foot: Array, hip_angle: Array, knee_angle: Array) -> Array:
        femur = _turn(quaternion, hip_angle)
        tibia = _turn(femur, knee_angle)
        return base + _rotate(quaternion, hip) + _rotate(femur, knee) + _rotate(tibia, foot)

    feet = jax.vmap(foot)(
        jnp.asarray(skeleton.hips),
        jnp.asarray(skeleton.knees),
        jnp.asarray(skeleton.feet),
        hinges[HIPS],
        hinges[KNEES],
    )
    return balloon, balloon_quaternion, feet


def _retract(qpos: Float[Array, " nq"], step: Float[Array, " 11"]) -> Float[Array, " nq"]:
    """`qpos` moved by `step`: base position, base rotation (body frame), then all hinges but the motors."""
    quaternion = _multiply(qpos[3:7], jnp.concatenate([jnp.ones(1), step[3:6] / 2]))
    hinges = qpos[7:].at[0].add(step[6]).at[HIPS].add(step[jnp.array([7, 9])]).at[KNEES].add(step[jnp.array([8, 10])])
    return jnp.concatenate([qpos[:3] + step[:3], quaternion / jnp.linalg.norm(quaternion), hinges])


def _rotation_between(a: Float[Array, " 4"], b: Float[Array, " 4"]) -> Float[Array, " 3"]:
    """Rotation vector (rad, in the frame of `a`) from `a` to `b`, for small angles."""
    difference = _multiply(a * jnp.array([1.0, -1.0, -1.0, -1.0]), b)
    return 2.0 * difference[1:] * jnp.where(difference[0] < 0, -1.0, 1.0)


def _misfit(
    step: Float[Array, " 11"],
    arguments: tuple[_Skeleton, Float[Array, " nq"], dict[str, Array], dict[str, Array]],
) -> Float[Array, " 20"]:
    """Differences to the measurements in units of their noise, `step` away from a guess."""
    skeleton, guess, measured, weights = arguments
    qpos = _retract(guess, step)
    balloon, balloon_quaternion, feet = _forward_kinematics(skeleton, qpos)
    return jnp.concatenate(
        [
            (balloon - measured["balloon"]) * weights["position"],
            (qpos[:3] - measured["base"]) * weights["position"],
            (feet - measured["feet"]).ravel() * weights["position"],
            _rotation_between(measured["balloon_quaternion"], balloon_quaternion) * weights["rotation"],
            _rotation_between(measured["base_quaternion"], qpos[3:7]) * weights["base_rotation"],
            (qpos[7:][KNEES] - measured["knee"]) * weights["knee"],
        ]
    )


@jax.jit
def _fit_chunk(
    skeleton: _Skeleton, guess: Float[Array, "chunk nq"], measured: dict[str, Array], weights: dict[str, Array]
) -> Float[Array, "chunk nq"]:
    """argmin over qpos of |misfit|^2, sample by sample."""
    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-6)

    def one(guess: Array, measured: dict[str, Array]) -> Array:
        solution = optx.least_squares(
            _misfit,
            solver,
            jnp.zeros(11),
            (skeleton, guess, measured, weights),
            options={"jac": "fwd"},
            max_steps=_MAX_STEPS,
            throw=False,
        )
        return _retract(guess, solution.value)

    return jax.vmap(one)(guess, measured)


def _in_chunks(function: Callable[..., Any], count: int, *arguments: Any) -> Any:
    """`function` of `arguments`' first `count` entries, `_CHUNK` at a time, in double precision, as NumPy arrays.

    In single precision the rounding of the balloon's distance, over the neck's lever of 15 mm, would show in the pitch.
    """
    results = []
    with jax.enable_x64(True):
        for start in range(0, count, _CHUNK):
            chunk = np.minimum(np.arange(start, start + _CHUNK), count - 1)
            results.append(function(*jax.tree.map(lambda array, at=chunk: array[at], arguments)))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *results)


def _inverse_kinematics(
    skeleton: _Skeleton,
    grid: _Grid,
    parameters: ReconstructionParameters,
    held: Float[np.ndarray, "T 4"] | None = None,
) -> Float[np.ndarray, "T nq"]:
    """Generalized positions that fit the measurements; motors as measured, or 0.

    `held` are base quaternions whose pitch is to be kept.
    """
    weights = _weights(grid, parameters)
    if held is not None:
        base_quaternion = held
        weights["base_rotation"] = np.array([0.0, _PITCH_HELD, 0.0])
    else:
        base_quaternion = grid.balloon_quaternion if grid.base_quaternion is None else grid.base_quaternion
    count = len(base_quaternion)
    measured = {
        "balloon": grid.balloon_position,
        "base": grid.base_position,
        "feet": grid.foot_position,
        "balloon_quaternion": grid.balloon_quaternion,
        "base_quaternion": base_quaternion,
        "knee": np.zeros((count, 2)) if grid.knee is None else grid.knee,
    }
    guess = _guess(skeleton, grid, base_quaternion)
    qpos = _in_chunks(lambda *each: _fit_chunk(skeleton, *each, weights), count, guess, measured)
    if grid.motor is not None:
        qpos[:, 7:][:, MOTORS] = grid.motor
    return qpos


def _weights(grid: _Grid, parameters: ReconstructionParameters) -> dict[str, np.ndarray]:
    """Inverse standard deviations of the measurements; 0 for what is not there."""
    prior = np.array([0.0, 1.0 / parameters.pitch_prior, 0.0])
    return {
        "position": np.array(1.0 / parameters.position_noise),
        "rotation": np.array(1.0 / parameters.rotation_noise),
        "base_rotation": prior if grid.base_quaternion is None else np.full(3, 1.0 / parameters.rotation_noise),
        "knee": np.array(0.0 if grid.knee is None else 1.0 / parameters.joint_noise),
    }


def _guess(skeleton: _Skeleton, grid: _Grid, base_quaternion: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, "T nq"]:
    """Base as measured, legs by the law of cosines between hip and foot; the neck at its angle to the balloon."""
    base = Rotation.from_quat(base_quaternion, scalar_first=True)
    balloon = Rotation.from_quat(grid.balloon_quaternion, scalar_first=True)
    qpos = np.zeros((len(base_quaternion), 14))
    qpos[:, :3], qpos[:, 3:7] = grid.base_position, base_quaternion
    hinges = qpos[:, 7:]
    hinges[:, 0] = (base.inv() * balloon).as_rotvec()[:, 1]
    for i in range(2):
        leg = base.inv().apply(grid.foot_position[:, i] - grid.base_position) - np.asarray(skeleton.hips[i])
        femur, tibia = -skeleton.knees[i][2], -skeleton.feet[i][2]
        cosine = (leg[:, 0] ** 2 + leg[:, 2] ** 2 - femur**2 - tibia**2) / (2 * femur * tibia)
        knee = np.arccos(np.clip(cosine, -0.99, 0.999))
        straight = np.arctan2(leg[:, 0], leg[:, 2])
        hip = straight - np.arctan2(-tibia * np.sin(knee), -femur - tibia * np.cos(knee))
        hinges[:, HIPS][:, i] = (hip + np.pi) % (2 * np.pi) - np.pi
        hinges[:, KNEES][:, i] = knee
    return qpos


@jax.jit
def _points_chunk(
    skeleton: _Skeleton, qpos: Float[Array, "chunk nq"]
) -> tuple[Float[Array, "chunk 3"], Float[Array, "chunk 2 3"]]:
    """Balloon and feet in the world."""
    balloon, _, feet = jax.vmap(partial(_forward_kinematics, skeleton))(qpos)
    return balloon, feet


def _residuals(skeleton: _Skeleton, grid: _Grid, qpos: Float[np.ndarray, "T nq"]) -> dict[str, float]:
    balloon, feet = _in_chunks(lambda each: _points_chunk(skeleton, each), len(qpos), qpos)

    def rms(fitted: np.ndarray, measured: np.ndarray) -> float:
        return 1e3 * float(np.sqrt(np.mean(np.sum((fitted - measured) ** 2, axis=-1))))

    return {
        "balloon": rms(balloon, grid.balloon_position),
        "base": rms(qpos[:, :3], grid.base_position),
        "feet": rms(feet, grid.foot_position),
    }


# 3. The base's pitch


def _base_pitch(
    model: mujoco.MjModel,
    skeleton: _Skeleton,
    grid: _Grid,
    qpos: Float[np.ndarray, "T nq"],
    parameters: ReconstructionParameters,
) -> tuple[Float[np.ndarray, "T 4"], float]:
    """Base quaternions with a pitch that agrees with markers and torques, and the pitch's standard deviation (rad).

    The hips' axes run through the base's frame, so legs and balloon in the world are known without its pitch theta.
    About that axis, with psi the world pitches of balloon and femurs, a and d the armature and damping of neck and
    hips, F the balloon's pull at the neck r and G the base's weight and inertia force at its centre of mass c:

        (I + sum a) theta'' + (sum d) theta' = sum (a psi'' + d psi') + r(theta) x F + c(theta) x G

    Its least-squares fit over all samples, together with the inverse kinematics' pitches, is a banded problem, solved
    by Gauss-Newton.
    """
    step, count = grid.step, len(qpos)
    measured, forward, up = _pitch(qpos[:, 3:7])
    base, balloon = model.body("base").id, model.body("balloon").id
    dofs = [model.joint(name).dofadr[0] for name in ("neck", "hip_left", "hip_right")]
    armature, damping = model.dof_armature[dofs], model.dof_damping[dofs]

    def smooth(values: np.ndarray, width: float, derivative: int) -> np.ndarray:
        return savitzky_golay(values, width, step, parameters.order, derivative)

    gravity = model.opt.gravity
    lifted = gravity * (1.0 - model.body_gravcomp[balloon])
    force = parameters.force_window
    pull = model.body_mass[balloon] * (lifted - smooth(grid.balloon_position, force, 2))
    weight = model.body_mass[base] * (gravity - smooth(grid.base_position, force, 2))
    levers = [(np.asarray(skeleton.neck), pull), (model.body_ipos[base], weight)]

    hinges = qpos[:, 7:]
    others = measured[:, None] + np.column_stack([hinges[:, 0], hinges[:, HIPS]])
    drive = (
        smooth(others, parameters.position_window, 2) @ armature
        + smooth(others, parameters.position_window, 1) @ damping
    )
    center = model.body_ipos[base]
    inertia = model.body_inertia[base][1] + model.body_mass[base] * (center[0] ** 2 + center[2] ** 2) + armature.sum()

    inner = count - 2
    shape = (inner, count)
    before, now, after = (scipy.sparse.eye_array(*shape, k=k) for k in range(3))
    first, second = (after - before) / (2 * step), (after - 2 * now + before) / step**2

    weights = _weights(grid, parameters)
    # It varies little; the median does not believe samples whose pitch has wandered to where it would be well seen.
    information = np.median(_in_chunks(lambda each: _pitch_information(skeleton, each, weights), count, qpos))
    torque_noise = parameters.torque_noise * np.sqrt(0.01 / step)
    pitch = np.full(count, np.mean(measured))
    for _ in range(10):
        torque, slope = np.zeros(count), np.zeros(count)
        for lever, load in levers:
            along, above = np.sum(load * forward, axis=1), np.sum(load * up, axis=1)
            x = lever[0] * np.cos(pitch) + lever[2] * np.sin(pitch)
            z = lever[2] * np.cos(pitch) - lever[0] * np.sin(pitch)
            torque += z * along - x * above
            slope -= x * along + z * above
        matrix = (inertia * second + damping.sum() * first - scipy.sparse.diags_array(slope[1:-1]) @ now) / torque_noise
        target = (drive + torque - slope * pitch)[1:-1] / torque_noise
        hessian = (matrix.T @ matrix + information * scipy.sparse.eye_array(count)).tocsc()
        factors = scipy.sparse.linalg.splu(hessian)
        previous, pitch = pitch, factors.solve(matrix.T @ target + information * measured)
        if np.max(np.abs(pitch - previous)) < 1e-5:
            break

    places = np.linspace(0, count - 1, 20).astype(int)
    units = np.zeros((count, len(places)))
    units[places, np.arange(len(places))] = 1.0
    variance = factors.solve(units)[places, np.arange(len(places))]
    turned = Rotation.from_quat(qpos[:, 3:7], scalar_first=True) * Rotation.from_rotvec(
        np.outer(pitch - measured, [0.0, 1.0, 0.0])
    )
    return turned.as_quat(scalar_first=True), float(np.sqrt(np.mean(variance)))


def _pitch(
    quaternion: Float[np.ndarray, "T 4"],
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Pitch (rad) about the body's own y axis, from the horizontal axis `forward`; `up` completes the frame."""
    matrix = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    x, y = matrix[:, :, 0], matrix[:, :, 1]
    forward = np.cross(y, np.array([0.0, 0.0, 1.0]))
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up = np.cross(forward, y)
    return np.unwrap(np.arctan2(-np.sum(x * up, axis=1), np.sum(x * forward, axis=1))), forward, up


@jax.jit
def _pitch_information(
    skeleton: _Skeleton, qpos: Float[Array, "chunk nq"], weights: dict[str, Any]
) -> Float[Array, " chunk"]:
    """What each sample's measurements alone say of the base's pitch (1/rad^2): its inverse variance, Gauss-Newton."""

    def one(qpos: Array) -> Array:
        balloon, quaternion, feet = _forward_kinematics(skeleton, qpos)
        measured = {
            "balloon": balloon,
            "base": qpos[:3],
            "feet": feet,
            "balloon_quaternion": quaternion,
            "base_quaternion": qpos[3:7],
            "knee": qpos[7:][KNEES],
        }
        jacobian = jax.jacfwd(_misfit)(jnp.zeros(11), (skeleton, qpos, measured, weights))
        return 1.0 / jnp.linalg.inv(jacobian.T @ jacobian)[4, 4]

    return jax.vmap(one)(qpos)


def _differentiate(
    qpos: Float[np.ndarray, "T nq"], step: float, parameters: ReconstructionParameters
) -> tuple[Float[np.ndarray, "T nq"], Float[np.ndarray, "T nv"]]:
    """Smoothed generalized positions and their velocities at the same instants, in MuJoCo's conventions.

    Filtered are the base's position, the balloon's orientation, the neck, the femurs' angles to the balloon, the knees
    and the motors. The base, light and loosely tied, follows from balloon and neck.
    """

    def smooth(values: np.ndarray, width: float, rate_width: float) -> _Smoothing:
        order = parameters.order
        return savitzky_golay(values, width, step, order, 0), savitzky_golay(values, rate_width, step, order, 1)

    narrow, wide, rotation = parameters.position_window, parameters.rate_window, parameters.rotation_window
    hinges = qpos[:, 7:]
    y = np.array([0.0, 1.0, 0.0])
    base = Rotation.from_quat(qpos[:, 3:7], scalar_first=True)
    balloon = (base * Rotation.from_rotvec(np.outer(hinges[:, 0], y))).as_quat(scalar_first=True)

    position, linear = smooth(qpos[:, :3], narrow, wide)
    quaternion, angular = smooth_rotation(sign_continuous(balloon), rotation, step, parameters.order)

    to_balloon = hinges.copy()
    to_balloon[:, HIPS] -= hinges[:, :1]
    angles, rates = smooth(to_balloon, narrow, wide)
    angles[:, HIPS] += angles[:, :1]
    rates[:, HIPS] += rates[:, :1]

    back = Rotation.from_rotvec(np.outer(-angles[:, 0], y))
    base_quaternion = (Rotation.from_quat(quaternion, scalar_first=True) * back).as_quat(scalar_first=True)
    base_angular = back.inv().apply(angular) - rates[:, :1] * y
    return (
        np.concatenate([position, sign_continuous(base_quaternion), angles], axis=1),
        np.concatenate([linear, base_angular, rates], axis=1),
    )


# 5. Motors


def _servos(
    model: mujoco.MjModel, grid: _Grid, knee: Float[np.ndarray, "T 2"]
) -> tuple[Float[np.ndarray, "T 2"], Float[np.ndarray, "T 2"]]:
    """Motor angles (rad) and rates that the model's servos take under the commands, with the knees going as they do."""
    servos = [model.actuator(f"servo_{side}").id for side in SIDES]
    cables = [model.tendon(f"cable_{side}").id for side in SIDES]
    dofs = [model.joint(f"motor_{side}").dofadr[0] for side in SIDES]
    arms = np.array([model.body(f"arm_{side}").pos for side in SIDES])
    tips = np.array([model.site(f"cable_arm_{side}").pos for side in SIDES])
    ties = np.array([model.site(f"cable_femur_{s}").pos - model.body(f"tibia_{s}").pos for s in SIDES])
    constants = {
        "radius": tips[:, 2],
        "sideways": ties[:, 1] - arms[:, 1] - tips[:, 1],
        "stiffness": model.tendon_stiffness[cables],
        "cable_damping": model.tendon_damping[cables],
        "rest": model.tendon_lengthspring[cables, 1],
        "gain": model.actuator_gainprm[servos, 0],
        "offset": model.actuator_biasprm[servos, 0],
        "feedback": model.actuator_biasprm[servos, 1],
        "limits": model.actuator_forcerange[servos].T,
        "damping": model.dof_damping[dofs],
        "armature": model.dof_armature[dofs],
    }
    # The femur's tie point in the tibia's frame, from the servo's axis.
    tie = np.stack(
        [
            np.cos(knee) * ties[:, 0] - np.sin(knee) * ties[:, 2] - arms[:, 0],
            np.sin(knee) * ties[:, 0] + np.cos(knee) * ties[:, 2] - arms[:, 2],
        ],
        axis=-1,
    )
    settling, count = round(_SETTLING / grid.step), len(knee)

    def pad(values: np.ndarray) -> np.ndarray:
        after = -(settling + count) % _CHUNK
        return np.concatenate([np.repeat(values[:1], settling, 0), values, np.repeat(values[-1:], after, 0)])

    tie, command = pad(tie), pad(grid.command)
    ahead = np.concatenate([tie[1:], tie[-1:]])
    angles, rates = [], []
    with jax.enable_x64(True):
        state = (jnp.zeros(2), jnp.zeros(2))
        for start in range(0, len(tie), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            substeps = int(np.ceil(grid.step / _SERVO_SUBSTEP - 1e-9))
            state, (angle, rate) = _servo_chunk(
                constants, state, tie[chunk], ahead[chunk], command[chunk], np.array(grid.step / substeps), substeps
            )
            angles.append(np.asarray(angle))
            rates.append(np.asarray(rate))
    kept = slice(settling, settling + count)
    return np.concatenate(angles)[kept], np.concatenate(rates)[kept]


@partial(jax.jit, static_argnames="substeps")
def _servo_chunk(
    constants: dict[str, Array],
    state: tuple[Array, Array],
    tie: Float[Array, "chunk 2 2"],
    ahead: Float[Array, "chunk 2 2"],
    command: Float[Array, "chunk 2"],
    dt: Float[Array, ""],
    substeps: int,
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Servo arms (left, right) on their armature, implicit in the rate: state after, and at each sample.

    armature m'' = clip(servo) - damping m' - (dl/dm) tension, where l is the cable's length.
    """
    c = constants

    def sample(state: tuple[Array, Array], inputs: tuple[Array, Array, Array]) -> tuple:
        tie, ahead, command = inputs
        tie_rate = (ahead - tie) / (substeps * dt)

        def substep(i: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            angle, rate = state
            tip = c["radius"][:, None] * jnp.stack([-jnp.sin(angle), jnp.cos(angle)], -1)
            along = c["radius"][:, None] * jnp.stack([-jnp.cos(angle), -jnp.sin(angle)], -1)
            gap = tip - (tie + (ahead - tie) * (i / substeps))
            length = jnp.sqrt(jnp.sum(gap**2, -1) + c["sideways"] ** 2)
            moment = jnp.sum(gap * along, -1) / length
            length_rate = moment * rate - jnp.sum(gap * tie_rate, -1) / length
            tension = c["stiffness"] * jnp.maximum(length - c["rest"], 0.0) + c["cable_damping"] * length_rate
            servo = jnp.clip(c["gain"] * command + c["offset"] + c["feedback"] * angle, *c["limits"])
            resistance = c["damping"] + c["cable_damping"] * moment**2
            rate += dt * (servo - c["damping"] * rate - moment * tension) / (c["armature"] + dt * resistance)
            return angle + dt * rate, rate

        return jax.lax.fori_loop(0, substeps, substep, state), state

    return jax.lax.scan(sample, state, (tie, ahead, command))
