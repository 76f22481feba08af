"""Training of supervised and analytic residuals: from a simulator and recorded motions to a residual."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.evaluation.open_loop import Evaluators
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.motion_windows import cut_motion_windows
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals import force_gradients, force_regression
from ballu_mjx.residuals.force_gradients import AnalyticConfig
from ballu_mjx.residuals.force_regression import SupervisedConfig
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_config import ForceNetworkConfig, check_network_config
from ballu_mjx.residuals.network_input import recorded_inputs
from ballu_mjx.residuals.network_loads import expected_units, num_loads
from ballu_mjx.residuals.network_mirror import network_mirror
from ballu_mjx.residuals.scales import missing_loads, resolve_scales
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.training_range import TrainingRange, with_fading
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.runs.record import MemoryRecord, TrainingRecord
from ballu_mjx.sim import force_sets
from ballu_mjx.sim.force_sets import FORCE_SETS, ForceSet
from ballu_mjx.sim.linearize import Linearizer
from ballu_mjx.sim.residual import add_to_base
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator


def fit_supervised(
    simulator: Simulator | AugmentedSimulator,
    motions: Sequence[Motion],
    config: SupervisedConfig | None = None,
    *,
    forces: ForceSet | ForceNetworkConfig = "force",
    validation: Sequence[Motion] | None = None,
    run: TrainingRecord | None = None,
    progress: PhaseProgress | None = None,
    evaluators: Evaluators | None = None,
) -> TrainedResidual:
    """Learn residual forces by regression on the forces that explain the recordings (the paper's baseline).

    **Arguments**

    - `simulator`: the simulator to correct. If it has a residual, that residual also acts, and the new forces add to
      it. The result is the sum of both residuals.
    - `motions`: training motions.
    - `config`: options of labels and regression. None for the defaults.
    - `forces`: force set of the network, or all options of its input and output. Scales that are not given are
      estimated from the motions (`scales.resolve_scales`).
    - `validation`: motions that choose the network. None for `motions`.
    - `run`: record of metrics and checkpoints, for example a run's folder. None to keep them in memory.
    - `progress`: display that is updated after every step.
    - `evaluators`: evaluators of this simulator without residual, to share their compiled programs.

    **Raises** `InputError` for options out of range.
    """
    config = config or SupervisedConfig()
    force_regression.check_supervised_config(config)
    uses = _Uses(motions, motions if validation is None else validation)
    return _fit(_Supervised, "supervised", simulator, uses, config, forces, run, progress, evaluators)


def fit_analytic(
    simulator: Simulator | AugmentedSimulator,
    motions: Sequence[Motion],
    config: AnalyticConfig | None = None,
    *,
    forces: ForceSet | ForceNetworkConfig = "force",
    validation: Sequence[Motion] | None = None,
    run: TrainingRecord | None = None,
    progress: PhaseProgress | None = None,
    evaluators: Evaluators | None = None,
) -> TrainedResidual:
    """Learn residual forces by gradients of the tracking error through the simulation.

    `config` has the options of this method. The other arguments and the errors are those of `fit_supervised`.
    """
    config = force_gradients.resolve_windows(config or AnalyticConfig(), simulator.robot)
    force_gradients.check_analytic_config(config, simulator.robot.control_timestep)
    uses = _Uses(motions, motions if validation is None else validation)
    return _fit(_Analytic, "analytic", simulator, uses, config, forces, run, progress, evaluators)


def network_layers(seed: int) -> PPOConfig:
    """Return the options of the network's layers. They are those of EnvMimic's network."""
    return PPOConfig(seed=seed)


def free_torques(forces: ForceSet, robot: RobotDescription) -> tuple[str, ...]:
    """Return the joints whose torques are unknowns of the labelling, in addition to the loads.

    There are none if the loads are forces along joints or changes of commands, which cause such torques themselves, or
    if residual forces may act along no joint.
    """
    return robot.joints if FORCE_SETS[forces].turns and force_sets.num_loads("joints", robot) else ()


def resolve_joint_spreads(
    config: SupervisedConfig,
    forces: ForceSet,
    simulator: Simulator | AugmentedSimulator,
    motions: Sequence[Motion],
) -> SupervisedConfig:
    """Return options whose `torque_spread` and `slide_force_spread` are set, as far as the robot has such joints.

    An open value becomes the largest RMS torque (of slides: force) that the model lacks at a joint along the motions.
    The options are returned unchanged if no joint torque is an unknown of the labelling.
    """
    robot, model = simulator.robot, simulator.with_residual(None).simulator.mj_model
    slides = [model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_SLIDE for name in free_torques(forces, robot)]
    units = {"torque_spread": "N m" if False in slides else None, "slide_force_spread": "N" if True in slides else None}
    missing = {name: unit for name, unit in units.items() if unit and getattr(config, name) is None}
    if not missing:
        return config
    size = missing_loads(simulator, motions, "joints").rms
    joints = list(zip(size, robot.force_joints.values(), strict=True))
    found = {
        name: float(max((x for x, joint in joints if joint.unit == unit), default=_LEAST_SPREAD))
        for name, unit in missing.items()
    }
    return dataclasses.replace(config, **found)


_LEAST_SPREAD = 1e-9
"""Spread (N, N m) of joint torques where no residual force may act along a joint of the kind."""


class _Uses(NamedTuple):
    """Motions by use."""

    training: Sequence[Motion]
    validation: Sequence[Motion]


@dataclasses.dataclass(frozen=True)
class _Setup:
    """Simulator, motions and network with which both methods learn."""

    simulator: AugmentedSimulator
    motions: _Uses
    forces: NetworkResidual
    start: Params
    """Initial parameters of `forces`."""
    inputs: Float[np.ndarray, "states inputs"]
    """Inputs of the network for all recorded training states."""

    def with_policy(self, policy: Any) -> Params:
        """Return parameters of `forces` with the policy network `policy`."""
        return self.start._replace(policy=policy)


class _Fit:
    """Base class of both methods: it logs metrics, and saves networks."""

    def __init__(
        self,
        setup: _Setup,
        config: SupervisedConfig | AnalyticConfig,
        record: TrainingRecord,
        validate: Callable[[Params], float],
        progress: PhaseProgress | None,
    ) -> None:
        self.setup, self.config, self.record, self.validate = setup, config, record, validate
        self.progress, self.began = progress, time.perf_counter()
        self.notes: list[str] = []
        """Lines of the report for the user."""

    def learn(self) -> None:
        """Learn the network and save it."""
        raise NotImplementedError

    @property
    def zero_policy(self) -> Any:
        """Return a policy whose loads are 0. It is the first candidate for the best policy."""
        return jax.tree.map(np.zeros_like, jax.device_get(self.setup.start.policy))

    def show(self, stage: str, iteration: int, steps: int, loss: float) -> None:
        """Update the progress display, if there is one."""
        if self.progress is not None:
            self.progress.update(stage, iteration, steps, loss)

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add metrics and the time since the start (s) to the record."""
        self.record.log(step, {**metrics, "seconds": time.perf_counter() - self.began})

    def save(self, step: int, policy: Any, error: float) -> None:
        """Save a policy with its open-loop validation error."""
        self.record.save(step, ppo.as_tree(self.setup.with_policy(jax.device_get(policy))), error)


class _Supervised(_Fit):
    def learn(self) -> None:
        """Label the motions, fit networks, and choose one of them and the share of its forces that acts."""
        setup, config = self.setup, self.config
        assert isinstance(config, SupervisedConfig)
        examples, simulated = self._labels(config)
        infer = jax.jit(lambda policy, seen: setup.forces.infer(setup.with_policy(policy), seen))
        # Without loads, all networks have the same error.
        without = self.validate(setup.with_policy(self.zero_policy)) if 0.0 in config.force_shares else math.nan
        candidates = [
            candidate
            for number in range(len(config.observation_noise))
            for candidate in self._networks(config, number, infer, examples, without)
        ]
        chosen = min(candidates, key=lambda each: each.error)
        if chosen.share == 0.0:
            self.notes.append("No share of the forces improves the validation error: the residual is 0.")
        else:
            self.notes.append(f"Kept: {chosen.share:.0%} of the forces, learned with noise {chosen.noise:g}.")
        kept = {"share": chosen.share, "observation_noise": chosen.noise, "validation_error": chosen.error}
        last = config.updates * len(config.observation_noise) + 1
        self.log(last, {**kept, "control_steps": simulated})
        self.save(chosen.step, chosen.policy, chosen.error)

    def _labels(self, config: SupervisedConfig) -> tuple[Mapping[str, _Examples], int]:
        """Return examples for training and validation, and the number of control steps that were simulated for them."""
        setup, env = self.setup, self.setup.forces.config
        robot = setup.simulator.robot
        joints = free_torques(env.forces, robot)
        config = resolve_joint_spreads(config, env.forces, setup.simulator, setup.motions.training)
        linearize = Linearizer(setup.simulator, joints, env.forces)
        label = force_regression.ForceLabeller(linearize, config, env)
        uses = {"training": setup.motions.training}
        if setup.motions.validation is not setup.motions.training:
            uses["validation"] = setup.motions.validation
        found = {}
        for use, motions in uses.items():
            loads = []
            for motion in motions:
                loads.append(label(motion))
                self.show(f"labels, {use}", len(loads), len(motions), math.nan)
            found[use] = force_regression.examples(setup.simulator.simulator, motions, loads, env)
            self.notes.append(f"Labels, {use}: {_sizes(np.concatenate(loads), env.forces, robot)}.")
        labelled = sum(len(motion.command) for motions in uses.values() for motion in motions)
        return {"validation": found["training"], **found}, labelled * (1 + linearize.directions)

    def _networks(
        self,
        config: SupervisedConfig,
        number: int,
        infer: Callable[[Any, Any], Any],
        examples: Mapping[str, _Examples],
        without: float,
    ) -> list[_Candidate]:
        """Fit a network with the noise `number` on its input, and return it with each share of its forces.

        `infer` returns outputs of a policy for inputs. `without` is the open-loop validation error without loads.
        """
        setup, noise = self.setup, config.observation_noise[number]
        before, total = number * config.updates, config.updates * len(config.observation_noise)
        seen, actions = examples["validation"]
        best = math.inf, 0, self.zero_policy

        def validate(step: int, policy: Any, loss: float) -> None:
            nonlocal best
            error = _rms(np.asarray(infer(policy, seen)) - actions) / _rms(actions)
            best = min(best, (error, before + step, jax.device_get(policy)), key=lambda found: found[0])
            self.log(before + step, {"loss": loss, "force_error": error})
            self.show("learning", before + step, total, error)

        if not number:
            validate(0, self.zero_policy, float(np.mean(examples["training"][1] ** 2)))
        force_regression.regress(infer, setup.start.policy, examples["training"], config, noise, validate)
        _, step, policy = best
        candidates = []
        for share in config.force_shares:
            part = ppo.with_share(policy, share)
            error = self.validate(setup.with_policy(part)) if share else without
            candidates.append(_Candidate(error, noise, share, step, part))
        summary = ", ".join(f"{each.share:.0%}: {each.error:.3g}" for each in candidates)
        self.notes.append(f"Validation error by share of the forces, noise {noise:g} (ratio): {summary}.")
        return candidates


_Examples = tuple[Float[np.ndarray, "examples inputs"], Float[np.ndarray, "examples loads"]]
"""Inputs and outputs of the network, from `force_regression.examples`."""


class _Candidate(NamedTuple):
    """Network of *supervised* that may be kept."""

    error: float
    """Open-loop validation error."""
    noise: float
    share: float
    step: int
    policy: Any


class _Analytic(_Fit):
    def learn(self) -> None:
        """Fit the network by gradients through the simulation, with open-loop validations."""
        setup, config = self.setup, self.config
        assert isinstance(config, AnalyticConfig)
        assert config.window_seconds is not None and config.interval_seconds is not None, "Resolved."
        cut = cut_motion_windows(
            setup.simulator.simulator, setup.motions.training, config.window_seconds, config.interval_seconds
        )
        total = config.relinearizations * config.updates

        def report(step: int, policy: Any, metrics: dict[str, float]) -> None:
            error = self.validate(setup.with_policy(policy))
            self.log(step, {**metrics, "validation_error": error})
            self.save(step, policy, error)
            self.show("learning", step, total, error)

        report(0, self.zero_policy, {})
        force_gradients.train(
            setup.forces,
            setup.with_policy,
            setup.start.policy,
            cut,
            np.std(setup.inputs, axis=0),
            config,
            report,
            Linearizer(setup.simulator, forces=setup.forces.config.forces),
        )


def _sizes(loads: Float[np.ndarray, "steps loads"], forces: ForceSet, robot: RobotDescription) -> str:
    """Return the RMS values of labels, as text."""
    if FORCE_SETS[forces].turns:
        return f"{_rms(loads[:, :3]) * 1e3:.1f} mN on the {robot.tracked} (RMS of an axis)"
    sizes = zip(FORCE_SETS[forces].names(robot), np.sqrt(np.mean(loads**2, axis=0)), strict=True)
    return (
        ", ".join(f"{name.rpartition(',')[0]} {size:.3g}{name.rpartition(',')[2]}" for name, size in sizes) + " (RMS)"
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _fit(
    method: type[_Fit],
    name: str,
    simulator: Simulator | AugmentedSimulator,
    motions: _Uses,
    config: SupervisedConfig | AnalyticConfig,
    forces: ForceSet | ForceNetworkConfig,
    run: TrainingRecord | None,
    progress: PhaseProgress | None,
    evaluators: Evaluators | None,
) -> TrainedResidual:
    """Learn a network by `method`, and return it together with the base residual of `simulator`."""
    augmented = simulator.with_residual(None)
    plain, robot = augmented.without_residual(), augmented.robot
    record = MemoryRecord({"fit": dataclasses.asdict(config)}) if run is None else run
    env, network = ForceNetworkConfig(forces) if isinstance(forces, str) else forces, network_layers(config.seed)
    check_network_config(env)
    env = resolve_scales(env, augmented, motions.training)
    reference, _ = stack_motions(plain, motions.training)
    inputs = np.asarray(recorded_inputs(reference, env, robot))
    mirror = network_mirror(env, robot)
    sizes = {ppo.STATE: (inputs.shape[1],)}, num_loads(env, robot), network, mirror
    network_forces = NetworkResidual(env, robot, ppo.make_inference(*sizes), None, name, network)
    start = ppo.initial_policy(inputs, *sizes[1:])
    start = start._replace(policy=ppo.with_mean(start.policy, expected_units(env, robot)))
    observed = TrainingRange.of(inputs, mirror)
    forces_in_range, with_range = with_fading(network_forces, env.fade_width, observed)
    model, with_base = add_to_base(augmented.residual, forces_in_range)
    measure = (evaluators or Evaluators(plain)).of(model, motions.validation)
    observed.write(record)
    setup = _Setup(augmented, motions, network_forces, start, inputs)
    work = method(setup, config, record, lambda params: measure(with_base(with_range(params))).score, progress)
    work.learn()
    if progress is not None:
        progress.close()
    step, tree = record.best()
    params, report = with_base(with_range(ppo.from_tree(tree))), "\n".join(work.notes)
    return TrainedResidual(model, params, observed, step, plain.actuators, report)
