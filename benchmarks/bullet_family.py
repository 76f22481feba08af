"""A second family of virtual BALLU robots, in PyBullet, for tests of identification and residuals.

Masses, positions and lengths are those of the real robot, from its CAD export. The mechanism differs from the
package's:

- A position loop moves each arm, with a time constant, a top speed, and a travel below 90 deg. There is backlash
  between the loop and the arm. The load bends the arm slightly.
- A cable is a one-sided spring and damper between its attachment points. Its tension saturates.
- Knees have viscous friction.
- The air exerts quadratic drag and the force of the added mass on the balloons, and a torque against their rotation.
- Contacts and joint stops are those of Bullet.

`draw(seed)` draws a robot from the ranges in its code. Seeds 0 to 4 are the family. Choices in the package were based
on robots 0, 1 and 2 (`CHOSEN_ON`). Results are reported for all five. The package does not import this module. No
start, prior or bound of any fit is taken from it.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pybullet  # pyright: ignore[reportMissingImports]
from bullet_world import open_world
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.gaits import Gait, telegraph, waves
from ballu_mjx.ballu.model import CONTROL_TIMESTEP, SIDES
from ballu_mjx.ballu.recordings import make_recording
from ballu_mjx.ballu.virtual.robot import (
    NAMES,
    CaptureController,
    TrialConditions,
    open_loop,
    recording_of,
    wind,
)
from ballu_mjx.policies.deploy.estimator import Capture
from ballu_mjx.recordings.recording import Recording

ROBOTS = range(5)
"""Seeds of the family."""
CHOSEN_ON = (0, 1, 2)
"""Robots on which choices in the package may be based."""
TIMESTEP = 1e-3
"""Physics step (s)."""
CAPTURE_TIMESTEP = 0.01
"""Sampling interval of recordings (s)."""
POSITION_NOISE = 5e-4
"""Standard deviation of recorded positions (m)."""
ANGLE_NOISE = float(np.deg2rad(0.3))
"""Standard deviation of recorded angles and orientations (rad)."""
GRAVITY = 9.81
_DEGREE = np.pi / 180

# ---- constants of the robot (SI units; x forward, y left, z up) ----

BASE_MASS, BASE_COM, BASE_INERTIA = 0.02127, (-0.00044, 0.00002, -0.0039), (2.3943e-5, 2.1653e-6, 2.3619e-5)
FEMUR_MASS, FEMUR_COM, FEMUR_INERTIA = 0.00944, (-0.00005, 0.0, -0.17956), (1.7050e-4, 1.7049e-4, 1.0243e-7)
TIBIA_MASS, TIBIA_COM, TIBIA_INERTIA = 0.04367, (0.0068, -0.00419, -0.22605), (1.5546e-4, 1.5892e-4, 5.6535e-6)
ARM_MASS = 0.00016
"""Mass of an arm, which is part of the tibia's."""
BALLOON_MASS, BALLOON_COM, BALLOON_INERTIA = 0.15898, (-0.00006, 0.0, 0.37953), (1.4214e-2, 1.4208e-2, 1.0256e-2)
TOTAL_MASS = BASE_MASS + BALLOON_MASS + 2 * (FEMUR_MASS + TIBIA_MASS + ARM_MASS)
NECK, HIP_Y, FEMUR_LENGTH = (0.00444, 0.0, 0.015), 0.058025, 0.36501
FOOT_Z, FOOT_RADIUS = -0.38485, 0.004
TIE_ABOVE_KNEE, ARM_X, ARM_Z, ARM_LENGTH = 0.025, -0.008375, -0.32732, 0.016
SPRING_STIFFNESS, SPRING_PRELOAD, KNEE_MOST = 2 * 0.00807, 72.35 * _DEGREE, 100 * _DEGREE
ARM_RANGE = np.pi / 2
PASSIVE_DAMPING, PASSIVE_ARMATURE = 1e-3, 1e-4
STANDING_HIP = -14 * _DEGREE


