"""Virtual robots that replace the hardware: a family in C MuJoCo, with effects that the nominal model lacks.

They differ from `assets/ballu.xml` in these points:

- The time step is 0.5 ms. Integration is explicit (semi-implicit Euler) and in double precision.
- Air acts on the balloon cluster by MuJoCo's ellipsoid model (drag, lift, Magnus force). The balloon's body has an
  added mass and inertia. A slow draught differs between trials.
- Servos and cables differ between left and right: gain, zero, torque limit, friction, backlash and slack. Knee springs
  and stops differ too.
- The balloon cluster is slightly off centre.
- Commands have a latency.

Only motion capture observes the robot: 100 Hz, noise of 0.5 mm and 0.3 deg, hidden markers.

Code that trains must not import this module's robots. It may know them only by their recordings.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.actuators import CABLE_SLACK, SERVO_RANGE, ActuatorParameters, actuator_fields
from ballu_mjx.ballu.model import CONTROL_TIMESTEP, SIDES, load_model, standing_qpos, suspend
from ballu_mjx.ballu.recordings import make_recording
from ballu_mjx.ballu.virtual.air import add_air, leave_drag_lift_and_magnus_force
from ballu_mjx.ballu.virtual.flexible_body import FlexibleBody, harden_cables, make_flexible
from ballu_mjx.policies.deploy.estimator import Capture
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.model import assets, set_fields

CaptureController = Callable[[Capture], Float[np.ndarray, " 2"]]
"""Function from all captured frames so far to the next commands (left, right)."""
NAMES = ("balloon", "base", "foot_left", "foot_right")
"""Points that motion capture sees. Each is hidden independently of the others."""
PHYSICS_TIMESTEP = 5e-4
"""Physics step (s)."""
CAPTURE_TIMESTEP = 0.01
"""Time (s) between two frames of motion capture."""
_TICK = 1e-3
"""Time (s) between two readings of the command queue, and thus the resolution of the latency."""
AIR_DENSITY = 1.2
"""Density of the air (kg/m^3)."""
POSITION_NOISE = 5e-4
"""Standard deviation (m) of captured positions, along each axis."""
ORIENTATION_NOISE = float(np.deg2rad(0.3))
"""Standard deviation (rad) of captured orientations, about each axis."""


@dataclasses.dataclass(frozen=True)
class VirtualRobot:
    """A robot of the family. Pairs are (left, right). Units are SI units and radians."""

    name: str
    knee_spring_stiffness: tuple[float, float]
    """Stiffness of the knee springs (N m/rad)."""
    default_knee_angle: tuple[float, float]
    """Angles of the knee stops (rad)."""
    knee_friction: tuple[float, float]
    """Dry friction of the knees (N m)."""
    motor_gain: tuple[float, float]
    """Position gain of the servos (N m/rad)."""
    default_motor_angle: tuple[float, float]
    """Motor angle (rad) at command 0."""
    torque_limit: tuple[float, float]
    """Torque at which the servos saturate (N m)."""
    motor_friction: tuple[float, float]
    """Dry friction of the motors (N m)."""
    backlash: tuple[float, float]
    """Width of the backlash between command and motor target (rad)."""
    cable_slack: tuple[float, float]
    """Slack of the cables (m) with the motor at 0 and the knee at its stop."""
    foot_friction: tuple[float, float]
    """Coefficient of sliding friction between foot and floor."""
    balloon_offset: tuple[float, float, float]
    """Offset of the balloon cluster's centre of lift and mass from the nominal one (m, balloon frame)."""
    balloon_semi_axes: tuple[float, float, float]
    """Semi-axes of the ellipsoid of air that the cluster displaces (m)."""
    added_mass: float
    """Mass of the air that moves with the cluster (kg), equal in all directions. Lift carries its weight."""
    added_inertia: float
    """Moment of inertia of the air that turns with the cluster (kg m^2), equal about all axes."""
    buoyancy: float
    """Ratio of the lift to the nominal robot's weight."""
    latency: float
    """Time (s) from a command to the servo's target."""
    flexible: FlexibleBody | None = None
    """Body of another form. None for the masses, lengths and parts of the nominal model. A robot with another body has
    its own cable stiffness and balloon shapes, and no `added_inertia`."""

    @property
    def actuators(self) -> ActuatorParameters:
        """Return the true values of the actuator parameters that `ActuatorParameters` requires."""
        names = {field.name for field in dataclasses.fields(self)}
        own = [f.name for f in dataclasses.fields(ActuatorParameters) if f.default is dataclasses.MISSING]
        return ActuatorParameters(**{name: jnp.array(getattr(self, name)) for name in own if name in names})


