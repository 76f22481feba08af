"""Proximal policy optimization: Brax's, with fresh resets, progress to look at, and a Gaussian that starts small.

Brax's `ppo.train` does the learning as it is. What stands here is what it needs around it: a wrapper that draws a new
initial state at every reset, sizes checked before anything is compiled, and networks for training and for use.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as brax_networks
from brax.training.agents.ppo import train as brax_ppo
from brax.training.types import UInt64
from flax import linen
from jaxtyping import Array, Float

from ballu_mjx.errors import InputError


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """How to learn. A control step is one environment advanced by one action."""

    num_timesteps: int = 3_000_000
    """Control steps to train for, all environments together; rounded up to whole training steps."""
    num_envs: int = 1024
    """Environments simulated side by side, over all devices together."""
    unroll_length: int = 20
    """Control steps of an environment in one piece of experience."""
    batch_size: int = 128
    """Pieces of experience in a minibatch."""
    num_minibatches: int = 8
    """Minibatches that a training step collects; times batch size, a multiple of the environments."""
    num_updates_per_batch: int = 4
    """Passes over the collected minibatches in a training step."""
    learning_rate: float = 1e-4
    """Adam's, to start with (see desired_kl)."""
    desired_kl: float = 0.01
    """Change of the policy per minibatch (Kullback-Leibler divergence) that the learning rate adapts to, by factors of
    1.5; 0 keeps it constant."""
    entropy_cost: float = 0.0
    """Weight of the policy's entropy in the objective."""
    discounting: float = 0.95
    """Discount per control step."""
    gae_lambda: float = 0.95
    """Decay of generalized advantage estimation."""
    clipping_epsilon: float = 0.2
    """Largest relative change of an action's probability that is rewarded."""
    reward_scaling: float = 1.0
    """Factor on rewards. A fresh value function gives numbers of order 1: returns should not be small beside that."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it."""
    normalize_observations: bool = True
    """Shift and scale observations by their running mean and standard deviation."""
    observation_clip: float = 10.0
    """Largest normalized observation that the networks see: bounds what they do far outside the data."""
    policy_layers: tuple[int, ...] = (64, 64)
    """Widths of the policy's hidden layers."""
    value_layers: tuple[int, ...] = (64, 64)
    """Widths of the value function's hidden layers."""
    activation: Literal["swish", "tanh"] = "swish"
    """Activation of the hidden layers."""
    initial_std: float = 0.5
    """Standard deviation of a fresh policy's actions, in the environment's units; the mean starts near 0."""
    averaging: int = 25
    """Training steps over which the policy that is handed out is averaged (exponentially); 1 hands out the last. Single
    iterates of PPO scatter: their validation errors differ by a factor of two from one step to the next."""
    seed: int = 0
    """Seeds all of it: networks, initial states, exploration."""


class Normalizer(NamedTuple):
    """Running statistics of the observations; all but the count by the observation's name."""

    count: Float[Array | np.ndarray, ""]
    mean: Mapping[str, Float[Array | np.ndarray, " n"]]
    std: Mapping[str, Float[Array | np.ndarray, " n"]]
    summed_variance: Mapping[str, Float[Array | np.ndarray, " n"]]


class Params(NamedTuple):
    """All that a checkpoint holds (not the optimizer's moments), on the host."""

    normalizer: Normalizer
    policy: Any
    value: Any


ObservationSize = int | Mapping[str, tuple[int, ...] | int]
Inference = Callable[[Params, Float[Array, " observations"]], Float[Array, " actions"]]
Sampler = Callable[[Params, Float[Array, " observations"], Array], Float[Array, " actions"]]
Callback = Callable[[int, Params, dict[str, float]], None]
"""(control steps done, parameters, means since the last call: empty before the first training step)."""

_STATE, _CRITIC, _PROGRESS = "state", "critic", "progress"
_INITIAL_MEAN_SCALE = 0.01
_MAX_CALLS = 400


