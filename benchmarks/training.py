"""Compare the wall time to learn to walk: our PPO in MJX, and the paper's software (Stable-Baselines3 and PyBullet).

The task is forward walking, and the reward is the velocity of the centre of mass along x (m/s). Both use the same
observations, actions, random episode lengths, starting states and networks. Stable-Baselines3's PPO runs with two sets
of options. `same` has our batch size, epochs, discount and so on. `defaults` has its own, with rewards and observations
normalized as its authors recommend. It runs with one, two or four processes per core, whichever is fastest.

Times are measured from the start of the process, including imports and compiling. The first result is the wall time
until the mean reward of the last 100,000 control steps, with exploration, reaches the target. The second is the number
of control steps per second, including learning, as the median over batches. Ours is measured with an empty cache of
compiled programs (cold, for the first seed only) and with a full one (warm). A slow method needs a long time for those
100,000 steps. So the times until a single batch reaches the target are compared too.

If MuJoCo Playground is installed (`pip install playground`), its speed is measured on its most similar task without
downloads. This is the planar walker of DeepMind's Control Suite, with Brax's PPO and batches of our size.

`python benchmarks/training.py`. With `--quick` it runs within minutes as a check, and its results mean little.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import multiprocessing
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import common
import numpy as np
import tyro
from matplotlib.figure import Figure

from ballu_mjx.common import runtime

TASK = "walk"
OURS, SAME, DEFAULTS, PLAYGROUND = "ours", "SB3 + PyBullet (same)", "SB3 + PyBullet (defaults)", "Playground"
COLOURS = {OURS: "#0072b2", SAME: "#d55e00", DEFAULTS: "#009e73"}
PLAYGROUND_TASK = "WalkerWalk"
"""Task of MuJoCo Playground."""
EPISODE_SECONDS = 12.0
"""Mean length of an episode (s), for both simulators."""
BULLET_TIMESTEP = 1 / 240
"""Bullet's time step (s): its default, and the largest one that is stable here."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the comparison of trainings."""

    target: float = 0.2
    """Target of the mean reward (m/s)."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds. Each method trains once for every seed (ours with a cold cache: for the first only). Ratios are of medians
    over seeds."""
    steps: int = 3_000_000
    """Control steps after which a training ends if it has not reached the target."""
    output: Path = Path("runs/bench-training")
    """Folder for training.json and training.png."""
    quick: bool = False
    """Use one seed and a few batches, too few to learn to walk."""


Curve = list[tuple[float, int, float]]
"""Seconds since the start of the process, control steps done, and mean reward of the last batch (m/s)."""


WINDOW = 100_000
"""Control steps over which the reward is averaged.

One batch is not enough, because it shows only one phase of episodes that began together.
"""


def measure(kind: str, **request: Any) -> Any:
    """Return the measurement of a child process."""
    functions = {OURS: train_ours, SAME: train_same, DEFAULTS: train_defaults, PLAYGROUND: playground_rate}
    return {"processes": stepping_rate, **functions}[kind](**request)


class _ReachedError(Exception):
    """Exception that ends a training when the target is reached."""


def train_ours(launched: float, seed: int, steps: int, target: float, config: dict[str, Any]) -> Curve:
    """Train as `python -m ballu_mjx.train walk`, without run folder, and return the curve.

    `launched` is the start of the process (s, `time.time`), and `config` has the fields of a `PPOConfig`.
    """
    runtime.prepare()
    from ballu_mjx.policies.locomotion_config import LocomotionConfig
    from ballu_mjx.policies.policy import environment_of
    from ballu_mjx.policies.tasks import TASKS
    from ballu_mjx.rl import learner, ppo, training_state
    from ballu_mjx.robots.registry import load_robot

    curve: Curve = []

    def note(step: int, state: training_state.TrainingState, metrics: dict[str, float]) -> None:
        if metrics:
            curve.append((time.time() - launched, step, metrics["reward"]))
            if seconds_to(curve, target) is not None:
                raise _ReachedError

    env = environment_of(load_robot(), TASKS[TASK], LocomotionConfig(episode_seconds=EPISODE_SECONDS))
    try:
        learner.train(env, dataclasses.replace(ppo.PPOConfig(**config), num_timesteps=steps, seed=seed), note)
    except _ReachedError:
        pass
    return curve


def _environments(processes: int, scale: float) -> Any:
    """Return environments in separate processes, with rewards multiplied by `scale`.

    Processes are forked if the system allows it. This is safe here, because JAX has not started. Otherwise they would
    spend seconds on imports, which is not due to Stable-Baselines3.
    """
    from stable_baselines3.common.vec_env import SubprocVecEnv  # pyright: ignore[reportMissingImports]

    def make() -> Any:
        import bullet_gym
        import gymnasium  # pyright: ignore[reportMissingImports]

        env = bullet_gym.LocomotionEnv(TASK, BULLET_TIMESTEP, EPISODE_SECONDS)
        return gymnasium.wrappers.TransformReward(env, lambda reward: scale * float(reward))

    fork = "fork" in multiprocessing.get_all_start_methods()
    return SubprocVecEnv([make] * processes, start_method="fork" if fork else None)


