"""Proximal policy optimization: options, networks for training and for use, and what is kept of them.

The learning itself is `ballu_mjx.rl.learner`'s.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.agents.ppo import networks as brax_networks
from flax import errors, linen
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError


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
    value_cost: float = 0.25
    """Weight of the value function's mean squared error in the objective."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it."""
    adam_epsilon: float = 1e-8
    """What Adam adds to the root of its second moment."""
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
    orthogonal_init: bool = False
    """Draw the hidden layers' weights as orthogonal matrices times the root of 2, instead of uniformly (LeCun)."""
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
    """All it takes to use what was learned, on the host."""

    normalizer: Normalizer
    policy: Any
    value: Any


ObservationSize = int | Mapping[str, tuple[int, ...] | int]
Inference = Callable[[Params, Float[Array, "*batch observations"]], Float[Array, "*batch actions"]]
Sampler = Callable[[Params, Float[Array, " observations"], Array], Float[Array, " actions"]]

STATE, CRITIC = "state", "critic"
"""Names of an observation's parts: what the policy sees and, where there is one of its own, the value function."""

_INITIAL_MEAN_SCALE = 0.01
_NARROWEST = 1e-4
"""Smallest standard deviation that an observation is divided by."""


_COUNTS = (
    "num_timesteps",
    "num_envs",
    "unroll_length",
    "batch_size",
    "num_minibatches",
    "num_updates_per_batch",
    "averaging",
)
_POSITIVE = (
    "learning_rate",
    "initial_std",
    "reward_scaling",
    "max_grad_norm",
    "adam_epsilon",
    "observation_clip",
    "clipping_epsilon",
)
_WIDEST, _LARGEST = 2**14, 2**31 - 1


def check_values(config: PPOConfig) -> None:
    """Refuse values that no option may have, each for itself.

    **Raises** `InputError` naming the option, and the nearest value that it may have.
    """
    for name in (*_COUNTS, "seed"):
        value, least = getattr(config, name), int(name != "seed")
        # 64 bits count the control steps; all else is XLA's, whose sizes and seeds have 32.
        most = 2**62 if name == "num_timesteps" else _LARGEST
        if not least <= value <= most:
            said, nearest = (f"{least} or more", least) if value < least else (f"{most} or less", most)
            raise InputError(f"{_option(name)} is {value}: it must be {said}; {nearest} is the nearest.")
    for name in _POSITIVE:
        if not (getattr(config, name) > 0 and math.isfinite(getattr(config, name))):
            usual = getattr(PPOConfig, name)
            raise InputError(
                f"{_option(name)} is {getattr(config, name)}: it must be greater than 0; {usual} is usual."
            )
    for name in ("entropy_cost", "value_cost", "desired_kl"):
        if not (getattr(config, name) >= 0 and math.isfinite(getattr(config, name))):
            raise InputError(f"{_option(name)} is {getattr(config, name)}: it must be 0 or more; 0 is the nearest.")
    for name in ("discounting", "gae_lambda"):
        value = getattr(config, name)
        if not 0 <= value <= 1:
            raise InputError(
                f"{_option(name)} is {value}: it must be between 0 and 1; {int(value > 1)} is the nearest."
            )
    for name in ("policy_layers", "value_layers"):
        if not (widths := getattr(config, name)) or min(widths) < 1 or max(widths) > _WIDEST:
            raise InputError(
                f"{_option(name)} is {widths}: give one width of 1 or more, and {_WIDEST} or less, for each layer."
            )


def check(config: PPOConfig, devices: int) -> None:
    """Refuse sizes that do not fit each other or the number of devices, before anything is compiled.

    **Raises** `InputError` naming the option, and the nearest value that fits; also from `check_values`.
    """
    check_values(config)
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