class _Training(Wrapper):
    """See `wrap_for_training`."""

    def reset(self, rng: Array) -> State:
        keys = jax.vmap(jax.random.split)(rng)
        state = jax.vmap(self.env.reset)(keys[:, 0])
        return self._with_extras(state, state, keys[:, 1])

    def step(self, state: State, action: Array) -> State:
        keys = jax.vmap(jax.random.split)(state.info["reset_key"])
        before = dataclasses.replace(state, done=jnp.zeros_like(state.done))
        after = jax.vmap(self.env.step)(before, action)
        renew = getattr(self.env, "renew", lambda state, key: self.env.reset(key))
        fresh = jax.vmap(renew)(before, keys[:, 0])
        done = after.done.astype(bool)

        def select(new: Array, old: Array) -> Array:
            return jnp.where(done.reshape(done.shape + (1,) * (old.ndim - 1)), new, old)

        truncation = after.info["truncation"]
        info = jax.tree.map(select, fresh.info, {key: after.info[key] for key in fresh.info})
        shown = dataclasses.replace(
            after,
            pipeline_state=jax.tree.map(select, fresh.pipeline_state, after.pipeline_state),
            obs=jax.tree.map(select, fresh.obs, after.obs),
            info=info | {"truncation": truncation},
        )
        return self._with_extras(shown, after, keys[:, 1])

    def _with_extras(self, shown: State, outcome: State, keys: Array) -> State:
        """Add what Brax's training loop reads, with the outcome's reward and metrics inside the observation."""
        named = {"reward": outcome.reward} | outcome.metrics
        progress = jnp.stack([jnp.asarray(named[name], jnp.float32) for name in _names(outcome.metrics)], axis=-1)
        info = shown.info | {"reset_key": keys, "episode_done": shown.done, "episode_metrics": {}}
        return dataclasses.replace(shown, obs=_named(shown.obs) | {_PROGRESS: progress}, info=info)


def wrap_for_training(
    env: Env, episode_length: int = 0, action_repeat: int = 1, randomization_fn: Callable | None = None
) -> Env:
    """`env` vectorized, with every finished environment reset to a newly drawn state. The `wrap_env_fn` of Brax's PPO.

    Brax's own auto-reset goes back to a cached first state for ever. Here all environments are reset in every step,
    and the finished ones take the result: for environments whose reset costs nothing beside their step.

    An `env` with a method `renew(state, key)` is reset by it: what tells one variant of an environment from another can
    then be handed on from state to state, instead of being a constant of the compiled program.

    `env` ends its episodes itself, by time also: it sets `done` and, where only time ran out,
    `info["truncation"]`, in both `reset` and `step`. What Brax's `compute_gae` makes of a truncated transition
    `t`: its advantage is 0 and its value's target the value itself, so that it teaches nothing; the transition before
    bootstraps from `V(s_t)`, as if the episode went on; the fresh state behind it never enters. So values are unbiased
    at the price of one transition in an episode. A `done` without truncation is a termination, with 0 to come.

    The observation becomes a dictionary: `state` for the policy, `critic` for the value function where `env` gives both
    by these names (else `state` serves both), and `progress` with the last step's reward and metrics. Brax keeps
    running means of all that is in an observation, so that `train` can read mean rewards off them; Brax's own way, a
    callback from inside the program, would keep that program out of the compilation cache.

    `episode_length`, `action_repeat` and `randomization_fn` are there for Brax to pass, and are not used.
    """
    del episode_length
    if action_repeat != 1 or randomization_fn is not None:
        raise ValueError("Repeated actions and randomization_fn are the environment's own affair here.")
    return _Training(env)