def stepping_rate(processes: int, steps: int) -> float:
    """Return the control steps per second of the environments without learning."""
    environments = _environments(processes, 1.0)
    environments.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, processes, 2)).astype(np.float32)
    environments.step(actions[0])
    began = time.perf_counter()
    for action in actions:
        environments.step(action)
    took = time.perf_counter() - began
    environments.close()
    return steps * processes / took


def train_same(launched: float, seed: int, steps: int, target: float, config: dict[str, Any], processes: int) -> Curve:
    """Train by Stable-Baselines3 with our options. It has no adaptive learning rate and no averaged policy."""
    from torch import nn  # pyright: ignore[reportMissingImports]

    batch = config["batch_size"] * config["unroll_length"]
    options = {
        "learning_rate": config["learning_rate"],
        "n_steps": batch * config["num_minibatches"] // processes,
        "batch_size": batch,
        "n_epochs": config["num_updates_per_batch"],
        "gamma": config["discounting"],
        "gae_lambda": config["gae_lambda"],
        "clip_range": config["clipping_epsilon"],
        "ent_coef": config["entropy_cost"],
        "vf_coef": 0.25,  # Brax's value.
        "max_grad_norm": config["max_grad_norm"],
        "policy_kwargs": {
            "net_arch": {"pi": list(config["policy_layers"]), "vf": list(config["value_layers"])},
            "activation_fn": {"swish": nn.SiLU, "tanh": nn.Tanh}[config["activation"]],
            "log_std_init": float(np.log(config["initial_std"])),
        },
    }
    normalize = {"norm_reward": False, "clip_obs": config["observation_clip"]}
    return _train_sb3(launched, seed, steps, target, processes, config["reward_scaling"], normalize, options)


def train_defaults(
    launched: float, seed: int, steps: int, target: float, config: dict[str, Any], processes: int
) -> Curve:
    """Train by Stable-Baselines3 with its default options. Its default networks have the size of ours."""
    return _train_sb3(launched, seed, steps, target, processes, 1.0, {}, {})


def _train_sb3(
    launched: float,
    seed: int,
    steps: int,
    target: float,
    processes: int,
    scale: float,
    normalize: dict[str, Any],
    options: dict[str, Any],
) -> Curve:
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import VecNormalize  # pyright: ignore[reportMissingImports]

    # Such small networks do not learn faster with more threads, and the environments need the cores.
    torch.set_num_threads(1)
    curve: Curve = []

    class Note(BaseCallback):
        """Callback that records the mean of unscaled rewards, and ends training at the target."""

        rewards: list[float] = []
        reached = False

        def _on_rollout_start(self) -> None:
            self.rewards = []

        def _on_step(self) -> bool:
            self.rewards += [info["reward"] for info in self.locals["infos"]]
            return not self.reached

        def _on_rollout_end(self) -> None:
            curve.append((time.time() - launched, self.num_timesteps, float(np.mean(self.rewards))))
            self.reached = seconds_to(curve, target) is not None

    environments = VecNormalize(_environments(processes, scale), gamma=options.get("gamma", 0.99), **normalize)
    try:
        PPO("MlpPolicy", environments, seed=seed, device="cpu", **options).learn(steps, Note())
    finally:
        environments.close()
    return curve