@dataclasses.dataclass(frozen=True)
class BulletRobot:
    """Parameters of one robot of the family, in SI units and radians. Pairs are (left, right)."""

    name: str
    arm_travel: tuple[float, float]
    """Angle of the arm at command 1, as a share of 90 deg."""
    arm_zero: tuple[float, float]
    """Angle of the arm at command 0."""
    arm_lag: tuple[float, float]
    """Time constant of the position loop."""
    arm_speed: tuple[float, float]
    """Top speed of the arm."""
    arm_yield: tuple[float, float]
    """Compliance of the arm, rad/(N m)."""
    play: tuple[float, float]
    """Width of the backlash between position loop and arm."""
    delay: float
    """Delay from the command to the position loop."""
    cable_stiffness: tuple[float, float]
    cable_damping: tuple[float, float]
    cable_limit: tuple[float, float]
    """Tension (N) at which the cable saturates."""
    cable_slack: tuple[float, float]
    """Slack with the arm at 0 and the knee at its stop."""
    spring_stiffness: tuple[float, float]
    knee_stop: tuple[float, float]
    knee_damping: tuple[float, float]
    foot_friction: tuple[float, float]
    buoyancy: float
    """Ratio of lift to weight."""
    balloon_offset: tuple[float, float]
    """Offset of the balloons' centre of mass and lift in x and y."""
    drag: float
    """Coefficient of the quadratic drag, N/(m/s)^2."""
    turning_drag: float
    """Coefficient of the torque against rotation, N m/(rad/s)^2."""
    added_mass: float
    """Added mass of the balloons."""


def draw(seed: int) -> BulletRobot:
    """Draw the robot with this seed."""
    rng = np.random.default_rng([seed, 41])

    def one(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def pair(low: float, high: float) -> tuple[float, float]:
        return one(low, high), one(low, high)

    return BulletRobot(
        name=f"bullet-ballu-{seed}",
        arm_travel=pair(0.75, 0.97),
        arm_zero=pair(-3 * _DEGREE, 4 * _DEGREE),
        arm_lag=pair(0.02, 0.06),
        arm_speed=pair(5.0, 8.0),
        arm_yield=pair(0.1, 0.4),
        play=pair(1 * _DEGREE, 4 * _DEGREE),
        delay=one(0.02, 0.06),
        cable_stiffness=pair(1000.0, 3000.0),
        cable_damping=pair(1.0, 4.0),
        cable_limit=pair(3.5, 7.0),
        cable_slack=pair(1e-4, 1.2e-3),
        spring_stiffness=pair(0.75 * SPRING_STIFFNESS, 1.2 * SPRING_STIFFNESS),
        knee_stop=pair(26 * _DEGREE, 31 * _DEGREE),
        knee_damping=pair(0.004, 0.016),
        foot_friction=pair(0.7, 1.0),
        buoyancy=one(0.82, 0.86),
        balloon_offset=(one(-0.006, 0.006), one(-0.012, 0.012)),
        drag=one(0.10, 0.30),
        turning_drag=one(2e-3, 8e-3),
        added_mass=one(0.08, 0.14),
    )


# ---- recordings ----

SWEEP_HOLD = 2.0
"""Duration of a hold in a sweep (s)."""


def sweep_commands(count: int = 20) -> Float[np.ndarray, "holds 2"]:
    """Return evenly spaced levels in [0, 1] in rising order, the same for both legs."""
    return np.repeat(np.round(np.linspace(0.0, 1.0, count), 4)[:, None], 2, axis=1)


def held_out_commands(seed: int, count: int = 16) -> Float[np.ndarray, "holds 2"]:
    """Return random levels in [0, 1], different for each leg."""
    return np.round(np.random.default_rng([seed, 42]).uniform(0.0, 1.0, (count, 2)), 4)


def record_sweep(robot: BulletRobot, commands: Float[np.ndarray, "holds 2"], name: str, seed: int = 0) -> Recording:
    """Return a sweep with a fixed base and each pair of commands held for `SWEEP_HOLD` (s).

    The legs have settled at the first commands before the recording begins.
    """
    world = World(robot, held=True)
    rng = np.random.default_rng([seed, 43])
    world.run(commands[0], 2.0)
    rows, sent = [], []
    for level in commands:
        for _ in range(round(SWEEP_HOLD / CAPTURE_TIMESTEP)):
            rows.append([*world.arms, *world.knees])
            sent.append(level)
            world.run(level, CAPTURE_TIMESTEP)
    world.close()
    angles = np.array(rows) + rng.normal(0, ANGLE_NOISE, (len(rows), 4))
    return make_recording(
        name=name,
        kind="suspended",
        robot=robot.name,
        notes="Commands held one after the other, feet off the ground.",
        time=np.arange(len(rows)) * CAPTURE_TIMESTEP,
        command=np.array(sent),
        motor=angles[:, :2],
        knee=angles[:, 2:],
    )


def walking_commands(seconds: float) -> dict[str, Float[np.ndarray, "steps 2"]]:
    """Return hand-designed commands by recording. `near-*` are walking gaits, `far-*` are other commands."""
    return {
        "near-1": Gait(1.2, 0.5, (0.4, 0.4), (0.9, 0.9)).commands(seconds),
        "near-2": Gait(1.4, 0.45, (0.45, 0.45), (0.8, 0.8)).commands(seconds),
        "far-1": waves(seconds),
        "far-2": telegraph(seconds),
    }


def record_walking(robot: BulletRobot, commands: Float[np.ndarray, "steps 2"], name: str, seed: int = 0) -> Recording:
    """Return a recording of commands at 20 Hz, after two seconds of standing, in still air."""
    notes = "Hand-designed commands, open loop."
    noise = np.random.default_rng([seed, 44])
    return _record(robot, STILL, noise, open_loop(commands), len(commands) * CONTROL_TIMESTEP, name, notes)


STILL = TrialConditions(draught=(0.0, 0.0, 0.0), draught_swing=(0.0, 10.0), start=(0.0, 0.0, 0.0), capture_seed=0)
"""Conditions without draught. The robot faces x."""


def draw_conditions(number: int) -> TrialConditions:
    """Draw the conditions of a trial: a draught of up to 0.06 m/s that varies slowly, and the heading at the start."""
    rng = np.random.default_rng([number, 45])
    direction, speed = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, 0.06)
    return TrialConditions(
        draught=(float(speed * math.cos(direction)), float(speed * math.sin(direction)), 0.0),
        draught_swing=(float(rng.uniform(0.0, 0.03)), float(rng.uniform(8.0, 25.0))),
        start=(0.0, 0.0, float(rng.normal(0.0, 2 * _DEGREE))),
        capture_seed=number,
    )