def check(config: PPOConfig, devices: int) -> None:
    """Refuse sizes that do not fit each other or the number of devices, before anything is compiled.

    **Raises** `InputError` naming the option, and the nearest value that fits.
    """
    sizes = (
        "num_timesteps",
        "num_envs",
        "unroll_length",
        "batch_size",
        "num_minibatches",
        "num_updates_per_batch",
        "averaging",
    )
    for name in (*sizes, "averaging"):
        if getattr(config, name) < 1:
            raise InputError(f"{_option(name)} is {getattr(config, name)}: it must be 1 or more.")
    for name in ("learning_rate", "initial_std", "reward_scaling", "max_grad_norm", "observation_clip"):
        if not getattr(config, name) > 0:
            raise InputError(f"{_option(name)} is {getattr(config, name)}: it must be greater than 0.")
    for name in ("discounting", "gae_lambda"):
        if not 0 <= getattr(config, name) <= 1:
            raise InputError(f"{_option(name)} is {getattr(config, name)}: it must be between 0 and 1.")
    if config.seed < 0:
        raise InputError(f"--seed is {config.seed}: it must be 0 or more.")
    for name in ("policy_layers", "value_layers"):
        if not getattr(config, name) or min(getattr(config, name)) < 1:
            raise InputError(f"{_option(name)} is {getattr(config, name)}: give one width of 1 or more for each layer.")
    if config.batch_size % devices:
        nearest = max(round(config.batch_size / devices), 1) * devices
        raise InputError(
            f"--batch-size is {config.batch_size}: it must be a multiple of the {devices} devices; {nearest} is the "
            "nearest."
        )
    pieces = config.batch_size * config.num_minibatches
    if config.num_envs % devices or pieces % config.num_envs:
        fitting = [n for n in range(devices, pieces + 1, devices) if pieces % n == 0]
        nearest = min(fitting, key=lambda n: abs(n - config.num_envs))
        raise InputError(
            f"--num-envs is {config.num_envs}: it must be a multiple of the {devices} devices and divide "
            f"--batch-size times --num-minibatches, {pieces}; {nearest} is the nearest."
        )


def total_timesteps(config: PPOConfig) -> int:
    """Control steps that `train` does: `num_timesteps` rounded up."""
    steps_per_call, calls = _schedule(config)
    return calls * steps_per_call * _step_size(config)


def train(
    env: Env,
    config: PPOConfig,
    callback: Callback | None = None,
    *,
    restore: Params | None = None,
    first_step: int = 0,
) -> tuple[Params, dict[str, float]]:
    """Learn a policy for `env` with Brax's PPO, on all local devices.

    **Arguments**

    - `env`: unbatched; see `wrap_for_training` for what it must do.
    - `callback`: called before the first training step and then after every one, or every few of many; the
      parameters are on the host and may be kept. It may raise to stop.
    - `restore`: start from these parameters instead of fresh ones (the optimizer starts anew).
    - `first_step`: control steps done before, added to what the callback is told; `num_timesteps` more are done. It
      also enters the seed, for a continued run not to draw the same numbers again.

    **Returns** the last parameters, and the last call's means: `reward` and the environment's metrics per control step,
    `steps_per_second`, and Brax's losses.

    **Raises** `InputError` from `check`.
    """
    devices = jax.local_device_count()
    check(config, devices)
    metrics_shape = jax.eval_shape(env.reset, jax.random.key(0)).metrics
    watch = _Watch(
        _names(metrics_shape), callback or (lambda step, params, metrics: None), first_step, config.averaging
    )

    steps_per_call, calls = _schedule(config)
    seed = config.seed
    if first_step:
        seed = int(np.random.SeedSequence([config.seed, first_step]).generate_state(1)[0] >> 1)

    brax_ppo.train(
        environment=env,
        wrap_env_fn=wrap_for_training,
        network_factory=functools.partial(_networks, config=config),
        # Exactly `steps_per_call` training steps between two calls.
        num_timesteps=total_timesteps(config),
        num_evals=calls + 1,
        # No evaluation by Brax, which would compile a second program; what remains of it is a reset, of nothing.
        run_evals=False,
        eval_env=_Nothing(),
        num_eval_envs=1,
        episode_length=1,
        num_envs=config.num_envs,
        unroll_length=config.unroll_length,
        batch_size=config.batch_size,
        num_minibatches=config.num_minibatches,
        num_updates_per_batch=config.num_updates_per_batch,
        learning_rate=config.learning_rate,
        learning_rate_schedule="ADAPTIVE_KL" if config.desired_kl else "NONE",
        desired_kl=config.desired_kl,
        entropy_cost=config.entropy_cost,
        discounting=config.discounting,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clipping_epsilon,
        reward_scaling=config.reward_scaling,
        max_grad_norm=config.max_grad_norm,
        normalize_observations=config.normalize_observations,
        seed=seed,
        restore_params=None if restore is None else _to_brax(restore, len(watch.names)),
        policy_params_fn=watch.params_ready,
        progress_fn=watch.losses_ready,
    )
    assert watch.params is not None
    return watch.params, watch.metrics


