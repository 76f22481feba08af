# %% [markdown]
# # Ablation of EnvMimic's options
#
# Each row of the table is the default configuration of EnvMimic with one change. It is trained with
# several seeds, and measured on twelve random recordings made for this purpose, six near and six far. These are neither
# the main job's validation recordings, which are too few, nor test recordings. The actuators are the identified ones.
#
# `python experiments/ablation.py` takes about an hour on two cores. Finished trainings are not repeated. `--quick` is a
# short trial run.

# %%
from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import jax

from ballu_mjx.ballu.actuators_file import read_actuators
from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.ballu.virtual.hardware import VirtualHardware
from ballu_mjx.common import files
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation.errors import SCORE_HORIZONS
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.presets import preset_values
from ballu_mjx.rl import learner, ppo, training_state
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.model import assets
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.simulator import Simulator

# %% [markdown]
# ## Rows of the table


# %%
@dataclasses.dataclass(frozen=True)
class Row:
    """Changes to the default options of a training."""

    env: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    ppo: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def key(self) -> str:
        """Hash of the options, for the names of files."""
        return hashlib.sha256(json.dumps(dataclasses.asdict(self), sort_keys=True).encode()).hexdigest()[:10]


PAPER = preset_values("paper")
PAPER_REWARD = {"fine_position_weight": 0.0, "fine_orientation_weight": 0.0}
ROWS: Mapping[str, Row] = {
    "defaults": Row(),
    "a force without a torque": Row({"forces": "force"}),
    "paper's reward alone": Row(PAPER_REWARD),
    "critic blind to the error": Row({"critic_sees_error": False}),
    "1 N a unit of output": Row({"force_scale": 1.0}),
    "commands not observed": Row({"observe_command": False}),
    "no noise on starts and observations": Row({"observation_noise": 0.0, "start_noise": 0.0}),
    "start at zero force, cost from there": Row({"expected_loads": (0.0,)}),
    "no cost on force": Row({"force_cost": 0.0}),
    "constant learning rate": Row(ppo={"desired_kl": 0.0}),
    "last iterate instead of the average": Row(ppo={"averaging": 1}),
    "absolute observation": Row({"relative_observation": False}),
    "world frame": Row({"heading_frame": False}),
    "episodes of one length": Row({"episode_spread": 0.0}),
    "the paper's preset": Row(PAPER["env"], PAPER["ppo"]),
    "the paper's preset, learning rate 1e-4": Row(PAPER["env"], {**PAPER["ppo"], "learning_rate": 1e-4}),
    "the paper's preset, learning rate 1e-3": Row(PAPER["env"], {**PAPER["ppo"], "learning_rate": 1e-3}),
}

# %% [markdown]
# ## One training


# %%
@dataclasses.dataclass(frozen=True)
class Sizes:
    """Length of training, and interval between validations."""

    steps: int
    """Control steps of a training."""
    validate_every: int
    """Control steps between two validations."""
    ppo: Mapping[str, Any]
    """Options of `PPOConfig` that set sizes."""


def train(
    row: Row, seed: int, sizes: Sizes, simulator: Simulator, motions: Mapping[str, Sequence[Motion]]
) -> list[dict[str, Any]]:
    """Train once, and return its validations.

    Each has the control step, the score, the reward, and ratios to the errors of the simulator without residual, by
    group, quantity and horizon (s).
    """
    ppo_config = PPOConfig(**{**sizes.ppo, "num_timesteps": sizes.steps, "seed": seed, **row.ppo})
    env = EnvMimicEnv(simulator, motions["training"], EnvMimicConfig(**row.env))
    infer = ppo.make_inference(env.observation_size, env.action_size, ppo_config, env.mirror)
    forces = NetworkResidual(env.config, simulator.robot, infer)
    evaluator = OpenLoopEvaluator(simulator, motions["validation"], forces)
    last = learner.total_timesteps(ppo_config)
    history: list[dict[str, Any]] = []
    due = sizes.validate_every

    def look(step: int, state: training_state.TrainingState, metrics: dict[str, float]) -> None:
        nonlocal due
        if step < due and step < last:
            return
        due = step + sizes.validate_every
        result = evaluator(training_state.params(state))
        ratios = {
            f"{group} {quantity} {horizon:g}": result.ratio(group, quantity, horizon)
            for group in result.groups
            for quantity in ("position", "orientation")
            for horizon in SCORE_HORIZONS
        }
        history.append({"step": step, "score": result.score, "reward": metrics["reward"], "ratios": ratios})

    learner.train(env, ppo_config, look)
    return history


