"""BALLU's additions to the reconstruction of its recordings.

- Base pitch: the neck's lever is only 15 mm long, so markers determine the pitch of a sample to about 7 deg. If the
  base's orientation is not recorded, the pitch is fitted over the whole recording at once, to the markers and to the
  base's torque balance.
- Motor angles: they are simulated by the model's servo, driven by the recorded commands and loaded by the cable at the
  knee angles found. Motor, cable and knee then agree. If motor angles are recorded, these are used instead.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import HIPS, KNEES, MOTORS, SIDES
from ballu_mjx.recordings.filters import noise_gain, odd_window, savitzky_golay
from ballu_mjx.recordings.inverse_kinematics import KinematicFit
from ballu_mjx.recordings.motion import MeasurementGrid

BASE_PITCH = "base_pitch"
"""Key of `Motion.uncertainty` for the standard deviation (rad) of the base's pitch. Neck and hip angles have the same
error with the opposite sign. The world poses of balloon, legs and feet do not have it."""

_CHUNK = 512
"""Number of samples in a compiled call, so that recordings of any length share one program."""
_TORQUE_NOISE = 1e-3
"""Standard deviation (N m) of the base's torque balance in a sample at 100 Hz. 1 deg of pitch is 2e-4 N m."""
_FORCE_WINDOW = 0.15
"""Width (s) of the Savitzky-Golay filter for the accelerations in the base's torque balance."""
_PITCH_HELD = 1e4
"""Weight (1/rad) with which the second fit holds the base's pitch at the value from the torque balance."""
_STOP_GIVE = float(np.deg2rad(0.5))
"""Largest angle (rad) of a knee below its stop. The stop is soft, and the spring holds the knee 0.35 deg inside it."""
_SERVO_SUBSTEP = 1e-3
"""Longest time step (s) of the servo's simulation, whose fastest time constant is about 9 ms."""
_SETTLING = 0.5
"""Time (s) for which the first command is held before the recording starts, so that the servo reaches its target."""


# ---- the base's pitch ----


def complete_positions(fit: KinematicFit) -> KinematicFit:
    """Return the fit with the base's pitch from its torque balance, unless the base's orientation is recorded.

    In either case, `uncertainty` of the result has the standard deviation (rad) of the pitch as `BASE_PITCH`.
    """
    grid, parameters = fit.problem.grid, fit.problem.parameters
    if "base" in grid.orientations:
        window = odd_window(parameters.position_window, grid.step, parameters.order, len(fit.qpos))
        deviation = parameters.rotation_noise * noise_gain(window, parameters.order)
        return dataclasses.replace(fit, uncertainty={BASE_PITCH: deviation})
    held, deviation = _base_pitch(fit)
    return fit.refit("base", held, np.array([0.0, _PITCH_HELD, 0.0]), **{BASE_PITCH: deviation})


_PITCH_DOF = 4
"""Index in qvel of the base's rotation about its y axis."""


def _base_pitch(fit: KinematicFit) -> tuple[Float[np.ndarray, "T 4"], float]:
    """Return base quaternions with a pitch that fits markers and torques, and the pitch's standard deviation (rad).

    The hips' axes pass through the base's origin. The world poses of legs and balloon are therefore known without the
    base's pitch theta. Let psi be the world pitches of balloon and femurs, and a and d the armature and damping of neck
    and hips. Let F be the balloon's pull at the neck r, and G the base's weight and inertia force at its centre of mass
    c. The torque balance about the hips' axis is:

        (I + sum a) theta'' + (sum d) theta' = sum (a psi'' + d psi') + r(theta) x F + c(theta) x G

    Its least-squares fit over all samples, together with the pitches of the inverse kinematics, is a banded problem.
    Gauss-Newton solves it.
    """
    model, grid, parameters = fit.problem.model, fit.problem.grid, fit.problem.parameters
    qpos, step, count = fit.qpos, grid.step, len(fit.qpos)
    measured, forward, up = _pitch(qpos[:, 3:7])
    base, balloon = model.body("base").id, model.body("balloon").id
    dofs = [model.joint(name).dofadr[0] for name in ("neck", "hip_left", "hip_right")]
    armature, damping = model.dof_armature[dofs], model.dof_damping[dofs]

    def smooth(values: np.ndarray, width: float, derivative: int) -> np.ndarray:
        return savitzky_golay(values, width, step, parameters.order, derivative)

    gravity = model.opt.gravity
    lifted = gravity * (1.0 - model.body_gravcomp[balloon])
    pull = model.body_mass[balloon] * (lifted - smooth(grid.positions["balloon"], _FORCE_WINDOW, 2))
    weight = model.body_mass[base] * (gravity - smooth(grid.positions["base"], _FORCE_WINDOW, 2))
    levers = [(model.body("balloon").pos, pull), (model.body_ipos[base], weight)]

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

    # The information varies little. The median ignores samples whose wrong pitch makes it seem well determined.
    information = np.median(1.0 / np.linalg.inv(fit.information)[:, _PITCH_DOF, _PITCH_DOF])
    torque_noise = _TORQUE_NOISE * np.sqrt(0.01 / step)
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
    """Return the pitch (rad) about the body's y axis, and the axes of the frame in which it is measured.

    These are the horizontal axis `forward`, from which the pitch is measured, and `up`, which completes the frame.
    """
    matrix = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    x, y = matrix[:, :, 0], matrix[:, :, 1]
    forward = np.cross(y, np.array([0.0, 0.0, 1.0]))
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up = np.cross(forward, y)
    return np.unwrap(np.arctan2(-np.sum(x * up, axis=1), np.sum(x * forward, axis=1))), forward, up