def make_inference(observation_size: ObservationSize, action_size: int, config: PPOConfig) -> Inference:
    """The deterministic policy: (parameters, the policy's observation) to the most likely action.

    Pure, for any number of leading axes of the observation.
    """
    networks = _networks(observation_size, action_size, config=config)

    def infer(params: Params, observation: Float[Array, " observations"]) -> Float[Array, " actions"]:
        logits = networks.policy_network.apply(params.normalizer, params.policy, {_STATE: observation})
        return networks.parametric_action_distribution.mode(logits)

    return infer


def make_sampler(observation_size: ObservationSize, action_size: int, config: PPOConfig) -> Sampler:
    """The policy as it explores: (parameters, the policy's observation, key) to a drawn action."""
    networks = _networks(observation_size, action_size, config=config)

    def sample(params: Params, observation: Float[Array, " observations"], key: Array) -> Float[Array, " actions"]:
        logits = networks.policy_network.apply(params.normalizer, params.policy, {_STATE: observation})
        return networks.parametric_action_distribution.sample(logits, key)

    return sample


def as_tree(params: Params) -> dict[str, Any]:
    """Nested dictionaries of arrays, for writing."""
    return {"normalizer": params.normalizer._asdict(), "policy": params.policy, "value": params.value}


def from_tree(tree: Mapping[str, Any]) -> Params:
    """The inverse of `as_tree`."""
    return Params(Normalizer(**tree["normalizer"]), tree["policy"], tree["value"])


class _Nothing(Env):
    """An environment that takes no time to compile."""

    def reset(self, rng: Array) -> State:
        zero = jnp.zeros(())
        return State(None, jnp.zeros(1), zero, zero, {}, {"truncation": zero})

    def step(self, state: State, action: Array) -> State:
        return state

    @property
    def observation_size(self) -> int:
        return 1

    @property
    def action_size(self) -> int:
        return 1

    @property
    def backend(self) -> str:
        return "none"


class _Watch:
    """Brings Brax's two callbacks together, and makes means since the last call of its running means."""

    def __init__(self, names: tuple[str, ...], callback: Callback, first_step: int, averaging: int) -> None:
        self.names = names
        self.metrics: dict[str, float] = {}
        self._callback = callback
        self._first_step = first_step
        self._averaging, self._calls = averaging, 0
        self.params: Params | None = None
        self._count, self._mean = 0, np.zeros(len(names))
        self._means: dict[str, float] = {}
        self._step, self._resumed = 0, 0.0

    def params_ready(self, step: int, make_policy: Any, params: Any) -> None:
        latest = _from_brax(params)
        if self.params is not None:
            self._calls += 1
            share = 1 / min(self._calls, self._averaging)
            policy = jax.tree.map(lambda old, new: old + share * (new - old), self.params.policy, latest.policy)
            latest = latest._replace(policy=policy)
        self.params = latest
        count = int(params[0].count)
        mean = np.asarray(params[0].mean[_PROGRESS], np.float64)
        if step:
            means = (count * mean - self._count * self._mean) / (count - self._count)
            self._means = dict(zip(self.names, means.tolist(), strict=True))
        self._count, self._mean = count, mean
        if step == 0:
            self._callback(self._first_step, self.params, {})
            self._resumed = time.perf_counter()

    def losses_ready(self, step: int, losses: Mapping[str, Any]) -> None:
        assert self.params is not None
        rate = (step - self._step) / (time.perf_counter() - self._resumed)
        keep = {k.removeprefix("training/"): float(v) for k, v in losses.items() if k not in _TIMINGS}
        self.metrics = self._means | {"steps_per_second": rate} | keep
        self._step = step
        self._callback(self._first_step + step, self.params, self.metrics)
        self._resumed = time.perf_counter()  # What the callback did is no training.


