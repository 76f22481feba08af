# %% [markdown]
# # Stable-Baselines3's PPO in an improved simulator
#
# `python experiments/stable_baselines3_ppo.py --run runs/envmimic-...` trains a walking policy in the simulator of a
# run. The run may be of a residual, of identified actuators, or of a policy. Without `--run`, the nominal simulator is
# used. The script needs `pip install -c constraints.txt -e ".[gym]" stable-baselines3`. One compiled program steps all
# environments.

# %%
from __future__ import annotations

import _setup

_setup.prepare()

import argparse
from pathlib import Path

import gymnasium
import numpy as np

import ballu_mjx.environments  # noqa: F401  # registers the tasks


# %%
def returns(model, env, steps: int) -> float:
    """Return the mean reward for a control step over `steps` control steps, without exploration."""
    observation, rewards = env.reset(), []
    for _ in range(steps):
        observation, reward, _, _ = env.step(model.predict(observation, deterministic=True)[0])
        rewards.append(reward)
    return float(np.mean(rewards))


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Train a policy with Stable-Baselines3's PPO in an improved simulator."
    )
    parser.add_argument("--run", type=Path, help="run folder that defines the simulator (nominal simulator without it)")
    parser.add_argument("--task", default="Walk", choices=["Walk", "Turn", "TurnRight", "WalkBackward"])
    parser.add_argument("--steps", type=int, default=1_000_000, help="control steps of the training")
    parser.add_argument("--num-envs", type=int, default=256, help="environments in parallel")
    parser.add_argument("--output", type=Path, default=Path("runs/sb3.zip"), help="file of the policy to write")
    options = parser.parse_args()
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]

    from ballu_mjx.policies.environments.gym_env import GymVectorEnv
    from ballu_mjx.policies.environments.sb3_env import StableBaselinesEnv  # raises if a package is missing

    torch.set_num_threads(1)  # more threads would compete with those of the simulation
    vector = gymnasium.make_vec(f"ballu_mjx/{options.task}-v0", num_envs=options.num_envs, run=options.run)
    assert isinstance(vector, GymVectorEnv)
    env = StableBaselinesEnv(vector)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=32,
        batch_size=options.num_envs * 4,
        n_epochs=4,
        learning_rate=1e-3,
        gamma=0.97,
        policy_kwargs={"log_std_init": -0.5},
        device="cpu",
        seed=0,
    )
    trial = round(
        vector.unwrapped.locomotion.config.episode_seconds / vector.unwrapped.locomotion.robot.control_timestep
    )
    before = returns(model, env, trial)
    model.learn(options.steps, progress_bar=False)
    after = returns(model, env, trial)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    model.save(options.output)
    print(f"Mean reward for a control step: {before:.3f} before, {after:.3f} after. Written to {options.output}.")


# %%
if __name__ == "__main__":
    _setup.run(main)
