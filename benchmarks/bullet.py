"""The robot in PyBullet, the paper's engine, built from the MuJoCo model for comparisons in benchmarks.

The URDF has the model's bodies, joints, joint limits and foot spheres. This module simulates the features that Bullet
lacks, with the model's formulas:

- Knee springs and cables are torques on the knees, set before every physics step.
- Lift is a force at the balloon's centre of mass, set before every physics step.
- The armature of neck and hips is added to the inertia about the axis of the lighter body, which is the base.
- The armature of a motor is five orders of magnitude larger than the arm's inertia. So the motor's motion (servo,
  back-EMF, cable, armature) is integrated here, with implicit damping. A velocity motor of Bullet makes the joint
  follow.

Joint limits and contacts are those of Bullet. They are hard, while MuJoCo's are slightly soft.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree import ElementTree

import mujoco
import numpy as np
import pybullet  # pyright: ignore[reportMissingImports]
from bullet_world import open_world
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, SIDES
from ballu_mjx.policies.deploy.estimator import euler_angles

TIMESTEPS = (1 / 240, 1e-3)
"""Time steps (s): Bullet's default and a finer one. Both divide the control step."""
_GRIP = 10.0
"""Largest torque (N m) of the velocity motor that moves a motor joint, far more than needed."""


def urdf(model: mujoco.MjModel) -> str:
    """Return the robot as a URDF, with a link for every body except the world. Names are those of the model."""
    robot = ElementTree.Element("robot", name="ballu")
    inertia = inertias(model)
    for body in range(1, model.nbody):
        link = ElementTree.SubElement(robot, "link", name=model.body(body).name)
        inertial = ElementTree.SubElement(link, "inertial")
        _origin(inertial, model.body_ipos[body], model.body_iquat[body])
        ElementTree.SubElement(inertial, "mass", value=repr(float(model.body_mass[body])))
        ixx, iyy, izz = (repr(float(value)) for value in inertia[body])
        ElementTree.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")
        for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_contype != 0)):
            collision = ElementTree.SubElement(link, "collision")
            _origin(collision, model.geom_pos[geom], model.geom_quat[geom])
            shape = ElementTree.SubElement(collision, "geometry")
            ElementTree.SubElement(shape, "sphere", radius=repr(float(model.geom_size[geom, 0])))
    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            _hinge(robot, model, joint)
    return ElementTree.tostring(robot, encoding="unicode")


def inertias(model: mujoco.MjModel) -> Float[np.ndarray, "bodies 3"]:
    """Return principal moments of inertia (kg m^2), including the armature of all joints except the motors."""
    inertia = model.body_inertia.copy()
    for dof in range(model.nv):
        joint = model.dof_jntid[dof]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and not _is_motor(model, joint):
            child = model.jnt_bodyid[joint]
            lighter = min(child, model.body_parentid[child], key=lambda body: model.body_inertia[body].max())
            inertia[lighter] += model.dof_armature[dof] * np.abs(model.jnt_axis[joint])
    return inertia