_TIMINGS = ("training/sps", "training/walltime")


def _names(metrics: Mapping[str, Any]) -> tuple[str, ...]:
    """Order of the entries of `progress`."""
    return ("reward", *sorted(metrics))


def _step_size(config: PPOConfig) -> int:
    """Control steps of a training step."""
    return config.batch_size * config.unroll_length * config.num_minibatches


def _schedule(config: PPOConfig) -> tuple[int, int]:
    """Training steps between two calls of the callback, and the number of calls."""
    training_steps = math.ceil(config.num_timesteps / _step_size(config))
    steps_per_call = math.ceil(training_steps / _MAX_CALLS)
    return steps_per_call, math.ceil(training_steps / steps_per_call)


def _named(observation: Any) -> dict[str, Array]:
    """An environment's observation by the names that the networks ask for."""
    return dict(observation) if isinstance(observation, Mapping) else {_STATE: observation}


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def _networks(
    observation_size: ObservationSize,
    action_size: int,
    preprocess_observations_fn: Callable | None = None,
    *,
    config: PPOConfig,
) -> brax_networks.PPONetworks:
    """Policy and value networks; the Gaussian's deviation is one number an action."""
    del preprocess_observations_fn  # Brax's normalizer has no bound

    def preprocess(observation: Any, preprocessor_params: Any) -> Array:
        if not config.normalize_observations:
            return observation
        normalized = (observation - preprocessor_params.mean) / preprocessor_params.std
        return jnp.clip(normalized, -config.observation_clip, config.observation_clip)

    return brax_networks.make_ppo_networks(
        observation_size,
        action_size,
        preprocess_observations_fn=preprocess,
        policy_obs_key=_STATE,
        value_obs_key=_CRITIC if isinstance(observation_size, Mapping) and _CRITIC in observation_size else _STATE,
        policy_hidden_layer_sizes=config.policy_layers,
        value_hidden_layer_sizes=config.value_layers,
        activation={"swish": linen.swish, "tanh": linen.tanh}[config.activation],
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=config.initial_std,
        mean_kernel_init_fn=jax.nn.initializers.orthogonal,
        mean_kernel_init_kwargs={"scale": _INITIAL_MEAN_SCALE},
    )


def _from_brax(params: Any) -> Params:
    statistics, policy, value = jax.device_get(params)
    moments = (statistics.mean, statistics.std, statistics.summed_variance)
    named = ({name: np.asarray(x) for name, x in moment.items() if name != _PROGRESS} for moment in moments)
    return Params(Normalizer(np.asarray(int(statistics.count), np.float32), *named), policy, value)


def _to_brax(params: Params, progress_size: int) -> tuple[RunningStatisticsState, Any, Any]:
    count, mean, std, variance = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params.normalizer)
    zeros, ones = jnp.zeros(progress_size), jnp.ones(progress_size)
    high, low = divmod(int(count), 2**32)
    statistics = RunningStatisticsState(
        count=UInt64(hi=high, lo=low),  # pyright: ignore[reportCallIssue]
        mean={**mean, _PROGRESS: zeros},
        std={**std, _PROGRESS: ones},
        summed_variance={**variance, _PROGRESS: zeros},
    )
    return statistics, *jax.tree.map(jnp.asarray, (params.policy, params.value))