@dataclasses.dataclass(frozen=True)
class BulletHardware:
    """A robot of the family as `ballu_mjx.ballu.virtual.hardware.Hardware`."""

    robot: BulletRobot
    seed: int

    @staticmethod
    def draw(seed: int) -> BulletHardware:
        """Draw the robot with this seed."""
        return BulletHardware(draw(seed), seed)

    @property
    def name(self) -> str:
        return self.robot.name

    def record_sweep(self, name: str) -> Recording:
        return record_sweep(self.robot, sweep_commands(), name, self.seed)

    def record(self, trial: int, controller: CaptureController, seconds: float, name: str, notes: str) -> Recording:
        conditions = draw_conditions(trial)
        noise = np.random.default_rng([conditions.capture_seed, 46])
        return _record(self.robot, conditions, noise, controller, seconds, name, notes)


def _record(
    robot: BulletRobot,
    conditions: TrialConditions,
    rng: np.random.Generator,
    controller: CaptureController,
    seconds: float,
    name: str,
    notes: str,
) -> Recording:
    """Return a recording of a controller, after two seconds of standing.

    It has the poses of balloons and base, and the positions of the feet. `rng` draws the noise of the motion capture.
    """
    world = World(robot, conditions)
    world.run(np.zeros(2), 2.0)
    world.begin_trial()
    frames = round(CONTROL_TIMESTEP / CAPTURE_TIMESTEP)
    capture, bases = Capture(NAMES), []
    command = np.zeros(2)
    for number in range(round(seconds / CAPTURE_TIMESTEP) + 1):
        places, balloon, base = world.look()
        noisy = places + rng.normal(0, POSITION_NOISE, places.shape)
        turns = Rotation.from_rotvec(rng.normal(0, ANGLE_NOISE, (2, 3)))
        capture.time.append(number * CAPTURE_TIMESTEP)
        capture.position.append(noisy)
        capture.quaternion.append((turns[0] * balloon).as_quat(scalar_first=True, canonical=True))
        bases.append((turns[1] * base).as_quat(scalar_first=True, canonical=True))
        if number == round(seconds / CAPTURE_TIMESTEP):
            break
        if number % frames == 0:
            command = np.clip(np.asarray(controller(capture), float), 0.0, 1.0)
        capture.command.append(command)
        world.run(command, CAPTURE_TIMESTEP)
    capture.command.append(command)
    world.close()
    return recording_of(capture, np.array(bases), robot.name, name, notes)


