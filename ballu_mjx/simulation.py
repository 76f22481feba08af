"""One control step of the robot in MJX."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from mujoco import mjx

from ballu_mjx import batch_last
from ballu_mjx.robot import CONTROL_TIMESTEP


def substeps(model: mujoco.MjModel) -> int:
    """Physics steps in a control step.

    Raises `ValueError` where the control step is no whole number of them.
    """
    count = CONTROL_TIMESTEP / model.opt.timestep
    if abs(count - round(count)) > 1e-6:
        raise ValueError(
            f"The model's timestep {model.opt.timestep} s does not divide the control step of {CONTROL_TIMESTEP} s."
        )
    return round(count)


class State(NamedTuple):
    """All that one physics step hands to the next: every other field of `mjx.Data` follows from it.

    Loops carry this alone. With all of `mjx.Data`, whose constants turn into batches one by one, JAX traces the nested
    loops of a vmapped step many times over, and every physics step copies what nobody reads.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    warmstart: Float[Array, " nv"]
    """`qacc_warmstart`: where the solver starts."""


def at(qpos: Float[Array, "*batch nq"], qvel: Float[Array, "*batch nv"]) -> State:
    """The state that nothing went before."""
    return State(qpos, qvel, jnp.zeros_like(qvel))


def load(template: mjx.Data, state: State) -> mjx.Data:
    """`template` (of the same model, for its sizes) in another state; what follows from it is not computed yet."""
    return template.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart)  # pyright: ignore


def physics_step(model: mjx.Model, held: mjx.Data, state: State) -> State:
    """One physics step under the commands and forces of `held`, data of the model."""
    data = mjx.step(model, load(held, state))
    return State(data.qpos, data.qvel, data.qacc_warmstart)


# Compiled as part of whatever calls it; jitted to be traced once, not once a program.
@functools.partial(jax.jit, static_argnames=("balloon", "count"))
def control_step(
    model: mjx.Model,
    template: mjx.Data,
    state: State,
    command: Float[Array, " commands"] | Float[Array, "count commands"],
    wrench: Float[Array, " 6"],
    *,
    balloon: int,
    count: int,
) -> State:
    """Advance by `count` physics steps, the external wrench held.

    **Arguments**

    - `template`: data of the model, from `make_data`; of no influence but for what no step changes.
    - `command`: actuators' commands in [0, 1], held, or a row for each physics step.
    - `wrench`: force (N) and torque (N m), world frame, at the centre of mass of the body with the id `balloon`.
    """
    commands = jnp.broadcast_to(command, (count, command.shape[-1]))

    def steps(
        model: mjx.Model,
        template: mjx.Data,
        state: State,
        commands: Float[Array, "count commands"],
        wrench: Float[Array, " 6"],
    ) -> State:
        held = template.replace(xfrc_applied=template.xfrc_applied.at[balloon].set(wrench))  # pyright: ignore

        def step(number: Array, state: State) -> State:
            return physics_step(model, held.replace(ctrl=commands[number]), state)  # pyright: ignore

        return jax.lax.fori_loop(0, count, step, state)

    return batch_last.fast(steps)(model, template, state, commands, wrench)


def make_data(model: mujoco.MjModel) -> mjx.Data:
    """MJX data of `model` at its reference pose, on the default device."""
    return mjx.make_data(model)


def balloon_id(model: mujoco.MjModel) -> int:
    """Body id of the balloon."""
    return int(np.asarray(model.body("balloon").id))
