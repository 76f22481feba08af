"""A trained locomotion policy: its commands, and the closed loop in its own simulator."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.closed_loop import ClosedLoop
from ballu_mjx.policies.locomotion_config import LocomotionConfig, check_locomotion_config
from ballu_mjx.policies.locomotion_env import (
    LocomotionEnv,
    command_of,
    locomotion_observation,
    num_observations,
    variant_of,
)
from ballu_mjx.policies.simulator_variants import SimulatorVariant
from ballu_mjx.policies.tasks import TASKS, Task
from ballu_mjx.residuals.run_config import ResidualReference, run_actuators, run_residual, run_robot
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import Inference, Params, PPOConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, bare_parameters, same_parameters
from ballu_mjx.runs.checkpoints import restore_checkpoint
from ballu_mjx.runs.folder import read_config, typed_config
from ballu_mjx.runs.layout import Which
from ballu_mjx.sim.drivetrain import drivetrain_of


@dataclasses.dataclass(frozen=True)
class Policy:
    """A deterministic policy, and the simulator of its training.

    **Fields**

    - `task`, `config`, `robot`, `actuators` (None: nominal), `residual` (or where to find it; None: none): parts of
      its simulator.
    - `network`: options of its networks.
    - `params`: parameters that `training_state.params` returned.
    - `infer`: function from parameters and observation to the action.
    - `step`: number of control steps of its training.
    """

    task: Task
    config: LocomotionConfig
    robot: RobotDescription
    actuators: ModelParameters | None
    residual: TrainedResidual | ResidualReference | None
    network: PPOConfig
    params: Params
    infer: Inference
    step: int
    loop: ClosedLoop | None = dataclasses.field(default=None, repr=False, compare=False)
    """Its simulator in closed loop, if it is already compiled."""

    @staticmethod
    def load(folder: Path | str, which: Which = "best") -> Policy:
        """Return the policy in a checkpoint of a run: the best one, the last one, or that of a step.

        The best checkpoint has the highest reward without exploration.

        **Raises** `InputError` if `folder` is not a run of a locomotion task, or has no such checkpoint.
        """
        folder = Path(folder)
        stored = read_config(folder, *TASKS)
        robot = run_robot(stored, folder)
        config = typed_config(
            LocomotionConfig,
            stored,
            "env",
            folder,
            lambda found: check_locomotion_config(found, robot.control_timestep),
        )
        network = typed_config(PPOConfig, stored, "ppo", folder, ppo.check_values)
        infer = ppo.make_inference(num_observations(robot), len(robot.commands), network)
        step, tree = restore_checkpoint(folder, which)
        params = ppo.from_tree(tree)
        if not ppo.fits(infer, params, num_observations(robot)):
            raise InputError(
                f"{folder}: the stored parameters do not fit the network in its config.json; restore one of the two."
            )
        return Policy(
            task=TASKS[stored["task"]],
            config=config,
            robot=robot,
            actuators=run_actuators(stored, folder, robot),
            residual=run_residual(stored, folder),
            network=network,
            params=params,
            infer=infer,
            step=step,
        )

    @functools.cached_property  # reading a run takes time, and commands do not need it
    def trained_residual(self) -> TrainedResidual | None:
        """Residual in the policy's simulator. None if there is none.

        **Raises** `InputError` if the residual's run is missing, damaged, changed, or of other actuators.
        """
        if not isinstance(self.residual, ResidualReference):
            return self.residual
        found = TrainedResidual.load_reference(self.residual, self.robot)
        check_belongs(found, self.actuators, self.residual.folder)
        return found

    @property
    def variant(self) -> SimulatorVariant:
        """The variant of the simulator in which the policy was trained."""
        return variant_of(self.config, self.actuators, self.trained_residual)

    @property
    def latency(self) -> float:
        """Largest delay (s) from a command to its actuator in the simulator in which the policy was trained."""
        drivetrain = drivetrain_of(bare_parameters(self.actuators))
        own = 0.0 if drivetrain is None else float(np.max(drivetrain.delay))
        return own if self.trained_residual is None else own + self.trained_residual.latency

    def environment(self) -> LocomotionEnv:
        """Return the simulator in which the policy was trained."""
        return environment_of(self.robot, self.task, self.config, self.actuators, self.trained_residual)

    def closed_loop(self) -> ClosedLoop:
        """Return the closed loop in that simulator, for any parameters of the policy."""
        return ClosedLoop(self.environment(), self.infer) if self.loop is None else self.loop

    def act(self) -> Callable[[Float[np.ndarray, " features"]], Float[np.ndarray, " commands"]]:
        """Return a function from `observation.observe_features` to commands, for step-by-step use outside of JAX."""

        @jax.jit
        def command(features: Array) -> Array:
            seen = locomotion_observation(features, self.robot.anchored)
            return command_of(self.infer(self.params, seen), self.robot)

        return lambda features: np.asarray(command(jnp.asarray(features, jnp.float32)), np.float64)


def environment_of(
    robot: RobotDescription,
    task: Task,
    config: LocomotionConfig,
    actuators: ModelParameters | None = None,
    residual: TrainedResidual | None = None,
) -> LocomotionEnv:
    """Return the simulator of a task.

    **Raises** `InputError` if the robot cannot perform the task.
    """
    return LocomotionEnv(robot, task, config, actuators=actuators, residual=residual)


def check_belongs(residual: TrainedResidual | None, actuators: ModelParameters | None, run: Path | None) -> None:
    """Check that the residual (None: none) of `run` was learned with these actuators.

    **Raises** `InputError` if it was learned with others.
    """
    if residual is not None and not same_parameters(residual.actuators, actuators):
        raise InputError(
            f"{run}: this residual was learned with other actuators; give --actuators the same file, or omit the "
            "option to use those of the residual."
        )
