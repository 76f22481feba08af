"""BALLU's actuators: servo, cable and knee, as numbers that identification changes and as fields of the model.

SI units and radians; arrays with a pair of entries are ordered (left, right).
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
"""The nominal robot's slack of the cable (m) with the motor at 0 and the knee at its stop."""
SERVO_RANGE = np.pi / 2
"""Motor angle (rad) that a command of 1 asks for."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ActuatorParameters:
    """What differs from one servo, cable and knee to the next, each as (left, right), or for one leg alone: the first
    four are the paper's eight free parameters (section "System Identification").

    What each moves in the model:

    - `knee_spring_stiffness` (N m/rad): `jnt_stiffness` of the knees; the spring's zero, -45 deg, stays.
    - `motor_gain` (N m/rad): the servo's position gain, in `actuator_gainprm` and `actuator_biasprm`.
    - `default_motor_angle` (rad): the motor angle that command 0 asks for, `actuator_biasprm[:, 0]`.
    - `default_knee_angle` (rad): the knee's stop, `jnt_range[:, 0]`; the cable's rest length follows it.
    - `torque_limit` (N m): where the servo saturates, `actuator_forcerange`. Not among the paper's eight, by which a
      servo weaker than nominal can be told only by a spring stiffer than the robot's.
    - `cable_slack` (m): what is left of the cable's rest length, `tendon_lengthspring[:, 1]`, with the motor at 0 and
      the knee at its stop. Not among the paper's eight either: without it, a cable that bends the knee late passes for
      one that stretches, under torques up to three times the robot's.

    Beyond these, None leaves what the model has:

    - `motor_travel` (1): share of 90 deg that a command of 1 asks for, in `actuator_gainprm`.
    - `cable_stiffness` (N/m): `tendon_stiffness`.
    - `knee_spring_reference` (rad): the knee's angle at which its spring would be at rest, `qpos_spring`.
    - `knee_damping` (N m s/rad): `dof_damping`; `knee_friction`, `motor_friction` (N m): `dof_frictionloss`.
    - `delay` (s), `lag` (s) and `backlash` (rad, of the motor's target) are the commands' drivetrain, which no model
      has and simulators add: `drivetrain()`.
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
        """Return `actuator_fields` of `model` for these parameters."""
        return actuator_fields(model, self)

    def drivetrain(self) -> DrivetrainParameters:
        """Return the drivetrain of all commands; the identity's where nothing else is known."""
        found = identity_drivetrain(len(self.motor_gain))
        known = {name: getattr(self, name) for name in ("delay", "lag") if getattr(self, name) is not None}
        if self.backlash is not None:
            known["backlash"] = self.backlash / (_travel(self) * SERVO_RANGE)
        return found._replace(**known)

    @staticmethod
    def nominal(model: mujoco.MjModel) -> ActuatorParameters:
        """The values that stand in `model`."""
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
    """Distance (m) between the cable's ends at the given knee and motor angles (rad).

    The same planar geometry as the model's spatial tendon, written out because the rest length must be known, and
    differentiable, before any state is.
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
    """Model fields that carry `parameters`, by name; for `mjx.Model.replace` or, as NumPy, for an `MjModel`."""
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
    gain = parameters.motor_gain
    return jnp.ones_like(gain) if parameters.motor_travel is None else parameters.motor_travel


def _motor_ids(model: mujoco.MjModel) -> np.ndarray:
    return np.array([model.joint(f"motor_{side}").id for side in leg_sides(model)])


def _servo_ids(model: mujoco.MjModel) -> np.ndarray:
    return np.array([model.actuator(f"servo_{side}").id for side in leg_sides(model)])


def _cable_ids(model: mujoco.MjModel) -> np.ndarray:
    return np.array([model.tendon(f"cable_{side}").id for side in leg_sides(model)])
