"""Simulation in MJX of one leg that is suspended from a fixed base."""

from __future__ import annotations

import copy
import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from ballu_mjx.ballu.actuators import ActuatorParameters, actuator_fields
from ballu_mjx.ballu.leg_parameters import INITIAL_DYNAMICS, LEG_PARAMETERS, LegDynamics
from ballu_mjx.ballu.model import SIDES, load_suspended_leg
from ballu_mjx.ballu.sweep import SAMPLE_TIMESTEP
from ballu_mjx.identification.batched_solver import directional_derivatives
from ballu_mjx.robots.model import raise_iterations, with_fields
from ballu_mjx.sim.drivetrain import DrivetrainState, init_drivetrain, step_drivetrain
from ballu_mjx.sim.step import PhysicsState, make_data, physics_step, put_model, state_at
from ballu_mjx.sim.vmap_last import vmap_with_trailing_batch


def leg_actuators(vector: Float[Array, " parameters"]) -> ActuatorParameters:
    """Return the actuator parameters of a model with one leg, from a vector in the order of `LEG_PARAMETERS`."""
    return ActuatorParameters(**dict(zip(LEG_PARAMETERS, vector[:, None], strict=True)))


class SuspendedLeg:
    """One leg in MJX, suspended from a fixed base, with any actuator parameters.

    The left leg represents both, because the right one is its mirror image and moves in the same way. Several legs are
    one batch, with an entry for each command, parameter vector and direction of a derivative.
    """

    def __init__(self) -> None:
        self.model = load_suspended_leg(SIDES[0])
        joints = [self.model.joint(f"{kind}_{SIDES[0]}") for kind in ("motor", "knee")]
        self.angles = np.array([joint.qposadr[0] for joint in joints])
        self._dofs = np.array([joint.dofadr[0] for joint in joints])
        self._mjx = put_model(self.model)
        self._data = make_data(self.model)
        with_friction = copy.copy(self.model)
        with_friction.dof_frictionloss[self._dofs] = (
            INITIAL_DYNAMICS.motor_friction,
            INITIAL_DYNAMICS.knee_friction,
        )  # not 0, because MJX leaves out joints without dry friction
        raise_iterations(with_friction)
        self._friction_model = put_model(with_friction)
        self._friction_data = make_data(with_friction)
        self._relaxation_damping = np.zeros(self.model.nv)
        for kind, damping in _RELAXATION_DAMPING.items():
            self._relaxation_damping[self.model.joint(f"{kind}_{SIDES[0]}").dofadr[0]] = damping
        self.residual_torque = vmap_with_trailing_batch(self._residual_torque)

    def settled(
        self, vectors: Float[Array, "legs parameters"], commands: Float[Array, " legs"]
    ) -> tuple[Float[Array, "legs nq"], Float[Array, "legs nq parameters"]]:
        """Return generalized positions at rest under each leg's command, and derivatives with respect to parameters.

        The entries `[:, self.angles]` are the angles (rad) of motor and knee. The derivatives are those of an implicit
        function.
        """
        close = jax.vmap(vmap_with_trailing_batch(self._relaxed_qpos))(vectors, commands)
        qpos, jacobians = self._rest(close, vectors, commands)
        nq = self.model.nq
        return qpos, -jnp.linalg.solve(jacobians[..., :nq], jacobians[..., nq:])

    def motion(
        self,
        vector: Float[Array, " parameters"],
        dynamics: LegDynamics,
        command: Float[Array, " times"],
        begins: Bool[np.ndarray, " times"],
    ) -> Float[Array, "times 2"]:
        """Return one leg's motor and knee angles (rad) every `SAMPLE_TIMESTEP`.

        The leg is simulated without delay. The angles are then shifted in time by the delay. The result can be
        differentiated in forward mode.

        **Arguments**

        - `command`: mean command from each time to the next.
        - `begins`: times at which the leg is set to rest at the default angles, and the backlash to its middle.
        """
        timestep = float(self.model.opt.timestep)
        inner = round(SAMPLE_TIMESTEP / timestep)

        def path(vector: Array, dynamics: LegDynamics, command: Array) -> Array:
            own = {name: getattr(dynamics, name)[None] for name in ("knee_friction", "motor_friction", "knee_damping")}
            parameters = dataclasses.replace(leg_actuators(vector), **own, backlash=dynamics.backlash[None])
            model = with_fields(self._friction_model, actuator_fields(self.model, parameters))
            start = state_at(self._default_qpos(vector), jnp.zeros(self.model.nv))
            drivetrain = parameters.drivetrain()._replace(lag=dynamics.lag[None])

            def step(
                carry: tuple[PhysicsState, DrivetrainState], now: tuple[Array, Array]
            ) -> tuple[tuple[PhysicsState, DrivetrainState], Array]:
                (state, driven), (command, begins) = carry, now
                at_rest = init_drivetrain(drivetrain, command[None], 2)
                state, driven = jax.tree.map(partial(jnp.where, begins), (start, at_rest), (state, driven))
                for _ in range(inner):
                    driven, ctrl = step_drivetrain(drivetrain, driven, command[None], timestep)
                    state = physics_step(model, self._friction_data.replace(ctrl=ctrl), state)  # pyright: ignore
                return (state, driven), state.qpos[self.angles]

            first = init_drivetrain(drivetrain, command[:1], 2)
            after = jax.lax.scan(step, (start, first), (command, jnp.asarray(begins)))[1]
            return jnp.concatenate([start.qpos[self.angles][None], after[:-1]])

        moved = vmap_with_trailing_batch(path)(vector, dynamics, command)
        times = SAMPLE_TIMESTEP * jnp.arange(len(begins))
        return jax.vmap(lambda column: jnp.interp(times - dynamics.delay, times, column), 1, 1)(moved)

    def _residual_torque(
        self, qpos: Float[Array, " nq"], vector: Float[Array, " parameters"], command: Float[Array, ""]
    ) -> Float[Array, " nv"]:
        """Return the unbalanced generalized forces (N m) at rest in `qpos`. They are 0 if the leg is in equilibrium."""
        model = self._with(vector)
        rest = jnp.zeros(self.model.nv)
        data = self._data.replace(qpos=qpos, qvel=rest, qacc=rest, ctrl=command[None])  # pyright: ignore
        data = mjx.fwd_actuation(model, mjx.inverse(model, data))
        return data.qfrc_actuator - data.qfrc_inverse

    def _with(self, vector: Float[Array, " parameters"]) -> mjx.Model:
        """Return the MJX model with the parameters of `vector`."""
        return with_fields(self._mjx, actuator_fields(self.model, leg_actuators(vector)))

    def _default_qpos(self, vector: Float[Array, " parameters"]) -> Float[Array, " nq"]:
        """Return the position with motor and knee at their default angles."""
        rest = [vector[LEG_PARAMETERS.index(name)] for name in ("default_motor_angle", "default_knee_angle")]
        return jnp.zeros(self.model.nq).at[self.angles].set(jnp.stack(rest))

    def _relaxed_qpos(self, vector: Float[Array, " parameters"], command: Float[Array, ""]) -> Float[Array, " nq"]:
        """Return a position close to rest, from a simulation with strong damping and long steps.

        The simulation starts at the default angles. It determines whether the cable is taut, the knee is at its stop
        and the servo saturates.
        """
        model = self._with(vector)
        # One solver iteration suffices, because Newton's method in `_rest` corrects the result.
        option = model.opt.replace(timestep=jnp.asarray(_RELAXATION_TIMESTEP), iterations=1, ls_iterations=4)
        model = model.replace(dof_damping=jnp.asarray(self._relaxation_damping), opt=option)  # pyright: ignore
        start = state_at(self._default_qpos(vector), jnp.zeros(self.model.nv))
        held = self._data.replace(ctrl=command[None])  # pyright: ignore
        step = lambda _, state: physics_step(model, held, state)  # noqa: E731
        return jax.lax.fori_loop(0, _RELAXATION_STEPS, step, start).qpos

    def _rest(
        self,
        close: Float[Array, "legs nq"],
        vectors: Float[Array, "legs parameters"],
        commands: Float[Array, " legs"],
    ) -> tuple[Float[Array, "legs nq"], Float[Array, "legs nv nq+parameters"]]:
        """Return positions in equilibrium, and there the Jacobian of the unbalanced forces.

        The Jacobian is with respect to positions, then parameters.

        The solver is Newton's method with Levenberg's damping, starting from `close`. Optimistix has equivalent
        solvers, but each of them contains MJX's program several times. This one contains it twice: for steps,
        which need derivatives by positions alone, and for the Jacobian at the end.
        """
        nq = self.model.nq
        every = jnp.eye(nq + vectors.shape[1])
        by_qpos, by_vector = (jnp.tile(x, (len(close), 1, 1)) for x in (every[:, :nq], every[:, nq:]))

        def evaluate(qpos: Array) -> tuple[Array, Array]:
            return directional_derivatives(self.residual_torque, (qpos,), (by_qpos[:, :nq],), (vectors, commands))

        def body(state: tuple[Array, ...]) -> tuple[Array, ...]:
            x, value, jacobian, damping, trial, count = state
            new_value, new_jacobian = evaluate(trial)
            better = jnp.sum(new_value**2, axis=1) < jnp.sum(value**2, axis=1)
            x, value = (jnp.where(better[:, None], *pair) for pair in ((trial, x), (new_value, value)))
            jacobian = jnp.where(better[:, None, None], new_jacobian, jacobian)
            damping = jnp.where(better, damping / 100, damping * 10)
            normal = jnp.swapaxes(jacobian, 1, 2) @ jacobian
            damped = normal * (1 + damping[:, None, None] * jnp.eye(nq))
            step = jnp.linalg.solve(damped, jnp.swapaxes(jacobian, 1, 2) @ value[..., None])[..., 0]
            return x, value, jacobian, damping, x - step, count + 1

        def unfinished(state: tuple[Array, ...]) -> Array:
            x, _, _, _, trial, count = state
            return (count < _ROOT_STEPS) & ((count == 0) | (jnp.max(jnp.abs(trial - x)) > _ROOT_TOLERANCE))

        legs, nv = len(close), self.model.nv
        start = (close, jnp.full((legs, nv), jnp.inf), jnp.zeros((legs, nv, nq)), jnp.full(legs, 1e-4), close)
        x, *_ = jax.lax.while_loop(unfinished, body, (*start, jnp.zeros((), int)))
        return x, directional_derivatives(self.residual_torque, (x, vectors), (by_qpos, by_vector), (commands,))[1]


_RELAXATION_TIMESTEP = 0.05
"""Time step (s) of the damped simulation."""
_RELAXATION_STEPS = 150
"""Number of its time steps."""
_RELAXATION_DAMPING = {"hip": 0.1, "knee": 0.12, "motor": 0.2}
"""Joint damping (N m s/rad): more than half the time step times each joint's stiffness, which keeps it stable."""


_ROOT_STEPS = 40
"""Largest number of Newton steps."""
_ROOT_TOLERANCE = 1e-9
"""Step size (rad) at which the solver ends, because the next step would be below the rounding error."""
