# %% [markdown]
# # Brax's own PPO in an improved simulator
#
# `python experiments/brax_ppo.py --run runs/envmimic-...` trains a walking policy in the simulator of a run. The run
# may be of a residual, of identified actuators, or of a policy. Without `--run`, the nominal simulator is used.
# `brax.training` is used unchanged.

# %%
from __future__ import annotations

import _setup

_setup.prepare()

import argparse
from pathlib import Path

from brax import envs
from brax.training.agents.ppo import train as ppo

import ballu_mjx.environments  # noqa: F401  # registers the tasks


# %%
def main() -> None:
    parser = argparse.ArgumentParser(description="Train a policy with Brax's own PPO in an improved simulator.")
    parser.add_argument("--run", type=Path, help="run folder that defines the simulator (nominal simulator without it)")
    parser.add_argument("--task", default="Walk", choices=["Walk", "Turn", "TurnRight", "WalkBackward"])
    parser.add_argument("--steps", type=int, default=1_000_000, help="control steps of the training")
    parser.add_argument("--num-envs", type=int, default=512, help="environments in parallel")
    options = parser.parse_args()
    env = envs.get_environment(f"ballu_mjx/{options.task}-v0", run=options.run)
    ppo.train(
        env,
        num_timesteps=options.steps,
        episode_length=env.episode_length,  # pyright: ignore
        num_envs=options.num_envs,
        num_eval_envs=16,
        num_evals=5,
        unroll_length=20,
        batch_size=options.num_envs // 4,
        num_minibatches=4,
        num_updates_per_batch=4,
        learning_rate=3e-4,
        discounting=0.985,
        reward_scaling=7.0,
        normalize_observations=True,
        progress_fn=lambda steps, found: print(
            f"{steps:9d} control steps: return {found['eval/episode_reward']:.2f}", flush=True
        ),
    )


# %%
if __name__ == "__main__":
    _setup.run(main)
