"""One control step of the robot in MJX."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float
from mujoco import mjx

from ballu_mjx.sim.constraint_solver import solve_constraints
from ballu_mjx.sim.vmap_last import vmap_with_trailing_batch


def count_substeps(model: mujoco.MjModel, control_timestep: float) -> int:
    """Return the number of physics steps in a control step of `control_timestep` seconds.

    **Raises** `ValueError` if the control step is not a whole number of physics steps.
    """
    count = control_timestep / model.opt.timestep
    if abs(count - round(count)) > 1e-6 or count < 1 - 1e-6:
        raise ValueError(
            f"The model's timestep {model.opt.timestep} s does not divide the control step of {control_timestep} s; "
            "change one of them."
        )
    return round(count)


class PhysicsState(NamedTuple):
    """The part of `mjx.Data` that one physics step passes to the next. All other fields follow from it.

    Loops carry these arrays only. The constants in a complete `mjx.Data` become batched one by one. JAX then traces the
    nested loops of a vmapped step many times, and every physics step copies unused arrays.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    warmstart: Float[Array, " nv"]
    """`qacc_warmstart`: initial guess of the solver (m/s^2, rad/s^2)."""


def state_at(qpos: Float[Array, "*batch nq"], qvel: Float[Array, "*batch nv"]) -> PhysicsState:
    """Return the state with the given positions and velocities, and with a warm start of zero."""
    return PhysicsState(qpos, qvel, jnp.zeros_like(qvel))


def load_state(template: mjx.Data, state: PhysicsState) -> mjx.Data:
    """Return `template`, data of the same model, with another state. Derived quantities are not computed yet."""
    return template.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart)  # pyright: ignore


def physics_step(
    model: mjx.Model, inputs: mjx.Data, state: PhysicsState, load_by_place: Callable[[mjx.Data], mjx.Data] | None = None
) -> PhysicsState:
    """Advance by one physics step, as `mjx.step` does.

    `inputs` are data of the model with commands and external forces. `load_by_place` adds external forces that depend
    on the positions of bodies.
    """
    data = mjx.fwd_position(model, load_state(inputs, state))
    if load_by_place is not None:
        data = load_by_place(data)
    for stage in (mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = stage(model, data)
    qacc, force = solve_constraints(model, data)
    data = data.replace(qacc=qacc, qfrc_constraint=force)  # pyright: ignore
    data = _INTEGRATORS[mujoco.mjtIntegrator(int(model.opt.integrator))](model, data)
    return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)


def _implicit(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Integrate like `mjx.implicit`, but without the velocity feedback of actuators whose force is at its limit.

    Their force does not change with velocity. C MuJoCo leaves it out too, and MJX does not.
    """
    low, high = model.actuator_forcerange.T
    force = data.actuator_force
    at_limit = jnp.asarray(model.actuator_forcelimited).astype(bool) & ((force <= low) | (force >= high))
    gain, bias = (jnp.where(at_limit[:, None], 0.0, prm) for prm in (model.actuator_gainprm, model.actuator_biasprm))
    return mjx.implicit(model.replace(actuator_gainprm=gain, actuator_biasprm=bias), data)  # pyright: ignore


_INTEGRATORS = {
    mujoco.mjtIntegrator.mjINT_EULER: mjx.euler,
    mujoco.mjtIntegrator.mjINT_RK4: mjx.rungekutta4,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST: _implicit,
}
"""All integrators of MJX, which rejects models with others."""


# Callers compile this into their own programs. With `jit` it is traced once, instead of once for each program.
@functools.partial(jax.jit, static_argnames=("bodies", "points", "count"))
def control_step(
    model: mjx.Model,
    template: mjx.Data,
    state: PhysicsState,
    command: Float[Array, " commands"] | Float[Array, "count commands"],
    wrench: Float[Array, "loaded 6"],
    *,
    bodies: tuple[int, ...],
    points: tuple[int, ...] = (),
    count: int,
) -> PhysicsState:
    """Advance by `count` physics steps with constant external wrenches.

    **Arguments**

    - `template`: data of the model, from `make_data`. Only fields that a step does not change have an effect.
    - `command`: commands in the actuators' own units: one row that is held, or one row for each physics step.
    - `wrench`: force (N) and torque (N m), world frame, on each of the bodies with the ids `bodies`. The first wrench
      acts at its body's centre of mass. Each other wrench acts at the body's site with the id in `points`, and moves
      with it.

    **Raises** `ValueError` if the numbers of wrenches, bodies and points do not match.
    """
    if not len(bodies) == len(points) + 1 == wrench.shape[0]:
        raise ValueError(
            f"There are {wrench.shape[0]} wrenches, {len(bodies)} bodies and {len(points)} points; give one wrench for "
            "each body, and one point for each body after the first."
        )
    commands = jnp.broadcast_to(command, (count, command.shape[-1]))

    def steps(
        model: mjx.Model,
        template: mjx.Data,
        state: PhysicsState,
        commands: Float[Array, "count commands"],
        wrench: Float[Array, "loaded 6"],
    ) -> tuple[Array, ...]:
        # Wrenches are added one by one, because two points may belong to the same body.
        applied = template.xfrc_applied
        for number, body in enumerate(bodies):
            applied = applied.at[body].add(wrench[number])
        loaded = template.replace(xfrc_applied=applied)  # pyright: ignore

        def at_points(data: mjx.Data) -> mjx.Data:
            applied = data.xfrc_applied
            for force, body, site in zip(wrench[1:, :3], bodies[1:], points, strict=True):
                applied = applied.at[body, 3:].add(jnp.cross(data.site_xpos[site] - data.xipos[body], force))
            return data.replace(xfrc_applied=applied)  # pyright: ignore

        def step(number: Array, state: PhysicsState) -> PhysicsState:
            now = loaded.replace(ctrl=commands[number])  # pyright: ignore
            return physics_step(model, now, state, at_points if points else None)

        return tuple(jax.lax.fori_loop(0, count, step, state))

    key = "control_step", bodies, points, count
    return PhysicsState(
        *vmap_with_trailing_batch(steps, has_dry_friction(model), key)(model, template, state, commands, wrench)
    )


def has_dry_friction(model: mjx.Model) -> bool:
    """Return whether joints or tendons of a model have dry friction."""
    return bool(model._impl.dof_hasfrictionloss.any() or model._impl.tendon_hasfrictionloss.any())  # pyright: ignore


def put_model(model: mujoco.MjModel) -> mjx.Model:
    """Return `model` for MJX, on this process's first device.

    MJX's default is the first device of all processes that train together (see `ballu_mjx.rl.distributed`). Other
    processes cannot read its memory.
    """
    return mjx.put_model(model, device=jax.local_devices()[0])


def make_data(model: mujoco.MjModel) -> mjx.Data:
    """Return MJX data of `model` at its reference pose, on this process's first device."""
    return mjx.make_data(model, device=jax.local_devices()[0])
