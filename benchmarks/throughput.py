"""Measure the speed of training: control steps per second of PPO, compared with simulation only.

Three speeds are measured in one run on the same machine:

- PPO with learning, for each number of environments.
- The same environments, stepped without learning.
- C MuJoCo's `rollout` of the same model at the same time step, with one thread per processor core.

The environments are those of EnvMimic on the bundled recordings, or those of a walking policy. Speeds are in control
steps and in simulated seconds per second. The first call of each, which compiles, is left out.

`python benchmarks/throughput.py`

On a GPU:

`python benchmarks/throughput.py --num-envs 1024 8192 65536`
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

from ballu_mjx.common import runtime

runtime.prepare()

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, standing_qpos
from ballu_mjx.common.provenance import usable_cores as cores
from ballu_mjx.common.results import Cell, Table, write_results
from ballu_mjx.identification.actuators import read_actuators
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.locomotion_env import LocomotionEnv
from ballu_mjx.policies.policy import environment_of
from ballu_mjx.policies.tasks import find_task
from ballu_mjx.policies.training import locomotion_ppo
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv
from ballu_mjx.rl import learner, ppo, training_env, training_state
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import count_substeps


def sized(config: ppo.PPOConfig, num_envs: int, repeats: int) -> ppo.PPOConfig:
    """Return `config` for `num_envs` environments, with one trajectory segment or more of each in a training step."""
    batch_size = max(config.batch_size, num_envs // config.num_minibatches)
    step_size = batch_size * config.num_minibatches * config.unroll_length
    return dataclasses.replace(
        config, num_envs=num_envs, batch_size=batch_size, num_timesteps=(repeats + 1) * step_size
    )


def training_rates(env: EnvMimicEnv | LocomotionEnv, config: ppo.PPOConfig) -> tuple[float, list[float]]:
    """Return the seconds to the end of the first training step, and control steps per second of each later one."""
    rates: list[float] = []
    first: list[float] = []
    began = time.perf_counter()

    def note(step: int, state: training_state.TrainingState, metrics: dict[str, float]) -> None:
        if metrics:
            first.append(time.perf_counter() - began)
            rates.append(metrics["steps_per_second"])

    learner.train(env, config, note)
    return first[0], rates[1:]


def stepping_rates(env: EnvMimicEnv | LocomotionEnv, num_envs: int, repeats: int, length: int = 20) -> list[float]:
    """Return control steps per second of the environments without learning, sharded over all devices."""
    wrapped = training_env.wrap_for_training(env)
    devices = jax.local_device_count()
    keys = jax.random.split(jax.random.key(0), num_envs).reshape(devices, -1)
    action = jnp.zeros((num_envs // devices, env.action_size))
    state = jax.pmap(wrapped.reset)(keys)
    unroll = jax.pmap(lambda s: jax.lax.scan(lambda s, _: (wrapped.step(s, action), None), s, None, length=length)[0])
    state = jax.block_until_ready(unroll(state))
    rates = []
    for _ in range(repeats):
        began = time.perf_counter()
        state = jax.block_until_ready(unroll(state))
        rates.append(num_envs * length / (time.perf_counter() - began))
    return rates


def rollout_rates(
    model: mujoco.MjModel, threads: int, repeats: int, commands: Float[np.ndarray, "runs steps 2"]
) -> list[float]:
    """Return control steps per second of C MuJoCo, for each repeat."""
    count, (runs, steps, _) = count_substeps(model, CONTROL_TIMESTEP), commands.shape
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states, controls = np.tile(state, (runs, 1)), np.repeat(commands, count, axis=1)
    rates = []
    with rollout.Rollout(nthread=threads) as pool:
        workers = [mujoco.MjData(model) for _ in range(threads)]
        for _ in range(repeats + 1):
            began = time.perf_counter()
            pool.rollout(model, workers, states, controls)
            rates.append(runs * steps / (time.perf_counter() - began))
    return rates[1:]


def make_environment(kind: str, simulator: Simulator) -> tuple[EnvMimicEnv | LocomotionEnv, ppo.PPOConfig]:
    """Return the environments to train in, and the default configuration of PPO for them."""
    robot = simulator.robot
    if kind == "walk":
        return environment_of(robot, find_task("walk"), LocomotionConfig(), simulator.actuators), locomotion_ppo()
    recordings = [read_recording(path, robot) for path in list_bundled("training")]
    motions = [reconstruct_for_simulator(recording, simulator) for recording in recordings]
    return EnvMimicEnv(simulator, motions, EnvMimicConfig()), ppo.PPOConfig()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer repeats")
    parser.add_argument(
        "--num-envs", type=int, nargs="+", default=[ppo.PPOConfig().num_envs], help="numbers of parallel environments"
    )
    parser.add_argument("--environment", choices=("envmimic", "walk"), default="envmimic", help="what is trained")
    parser.add_argument("--actuators", type=Path, help="file of identified actuators (nominal ones)")
    parser.add_argument("--results", type=Path, help="write the measurements to this JSON file")
    arguments = parser.parse_args()
    repeats = 3 if arguments.quick else 10

    robot = load_robot()
    actuators = None if arguments.actuators is None else read_actuators(robot, arguments.actuators)[1]
    simulator = Simulator(robot, actuators)
    model = simulator.mj_model
    env, default = make_environment(arguments.environment, simulator)
    devices, threads = jax.local_device_count(), len(cores())

    rows: list[tuple[str, list[float], list[float]]] = []
    for count in arguments.num_envs:
        first, rates = training_rates(env, sized(default, count, repeats))
        rows.append((f"PPO with learning, {count:,} environments", rates, [first]))
        rows.append((f"Simulation alone, {count:,} environments", stepping_rates(env, count, repeats), []))
    commands = np.random.default_rng(0).integers(0, 2, (64, 40, 2)).astype(float)
    rows.append((f"C MuJoCo's `rollout`, {threads} threads", rollout_rates(model, threads, repeats, commands), []))

    columns = ("", "control steps/s", "simulated s/s", "first training step (s)")
    table = Table(
        columns,
        tuple(
            (
                name,
                Cell(tuple(rates), ",.0f"),
                Cell(tuple(rate * CONTROL_TIMESTEP for rate in rates), ",.0f"),
                Cell(tuple(first), ".0f"),
            )
            for name, rates, first in rows
        ),
    )
    kind = jax.devices()[0].device_kind
    backend = f"{devices} {jax.default_backend()} {'device' if devices == 1 else 'devices'} ({kind})"
    data = f"{arguments.environment} on {backend}; means of {repeats} [lowest, highest]"
    print(f"{data}\n{table.to_markdown()}")
    if arguments.results:
        write_results(arguments.results, {"speed": table}, data)


if __name__ == "__main__":
    main()
