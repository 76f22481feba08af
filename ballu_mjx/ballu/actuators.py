"""BALLU's actuators: parameters of servo, cable and knee, and the model fields that they set.

Units are SI units and radians. Arrays with a pair of entries are ordered (left, right).
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.ballu.model import knee_ids, leg_sides
from ballu_mjx.sim.drivetrain import DrivetrainParameters, identity_drivetrain

CABLE_SLACK = 1e-4
"""Slack (m) of the nominal robot's cables with the motor at 0 and the knee at its stop."""
SERVO_RANGE = np.pi / 2
"""Motor angle (rad) that a command of 1 requests from a nominal servo."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ActuatorParameters:
    """Parameters of servos, cables and knees that differ between robots, as (left, right) or for one leg alone.

    The first four are the paper's eight free parameters of two legs (section "System Identification"). The paper does
    not fit the next two. Each parameter sets fields of the model:

    - `knee_spring_stiffness` (N m/rad): stiffness of the knee springs. Field: `jnt_stiffness`.
    - `motor_gain` (N m/rad): position gain of the servos. Fields: `actuator_gainprm`, `actuator_biasprm`.
    - `default_motor_angle` (rad): motor angle requested by command 0. Field: `actuator_biasprm[:, 0]`.
    - `default_knee_angle` (rad): angle of the knees' stops. Field: `jnt_range[:, 0]`. The cables' rest length depends
      on it.
    - `torque_limit` (N m): torque at which the servos saturate. Field: `actuator_forcerange`. If it is not
      fitted, only a spring that is too stiff can explain a servo that is weaker than nominal.
    - `cable_slack` (m): rest length of the cables, less the distance between their ends with the motor at 0 and the
      knee at its stop. Field: `tendon_lengthspring[:, 1]`. If it is not fitted, a cable that bends the knee late is
      identified as one that stretches, with torques of up to three times the robot's.

    The following may be None. The nominal robot's value is then used:

    - `motor_travel` (1): fraction of 90 deg that a command of 1 requests. Field: `actuator_gainprm`.
    - `cable_stiffness` (N/m): stiffness of the cables. Field: `tendon_stiffness`.
    - `knee_spring_reference` (rad): knee angle at which the spring is at rest; nominally -45 deg. Field: `qpos_spring`.
    - `knee_damping` (N m s/rad): viscous damping of the knees. Field: `dof_damping`.
    - `knee_friction`, `motor_friction` (N m): dry friction of the joints. Field: `dof_frictionloss`.
    - `delay` (s), `lag` (s) and `backlash` (rad of motor angle): drivetrain between commands and servos. The model has
      no drivetrain, so simulators take it from `drivetrain()`.
    """

    knee_spring_stiffness: Float[Array, " sides"]
    motor_gain: Float[Array, " sides"]
    default_motor_angle: Float[Array, " sides"]
    default_knee_angle: Float[Array, " sides"]
    torque_limit: Float[Array, " sides"]
    cable_slack: Float[Array, " sides"]
    motor_travel: Float[Array, " sides"] | None = None
    cable_stiffness: Float[Array, " sides"] | None = None
    knee_spring_reference: Float[Array, " sides"] | None = None
    knee_damping: Float[Array, " sides"] | None = None
    knee_friction: Float[Array, " sides"] | None = None
    motor_friction: Float[Array, " sides"] | None = None
    delay: Float[Array, " sides"] | None = None
    lag: Float[Array, " sides"] | None = None
    backlash: Float[Array, " sides"] | None = None

    def fields(self, model: mujoco.MjModel) -> dict[str, Array]:
        """Return the fields of `model` that carry these parameters; see `actuator_fields`."""
        return actuator_fields(model, self)

    def drivetrain(self) -> DrivetrainParameters:
        """Return the drivetrain of all commands. Parameters that are None have the values of `identity_drivetrain`."""
        found = identity_drivetrain(len(self.motor_gain))
        known = {name: getattr(self, name) for name in ("delay", "lag") if getattr(self, name) is not None}
        if self.backlash is not None:
            known["backlash"] = self.backlash / (_travel(self) * SERVO_RANGE)
        return found._replace(**known)

    @staticmethod
    def nominal(model: mujoco.MjModel) -> ActuatorParameters:
        """Return the parameters of `model`."""
        knees, servos = knee_ids(model), _servo_ids(model)
        gain = -model.actuator_biasprm[servos, 1]
        taut = cable_length(model, model.jnt_range[knees, 0], np.zeros(len(knees)))
        return ActuatorParameters(
            knee_spring_stiffness=jnp.asarray(model.jnt_stiffness[knees], jnp.float32),
            motor_gain=jnp.asarray(gain, jnp.float32),
            default_motor_angle=jnp.asarray(model.actuator_biasprm[servos, 0] / gain, jnp.float32),
            default_knee_angle=jnp.asarray(model.jnt_range[knees, 0], jnp.float32),
            torque_limit=jnp.asarray(model.actuator_forcerange[servos, 1], jnp.float32),
            cable_slack=jnp.asarray(model.tendon_lengthspring[_cable_ids(model), 1] - taut, jnp.float32),
            motor_travel=jnp.asarray(model.actuator_gainprm[servos, 0] / (gain * SERVO_RANGE), jnp.float32),
            cable_stiffness=jnp.asarray(model.tendon_stiffness[_cable_ids(model)], jnp.float32),
            knee_spring_reference=jnp.asarray(model.qpos_spring[model.jnt_qposadr[knees]], jnp.float32),
            knee_damping=jnp.asarray(model.dof_damping[model.jnt_dofadr[knees]], jnp.float32),
        )


def cable_length(
    model: mujoco.MjModel, knee: Float[Array | np.ndarray, " sides"], motor: Float[Array | np.ndarray, " sides"]
) -> Float[Array, " sides"]:
    """Return the distance (m) between the cable's ends at the given knee and motor angles (rad).

    The geometry is that of the model's spatial tendon. It is written out here because the rest length must be known,
    and be differentiable, before any state is computed.
    """
    knee, motor = jnp.asarray(knee), jnp.asarray(motor)
    lengths = []
    for i, side in enumerate(leg_sides(model)):
        anchor = model.site(f"cable_femur_{side}").pos - model.body(f"tibia_{side}").pos
        arm = model.body(f"arm_{side}").pos
        radius = model.site(f"cable_arm_{side}").pos[2]
        x = arm[0] - radius * jnp.sin(motor[i])
        z = arm[2] + radius * jnp.cos(motor[i])
        dx = jnp.cos(knee[i]) * x + jnp.sin(knee[i]) * z - anchor[0]
        dz = -jnp.sin(knee[i]) * x + jnp.cos(knee[i]) * z - anchor[2]
        lengths.append(jnp.sqrt(dx**2 + dz**2 + (arm[1] - anchor[1]) ** 2))
    return jnp.stack(lengths)


def actuator_fields(model: mujoco.MjModel, parameters: ActuatorParameters) -> dict[str, Array]:
    """Return model fields that carry `parameters`, by name, for `mjx.Model.replace` or `robots.model.set_fields`."""
    knees, servos = knee_ids(model), _servo_ids(model)
    gain = parameters.motor_gain
    reach = gain * SERVO_RANGE * _travel(parameters)
    rest = cable_length(model, parameters.default_knee_angle, jnp.zeros_like(gain)) + parameters.cable_slack
    fields = {
        "jnt_stiffness": jnp.asarray(model.jnt_stiffness).at[knees].set(parameters.knee_spring_stiffness),
        "jnt_range": jnp.asarray(model.jnt_range).at[knees, 0].set(parameters.default_knee_angle),
        "actuator_gainprm": jnp.asarray(model.actuator_gainprm).at[servos, 0].set(reach),
        "actuator_biasprm": jnp.asarray(model.actuator_biasprm)
        .at[servos, 0]
        .set(gain * parameters.default_motor_angle)
        .at[servos, 1]
        .set(-gain),
        "actuator_forcerange": jnp.asarray(model.actuator_forcerange)
        .at[servos]
        .set(parameters.torque_limit[:, None] * jnp.array([-1.0, 1.0])),
        "tendon_lengthspring": jnp.asarray(model.tendon_lengthspring).at[_cable_ids(model), 1].set(rest),
    }
    if parameters.cable_stiffness is not None:
        stiffness = jnp.asarray(model.tendon_stiffness).at[_cable_ids(model)].set(parameters.cable_stiffness)
        fields["tendon_stiffness"] = stiffness
    if parameters.knee_spring_reference is not None:
        reference = jnp.asarray(model.qpos_spring).at[model.jnt_qposadr[knees]].set(parameters.knee_spring_reference)
        fields["qpos_spring"] = reference
    dofs = {"knee": model.jnt_dofadr[knees], "motor": model.jnt_dofadr[_motor_ids(model)]}
    if parameters.knee_damping is not None:
        fields["dof_damping"] = jnp.asarray(model.dof_damping).at[dofs["knee"]].set(parameters.knee_damping)
    for joint, friction in (("knee", parameters.knee_friction), ("motor", parameters.motor_friction)):
        if friction is not None:
            own = fields.get("dof_frictionloss", jnp.asarray(model.dof_frictionloss))
            fields["dof_frictionloss"] = own.at[dofs[joint]].set(friction)
    return fields


def _travel(parameters: ActuatorParameters) -> Float[Array, " sides"]:
    """Return `motor_travel`, or the nominal 1 if it is None."""
    gain = parameters.motor_gain
    return jnp.ones_like(gain) if parameters.motor_travel is None else parameters.motor_travel


def _motor_ids(model: mujoco.MjModel) -> np.ndarray:
    return np.array([model.joint(f"motor_{side}").id for side in leg_sides(model)])


def _servo_ids(model: mujoco.MjModel) -> np.ndarray:
    return np.array([model.actuator(f"servo_{side}").id for side in leg_sides(model)])


def _cable_ids(model: mujoco.MjModel) -> np.ndarray:
    return np.array([model.tendon(f"cable_{side}").id for side in leg_sides(model)])
