"""Check that the simulation stays stable under random commands and random forces on the balloon.

    python benchmarks/stability.py           # 2,000 environments for 20 s
    python benchmarks/stability.py --quick

At every control step, every environment gets new commands, uniform in [0, 1], and a new force on the balloon, uniform
within 1 N on each axis. States are checked after every physics step. The exit status is 1 if a state is not finite or a
joint is faster than 100 rad/s.
"""

from __future__ import annotations

import sys
import time

from ballu_mjx.common import runtime

runtime.prepare()

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import Array
from jax.sharding import PartitionSpec

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, JOINTS, load_model, standing_qpos
from ballu_mjx.sim.step import PhysicsState, control_step, count_substeps, make_data, put_model, state_at

MAX_JOINT_SPEED = 100.0
"""Largest allowed joint speed (rad/s)."""


def main(
    quick: bool = False, environments: int = 2000, duration: float = 20.0, force: float = 1.0, seed: int = 0
) -> None:
    """Simulate many environments under random commands and forces.

    Args:
        quick: Simulate 100 environments for 5 s. The result means little.
        environments: Number of environments, simulated in parallel.
        duration: Simulated time (s).
        force: Largest force on each axis (N).
        seed: Seed of the commands and forces.
    """
    if quick:
        environments, duration = 100, 5.0
        print("--quick: these numbers mean little")
    model = load_model()
    substeps, bodies, devices = count_substeps(model, CONTROL_TIMESTEP), (model.body("balloon").id,), jax.device_count()
    steps = round(duration / CONTROL_TIMESTEP)
    mjx_model = put_model(model)
    template = make_data(model)
    start = state_at(jnp.asarray(standing_qpos(model), jnp.float32), jnp.zeros(model.nv))

    def worst(key: Array) -> tuple[Array, Array]:
        """Return the number of physics steps with a non-finite state, and each hinge's largest finite speed (rad/s)."""

        def control(state: PhysicsState, key: Array) -> tuple[PhysicsState, tuple[Array, Array]]:
            command_key, force_key = jax.random.split(key)
            command = jax.random.uniform(command_key, (2,))
            push = jax.random.uniform(force_key, (3,), minval=-force, maxval=force)
            push = jnp.concatenate([push, jnp.zeros(3)])[None]

            def physics(state: PhysicsState, _: None) -> tuple[PhysicsState, tuple[Array, Array]]:
                state = control_step(mjx_model, template, state, command, push, bodies=bodies, count=1)
                finite = jnp.isfinite(state.qpos).all() & jnp.isfinite(state.qvel).all()
                return state, (finite, jnp.abs(state.qvel[6:]))

            state, (finite, speed) = jax.lax.scan(physics, state, None, length=substeps)
            return state, ((~finite).sum(), jnp.nanmax(speed, axis=0))

        _, (bad, speed) = jax.lax.scan(control, start, jax.random.split(key, steps))
        return bad.sum(), jnp.nanmax(speed, axis=0)

    count = -(-environments // devices) * devices
    keys = jax.random.split(jax.random.key(seed), count)
    mesh = jax.make_mesh((devices,), ("batch",), axis_types=(jax.sharding.AxisType.Auto,))
    spec = PartitionSpec("batch")
    run = jax.jit(jax.shard_map(jax.vmap(worst), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))
    compiled = run.lower(keys).compile()
    clock = time.perf_counter()
    bad, speed = (np.asarray(x) for x in compiled(keys))
    clock = time.perf_counter() - clock

    diverged = int((bad > 0).sum())
    fastest = speed.max(axis=1)
    print(f"{count} environments x {duration} s, forces to {force} N, {model.opt.timestep * 1e3:.2f} ms: {clock:.0f} s")
    print(f"diverged: {diverged}")
    print(f"greatest joint speed: {fastest.max():.1f} rad/s, in the median environment {np.median(fastest):.1f}")
    for name, value in zip(JOINTS, speed.max(axis=0), strict=True):
        print(f"    {name:12} {value:6.1f}")
    if diverged or not fastest.max() <= MAX_JOINT_SPEED:
        print(f"FAILED: wanted no divergence and no joint faster than {MAX_JOINT_SPEED:.0f} rad/s")
        sys.exit(1)


if __name__ == "__main__":
    tyro.cli(main)