class Robot:
    """One robot on a floor, in a separate Bullet world."""

    def __init__(self, model: mujoco.MjModel, timestep: float, *, held: bool = False) -> None:
        """Create the world.

        **Arguments**

        - `model`: the robot in MuJoCo.
        - `timestep`: Bullet's time step (s), which must divide the control step.
        - `held`: whether the base is fixed in the pose of `reset`.
        """
        self.model, self.timestep = model, timestep
        self.substeps = round(CONTROL_TIMESTEP / timestep)
        self._world, self._body = open_world(urdf(model), model.opt.gravity, timestep, held=held)
        count = self._world.getNumJoints(self._body)
        infos = [self._world.getJointInfo(self._body, index) for index in range(count)]
        self._joint = {info[1].decode(): info[0] for info in infos}
        self._link = {info[12].decode(): info[0] for info in infos}
        self._names = [model.joint(joint).name for joint in range(1, model.njnt)]
        foot, inertia = model.geom("foot_left").id, inertias(model)
        for name, link in {"base": -1, **self._link}.items():
            self._world.changeDynamics(
                self._body,
                link,
                linearDamping=0.0,
                angularDamping=0.0,
                lateralFriction=float(model.geom_friction[foot, 0]),
                restitution=0.0,
                maxJointVelocity=1e3,
            )
            # Bullet rejects an inertia in the URDF that no rigid body can have, for example with armature. A call of
            # changeDynamics with other values resets it, so it is set in a separate call.
            moments = inertia[model.body(name).id].tolist()
            self._world.changeDynamics(self._body, link, localInertiaDiagonal=moments)
        for index in self._joint.values():  # Bullet brakes every joint by default.
            self._world.setJointMotorControl2(self._body, index, pybullet.VELOCITY_CONTROL, force=0.0)
        self._legs = [_Leg(model, side, timestep) for side in SIDES]
        self._driven = [self._joint[f"{kind}_{side}"] for kind in ("knee", "motor") for side in SIDES]
        balloon = model.body("balloon").id
        self._balloon = self._link["balloon"]
        self._lift = (-model.body_gravcomp[balloon] * model.body_mass[balloon] * model.opt.gravity).tolist()
        self._com_links = [self._link[model.body(body).name] for body in range(2, model.nbody)]
        self._sites = [_at_centre_of_mass(model, name) for name in ("balloon", "base", "foot_left", "foot_right")]
        self._masses = model.body_mass[1:] / model.body_mass[1:].sum()

    def close(self) -> None:
        """Close the Bullet world."""
        self._world.disconnect()

    def reset(self, qpos: Float[np.ndarray, " nq"]) -> None:
        """Place the robot at MuJoCo's generalized position `qpos`, at rest."""
        turn = Rotation.from_quat(qpos[3:7], scalar_first=True)
        centre = qpos[:3] + turn.apply(self.model.body_ipos[1])  # Bullet places a base by its centre of mass.
        self._world.resetBasePositionAndOrientation(self._body, centre.tolist(), turn.as_quat().tolist())
        self._world.resetBaseVelocity(self._body, [0.0] * 3, [0.0] * 3)
        for name, angle in zip(self._names, qpos[7:], strict=True):
            self._world.resetJointState(self._body, self._joint[name], float(angle), 0.0)

    def step(self, command: Sequence[float]) -> None:
        """Advance one control step with the commands (left, right), in [0, 1]."""
        for _ in range(self.substeps):
            self.physics_step(command)

    def physics_step(self, command: Sequence[float]) -> None:
        """Advance one physics step with the commands (left, right), in [0, 1]."""
        world, body = self._world, self._body
        states = world.getJointStates(body, self._driven)
        forces, targets = [], []
        for i, leg in enumerate(self._legs):
            torque, velocity = leg.drive(command[i], states[i][0], *states[i + 2][:2])
            forces.append(torque)
            targets.append(velocity)
        world.setJointMotorControlArray(body, self._driven[:2], pybullet.TORQUE_CONTROL, forces=forces)
        world.setJointMotorControlArray(
            body,
            self._driven[2:],
            pybullet.VELOCITY_CONTROL,
            targetVelocities=targets,
            velocityGains=[1.0, 1.0],
            forces=[_GRIP, _GRIP],
        )
        place = world.getLinkState(body, self._balloon)[0]
        world.applyExternalForce(body, self._balloon, self._lift, place, pybullet.WORLD_FRAME)
        world.stepSimulation()

    def qpos(self) -> Float[np.ndarray, " nq"]:
        """Return the generalized position, as in MuJoCo."""
        centre, quaternion = self._world.getBasePositionAndOrientation(self._body)
        turn = Rotation.from_quat(quaternion)
        states = self._world.getJointStates(self._body, [self._joint[name] for name in self._names])
        origin = np.array(centre) - turn.apply(self.model.body_ipos[1])
        return np.concatenate([origin, turn.as_quat(scalar_first=True), [state[0] for state in states]])

    def joint_angle(self, name: str) -> float:
        """Return a joint's angle (rad)."""
        return self._world.getJointState(self._body, self._joint[name])[0]

    def total_mass(self) -> float:
        """Return the total mass (kg) in Bullet."""
        links = (-1, *self._link.values())
        return sum(self._world.getDynamicsInfo(self._body, link)[0] for link in links)

    def joint_limits(self, name: str) -> tuple[float, float]:
        """Return a joint's limits (rad) in Bullet. Without limits, the lower one is above the upper one."""
        info = self._world.getJointInfo(self._body, self._joint[name])
        return info[8], info[9]

    def observe(self) -> tuple[Float[np.ndarray, " 27"], Float[np.ndarray, " 3"]]:
        """Return the features of `observation.observe_features`, and the centre of mass (m, world frame)."""
        centre, quaternion = self._world.getBasePositionAndOrientation(self._body)
        velocity, spin = self._world.getBaseVelocity(self._body)
        states = self._world.getLinkStates(self._body, self._com_links, computeLinkVelocity=1)
        com = self._masses @ np.array([centre, *(state[0] for state in states)])

        def point(body: int, offset: np.ndarray) -> np.ndarray:
            """Return position and velocity of a site, given its body and its `offset` in the body's inertial frame."""
            place, orientation, linear, angular = centre, quaternion, velocity, spin
            if body > 1:
                state = states[body - 2]
                place, orientation, linear, angular = state[0], state[1], state[6], state[7]
            turn = np.array(self._world.getMatrixFromQuaternion(orientation)).reshape(3, 3)
            (x, y, z), (a, b, c) = arm, _ = turn @ offset, angular
            turning = np.array([b * z - c * y, c * x - a * z, a * y - b * x])
            return np.concatenate([arm + place, turning + linear])

        balloon, base, left, right = (point(*site) for site in self._sites)
        x, y, z, w = states[self._sites[0][0] - 2][5]
        euler = euler_angles(np.array([w, x, y, z]))
        return np.concatenate([balloon, euler, base, left, right]), com