def make_networks(observation_size: ObservationSize, action_size: int, config: PPOConfig) -> brax_networks.PPONetworks:
    """Policy and value networks; the Gaussian's deviation is one number an action."""

    def preprocess(observation: Any, preprocessor_params: Any) -> Array:
        if not config.normalize_observations:
            return observation
        normalized = (observation - preprocessor_params.mean) / preprocessor_params.std
        return jnp.clip(normalized, -config.observation_clip, config.observation_clip)

    hidden: dict[str, Any] = {}
    if config.orthogonal_init:
        for network in ("policy", "value"):
            hidden[f"{network}_network_kernel_init_fn"] = jax.nn.initializers.orthogonal
            hidden[f"{network}_network_kernel_init_kwargs"] = {"scale": math.sqrt(2)}
    return brax_networks.make_ppo_networks(
        observation_size,
        action_size,
        preprocess_observations_fn=preprocess,
        policy_obs_key=STATE,
        value_obs_key=CRITIC if isinstance(observation_size, Mapping) and CRITIC in observation_size else STATE,
        policy_hidden_layer_sizes=config.policy_layers,
        value_hidden_layer_sizes=config.value_layers,
        activation={"swish": linen.swish, "tanh": linen.tanh}[config.activation],
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=config.initial_std,
        mean_kernel_init_fn=jax.nn.initializers.orthogonal,
        mean_kernel_init_kwargs={"scale": _INITIAL_MEAN_SCALE},
        **hidden,
    )


def make_inference(observation_size: ObservationSize, action_size: int, config: PPOConfig) -> Inference:
    """The deterministic policy: (parameters, the policy's observation) to the most likely action.

    Pure, for any number of leading axes of the observation.
    """
    networks = make_networks(observation_size, action_size, config)

    def infer(params: Params, observation: Float[Array, "*batch observations"]) -> Float[Array, "*batch actions"]:
        logits = networks.policy_network.apply(params.normalizer, params.policy, {STATE: observation})
        return networks.parametric_action_distribution.mode(logits)

    return infer


def make_sampler(observation_size: ObservationSize, action_size: int, config: PPOConfig) -> Sampler:
    """The policy as it explores: (parameters, the policy's observation, key) to a drawn action."""
    networks = make_networks(observation_size, action_size, config)

    def sample(params: Params, observation: Float[Array, " observations"], key: Array) -> Float[Array, " actions"]:
        logits = networks.policy_network.apply(params.normalizer, params.policy, {STATE: observation})
        return networks.parametric_action_distribution.sample(logits, key)

    return sample


def fits(infer: Inference, params: Params, inputs: int) -> bool:
    """Whether `params` are of the network that `infer` evaluates for so many inputs."""
    observation = jax.ShapeDtypeStruct((inputs,), jnp.float32)
    try:
        jax.eval_shape(infer, params, observation)
    except (errors.FlaxError, TypeError, ValueError, KeyError):
        return False
    return True


def initial_policy(inputs: Float[Array | np.ndarray, "states inputs"], action_size: int, config: PPOConfig) -> Params:
    """A fresh policy whose normalizer knows the observations `inputs`; it has no value function."""
    inputs = np.asarray(inputs, np.float64)
    std = np.maximum(inputs.std(axis=0), _NARROWEST)
    mean, std, summed = (np.asarray(x, np.float32) for x in (inputs.mean(axis=0), std, std**2 * len(inputs)))
    normalizer = Normalizer(np.asarray(len(inputs), np.float32), {STATE: mean}, {STATE: std}, {STATE: summed})
    policy = make_networks({STATE: (inputs.shape[1],)}, action_size, config).policy_network
    return Params(normalizer, policy.init(jax.random.key(config.seed)), {})


def with_share(policy: Mapping[str, Any], share: float) -> Mapping[str, Any]:
    """A policy network whose most likely actions are `share` times those of `policy`."""
    layers = policy["params"]
    return {**policy, "params": {**layers, _MEAN: jax.tree.map(lambda x: share * x, layers[_MEAN])}}


_MEAN = "Dense_0"
"""Brax's name for the layer that makes the mean of the actions' distribution."""


def as_tree(params: Params) -> dict[str, Any]:
    """Nested dictionaries of arrays, for writing."""
    return {"normalizer": params.normalizer._asdict(), "policy": params.policy, "value": params.value}


def from_tree(tree: Mapping[str, Any]) -> Params:
    """The inverse of `as_tree`."""
    return Params(Normalizer(**tree["normalizer"]), tree["policy"], tree["value"])


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