# ---- motors ----


def complete_joints(
    model: mujoco.MjModel,
    grid: MeasurementGrid,
    qpos: Float[np.ndarray, "T nq"],
    qvel: Float[np.ndarray, "T nv"],
) -> tuple[Float[np.ndarray, "T nq"], Float[np.ndarray, "T nv"]]:
    """Return states with the knees at or above their stops, and with simulated motors if these are not recorded."""
    qpos, qvel = qpos.copy(), qvel.copy()
    stops = np.array([model.joint(f"knee_{side}").range for side in SIDES])
    knees = qpos[:, 7:][:, KNEES]
    knees[:] = np.clip(knees, stops[:, 0] - _STOP_GIVE, stops[:, 1])
    if not all(f"motor_{side}" in grid.joint_angles for side in SIDES):
        qpos[:, 7:][:, MOTORS], qvel[:, 6:][:, MOTORS] = _servos(model, grid, knees)
    return qpos, qvel


def _servos(
    model: mujoco.MjModel, grid: MeasurementGrid, knee: Float[np.ndarray, "T 2"]
) -> tuple[Float[np.ndarray, "T 2"], Float[np.ndarray, "T 2"]]:
    """Return motor angles (rad) and rates (rad/s) of the model's servos under the commands, for given knee angles."""
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
        "rest": model.tendon_lengthspring[cables, 1],
        "gain": model.actuator_gainprm[servos, 0],
        "offset": model.actuator_biasprm[servos, 0],
        "feedback": model.actuator_biasprm[servos, 1],
        "limits": model.actuator_forcerange[servos].T,
        "damping": model.dof_damping[dofs],
        "armature": model.dof_armature[dofs],
    }
    # The cable's end at the femur in the tibia's frame, relative to the servo's axis.
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
    """Simulate the servo arms (left, right) and return the final state, and the angles and rates at each sample.

    The equation, with the motor angle m and the cable's length l, is integrated implicitly in the damping's rate m':

        armature m'' = clip(servo) - damping m' - (dl/dm) tension
    """
    c = constants

    def sample(state: tuple[Array, Array], inputs: tuple[Array, Array, Array]) -> tuple:
        tie, ahead, command = inputs

        def substep(i: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            angle, rate = state
            tip = c["radius"][:, None] * jnp.stack([-jnp.sin(angle), jnp.cos(angle)], -1)
            along = c["radius"][:, None] * jnp.stack([-jnp.cos(angle), -jnp.sin(angle)], -1)
            gap = tip - (tie + (ahead - tie) * (i / substeps))
            length = jnp.sqrt(jnp.sum(gap**2, -1) + c["sideways"] ** 2)
            moment = jnp.sum(gap * along, -1) / length
            tension = c["stiffness"] * jnp.maximum(length - c["rest"], 0.0)
            servo = jnp.clip(c["gain"] * command + c["offset"] + c["feedback"] * angle, *c["limits"])
            rate += dt * (servo - c["damping"] * rate - moment * tension) / (c["armature"] + dt * c["damping"])
            return angle + dt * rate, rate

        return jax.lax.fori_loop(0, substeps, substep, state), state

    return jax.lax.scan(sample, state, (tie, ahead, command))