# ---- the world ----


class World:
    """A robot in Bullet, standing on a floor or with a fixed base (`held`)."""

    def __init__(self, robot: BulletRobot, conditions: TrialConditions = STILL, *, held: bool = False) -> None:
        self.robot, self._conditions = robot, conditions
        self._time = 0.0
        self._world, self._body = open_world(urdf(robot), (0.0, 0.0, -GRAVITY), TIMESTEP, held=held)
        infos = [self._world.getJointInfo(self._body, index) for index in range(self._world.getNumJoints(self._body))]
        self._links = {info[12].decode(): info[0] for info in infos}
        self._knees = [self._links[f"tibia_{side}"] for side in SIDES]
        inertia = _inertias()
        for name, link in {"base": -1, **self._links}.items():
            side = name.endswith("right")
            self._world.changeDynamics(
                self._body, link, linearDamping=0.0, angularDamping=0.0, restitution=0.0,
                lateralFriction=robot.foot_friction[side], maxJointVelocity=1e3,
            )  # fmt: skip
            # No rigid body can have the base's inertia with armature. Bullet rejects it in a URDF, but not here.
            self._world.changeDynamics(self._body, link, localInertiaDiagonal=inertia[name])
        for link in self._links.values():  # Bullet brakes every joint by default.
            self._world.setJointMotorControl2(self._body, link, pybullet.VELOCITY_CONTROL, force=0.0)
        self._legs = [_Leg(robot, side) for side in range(2)]
        for side, knee in enumerate(self._knees):
            self._world.resetJointState(self._body, knee, robot.knee_stop[side], 0.0)
            hip = self._links[f"femur_{SIDES[side]}"]
            self._world.resetJointState(self._body, hip, STANDING_HIP, 0.0)
        self._world.resetBasePositionAndOrientation(self._body, [0.0, 0.0, 1.5 if held else 0.72], [0, 0, 0, 1])
        self._queue: list[np.ndarray] = []
        self._air = np.zeros(3), np.zeros(3)
        """Last velocity of the balloons, and their filtered acceleration for the force of the added mass."""

    def close(self) -> None:
        """Close the Bullet world."""
        self._world.disconnect()

    @property
    def arms(self) -> list[float]:
        """Angles of the arms (rad)."""
        return [leg.arm for leg in self._legs]

    @property
    def knees(self) -> list[float]:
        """Angles of the knees (rad)."""
        return [state[0] for state in self._world.getJointStates(self._body, self._knees)]

    def total_mass(self) -> float:
        """Return the total mass (kg) in Bullet."""
        return sum(self._world.getDynamicsInfo(self._body, link)[0] for link in (-1, *self._links.values()))

    def floor_force(self) -> float:
        """Return the upward force (N) from the floor."""
        return sum(contact[9] for contact in self._world.getContactPoints(self._body))

    def run(self, command: Float[np.ndarray, " 2"], seconds: float) -> None:
        """Advance by `seconds` with a command."""
        late = round(self.robot.delay / TIMESTEP)
        for _ in range(round(seconds / TIMESTEP)):
            self._queue.append(command)
            if len(self._queue) > late + 1:
                self._queue.pop(0)
            self._step(self._queue[0])

    def _step(self, command: Float[np.ndarray, " 2"]) -> None:
        states = self._world.getJointStates(self._body, self._knees)
        torques = [leg.drive(float(command[i]), *states[i][:2]) for i, leg in enumerate(self._legs)]
        self._world.setJointMotorControlArray(self._body, self._knees, pybullet.TORQUE_CONTROL, forces=torques)
        robot, link = self.robot, self._links["balloon"]
        state = self._world.getLinkState(self._body, link, computeLinkVelocity=1)
        velocity, spin = np.array(state[6]), np.array(state[7])
        relative = velocity - wind(self._conditions, self._time)
        self._time += TIMESTEP
        last, felt = self._air
        felt = felt + (TIMESTEP / _AIR_FILTER) * ((velocity - last) / TIMESTEP - felt)
        self._air = velocity, felt
        force = -robot.drag * math.sqrt(relative @ relative) * relative - robot.added_mass * felt
        force[2] += robot.buoyancy * TOTAL_MASS * GRAVITY
        self._world.applyExternalForce(self._body, link, force.tolist(), state[0], pybullet.WORLD_FRAME)
        torque = -robot.turning_drag * math.sqrt(spin @ spin) * spin
        self._world.applyExternalTorque(self._body, link, torque.tolist(), pybullet.WORLD_FRAME)
        self._world.stepSimulation()

    def begin_trial(self) -> None:
        """Move the robot above the origin, turn its base to the heading of the conditions, and set the time to 0."""
        self._time = 0.0
        place, quaternion = self._world.getBasePositionAndOrientation(self._body)
        turn = Rotation.from_quat(quaternion)
        back = Rotation.from_euler("z", self._conditions.start[2] - turn.as_euler("ZYX")[0])
        linear, angular = self._world.getBaseVelocity(self._body)
        self._world.resetBasePositionAndOrientation(self._body, [0.0, 0.0, place[2]], (back * turn).as_quat().tolist())
        self._world.resetBaseVelocity(self._body, back.apply(linear).tolist(), back.apply(angular).tolist())
        self._air = back.apply(self._air[0]), back.apply(self._air[1])

    def look(self) -> tuple[Float[np.ndarray, "4 3"], Rotation, Rotation]:
        """Return positions (m) of balloons, base, left and right foot, and orientations of balloons and base."""
        centre, quaternion = self._world.getBasePositionAndOrientation(self._body)
        base = Rotation.from_quat(quaternion)
        names = ("balloon", *(f"tibia_{side}" for side in SIDES))
        states = self._world.getLinkStates(
            self._body, [self._links[name] for name in names], computeForwardKinematics=1
        )
        frames = [(np.array(state[4]), Rotation.from_quat(state[5])) for state in states]
        sites = [BALLOON_COM, *[(0.0, 0.0, FOOT_Z)] * 2]
        balloon, left, right = (p + turn.apply(site) for (p, turn), site in zip(frames, sites, strict=True))
        return np.stack([balloon, np.array(centre) - base.apply(BASE_COM), left, right]), frames[0][1], base