@dataclasses.dataclass(frozen=True)
class TrialConditions:
    """Conditions that differ between trials of the same robot."""

    draught: tuple[float, float, float]
    """Mean air velocity (m/s, world frame)."""
    draught_swing: tuple[float, float]
    """Amplitude (m/s) and period (s) of the slow variation of the draught."""
    start: tuple[float, float, float]
    """Offset of the start from the origin: x, y (m) and yaw (rad)."""
    capture_seed: int
    """Seed of the motion capture's noise and drop-outs."""


def still(trial: TrialConditions) -> TrialConditions:
    """Return the conditions of a trial without its draught."""
    return dataclasses.replace(trial, draught=(0.0, 0.0, 0.0), draught_swing=(0.0, trial.draught_swing[1]))


def draw_pair(rng: np.random.Generator, low: float, high: float) -> tuple[float, float]:
    """Draw two values, uniformly between `low` and `high`."""
    first, second = rng.uniform(low, high, 2)
    return float(first), float(second)


def draw_robot(seed: int) -> VirtualRobot:
    """Draw one robot of the family."""
    rng = np.random.default_rng([seed, 1])
    pair = functools.partial(draw_pair, rng)
    degree = np.pi / 180
    side = rng.choice([-1.0, 1.0])
    return VirtualRobot(
        name=f"virtual-ballu-{seed}",
        knee_spring_stiffness=pair(0.0125, 0.0210),
        default_knee_angle=pair(26 * degree, 33 * degree),
        knee_friction=pair(2e-4, 1.2e-3),
        motor_gain=pair(0.28, 0.55),
        default_motor_angle=pair(-6 * degree, 6 * degree),
        torque_limit=pair(0.055, 0.085),
        motor_friction=pair(1e-3, 4e-3),
        backlash=pair(1 * degree, 4 * degree),
        cable_slack=pair(2e-4, 1.5e-3),
        foot_friction=pair(0.7, 1.0),
        balloon_offset=(float(rng.uniform(-0.01, 0.01)), float(side * rng.uniform(0.010, 0.020)), 0.0),
        balloon_semi_axes=(0.34, 0.36, 0.38),
        added_mass=float(rng.uniform(0.10, 0.14)),
        added_inertia=float(rng.uniform(1e-3, 3e-3)),
        buoyancy=float(rng.uniform(0.83, 0.85)),
        latency=float(rng.uniform(0.03, 0.07)),
    )


def draw_trial(seed: int) -> TrialConditions:
    """Draw the conditions of one trial."""
    rng = np.random.default_rng([seed, 2])
    direction, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 0.06)
    return TrialConditions(
        draught=(float(speed * np.cos(direction)), float(speed * np.sin(direction)), 0.0),
        draught_swing=(float(rng.uniform(0.0, 0.03)), float(rng.uniform(8.0, 25.0))),
        start=(float(rng.normal(0, 0.01)), float(rng.normal(0, 0.01)), float(rng.normal(0, np.deg2rad(2.0)))),
        capture_seed=int(rng.integers(2**31)),
    )


