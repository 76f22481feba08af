"""Residual forces without reinforcement learning: `python -m ballu_mjx.train residual --method supervised|analytic`."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.cli import evaluate
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.recordings.segments import cut_segments
from ballu_mjx.residuals import analytic, supervised
from ballu_mjx.residuals.analytic import AnalyticConfig
from ballu_mjx.residuals.dataset import RecordingsData, ResidualDataset
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.network import NetworkForces, num_loads, recorded_inputs
from ballu_mjx.residuals.run_config import describe_run
from ballu_mjx.residuals.supervised import SupervisedConfig
from ballu_mjx.residuals.trained import TrainedResidual, write_observed
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import Run, new_folder
from ballu_mjx.runs.metrics import read_column
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.sim.force_model import BoundForces, ForceSet, SumOfForces
from ballu_mjx.sim.linearize import Linearizer
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.viz import artifacts, plots

QUICK: Mapping[str, Mapping[str, Any]] = {
    "supervised": {"updates": 400},
    "analytic": {"window_seconds": 0.5, "rounds": 1, "updates": 50},
}
"""Defaults of the methods' configurations under `--quick`."""


@dataclasses.dataclass(frozen=True)
class ForcesData(RecordingsData):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    forces: ForceSet = "force"
    """What the network pushes with: a force on the balloon (the paper's), a force and a torque there (wrench), or
    forces at balloon, base and feet (multi)."""
    residual: Path | None = None
    """Folder of another residual's run, which acts beside the forces: these learn what it leaves. It must have been
    learned beside the same actuators. Without this option: none."""


def fit_supervised(data: ForcesData, config: SupervisedConfig) -> int:
    """Read and check everything, label, regress, evaluate; returns the exit status."""
    supervised.check_supervised_config(config)
    return _fit("supervised", data, config, _Supervised)


def fit_analytic(data: ForcesData, config: AnalyticConfig) -> int:
    """Read and check everything, learn, evaluate; returns the exit status."""
    analytic.check_analytic_config(config)
    return _fit("analytic", data, config, _Analytic)


@dataclasses.dataclass(frozen=True)
class _Setup:
    """What both methods learn with."""

    model: mujoco.MjModel
    motions: Mapping[str, Sequence[Motion]]
    forces: NetworkForces
    start: Params
    inputs: Float[np.ndarray, "states inputs"]
    beside: BoundForces | None

    def with_policy(self, policy: Any) -> Params:
        """Parameters of `forces`."""
        return self.start._replace(policy=policy)


class _Fit:
    """A method at work, which logs and saves what it learns."""

    curve = "validation_error"
    """The metric that tells the best."""
    curve_label = "validation error (ratio)"

    def __init__(self, setup: _Setup, config: Any, run: Run, validate: Callable[[Any], float]) -> None:
        self.setup, self.config, self.run, self.validate = setup, config, run, validate
        self.stages, self.began = PhaseProgress(), time.perf_counter()

    def learn(self) -> None:
        """From beginning to end."""
        raise NotImplementedError

    @property
    def still(self) -> Any:
        """A policy without force, which whatever is learned has to beat."""
        return jax.tree.map(np.zeros_like, jax.device_get(self.setup.start.policy))

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """With the time so far."""
        self.run.log(step, {**metrics, "seconds": time.perf_counter() - self.began})

    def save(self, step: int, policy: Any, error: float) -> None:
        """Keep what was learned; `error` is the validation's, open loop."""
        self.run.save(step, ppo.as_tree(self.setup.with_policy(jax.device_get(policy))), error)


class _Supervised(_Fit):
    curve = "force_error"
    curve_label = "error of validation forces (ratio)"

    def learn(self) -> None:
        """Labels for training and validation, the regression, and which share of its forces to take."""
        setup, config = self.setup, self.config
        simulator = Simulator(setup.model)
        env = setup.forces.config
        linearize = Linearizer(setup.model, setup.beside, simulator.robot.joints, env.forces)
        label = supervised.ForceLabeller(setup.model, simulator.robot, linearize, config, env)
        found = {}
        for use in ("training", "validation"):
            motions, loads = setup.motions[use], []
            for motion in motions:
                loads.append(label(motion))
                self.stages.update(f"labels, {use}", len(loads), len(motions), math.nan)
            found[use] = supervised.examples(simulator, motions, loads, env)
            self.stages.close()
            force = _rms(np.concatenate(loads)[:, :3])
            print(f"Labels, {use}: {force * 1e3:.1f} mN on the balloon (RMS along an axis).", flush=True)
        infer = jax.jit(lambda policy, seen: setup.forces.infer(setup.with_policy(policy), seen))
        seen, actions = found["validation"]
        best = math.inf, 0, self.still

        def validate(step: int, policy: Any, loss: float) -> None:
            nonlocal best
            error = _rms(np.asarray(infer(policy, seen)) - actions) / _rms(actions)
            best = min(best, (error, step, jax.device_get(policy)), key=lambda found: found[0])
            self.log(step, {"loss": loss, "force_error": error})
            self.stages.update("learning", step, config.updates, error)

        validate(0, self.still, float(np.mean(found["training"][1] ** 2)))
        supervised.regress(infer, setup.start.policy, found["training"], config, validate)
        self.stages.close()
        _, step, policy = best
        parts = {share: ppo.with_share(policy, share) for share in config.shares}
        errors = {share: self.validate(setup.with_policy(part)) for share, part in parts.items()}
        told = ", ".join(f"{share:.0%}: {error:.2f}" for share, error in errors.items())
        print(f"Validation error by the share of the forces that acts (ratio): {told}.", flush=True)
        share = min(errors, key=lambda share: errors[share])
        if share == 0.0:
            print("No share of them is better than none: the residual is without force.", flush=True)
        labelled = sum(len(motion.command) for use in found for motion in setup.motions[use])
        simulated = labelled * (1 + linearize.directions)
        self.log(config.updates + 1, {"share": share, "validation_error": errors[share], "control_steps": simulated})
        self.save(step, parts[share], errors[share])