# %% [markdown]
# ## Table, with one value for each seed


# %%
def table(results: Mapping[str, Sequence[Sequence[Mapping[str, Any]]]]) -> Table:
    """Return the best score, the last score, and the ratios at the best score, by row.

    The best validation is chosen as in the main job.
    """
    names = list(next(iter(results.values()))[0][0]["ratios"])
    rows = []
    for label, histories in results.items():
        best = [min(history, key=lambda entry: entry["score"]) for history in histories]
        scores = (best, [history[-1] for history in histories])
        cells = [Cell(tuple(entry["score"] for entry in entries)) for entries in scores]
        cells += [Cell(tuple(entry["ratios"][name] for entry in best), spread=False) for name in names]
        rows.append((label, Cell((len(histories),), ".0f"), *cells))
    return Table(("", "seeds", "best score", "last score", *(f"{name} s" for name in names)), tuple(rows))


# %% [markdown]
# ## Run


# %%
def main() -> None:
    parser = argparse.ArgumentParser(description="Ablation of EnvMimic's options, over seeds.")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="training seeds of each row (0 1 2)")
    parser.add_argument(
        "--rows", nargs="+", choices=list(ROWS), default=list(ROWS), help="rows to train (all)", metavar="ROW"
    )
    parser.add_argument("--steps", type=int, default=1_200_000, help="control steps of each training")
    parser.add_argument("--fresh", type=int, default=7, help="seed of the recordings for measurement")
    parser.add_argument("--quick", action="store_true", help="two rows, trained for seconds; the numbers mean nothing")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    options = _setup.parse(parser, Path("runs/ablation"))
    _setup.reserve(options.output, steps=options.steps, fresh=options.fresh, quick=options.quick)

    training = list_bundled("training")
    rows, seeds, sizes = options.rows, options.seeds, Sizes(options.steps, 200_000, {})
    if options.quick:
        rows, seeds, training = rows[:2], seeds[:1], training[:2]
        sizes = Sizes(20_000, 20_000, {"num_envs": 256, "batch_size": 128})
    bundled = VirtualHardware.draw(dataset.ROBOT_SEED)
    validation = dataset.record_fresh(options.fresh, bundled, options.output, 1 if options.quick else 6)
    _, identified = read_actuators(assets() / "recordings" / ACTUATORS_FILE)
    simulator = Simulator(load_robot(), identified)
    read = {"training": training, "validation": validation}
    motions = {
        use: [reconstruct_for_simulator(read_recording(path, load_robot()), simulator) for path in paths]
        for use, paths in read.items()
    }
    results: dict[str, list[list[dict[str, Any]]]] = {}
    for seed in seeds:
        for label in rows:
            path = options.output / f"{ROWS[label].key}-seed-{seed}.json"
            if not path.exists():
                started = time.perf_counter()
                history = train(ROWS[label], seed, sizes, simulator, motions)
                files.write(path, json.dumps({"row": label, "seed": seed, "validations": history}, indent=1) + "\n")
                jax.clear_caches()  # the programs of a dozen trainings exceed the process's limit of memory maps
                seconds = time.perf_counter() - started
                print(f"{label}, seed {seed}: {history[-1]['score']:.2f} ({seconds:.0f} s)", flush=True)
            results.setdefault(label, []).append(json.loads(path.read_text())["validations"])
    used = {"training": seeds, "recording": [options.fresh]}
    _setup.write_tables({"options": table(results)}, options.output, options.results, used)


if __name__ == "__main__":
    _setup.run(main)