def build(virtual: VirtualRobot, *, suspended: bool = False) -> mujoco.MjModel:
    """Return the robot's C MuJoCo model.

    `suspended`: whether to weld the base to the world with the feet off the ground, for sweeps.
    """
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    spec.option.timestep = PHYSICS_TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.iterations, spec.option.ls_iterations, spec.option.tolerance = 50, 50, 1e-9
    spec.option.density = AIR_DENSITY

    nominal = load_model()
    lift = virtual.buoyancy * float(nominal.body_mass.sum() * np.linalg.norm(nominal.opt.gravity))
    if virtual.flexible is None:
        balloon = spec.body("balloon")
        balloon.ipos += virtual.balloon_offset
        balloon.inertia += virtual.added_inertia
        add_air(spec, balloon, "air", lift, virtual.added_mass, virtual.balloon_semi_axes)
    else:
        make_flexible(spec, virtual.flexible, virtual.balloon_offset, lift, virtual.added_mass)
    for index, side in enumerate(SIDES):
        spec.joint(f"knee_{side}").frictionloss = virtual.knee_friction[index]
        spec.joint(f"motor_{side}").frictionloss = virtual.motor_friction[index]
        spec.geom(f"foot_{side}").friction[0] = virtual.foot_friction[index]
    if suspended:
        suspend(spec)
    model = spec.compile()

    parameters = dataclasses.replace(virtual.actuators, cable_slack=jnp.full(2, CABLE_SLACK))
    set_fields(model, actuator_fields(model, parameters))
    model.actuator_forcerange[:] = np.outer(virtual.torque_limit, [-1.0, 1.0])  # again, in double precision
    for side, slack in zip(SIDES, virtual.cable_slack, strict=True):
        model.tendon_lengthspring[model.tendon(f"cable_{side}").id, 1] += slack - CABLE_SLACK
    if virtual.flexible is not None:
        harden_cables(model, virtual.flexible)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    leave_drag_lift_and_magnus_force(model)
    return model


@dataclasses.dataclass
class _Servos:
    """Latency and backlash between the sent commands and the servos' targets."""

    latency: float
    """Latency (s)."""
    backlash: Float[np.ndarray, " 2"]
    """Width of the backlash (rad)."""
    queue: list[tuple[float, np.ndarray]]
    """Commands that have not arrived yet, with the times (s) at which they arrive."""
    target: Float[np.ndarray, " 2"]
    """Targets (command units)."""

    def send(self, time: float, command: np.ndarray) -> None:
        """Send a command at `time` (s)."""
        self.queue.append((time + self.latency, command))

    def at(self, time: float) -> np.ndarray:
        """Return the targets (command units) at `time` (s). They stay within half the backlash of the last command."""
        while self.queue and self.queue[0][0] <= time + 1e-9:
            _, command = self.queue.pop(0)
            half = self.backlash / SERVO_RANGE / 2
            self.target = np.clip(self.target, command - half, command + half)
        return np.clip(self.target, 0.0, 1.0)