_AIR_FILTER = 0.01
"""Time constant of the filtered acceleration (s). Without the filter, the added mass would react to its own force."""


class _Leg:
    """Actuation of one knee: position loop, backlash, arm, cable and spring."""

    def __init__(self, robot: BulletRobot, side: int) -> None:
        self._travel, self._zero = robot.arm_travel[side] * ARM_RANGE, robot.arm_zero[side]
        self._lag, self._speed = robot.arm_lag[side], robot.arm_speed[side]
        self._yield, self._half = robot.arm_yield[side], robot.play[side] / 2
        self._stiffness, self._damping = robot.cable_stiffness[side], robot.cable_damping[side]
        self._most = robot.cable_limit[side]
        self._spring, self._friction = robot.spring_stiffness[side], robot.knee_damping[side]
        self._springref = robot.knee_stop[side] - SPRING_PRELOAD
        self._rest = _cable(robot.knee_stop[side], 0.0)[0] + robot.cable_slack[side]
        self._loop = self._played = self.arm = self._zero
        self._last = 0.0
        self._torque = 0.0

    def drive(self, command: float, knee: float, velocity: float) -> float:
        """Advance one physics step and return the torque on the knee (N m)."""
        target = self._zero + self._travel * command
        rate = min(max((target - self._loop) / self._lag, -self._speed), self._speed)
        self._loop += TIMESTEP * rate
        self._played = min(max(self._played, self._loop - self._half), self._loop + self._half)
        self.arm = self._played - self._yield * self._torque
        length, by_knee, by_arm = _cable(knee, self.arm)
        stretch = length - self._rest
        tension = 0.0
        if stretch > 0:
            rate = by_knee * velocity + by_arm * (self.arm - self._last) / TIMESTEP
            tension = min(max(self._stiffness * stretch + self._damping * rate, 0.0), self._most)
        self._last = self.arm
        self._torque += 0.05 * (tension * by_arm - self._torque)  # The arm bends over 20 physics steps.
        return -self._spring * (knee - self._springref) - self._friction * velocity - tension * by_knee


