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

from ballu_mjx.sim.contact_solver import solve_constraints
from ballu_mjx.sim.vmap_last import vmap_with_trailing_batch


def count_substeps(model: mujoco.MjModel, control_timestep: float) -> int:
    """Return the number of physics steps in a control step of `control_timestep` seconds.

    **Raises** `ValueError` where the control step is no whole number of them.
    """
    count = control_timestep / model.opt.timestep
    if abs(count - round(count)) > 1e-6 or count < 1 - 1e-6:
        raise ValueError(
            f"The model's timestep {model.opt.timestep} s does not divide the control step of {control_timestep} s."
        )
    return round(count)


class PhysicsState(NamedTuple):
    """All that one physics step hands to the next: every other field of `mjx.Data` follows from it.

    Loops carry this alone. With all of `mjx.Data`, whose constants turn into batches one by one, JAX traces the nested
    loops of a vmapped step many times over, and every physics step copies what nobody reads.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    warmstart: Float[Array, " nv"]
    """`qacc_warmstart`: where the solver starts."""


def state_at(qpos: Float[Array, "*batch nq"], qvel: Float[Array, "*batch nv"]) -> PhysicsState:
    """The state that nothing went before."""
    return PhysicsState(qpos, qvel, jnp.zeros_like(qvel))


def load_state(template: mjx.Data, state: PhysicsState) -> mjx.Data:
    """`template` (of the same model, for its sizes) in another state; what follows from it is not computed yet."""
    return template.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart)  # pyright: ignore


def physics_step(
    model: mjx.Model, inputs: mjx.Data, state: PhysicsState, load_by_place: Callable[[mjx.Data], mjx.Data] | None = None
) -> PhysicsState:
    """One physics step under the commands and forces of `inputs`, data of the model: `mjx.step`. `load_by_place` adds
    external forces that depend on where bodies are."""
    data = mjx.fwd_position(model, load_state(inputs, state))
    if load_by_place is not None:
        data = load_by_place(data)
    for stage in (mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = stage(model, data)
    qacc, force = solve_constraints(model, data)
    data = data.replace(qacc=qacc, qfrc_constraint=force)  # pyright: ignore
    data = _INTEGRATORS[mujoco.mjtIntegrator(int(model.opt.integrator))](model, data)
    return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)


_INTEGRATORS = {
    mujoco.mjtIntegrator.mjINT_EULER: mjx.euler,
    mujoco.mjtIntegrator.mjINT_RK4: mjx.rungekutta4,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST: mjx.implicit,
}
"""All that MJX has; it refuses models with others."""


# Compiled as part of whatever calls it; jitted to be traced once, not once a program.
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
    """Advance by `count` physics steps, the external wrenches held.

    **Arguments**

    - `template`: data of the model, from `make_data`; of no influence but for what no step changes.
    - `command`: commands in the actuators' own units, held, or a row for each physics step.
    - `wrench`: force (N) and torque (N m), world frame, on the bodies of the ids `bodies`: at the first one's centre of
      mass, and on each of the others at the site of its id in `points`, wherever that moves.
    """
    if not len(bodies) == len(points) + 1 == wrench.shape[0]:
        raise ValueError(f"{wrench.shape[0]} wrenches for {len(bodies)} bodies with {len(points)} points.")
    commands = jnp.broadcast_to(command, (count, command.shape[-1]))

    def steps(
        model: mjx.Model,
        template: mjx.Data,
        state: PhysicsState,
        commands: Float[Array, "count commands"],
        wrench: Float[Array, "loaded 6"],
    ) -> PhysicsState:
        # Added one by one: two points may be of the same body.
        pushed = template.xfrc_applied
        for number, body in enumerate(bodies):
            pushed = pushed.at[body].add(wrench[number])
        loaded = template.replace(xfrc_applied=pushed)  # pyright: ignore

        def at_points(data: mjx.Data) -> mjx.Data:
            pushed = data.xfrc_applied
            for force, body, site in zip(wrench[1:, :3], bodies[1:], points, strict=True):
                pushed = pushed.at[body, 3:].add(jnp.cross(data.site_xpos[site] - data.xipos[body], force))
            return data.replace(xfrc_applied=pushed)  # pyright: ignore

        def step(number: Array, state: PhysicsState) -> PhysicsState:
            now = loaded.replace(ctrl=commands[number])  # pyright: ignore
            return physics_step(model, now, state, at_points if points else None)

        return jax.lax.fori_loop(0, count, step, state)

    return vmap_with_trailing_batch(steps)(model, template, state, commands, wrench)


def put_model(model: mujoco.MjModel) -> mjx.Model:
    """`model` for MJX, on this process's first device: MJX's own choice is the first of all processes that train
    together (see `ballu_mjx.rl.distributed`), whose memory the others cannot read."""
    return mjx.put_model(model, device=jax.local_devices()[0])


def make_data(model: mujoco.MjModel) -> mjx.Data:
    """MJX data of `model` at its reference pose, on this process's first device."""
    return mjx.make_data(model, device=jax.local_devices()[0])
