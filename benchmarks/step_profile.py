"""Profile a physics step on one core, with the batch as the first axis (`jax.vmap`) and as the last (`vmap_last`).

With the batch as the last axis, the step is also timed with MJX's constraint solver instead of ours.

The parts of a step are compiled separately, in growing chains, so that XLA cannot omit what a part needs. Their times
do not add up exactly to that of the whole step, in which XLA fuses operations of different parts. The output also shows
XLA's count of arithmetic operations, which gives a lower bound, and the time of C MuJoCo's step on one thread.
`--kernels` lists the slowest kernels, from JAX's profiler.

`python benchmarks/step_profile.py` takes ten minutes, mostly for compiling. `--quick` times only the whole step.
"""

from __future__ import annotations

import collections
import dataclasses
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import common

from ballu_mjx.common import runtime

FIRST, LAST, MJX, C = "batch first", "batch last", "batch last, MJX's solver", "C MuJoCo"


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the profile of a physics step."""

    batches: tuple[int, ...] = (64, 256, 512, 1024, 4096)
    """Numbers of robots for the time of the whole step. Its parts are timed with 512 robots."""
    dry_friction: float = 0.0
    """Dry friction of all joints (N m)."""
    kernels: int = 0
    """Number of the slowest kernels of the whole step to list."""
    output: Path = Path("runs/bench-step-profile")
    """Folder for step_profile.json."""
    quick: bool = False
    """Time only the whole step, with 512 robots."""


def measure(layout: str, batch: int, parts: bool, kernels: int, dry_friction: float) -> dict[str, Any]:
    """Return microseconds per robot and physics step, by part. A child process calls this function."""
    runtime.prepare()
    import jax
    import jax.numpy as jnp
    import mujoco
    import numpy as np
    import throughput
    from mujoco import mjx

    from ballu_mjx.ballu.model import load_model, standing_qpos
    from ballu_mjx.robots.model import raise_iterations
    from ballu_mjx.robots.registry import load_robot
    from ballu_mjx.sim.step import (
        PhysicsState,
        count_substeps,
        has_dry_friction,
        load_state,
        make_data,
        physics_step,
        put_model,
        state_at,
    )
    from ballu_mjx.sim.vmap_last import vmap_with_trailing_batch

    model, rng = load_model(), np.random.default_rng(0)
    model.dof_frictionloss[6:] = dry_friction
    raise_iterations(model)
    if layout == C:
        commands = rng.integers(0, 2, (64, 40, 2)).astype(float)
        rates = throughput.rollout_rates(model, 1, 5, commands)
        return {"whole": 1e6 / float(np.median(rates)) / count_substeps(model, load_robot().control_timestep)}

    mjx_model, template = put_model(model), make_data(model)
    commands = jnp.asarray(rng.uniform(size=(batch, 2)), jnp.float32)
    qpos = np.tile(standing_qpos(model), (batch, 1))
    state = state_at(jnp.asarray(qpos), jnp.zeros((batch, model.nv)))

    def batched(function: Callable[..., Any]) -> Any:
        last = vmap_with_trailing_batch(function, has_dry_friction(mjx_model))
        return jax.jit(jax.vmap(function if layout == FIRST else last))

    def seconds(function: Callable[..., Any], state: PhysicsState) -> float:
        jax.block_until_ready(function(state, commands))
        took = []
        for _ in range(9):
            began = time.perf_counter()
            jax.block_until_ready(function(state, commands))
            took.append(time.perf_counter() - began)
        return float(np.median(took))

    def step(state: PhysicsState, command: Any) -> PhysicsState:
        commanded: Any = template.replace(ctrl=command)  # pyright: ignore
        if layout == MJX:
            data = mjx.step(mjx_model, load_state(commanded, state))
            return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
        return physics_step(mjx_model, commanded, state)

    whole = batched(step)
    for _ in range(50):  # Until the robots walk, with feet on the floor.
        state = whole(state, commands)
    found: dict[str, Any] = {"whole": 1e6 * seconds(whole, state) / batch}
    cost: Any = whole.lower(state, commands).compile().cost_analysis()
    found["operations"] = float(cost.get("flops", 0.0)) / batch
    if kernels:
        found["kernels"] = _kernels(lambda: jax.block_until_ready(whole(state, commands)), kernels, batch)
    if parts:
        chain: list[Callable[..., Any]] = []
        forward = mujoco.mjx._src.forward  # pyright: ignore
        for name, part in (
            ("positions", forward.fwd_position),
            ("velocities", forward.fwd_velocity),
            ("actuation", forward.fwd_actuation),
            ("smooth acceleration", forward.fwd_acceleration),
        ):
            chain.append(part)

            def so_far(state: PhysicsState, command: Any, chain: Sequence[Callable[..., Any]] = tuple(chain)) -> Any:
                data: Any = load_state(template, state).replace(ctrl=command)  # pyright: ignore
                for function in chain:
                    data = function(mjx_model, data)
                inner = data._impl
                return (inner.M, inner.qLD, inner.efc_J, inner.efc_aref, inner.efc_D, data.qfrc_bias, data.qacc_smooth)

            found[f"up to {name}"] = 1e6 * seconds(batched(so_far), state) / batch
    return found


def _kernels(run: Callable[[], Any], count: int, batch: int) -> list[tuple[str, int, float]]:
    """Return name, number of executions and microseconds per robot of the slowest kernels."""
    import jax

    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            run()
        file = next(Path(folder).rglob("*.xplane.pb"))
        spent: collections.Counter[str] = collections.Counter()
        times: collections.Counter[str] = collections.Counter()
        for plane in jax.profiler.ProfileData.from_file(str(file)).planes:
            for line in plane.lines:
                for event in line.events:
                    if "hlo_op" in dict(event.stats):
                        spent[event.name] += event.duration_ns
                        times[event.name] += 1
    return [(name, times[name], ns / 1e3 / batch) for name, ns in spent.most_common(count)]


def main(options: Options) -> None:
    """Measure, print and write the profile."""

    def request(layout: str, batch: int, parts: bool = False) -> dict[str, Any]:
        kernels = options.kernels if parts else 0
        return {
            "layout": layout, "batch": batch, "parts": parts, "kernels": kernels, "dry_friction": options.dry_friction
        }  # fmt: skip

    core = common.cores()[:1]
    batches = (512,) if options.quick else options.batches
    result: dict[str, Any] = {C: common.child(__file__, request(C, 1), cores=core)}
    print(f"{common.described(common.machine())}; one core, microseconds per robot and physics step")
    print(f"{C + ', one thread':40}{result[C]['whole']:10.1f}")
    for layout in (FIRST, MJX, LAST):
        for batch in batches if layout != MJX else (512,):
            parts = batch == 512 and not options.quick and layout != MJX
            found = result[f"{layout}, {batch}"] = common.child(__file__, request(layout, batch, parts), cores=core)
            print(f"{f'{layout}, {batch:,} robots':40}{found['whole']:10.1f}")
            for name, value in found.items():
                if name.startswith("up to"):
                    print(f"{'    ' + name:40}{value:10.1f}")
            for name, times, microseconds in found.get("kernels", []):
                print(f"        {microseconds:8.3f} x{times:4d}  {name}")
    print(f"operations (XLA's count, a loop's body once): {found['operations']:,.0f}")
    common.write(options.output, "step_profile", result)


if __name__ == "__main__":
    if not common.answer(measure):
        import tyro

        main(tyro.cli(Options, description=__doc__))
