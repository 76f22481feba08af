"""Proximal policy optimization (PPO): options, networks for training and inference, and their parameters.

The training algorithm is in `ballu_mjx.rl.learner`.
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
from ballu_mjx.rl.mirror import OFFSET, Mirror, symmetric_policy


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Options of PPO. A control step advances one environment by one action."""

    num_timesteps: int = 3_000_000
    """Length of the training in control steps, summed over all environments. Rounded up to whole training steps."""
    num_envs: int = 1024
    """Number of environments simulated in parallel, summed over all devices."""
    unroll_length: int = 20
    """Length of one trajectory segment: consecutive control steps of one environment."""
    batch_size: int = 128
    """Number of trajectory segments in a minibatch."""
    num_minibatches: int = 8
    """Number of minibatches that a training step collects. Its product with the batch size must be a multiple of the
    number of environments."""
    num_updates_per_batch: int = 4
    """Number of epochs of a training step: passes over the collected minibatches."""
    learning_rate: float = 1e-4
    """Initial learning rate of Adam. It stays constant only if desired_kl is 0."""
    desired_kl: float = 0.01
    """Target for the change of the policy per minibatch (Kullback-Leibler divergence). The learning rate is adapted to
    reach it, in factors of 1.5. With 0 the learning rate is constant."""
    entropy_cost: float = 0.0
    """Weight of the policy's entropy in the objective."""
    discounting: float = 0.95
    """Discount factor per control step."""
    gae_lambda: float = 0.95
    """Decay factor (lambda) of generalized advantage estimation."""
    clipping_epsilon: float = 0.2
    """Clipping range of PPO: a larger relative change of an action's probability brings no further gain."""
    reward_scaling: float = 0.05
    """Factor on rewards. An untrained value function returns numbers of order 1, and scaled returns should, too. The
    default is 1 - discounting, so that the return is the mean reward."""
    value_cost: float = 0.25
    """Weight of the value function's mean squared error in the objective."""
    max_grad_norm: float = 1.0
    """Largest norm of the gradient. Longer gradients are scaled down to it."""
    adam_epsilon: float = 1e-8
    """Term that Adam adds to the root of its second moment, for numerical stability."""
    normalize_observations: bool = True
    """Normalize observations by their running mean and standard deviation."""
    observation_clip: float = 10.0
    """Magnitude to which normalized observations are clipped. It bounds the networks' inputs far outside the training
    range."""
    policy_layers: tuple[int, ...] = (64, 64)
    """Widths of the policy's hidden layers."""
    value_layers: tuple[int, ...] = (64, 64)
    """Widths of the value function's hidden layers."""
    activation: Literal["swish", "tanh"] = "swish"
    """Activation of the hidden layers."""
    orthogonal_init: bool = False
    """Initialize the hidden layers with orthogonal matrices times the root of 2, instead of uniform numbers (LeCun)."""
    initial_std: float = 0.2
    """Standard deviation of an untrained policy's actions, in the environment's units. Their mean starts near 0."""
    averaging: int = 25
    """Training steps over which the saved policy is averaged (exponentially). With 1 the last policy is saved. Single
    iterates of PPO scatter: their validation errors differ by a factor of two from one step to the next."""
    seed: int = 0
    """Seed of all random numbers: initial networks, initial states and exploration."""


class Normalizer(NamedTuple):
    """Running statistics of the observations. All but the count are by name of the observation's part."""

    count: Float[Array | np.ndarray, ""]
    mean: Mapping[str, Float[Array | np.ndarray, " n"]]
    std: Mapping[str, Float[Array | np.ndarray, " n"]]
    summed_variance: Mapping[str, Float[Array | np.ndarray, " n"]]


class Params(NamedTuple):
    """Trained parameters on the host: normalizer, policy network and value network."""

    normalizer: Normalizer
    policy: Any
    value: Any


ObservationSize = int | Mapping[str, tuple[int, ...] | int]
Inference = Callable[[Params, Float[Array, "*batch observations"]], Float[Array, "*batch actions"]]
Sampler = Callable[[Params, Float[Array, " observations"], Array], Float[Array, " actions"]]

STATE, CRITIC = "state", "critic"
"""Names of an observation's parts: the policy's input, and the value function's input if it differs."""

