"""A trained locomotion policy: its commands, and its own simulator in closed loop."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Float

from ballu_mjx import locomotion, ppo, robot, runs
from ballu_mjx.errors import InputError
from ballu_mjx.locomotion import Contents, LocomotionConfig, LocomotionEnv
from ballu_mjx.ppo import Inference, Params, PPOConfig
from ballu_mjx.residual import Residual
from ballu_mjx.robot import ActuatorParameters
from ballu_mjx.tasks import TASKS, Task

ACTIONS = 2
"""One command a servo."""


@dataclasses.dataclass(frozen=True)
class Policy:
    """The deterministic policy of a run, and what it was trained in.

    **Fields**

    - `task`, `config`, `actuators` (None: nominal), `residual` (the run's folder; None: none): its simulator.
    - `params`: what `learner.params` gave.
    - `infer`: (parameters, observation) to action.
    - `step`: control steps of training behind it.
    """

    task: Task
    config: LocomotionConfig
    actuators: ActuatorParameters | None
    residual: Path | None
    params: Params
    infer: Inference
    step: int

    @staticmethod
    def load(folder: Path | str, which: runs.Which = "best") -> Policy:
        """The policy in a run's best checkpoint, by its reward without exploration; in the last, or that of a step.

        **Raises** `InputError` where `folder` is no run of a locomotion task, or has no such checkpoint.
        """
        folder = Path(folder)
        stored = runs.read_config(folder, *TASKS)
        config = runs.typed(LocomotionConfig, stored, "env", folder, locomotion.check)
        sizes = locomotion.OBSERVATIONS, ACTIONS, runs.typed(PPOConfig, stored, "ppo", folder, ppo.check_values)
        infer = ppo.make_inference(*sizes)
        step, tree = runs.restore(folder, which)
        params = ppo.from_tree(tree)
        if not ppo.fits(infer, params, locomotion.OBSERVATIONS):
            raise InputError(
                f"{folder}: the stored parameters are not of the network in its config.json; restore one of the two."
            )
        return Policy(
            task=TASKS[stored["task"]],
            config=config,
            actuators=runs.actuators(stored, folder),
            residual=runs.residual(stored, folder),
            params=params,
            infer=infer,
            step=step,
        )

    @functools.cached_property  # a residual's name takes reading its run
    def setting(self) -> str:
        """The paper's name of the simulator; see `locomotion.setting_name`."""
        name = None if self.residual is None else Residual.load(self.residual).model.name
        return locomotion.setting_name(self.config, self.actuators is not None, name)

    def environment(self) -> LocomotionEnv:
        """The simulator that the policy was trained in."""
        return environment(self.task, self.config, self.actuators, self.residual)

    def closed_loop(self) -> ClosedLoop:
        """That simulator, for any parameters of the policy."""
        return ClosedLoop(self.environment(), self.infer)

    def act(self) -> Callable[[Float[np.ndarray, " 27"]], Float[np.ndarray, " 2"]]:
        """`envmimic.features` to servo commands, for use outside of JAX, step by step."""

        @jax.jit
        def command(features: Array) -> Array:
            return locomotion.command_of(self.infer(self.params, locomotion.policy_input(features)))

        return lambda features: np.asarray(command(jnp.asarray(features, jnp.float32)), np.float64)


def environment(
    task: Task, config: LocomotionConfig, actuators: ActuatorParameters | None, residual: Path | None
) -> LocomotionEnv:
    """A task's simulator.

    **Raises** `InputError` where `residual` holds no residual, or one that belongs to other actuators.
    """
    force = None if residual is None else Residual.load(residual)
    if force is not None and not robot.same_actuators(force.actuators, actuators):
        raise InputError(
            f"{residual}: its forces were learned beside other actuators; give --actuators the same file, or leave it "
            "out to take the residual's."
        )
    return LocomotionEnv(robot.load_model(), task, config, actuators=actuators, residual=force)


class Rollout(NamedTuple):
    """Closed-loop simulations at the control rate, the starting state first."""

    qpos: Float[np.ndarray, "runs states nq"]
    features: Float[np.ndarray, "runs states 27"]
    """`envmimic.features`."""
    com: Float[np.ndarray, "runs states 3"]
    """Centre of mass (m, world)."""
    command: Float[np.ndarray, "runs steps 2"]
    """Servo commands."""
    outside: Float[np.ndarray, "runs steps"]
    """1 where the residual's observation lay outside of what its training had seen."""
    reward: Float[np.ndarray, "runs steps"]
    """The task's."""

    @property
    def yaw(self) -> Float[np.ndarray, "runs states"]:
        """Of the balloon (rad), not unwrapped."""
        return self.features[..., 8]


_CHUNK = 100
"""Control steps that the compiled program does at a time."""
_BATCH = 8
"""Runs that it does side by side; fewer are filled up, more are done one batch after another."""


class ClosedLoop:
    """Runs policies in closed loop; one compiled program for any number of runs and steps, any parameters, and all
    simulators that differ in their contents alone (`LocomotionEnv.contents`)."""

    def __init__(self, env: LocomotionEnv, infer: Inference) -> None:
        self._contents = env.contents

        def look(state: State) -> tuple[Array, ...]:
            s: dict[str, Any] = state.pipeline_state  # pyright: ignore[reportAssignmentType]
            return s["physics"].qpos, s["history"][-1], s["com"]

        def run(params: Params, contents: Contents, state: State) -> Any:
            here = env.with_contents(contents)

            def advance(state: State, _: None) -> tuple[State, Any]:
                action = infer(params, state.obs)  # pyright: ignore[reportArgumentType]
                after = here.step(state, action)
                return after, (*look(after), locomotion.command_of(action), after.metrics["outside"], after.reward)

            return jax.lax.scan(advance, state, None, _CHUNK)

        def at(contents: Contents, qpos: Array, qvel: Array, key: Array) -> State:
            return env.with_contents(contents).at(qpos, qvel, key)

        def reset(contents: Contents, key: Array) -> State:
            return env.with_contents(contents).reset(key)

        self._run = jax.jit(jax.vmap(run, in_axes=(None, None, 0)))
        self._at = jax.jit(jax.vmap(at, in_axes=(None, 0, 0, 0)))
        self._look = jax.vmap(look)
        self._reset = jax.jit(jax.vmap(reset, in_axes=(None, 0)))

    def __call__(
        self,
        params: Params,
        qpos: Float[np.ndarray, "runs nq"],
        qvel: Float[np.ndarray, "runs nv"],
        steps: int,
    ) -> Rollout:
        """Simulate `steps` control steps from each of the given states."""
        batches = [slice(first, first + _BATCH) for first in range(0, len(qpos), _BATCH)]
        rollouts = [self._batch(params, qpos[batch], qvel[batch], steps) for batch in batches]
        return Rollout(*(np.concatenate(parts) for parts in zip(*rollouts, strict=True)))

    def _batch(self, params: Params, qpos: np.ndarray, qvel: np.ndarray, steps: int) -> Rollout:
        runs = len(qpos)
        filled = np.arange(_BATCH) % runs
        keys = jax.random.split(jax.random.key(0), _BATCH)
        start = (jnp.asarray(x[filled], jnp.float32) for x in (qpos, qvel))
        state = self._at(self._contents, *start, keys)
        pieces = [tuple(np.asarray(x)[:, None] for x in self._look(state))]
        outcomes = []
        for _ in range(-(-steps // _CHUNK)):
            state, seen = self._run(params, self._contents, state)
            state_parts, step_parts = seen[: len(pieces[0])], seen[len(pieces[0]) :]
            pieces.append(tuple(np.asarray(x) for x in state_parts))
            outcomes.append(tuple(np.asarray(x) for x in step_parts))
        states = (np.concatenate(parts, axis=1)[:runs, : steps + 1] for parts in zip(*pieces, strict=True))
        per_step = (np.concatenate(parts, axis=1)[:runs, :steps] for parts in zip(*outcomes, strict=True))
        return Rollout(*states, *per_step)

    def standing(self, count: int = 1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """`count` starting states, (qpos, qvel), as training draws them."""
        state: Any = self._reset(self._contents, jax.random.split(jax.random.key(seed), count)).pipeline_state
        return np.asarray(state["physics"].qpos), np.asarray(state["physics"].qvel)