class _Analytic(_Fit):
    def learn(self) -> None:
        """Gradients through the simulation; the validation is open loop."""
        setup, config = self.setup, self.config
        robots = Simulator(setup.model)
        cut = cut_segments(robots, setup.motions["training"], config.window_seconds, config.interval_seconds)
        total = config.rounds * config.updates

        def report(step: int, policy: Any, metrics: dict[str, float]) -> None:
            error = self.validate(setup.with_policy(policy))
            self.log(step, {**metrics, "validation_error": error})
            self.save(step, policy, error)
            self.stages.update("learning", step, total, error)

        report(0, self.still, {})
        analytic.train(
            setup.model,
            setup.forces,
            setup.with_policy,
            setup.start.policy,
            cut,
            np.std(setup.inputs, axis=0),
            config,
            report,
            Linearizer(setup.model, setup.beside, forces=setup.forces.config.forces),
        )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _fit(task: str, data: ForcesData, config: Any, method: type[_Fit]) -> int:
    started = time.perf_counter()
    loggers.check(data.wandb)
    beside = None if data.residual is None else TrainedResidual.load(data.residual)
    prepared = ResidualDataset.read(data)
    if beside is not None:
        prepared.check_beside(beside.actuators, data.residual)
    folder = new_folder(data.output, task)
    prepared.announce(folder, data.quick)
    model = prepared.load_model()
    motions = prepared.reconstruct(model)
    env, network = EnvMimicConfig(forces=data.forces), dataclasses.replace(PPOConfig(), seed=config.seed)
    reference, _ = stack_motions(Simulator(model), motions["training"])
    inputs, actions = np.asarray(recorded_inputs(reference, env)), num_loads(env, prepared.robot)
    infer = ppo.make_inference({ppo.STATE: (inputs.shape[1],)}, actions, network)
    forces = NetworkForces(env, infer, name=task)
    start = ppo.initial_policy(inputs, actions, network)
    setup = _Setup(model, motions, forces, start, inputs, None if beside is None else beside.applied)
    whole = forces if beside is None else SumOfForces(beside.model, forces)

    def all_params(params: Params) -> Any:
        return params if beside is None else (beside.params, params)

    sections = {"env": env, "ppo": network, "fit": config, "data": data}
    devices = [str(device) for device in jax.local_devices()]
    description = describe_run(task, sections, prepared.files, devices, prepared.identified)
    description["residual"] = None if data.residual is None else str(data.residual.resolve())
    validation = OpenLoopEvaluator(model, motions["validation"], whole, prepared.base)
    with Run(folder, description, wandb=data.wandb) as run:
        print("Compiling: about a minute the first time ...", flush=True)
        write_observed(run, inputs)
        work = method(setup, config, run, lambda params: validation(all_params(params)).score)
        work.learn()
        work.stages.close()
    best_step, params = evaluate.load_params(folder, "best")
    names = [name for name in ("loss", "linear_loss") if len(read_column(folder, name)[0])]
    losses = {name.replace("_", " "): read_column(folder, name) for name in names}
    validated = read_column(folder, method.curve)
    plots.fit_curve(folder / "learning_curve.png", losses, validated, method.curve_label, task, best_step)
    test = validation if prepared.one_set else validation.on(motions["test"])
    print(f"Best checkpoint: gradient step {best_step:,}. Open-loop replay of the test recordings:\n")
    print(artifacts.write_evaluation(test, all_params(params), folder).table())
    if data.quick:
        print("\nThese numbers mean little: --quick learns for seconds.")
    print(f"\nWritten to {folder}. {time.perf_counter() - started:.0f} s in all.")
    return 0