def playground_rate(steps: int, config: dict[str, Any]) -> dict[str, float]:
    """Return the speed of Brax's PPO on Playground's task, with its networks and our batch size."""
    runtime.prepare()
    import functools

    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo
    from mujoco_playground import registry, wrapper  # pyright: ignore[reportMissingImports]
    from mujoco_playground.config import dm_control_suite_params  # pyright: ignore[reportMissingImports]

    env = registry.load(PLAYGROUND_TASK, config_overrides={"impl": "jax"})
    params = dm_control_suite_params.brax_ppo_config(PLAYGROUND_TASK, "jax").to_dict()
    factory = functools.partial(networks.make_ppo_networks, **params.pop("network_factory", {}))
    sizes = ("num_envs", "batch_size", "num_minibatches", "unroll_length", "num_updates_per_batch")
    params |= {name: config[name] for name in sizes}
    rates: list[float] = []

    def note(step: int, metrics: Mapping[str, Any]) -> None:
        if "training/sps" in metrics:
            rates.append(float(metrics["training/sps"]))

    each = config["batch_size"] * config["num_minibatches"] * config["unroll_length"] * params["action_repeat"]
    params |= {"num_timesteps": steps, "num_evals": max(steps // each, 2) + 1, "num_eval_envs": 2, "run_evals": False}
    ppo.train(
        environment=env,
        wrap_env_fn=wrapper.wrap_for_brax_training,
        network_factory=factory,
        progress_fn=note,
        seed=0,
        **params,
    )
    rate = float(np.median(rates[1:]))
    return {"control_steps_per_second": rate, "simulated_seconds_per_second": rate * env.dt}


def seconds_to(curve: Curve, target: float, window: int = WINDOW) -> float | None:
    """Return the seconds until the mean reward over the last `window` control steps reached the target. None if never.

    The mean is over the last batch if that is longer.
    """
    for last, (seconds, steps, _) in enumerate(curve):
        recent = [reward for _, done, reward in curve[: last + 1] if done > steps - window]
        if steps >= window and np.mean(recent) >= target:
            return seconds
    return None


def rate(curve: Curve) -> float | None:
    """Return the median control steps per second over batches without the first, which compiles. None for one batch."""
    times, steps, _ = zip(*curve, strict=True)
    return float(np.median(np.diff(steps) / np.diff(times))) if len(curve) > 1 else None


def plot(path: Path, rows: list[dict[str, Any]], target: float, machine: str) -> None:
    """Plot mean rewards over wall time."""
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    seen = set()
    for row in rows:
        seconds, _, rewards = zip(*row["curve"], strict=True)
        name = row["kind"] + (f", {row['cache']}" if row["cache"] else "")
        style = "--" if row["cache"] == "cold" else "-"
        label = None if name in seen else name
        axes.plot(seconds, rewards, style, color=COLOURS[row["kind"]], label=label, marker=".", markersize=3)
        seen.add(name)
    axes.axhline(target, color="black", linewidth=0.8)
    axes.set(xscale="log", xlabel="wall time from the start of the process (s)")
    axes.set_ylabel("mean velocity along x while learning (m/s)")
    axes.set_title(machine, fontsize=9)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    common.save(figure, path)


def main(options: Options) -> None:
    runtime.prepare()
    from ballu_mjx.policies.training import locomotion_ppo

    config = dataclasses.asdict(locomotion_ppo())
    if options.quick:
        options = dataclasses.replace(options, seeds=(0,), steps=21_000)
    counts = [len(common.cores()) * each for each in ((2,) if options.quick else (1, 2, 4))]
    stepping = {n: common.child(__file__, {"kind": "processes", "processes": n, "steps": 100}) for n in counts}
    processes = max(stepping, key=lambda n: stepping[n])
    print("PyBullet environments alone: " + ", ".join(f"{n} processes {r:,.0f} steps/s" for n, r in stepping.items()))

    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as cache:
        environment = {"JAX_COMPILATION_CACHE_DIR": cache}
        for seed in options.seeds:
            for kind in (OURS, SAME, DEFAULTS):
                request = {"kind": kind, "seed": seed, "steps": options.steps, "target": options.target}
                request["config"] = config
                if kind != OURS:
                    request["processes"] = processes
                caches = ("",) if kind != OURS else ("cold", "warm") if seed == options.seeds[0] else ("warm",)
                for state in caches:
                    curve = common.child(__file__, {**request, "launched": time.time()}, env=environment)
                    rows.append({"kind": kind, "cache": state, "seed": seed, "curve": curve})
                    reached, speed = seconds_to(curve, options.target), rate(curve)
                    rows[-1] |= {"seconds_to_target": reached, "control_steps_per_second": speed}
                    rows[-1]["seconds_to_target_by_batch"] = seconds_to(curve, options.target, window=1)
                    told = "never" if reached is None else f"{reached:.0f} s"
                    steps = "" if speed is None else f"; {speed:,.0f} control steps/s"
                    print(f"{kind} {state} seed {seed}: {options.target} m/s reached: {told}{steps}", flush=True)

    playground: Any = "not installed"
    if importlib.util.find_spec("mujoco_playground") is not None:
        steps = 21_000 if options.quick else 400_000
        playground = common.child(__file__, {"kind": PLAYGROUND, "steps": steps, "config": config})
    print(f"MuJoCo Playground, {PLAYGROUND_TASK}: {playground}")

    ratios = compare(rows)
    for line, value in ratios.items():
        print(f"{line}: {value:.1f}")
    result = {"quick": options.quick, "target": options.target, "stepping": stepping, "processes": processes}
    common.write(options.output, "training", {**result, "rows": rows, "playground": playground, "ratios": ratios})
    plot(options.output / "training.png", rows, options.target, common.described(common.machine()))


def compare(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return ratios of speed and time between ours and the better variant of Stable-Baselines3.

    They are of medians over seeds. With a cold cache, ours is one run of the first seed.
    """

    def median(kind: str, cache: str, name: str) -> float:
        values = [row[name] for row in rows if (row["kind"], row["cache"]) == (kind, cache)]
        known = [value if value is not None else np.inf for value in values]
        return float(np.median(known)) if known else np.nan

    found = {}
    fastest = max(median(kind, "", "control_steps_per_second") for kind in (SAME, DEFAULTS))
    found["steps/s, times"] = median(OURS, "warm", "control_steps_per_second") / fastest
    for name, how in (("seconds_to_target", ""), ("seconds_to_target_by_batch", ", by one batch")):
        soonest = min(median(kind, "", name) for kind in (SAME, DEFAULTS))
        for cache in ("cold", "warm"):
            found[f"sooner at the target{how}, {cache}, times"] = soonest / median(OURS, cache, name)
    return {name: value for name, value in found.items() if np.isfinite(value)}


if __name__ == "__main__" and not common.answer(measure):
    main(tyro.cli(Options, description=__doc__))