def _cable(knee: float, arm: float) -> tuple[float, float, float]:
    """Return the distance (m) of the attachment points, and its derivatives with respect to knee and arm."""
    sin_k, cos_k = math.sin(knee), math.cos(knee)
    x, z = ARM_X - ARM_LENGTH * math.sin(arm), ARM_Z + ARM_LENGTH * math.cos(arm)
    along, up = cos_k * x + sin_k * z, -sin_k * x + cos_k * z
    dx, dz = along, up - TIE_ABOVE_KNEE
    length = math.hypot(dx, dz)
    x_m, z_m = -ARM_LENGTH * math.cos(arm), -ARM_LENGTH * math.sin(arm)
    by_arm = dx * (cos_k * x_m + sin_k * z_m) + dz * (-sin_k * x_m + cos_k * z_m)
    return length, (dx * up - dz * along) / length, by_arm / length


# ---- URDF ----


def _inertias() -> dict[str, list[float]]:
    """Return moments of inertia (kg m^2). The base's include the armature of neck and hips about y."""
    base = np.array(BASE_INERTIA) + [0.0, 3 * PASSIVE_ARMATURE, 0.0]
    own = {"base": base, "balloon": BALLOON_INERTIA}
    for side in SIDES:
        own |= {f"femur_{side}": FEMUR_INERTIA, f"tibia_{side}": TIBIA_INERTIA}
    return {name: [float(value) for value in moments] for name, moments in own.items()}


def urdf(robot: BulletRobot) -> str:
    """Return the robot as a URDF. The angle of a knee is 0 if the leg is straight."""
    root = ElementTree.Element("robot", name="ballu")
    offset = np.array([*robot.balloon_offset, 0.0])
    _link(root, "base", BASE_MASS, BASE_COM, BASE_INERTIA)
    _link(root, "balloon", BALLOON_MASS, np.array(BALLOON_COM) + offset, BALLOON_INERTIA)
    _joint(root, "neck", "base", "balloon", NECK)
    for side, sign, stop in zip(SIDES, (1, -1), robot.knee_stop, strict=True):
        _link(root, f"femur_{side}", FEMUR_MASS, FEMUR_COM, FEMUR_INERTIA)
        com = np.array(TIBIA_COM) * [1, sign, 1]
        _link(root, f"tibia_{side}", TIBIA_MASS + ARM_MASS, com, TIBIA_INERTIA, foot=True)
        _joint(root, f"hip_{side}", "base", f"femur_{side}", (0.0, sign * HIP_Y, 0.0))
        knee = (0.0, 0.0, -FEMUR_LENGTH)
        _joint(root, f"knee_{side}", f"femur_{side}", f"tibia_{side}", knee, (stop, KNEE_MOST))
    return ElementTree.tostring(root, encoding="unicode")


def _link(root: ElementTree.Element, name: str, mass: float, com: Any, inertia: Any, *, foot: bool = False) -> None:
    link = ElementTree.SubElement(root, "link", name=name)
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_numbers(com), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=repr(float(mass)))
    moments = {name: repr(float(value)) for name, value in zip(("ixx", "iyy", "izz"), inertia, strict=True)}
    ElementTree.SubElement(inertial, "inertia", moments, ixy="0", ixz="0", iyz="0")
    if foot:
        collision = ElementTree.SubElement(link, "collision")
        ElementTree.SubElement(collision, "origin", xyz=f"0 0 {FOOT_Z}", rpy="0 0 0")
        shape = ElementTree.SubElement(collision, "geometry")
        ElementTree.SubElement(shape, "sphere", radius=repr(FOOT_RADIUS))


def _joint(
    root: ElementTree.Element, name: str, parent: str, child: str, place: Any, limits: tuple[float, float] | None = None
) -> None:
    joint = ElementTree.SubElement(root, "joint", name=name, type="revolute" if limits else "continuous")
    ElementTree.SubElement(joint, "origin", xyz=_numbers(place), rpy="0 0 0")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "axis", xyz="0 1 0")
    damping = 0.0 if limits else PASSIVE_DAMPING  # The damping of the knees is part of their torque.
    ElementTree.SubElement(joint, "dynamics", damping=repr(damping), friction="0")
    if limits:
        low, high = (repr(float(value)) for value in limits)
        ElementTree.SubElement(joint, "limit", lower=low, upper=high, effort="1000", velocity="1000")


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