def open_loop(commands: Float[np.ndarray, "steps 2"]) -> CaptureController:
    """Return a controller that replays `commands`, one for each control step, without feedback."""
    frames = round(CONTROL_TIMESTEP / CAPTURE_TIMESTEP)
    return lambda capture: commands[(len(capture.time) - 1) // frames]


def record(
    virtual: VirtualRobot,
    trial: TrialConditions,
    controller: CaptureController,
    duration: float,
    name: str,
    notes: str = "",
) -> Recording:
    """Run one trial of `duration` seconds and return its recording by motion capture.

    The robot stands still for two seconds before time 0. Commands change at the control rate (20 Hz). The last command
    is repeated in the last frame.
    """
    capture, base_quaternion, _, _ = _simulate(virtual, trial, controller, duration)
    return recording_of(capture, base_quaternion, virtual.name, name, notes)


def record_truth(
    virtual: VirtualRobot, trial: TrialConditions, controller: CaptureController, duration: float
) -> tuple[Float[np.ndarray, "frames nq"], Float[np.ndarray, "frames nv"]]:
    """Return the true generalized positions and velocities in a trial of `record`, at the frames of its recording.

    They serve to check quantities that are computed from the recording.
    """
    _, _, qpos, qvel = _simulate(virtual, trial, controller, duration)
    return qpos, qvel


def _simulate(
    virtual: VirtualRobot, trial: TrialConditions, controller: CaptureController, duration: float
) -> tuple[Capture, np.ndarray, np.ndarray, np.ndarray]:
    """Return the captured frames, the captured orientations of the base, and the true qpos and qvel."""
    model = build(virtual)
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    servos = _Servos(virtual.latency, np.array(virtual.backlash), [], np.zeros(2))
    mujoco.mj_step(model, data, round(2.0 / PHYSICS_TIMESTEP))
    _place(model, data, trial)

    rng = np.random.default_rng(trial.capture_seed)
    capture, turns = Capture(NAMES), []
    hidden = _hidden(rng, round(duration / CAPTURE_TIMESTEP) + 1)
    frames_per_control = round(CONTROL_TIMESTEP / CAPTURE_TIMESTEP)
    command = np.zeros(2)
    truth = []
    for frame in range(len(hidden)):
        time = frame * CAPTURE_TIMESTEP
        mujoco.mj_forward(model, data)
        truth.append((data.qpos.copy(), data.qvel.copy()))
        turns.append(_capture_frame(data, rng, hidden[frame], time, capture))
        if frame % frames_per_control == 0 and frame < len(hidden) - 1:
            command = np.clip(np.asarray(controller(capture), float), 0.0, 1.0)
            servos.send(time, command)
        capture.command.append(command)
        if frame == len(hidden) - 1:
            break
        _advance(model, data, servos, trial, time)
    qpos, qvel = (np.array(x) for x in zip(*truth, strict=True))
    return capture, np.array(turns), qpos, qvel


def _advance(model: mujoco.MjModel, data: mujoco.MjData, servos: _Servos, trial: TrialConditions, time: float) -> None:
    """Advance the simulation from a frame of the capture, at `time` (s), to the next one.

    Commands arrive at ticks, or at the nearest physics step if physics steps are longer than ticks.
    """
    model.opt.wind[:] = wind(trial, time)
    tick = max(_TICK, model.opt.timestep)
    for start in time + tick * np.arange(round(CAPTURE_TIMESTEP / tick)):
        data.ctrl[:] = servos.at(start + (tick - _TICK) / 2)
        mujoco.mj_step(model, data, round(tick / model.opt.timestep))


def continue_trial(
    virtual: VirtualRobot,
    trial: TrialConditions,
    commands: Float[np.ndarray, "steps 2"],
    first: int,
    state: tuple[Float[np.ndarray, " nq"], Float[np.ndarray, " nv"]],
    count: int,
    model: mujoco.MjModel | None = None,
) -> Float[np.ndarray, "count nq"]:
    """Continue a trial from its control step `first` and return generalized positions after each of `count` steps.

    **Arguments**

    - `commands`: all commands of the trial. Those before `first` determine the state of the servos.
    - `state`: qpos and qvel at the control step `first`.
    - `model`: model that replaces the robot's own. Its time step is at most that of the capture.
    """
    model = build(virtual) if model is None else model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state
    servos = _Servos(virtual.latency, np.array(virtual.backlash), [], np.zeros(2))
    frames = round(CONTROL_TIMESTEP / CAPTURE_TIMESTEP)
    qpos = []
    for step, command in enumerate(commands[: first + count]):
        time = step * CONTROL_TIMESTEP
        servos.send(time, command)
        if step < first:
            servos.at(time)
            continue
        for frame in range(frames):
            _advance(model, data, servos, trial, time + frame * CAPTURE_TIMESTEP)
        qpos.append(data.qpos.copy())
    return np.array(qpos)


def record_sweep(virtual: VirtualRobot, seed: int, name: str, *, commands: int = 20, hold: float = 2.0) -> Recording:
    """Record a suspended sweep: `commands` levels spread uniformly over [0, 1], each held for `hold` seconds."""
    model = build(virtual, suspended=True)
    data = mujoco.MjData(model)
    knees = [model.joint(f"knee_{side}").qposadr[0] for side in SIDES]
    motors = [model.joint(f"motor_{side}").qposadr[0] for side in SIDES]
    data.qpos[knees] = virtual.default_knee_angle
    mujoco.mj_step(model, data, round(2.0 / PHYSICS_TIMESTEP))
    rng = np.random.default_rng([seed, 3])
    servos = _Servos(virtual.latency, np.array(virtual.backlash), [], np.zeros(2))
    frames_per_level = round(hold / CAPTURE_TIMESTEP)
    ticks_per_frame = round(CAPTURE_TIMESTEP / _TICK)
    rows = []
    for level in np.linspace(0.0, 1.0, commands):
        for frame in range(frames_per_level):
            time = len(rows) * CAPTURE_TIMESTEP
            if frame == 0:
                servos.send(time, np.full(2, level))
            angles = np.concatenate([data.qpos[motors], data.qpos[knees]])
            rows.append([time, level, *(angles + rng.normal(0, ORIENTATION_NOISE, 4))])
            for tick in range(ticks_per_frame):
                data.ctrl[:] = servos.at(time + tick * _TICK)
                mujoco.mj_step(model, data, round(_TICK / PHYSICS_TIMESTEP))
    table = np.array(rows)
    return make_recording(
        name=name,
        kind="suspended",
        robot=virtual.name,
        notes="Actuator sweep, feet off the ground.",
        time=table[:, 0],
        command=np.repeat(table[:, 1:2], 2, axis=1),
        motor=table[:, 2:4],
        knee=table[:, 4:6],
    )


def _place(model: mujoco.MjModel, data: mujoco.MjData, trial: TrialConditions) -> None:
    """Turn and shift the standing robot about its base, so that a trial starts near the origin and faces x."""
    start = Rotation.from_quat(data.qpos[3:7], scalar_first=True)
    heading = start.as_euler("ZYX")[0]
    turn = Rotation.from_euler("z", trial.start[2] - heading)
    data.qpos[:2] = trial.start[:2]
    data.qpos[3:7] = (turn * start).as_quat(scalar_first=True)
    data.qvel[:3] = turn.apply(data.qvel[:3])


def wind(trial: TrialConditions, time: float) -> Float[np.ndarray, " 3"]:
    """Return the air velocity (m/s, world frame) at `time` (s)."""
    amplitude, period = trial.draught_swing
    phase = 2 * np.pi * time / period
    return np.array(trial.draught) + amplitude * np.array([np.sin(phase), np.cos(phase), 0.0])


def _hidden(rng: np.random.Generator, frames: int) -> np.ndarray:
    """Return which points are hidden in which frame: each about once in 10 s, for up to 0.15 s."""
    hidden = np.zeros((frames, len(NAMES)), bool)
    for marker in range(len(NAMES)):
        for _ in range(rng.poisson(frames * CAPTURE_TIMESTEP / 10.0)):
            start, length = rng.integers(5, max(frames - 20, 6)), rng.integers(2, 16)
            hidden[start : start + length, marker] = True
    return hidden


def _capture_frame(
    data: mujoco.MjData, rng: np.random.Generator, hidden: np.ndarray, time: float, capture: Capture
) -> Float[np.ndarray, " 4"]:
    """Append the current frame to `capture`. Return the base's orientation (w, x, y, z), which policies do not see."""

    def position(site: str, is_hidden: np.bool) -> np.ndarray:
        noisy = data.site(site).xpos + rng.normal(0, POSITION_NOISE, 3)
        return np.full(3, np.nan) if is_hidden else noisy

    def quaternion(body: str, is_hidden: np.bool) -> np.ndarray:
        noise = Rotation.from_rotvec(rng.normal(0, ORIENTATION_NOISE, 3))
        noisy = noise * Rotation.from_quat(data.body(body).xquat, scalar_first=True)
        return np.full(4, np.nan) if is_hidden else noisy.as_quat(scalar_first=True, canonical=True)

    balloon, turn = position("balloon", hidden[0]), quaternion("balloon", hidden[0])
    base, base_turn = position("base", hidden[1]), quaternion("base", hidden[1])
    feet = [position(f"foot_{side}", hidden[2 + i]) for i, side in enumerate(SIDES)]
    capture.time.append(time)
    capture.position.append(np.stack([balloon, base, *feet]))
    capture.quaternion.append(turn)
    return base_turn


def recording_of(
    capture: Capture, base_quaternion: Float[np.ndarray, "T 4"], robot: str, name: str, notes: str
) -> Recording:
    """Return the recording of all captured frames. `robot` is the name of the specimen."""
    position = np.array(capture.position)
    return make_recording(
        name=name,
        kind="free",
        robot=robot,
        notes=notes,
        time=np.array(capture.time),
        command=np.array(capture.command),
        balloon_position=position[:, 0],
        balloon_quaternion=np.array(capture.quaternion),
        base_position=position[:, 1],
        base_quaternion=base_quaternion,
        foot_position=position[:, 2:],
    )