_INITIAL_MEAN_SCALE = 0.01
_NARROWEST = 1e-4
"""Lower bound of the standard deviation by which an observation is divided."""


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
    """Check that each option's value is in its range.

    **Raises** `InputError` naming the option and the nearest valid value (or the default).
    """
    for name in (*_COUNTS, "seed"):
        value, least = getattr(config, name), int(name != "seed")
        # The control steps are counted with 64 bits. All other numbers are sizes or seeds in XLA, which have 32.
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
    """Check that sizes fit each other and the number of devices, before anything is compiled.

    **Raises** `InputError` naming the option and the nearest valid value, also from `check_values`.
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


def make_networks(
    observation_size: ObservationSize, action_size: int, config: PPOConfig, mirror: Mirror | None = None
) -> brax_networks.PPONetworks:
    """Return policy and value networks. Each action's standard deviation is one parameter, the same in all states.

    With `mirror`, mean actions are symmetric apart from a constant (`mirror.symmetric_policy`).
    """

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
    networks = brax_networks.make_ppo_networks(
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
    if mirror is None:
        return networks
    return networks.replace(policy_network=symmetric_policy(networks.policy_network, mirror, STATE))  # pyright: ignore


def make_inference(
    observation_size: ObservationSize, action_size: int, config: PPOConfig, mirror: Mirror | None = None
) -> Inference:
    """Return the deterministic policy, a function of parameters and observation.

    It returns the mode of the policy's distribution. It is pure, and the observation may have any number of leading
    axes.
    """
    networks = make_networks(observation_size, action_size, config, mirror)

    def infer(params: Params, observation: Float[Array, "*batch observations"]) -> Float[Array, "*batch actions"]:
        logits = networks.policy_network.apply(params.normalizer, params.policy, {STATE: observation})
        return networks.parametric_action_distribution.mode(logits)

    return infer


def make_sampler(
    observation_size: ObservationSize, action_size: int, config: PPOConfig, mirror: Mirror | None = None
) -> Sampler:
    """Return the stochastic policy, a function of parameters, observation and random key that samples an action."""
    networks = make_networks(observation_size, action_size, config, mirror)

    def sample(params: Params, observation: Float[Array, " observations"], key: Array) -> Float[Array, " actions"]:
        logits = networks.policy_network.apply(params.normalizer, params.policy, {STATE: observation})
        return networks.parametric_action_distribution.sample(logits, key)

    return sample


def fits(infer: Inference, params: Params, inputs: int) -> bool:
    """Return whether `params` have the shapes of the network that `infer` evaluates, with `inputs` inputs."""
    observation = jax.ShapeDtypeStruct((inputs,), jnp.float32)
    try:
        jax.eval_shape(infer, params, observation)
    except (errors.FlaxError, TypeError, ValueError, KeyError):
        return False
    return True


def initial_policy(
    inputs: Float[Array | np.ndarray, "states inputs"],
    action_size: int,
    config: PPOConfig,
    mirror: Mirror | None = None,
) -> Params:
    """Return an untrained policy, with a normalizer from the observations `inputs` and without value function."""
    inputs = np.asarray(inputs, np.float64)
    std = np.maximum(inputs.std(axis=0), _NARROWEST)
    mean, std, summed = (np.asarray(x, np.float32) for x in (inputs.mean(axis=0), std, std**2 * len(inputs)))
    normalizer = Normalizer(np.asarray(len(inputs), np.float32), {STATE: mean}, {STATE: std}, {STATE: summed})
    policy = make_networks({STATE: (inputs.shape[1],)}, action_size, config, mirror).policy_network
    return Params(normalizer, policy.init(jax.random.key(config.seed)), {})


def with_share(policy: Mapping[str, Any], share: float) -> Mapping[str, Any]:
    """Return a policy network whose mean actions are `share` times those of `policy`."""
    layers = policy["params"]
    scaled = {name: jax.tree.map(lambda x: share * x, layers[name]) for name in (_MEAN, OFFSET) if name in layers}
    return {**policy, "params": {**layers, **scaled}}


def with_mean(policy: Mapping[str, Any], mean: Float[Array | np.ndarray, " actions"]) -> Mapping[str, Any]:
    """Return a policy network whose mean actions are those of `policy` plus `mean`."""
    layers, mean = policy["params"], jnp.asarray(mean, jnp.float32)
    if OFFSET in layers:
        return {**policy, "params": {**layers, OFFSET: layers[OFFSET] + mean}}
    last = layers[_MEAN]
    return {**policy, "params": {**layers, _MEAN: {**last, "bias": last["bias"] + mean}}}


def with_exploration(policy: Mapping[str, Any], other: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a policy network with the mean actions of `policy` and the standard deviations of `other`."""
    return {**policy, "params": {**policy["params"], _STD: other["params"][_STD]}}


def num_actions(policy: Mapping[str, Any]) -> int:
    """Return the number of actions of a policy network."""
    layers = policy["params"]
    return len(layers[OFFSET] if OFFSET in layers else layers[_MEAN]["bias"])


_MEAN, _STD = "Dense_0", "std_logparam"
"""Brax's names of the layer whose output is the mean of the action distribution, and of its standard deviations."""
POLICY_OPTIONS = ("policy_layers", "activation", "normalize_observations", "observation_clip")
"""Options of `PPOConfig` on which the meaning of a policy's parameters depends."""
START_OPTIONS = ("initial_std", "orthogonal_init")
"""Options of `PPOConfig` that act on new networks alone."""


def as_tree(params: Params) -> dict[str, Any]:
    """Return `params` as nested dictionaries of arrays, for checkpoints."""
    return {"normalizer": params.normalizer._asdict(), "policy": params.policy, "value": params.value}


def from_tree(tree: Mapping[str, Any]) -> Params:
    """Return parameters from nested dictionaries, the inverse of `as_tree`."""
    return Params(Normalizer(**tree["normalizer"]), tree["policy"], tree["value"])


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
