"""Measure the speed of training: control steps per second of PPO on EnvMimic, compared with simulation only.

Three speeds are measured in one run on the same machine:

- PPO on the bundled recordings, with the default sizes, including learning.
- The same environments, stepped without learning.
- C MuJoCo's `rollout` of the same model at the same time step, with one thread per device.

Speeds are in control steps and in simulated seconds per second. The first call of each, which compiles, is left out.

`python benchmarks/throughput.py`
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from ballu_mjx.common import runtime
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.simulator import Simulator

runtime.prepare()

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, standing_qpos
from ballu_mjx.identification.actuators import read_actuators
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv
from ballu_mjx.rl import learner, ppo, training_env, training_state
from ballu_mjx.sim.step import count_substeps


def training_rates(env: EnvMimicEnv, config: ppo.PPOConfig) -> list[float]:
    """Return control steps per second of each training step except the first, which compiles."""
    rates: list[float] = []

    def note(step: int, state: training_state.TrainingState, metrics: dict[str, float]) -> None:
        if metrics:
            rates.append(metrics["steps_per_second"])

    learner.train(env, config, note)
    return rates[1:]


def stepping_rates(env: EnvMimicEnv, num_envs: int, repeats: int, length: int = 20) -> list[float]:
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer repeats")
    parser.add_argument("--num-envs", type=int, default=ppo.PPOConfig().num_envs, help="environments in parallel")
    parser.add_argument("--actuators", type=Path, help="file of identified actuators (nominal ones)")
    arguments = parser.parse_args()
    repeats = 3 if arguments.quick else 10

    robot = load_robot()
    actuators = None if arguments.actuators is None else read_actuators(robot, arguments.actuators)[1]
    simulator = Simulator(robot, actuators)
    model, drivetrain = simulator.mj_model, simulator.drivetrain
    recordings = [read_recording(path, robot) for path in list_bundled("training")]
    motions = [reconstruct(recording, robot, model, drivetrain=drivetrain) for recording in recordings]
    env = EnvMimicEnv(simulator, motions, EnvMimicConfig())
    config = ppo.PPOConfig(num_envs=arguments.num_envs)
    step_size = config.batch_size * config.num_minibatches * config.unroll_length
    config = ppo.PPOConfig(num_envs=arguments.num_envs, num_timesteps=(repeats + 1) * step_size)

    devices = jax.local_device_count()
    commands = np.random.default_rng(0).integers(0, 2, (64, 40, 2)).astype(float)
    rows = {
        "PPO training, learning included": training_rates(env, config),
        "MJX environments alone": stepping_rates(env, config.num_envs, repeats),
        f"C MuJoCo rollout, {devices} threads": rollout_rates(model, devices, repeats, commands),
    }
    print(
        f"{devices} {jax.default_backend()} devices, {config.num_envs} environments, time step {model.opt.timestep} s"
    )
    print(f"{'median (least to most) of ' + str(repeats):36}{'control steps/s':>30}{'simulated s/s':>16}")
    for name, rates in rows.items():
        middle = float(np.median(rates))
        cell = f"{middle:,.0f} ({min(rates):,.0f} to {max(rates):,.0f})"
        print(f"{name:36}{cell:>30}{middle * CONTROL_TIMESTEP:>16,.0f}")


if __name__ == "__main__":
    main()