class _Leg:
    """Actuation of one leg: servo, cable and knee spring. It uses Python floats for speed."""

    def __init__(self, model: mujoco.MjModel, side: str, timestep: float) -> None:
        servo, cable = model.actuator(f"servo_{side}").id, model.tendon(f"cable_{side}").id
        knee, motor = model.joint(f"knee_{side}").id, model.joint(f"motor_{side}").id
        dof = model.jnt_dofadr[motor]
        self._gain, (self._bias, self._slope) = model.actuator_gainprm[servo, 0], model.actuator_biasprm[servo, :2]
        self._low, self._high = model.actuator_forcerange[servo]
        self._stiffness, self._rest = model.tendon_stiffness[cable], model.tendon_lengthspring[cable, 1]
        self._spring, self._springref = model.jnt_stiffness[knee], model.qpos_spring[model.jnt_qposadr[knee]]
        anchor = model.site(f"cable_femur_{side}").pos - model.body(f"tibia_{side}").pos
        arm = model.body(f"arm_{side}").pos
        self._anchor, self._arm, self._across = anchor[[0, 2]], arm[[0, 2]], float(arm[1] - anchor[1])
        self._radius = float(model.site(f"cable_arm_{side}").pos[2])
        body = model.body(f"arm_{side}").id
        own = model.body_inertia[body, 1] + model.body_mass[body] * np.sum(model.body_ipos[body][[0, 2]] ** 2)
        self._inertia = float(model.dof_armature[dof] + own)
        self._brake = 1.0 + timestep * model.dof_damping[dof] / self._inertia
        self._timestep = timestep
        for name, value in vars(self).items():  # NumPy scalars are slow.
            setattr(self, name, value.tolist() if isinstance(value, np.generic | np.ndarray) else value)

    def drive(self, command: float, knee: float, motor: float, motor_velocity: float) -> tuple[float, float]:
        """Return the torque on the knee (N m), and the motor's velocity (rad/s) at the end of the physics step."""
        # The cable's upper end rotates with the motor (about -y), and then with the knee (about y) around its axis.
        sin_m, cos_m, sin_k, cos_k = math.sin(motor), math.cos(motor), math.sin(knee), math.cos(knee)
        x, z = self._arm[0] - self._radius * sin_m, self._arm[1] + self._radius * cos_m
        dx = cos_k * x + sin_k * z - self._anchor[0]
        dz = -sin_k * x + cos_k * z - self._anchor[1]
        length = math.sqrt(dx * dx + dz * dz + self._across * self._across)
        by_knee = (dx * (-sin_k * x + cos_k * z) - dz * (cos_k * x + sin_k * z)) / length
        x_m, z_m = -self._radius * cos_m, -self._radius * sin_m
        by_motor = (dx * (cos_k * x_m + sin_k * z_m) + dz * (-sin_k * x_m + cos_k * z_m)) / length

        tension = self._stiffness * max(length - self._rest, 0.0)
        servo = self._gain * command + self._bias + self._slope * motor
        servo = min(max(servo, self._low), self._high)
        pushed = motor_velocity + self._timestep * (servo - tension * by_motor) / self._inertia
        return -self._spring * (knee - self._springref) - tension * by_knee, pushed / self._brake


def _at_centre_of_mass(model: mujoco.MjModel, name: str) -> tuple[int, Float[np.ndarray, " 3"]]:
    """Return a site's body, and its position (m) in the body's inertial frame (centre of mass, principal axes)."""
    site = model.site(name)
    body = int(model.site_bodyid[site.id])
    turn = Rotation.from_quat(model.body_iquat[body], scalar_first=True).inv()
    return body, turn.apply(site.pos - model.body_ipos[body])


def _is_motor(model: mujoco.MjModel, joint: int) -> bool:
    return bool(np.any(model.actuator_trnid[:, 0] == joint))


def _hinge(robot: ElementTree.Element, model: mujoco.MjModel, joint: int) -> None:
    body, dof = model.jnt_bodyid[joint], model.jnt_dofadr[joint]
    limited = bool(model.jnt_limited[joint])
    hinge = ElementTree.SubElement(
        robot, "joint", name=model.joint(joint).name, type="revolute" if limited else "continuous"
    )
    _origin(hinge, model.body_pos[body], model.body_quat[body])
    ElementTree.SubElement(hinge, "parent", link=model.body(model.body_parentid[body]).name)
    ElementTree.SubElement(hinge, "child", link=model.body(body).name)
    ElementTree.SubElement(hinge, "axis", xyz=_numbers(model.jnt_axis[joint]))
    damping = 0.0 if _is_motor(model, joint) else float(model.dof_damping[dof])
    ElementTree.SubElement(hinge, "dynamics", damping=repr(damping), friction="0")
    if limited:
        low, high = (repr(float(value)) for value in model.jnt_range[joint])
        ElementTree.SubElement(hinge, "limit", lower=low, upper=high, effort="1000", velocity="1000")


def _origin(parent: ElementTree.Element, position: np.ndarray, quaternion: np.ndarray) -> None:
    angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("xyz")
    ElementTree.SubElement(parent, "origin", xyz=_numbers(position), rpy=_numbers(angles))


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
