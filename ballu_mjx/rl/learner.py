"""PPO's training algorithm from Brax's components, in one program that is compiled once.

`brax.training.agents.ppo.train` computes the same from the same random numbers (a test compares the two), but does not
expose the optimizer and the environments. Here they are part of a `TrainingState`. It can be saved after any training
step, and a resumed training continues exactly.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, cast

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import Env, State, Wrapper
from brax.training import acting
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as brax_networks
from brax.training.agents.ppo.losses import PPONetworkParams, compute_ppo_loss
from brax.training.agents.ppo.optimizer import adaptive_kl_learning_rate
from brax.training.types import Transition, UInt64
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, UInt32

from ballu_mjx.common.compiler_options import FOR_ONE_RUN
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import Params, PPOConfig, with_mean
from ballu_mjx.rl.training_env import MEASURED, wrap_for_training
from ballu_mjx.rl.training_state import Stored, TrainingState, array_name, to_uint64, with_own_memory

Callback = Callable[[int, TrainingState, dict[str, float]], None]
"""Function of the control steps done, the state, and metrics (means since the last call).

Metrics are empty before the first training step. The next training step reuses the state's memory: copy what you need
with `training_state.params` or `training_state.stored` before you return."""

_AXIS = "devices"
_MAX_CALLS = 400


class Learner:
    """PPO for one environment and configuration, on all devices of all processes (see `ballu_mjx.rl.distributed`).

    Each device simulates its share of the environments and learns from their experience. Gradients and statistics are
    averaged over all devices.
    """

    def __init__(self, env: Env, config: PPOConfig) -> None:
        """Build networks, optimizer and the program of a training step; nothing is compiled yet.

        **Raises** `InputError` from `ppo.check`.
        """
        self._devices = jax.device_count()
        ppo.check(config, self._devices)
        self._config, self._env = config, env
        mesh = Mesh(np.array(jax.devices()), (_AXIS,))
        each: Any = PartitionSpec()
        everywhere = NamedSharding(mesh, each)
        # From the host, because an array on one device cannot be placed on the devices of all processes.
        self._parameters = jax.device_put(jax.device_get(getattr(env, "parameters", ())), everywhere)
        # A separate program, because its shapes are needed before another program uses it. So it is traced once.
        self._reset = jax.jit(lambda keys, parameters: self._with_parameters(parameters).reset(keys))
        keys = jax.ShapeDtypeStruct((config.num_envs, 2), jnp.uint32)
        shapes = jax.eval_shape(self._reset, keys, self._parameters).obs
        self._observation = {name: jax.ShapeDtypeStruct(x.shape[1:], jnp.float32) for name, x in shapes.items()}
        sizes = {name: x.shape for name, x in self._observation.items()}
        self._networks = ppo.make_networks(sizes, env.action_size, config, getattr(env, "mirror", None))
        # The learning rate is in the state even if it is constant, so that one program serves all learning rates.
        self._optimizer = optax.chain(
            optax.clip_by_global_norm(config.max_grad_norm),
            optax.inject_hyperparams(optax.adam)(learning_rate=config.learning_rate, eps=config.adam_epsilon),
        )
        loss = functools.partial(
            compute_ppo_loss,
            ppo_network=self._networks,
            entropy_cost=config.entropy_cost,
            discounting=config.discounting,
            reward_scaling=config.reward_scaling,
            gae_lambda=config.gae_lambda,
            clipping_epsilon=config.clipping_epsilon,
            vf_coefficient=2 * config.value_cost,  # Brax halves it.
        )
        self._gradient = jax.grad(loss, has_aux=True)

        specs = TrainingState(*[each] * len(TrainingState._fields))._replace(environments=PartitionSpec(_AXIS))
        self._shardings: Any = TrainingState(*(NamedSharding(mesh, spec) for spec in specs))  # pyright: ignore
        self._first = jax.jit(self._make_first, out_shardings=self._shardings, compiler_options=dict(FOR_ONE_RUN))
        step = jax.shard_map(
            self._make_step, mesh=mesh, in_specs=(specs, each), out_specs=(specs, each), check_vma=False
        )
        # Outputs keep the shardings of the inputs. On one device they would differ, and the step would compile twice.
        self._step = jax.jit(step, donate_argnums=0, out_shardings=(self._shardings, everywhere))
        self._step_traced: jax.stages.Lowered | None = None
        self._step_compiled: Future | None = None

    @property
    def steps_each(self) -> int:
        """Control steps of one training step, summed over all environments."""
        return _step_size(self._config)

    def init(self, seed: int) -> TrainingState:
        """Return the initial state for `seed`, the same as in Brax.

        If the environment has an attribute `initial_action`, the policy's mean actions start there instead of at 0.
        """
        arguments = np.array(jax.random.PRNGKey(seed)), self._parameters
        first = self._first.lower(*arguments)
        state = jax.tree.map(
            lambda x, sharding: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding),
            first.out_info,
            jax.tree.broadcast(self._shardings, first.out_info),
        )
        # XLA compiles this program while Python traces the next.
        with ThreadPoolExecutor(1) as pool:
            compiled = pool.submit(first.compile)
            self._step_traced = self._step.lower(state, self._parameters)
            compiled.result()
        return self._first(*arguments)

    def compile_step(self) -> None:
        """Start to compile the training step in another thread, if `init` has traced it. `step` waits for the end."""
        if self._step_traced is not None:
            pool = ThreadPoolExecutor(1)
            self._step_compiled = pool.submit(self._step_traced.compile)
            pool.shutdown(wait=False)

    def step(self, state: TrainingState) -> tuple[TrainingState, dict[str, Array]]:
        """Take a training step. Return the next state, and the means of reward, metrics and losses.

        The memory of `state` is reused, so do not read `state` afterwards.
        """
        if self._step_compiled is not None:
            self._step_compiled.result()
            self._step_compiled = None
        return self._step(state, self._parameters)

    def resume(self, stored: Stored, *, environments: bool = True) -> tuple[TrainingState, bool]:
        """Return the state that `stored` holds, and whether all of it was used.

        If `environments` is False, or if the stored environments do not fit (for example, their number differs),
        environments and random key are new. They are drawn from the configuration's seed and the steps done.

        **Raises** `ValueError` if any other array is missing or has another shape.
        """
        shapes = jax.eval_shape(self._first, jax.random.PRNGKey(0), self._parameters)
        leaves = jax.tree.leaves_with_path(shapes)
        stored = {
            array_name(path): np.zeros(leaf.shape, leaf.dtype) for path, leaf in leaves if 0 in leaf.shape
        } | dict(stored)
        fits, drawn = {}, set()
        for path, leaf in leaves:
            name = array_name(path)
            found = stored.get(name)
            fits[name] = found is not None and (found.shape, found.dtype) == (leaf.shape, leaf.dtype)
            if name.split(".")[0] in ("environments", "key"):
                drawn.add(name)
        for name in fits.keys() - drawn:
            if not fits[name]:
                raise ValueError(f"{name} is missing or has another shape")
        whole = environments and all(fits.values())
        steps = int(UInt64(hi=stored["steps.hi"], lo=stored["steps.lo"]))  # pyright: ignore[reportCallIssue]

        def choose(path: Any, leaf: Any) -> Any:
            name = array_name(path)
            return leaf if name in drawn and not whole else np.array(stored[name])

        template = shapes if whole else self.init(_seed(self._config, steps))
        return self._placed(jax.tree.map_with_path(choose, template)), whole

    def init_from(self, params: Params, steps: int) -> TrainingState:
        """Return a state with `params`, learned in `steps` control steps. The optimizer and everything else are new."""
        state = self.init(_seed(self._config, steps))
        known = params.normalizer
        normalizer = dataclasses.replace(
            state.normalizer,
            count=to_uint64(int(known.count)),
            mean=known.mean,
            std=known.std,
            summed_variance=known.summed_variance,
        )
        networks = PPONetworkParams(policy=params.policy, value=params.value)  # pyright: ignore[reportCallIssue]
        filled = state._replace(
            networks=networks, averaged=params.policy, normalizer=normalizer, steps=to_uint64(steps)
        )
        return self._filled(filled, state)

    def init_with(self, params: Params) -> TrainingState:
        """Return the initial state with the mean actions of the policy in `params`.

        Exploration and value function are those of an untrained policy. The policy's input is normalized as in
        `params`. These statistics count like those of one training step, so that they follow the new observations.
        """
        state, known, count = self.init(self._config.seed), params.normalizer, self.steps_each
        mean = {name: np.zeros(size.shape, np.float32) for name, size in self._observation.items()}
        mean[ppo.STATE] = np.asarray(known.mean[ppo.STATE])
        std = {name: np.ones_like(each) for name, each in mean.items()}
        std[ppo.STATE] = np.asarray(known.std[ppo.STATE])
        normalizer = dataclasses.replace(
            state.normalizer,
            count=to_uint64(count),
            mean=mean,
            std=std,
            summed_variance={name: each**2 * count for name, each in std.items()},
        )
        policy = jax.device_get(ppo.with_exploration(params.policy, cast(Any, state.networks.policy)))
        networks = state.networks.replace(policy=policy)  # pyright: ignore[reportAttributeAccessIssue]
        return self._filled(state._replace(networks=networks, averaged=policy, normalizer=normalizer), state)

    def _filled(self, state: TrainingState, like: TrainingState) -> TrainingState:
        """Move a state with arrays from the host to the devices, with the types of the state `like`."""

        def placeable(x: Any, like: Array) -> Any:
            return x if isinstance(x, jax.Array) else np.array(x, like.dtype)

        return self._placed(jax.tree.map(placeable, state, like))

    def _placed(self, state: TrainingState) -> TrainingState:
        """Move a state from the host to the devices, as `step` needs it."""
        return jax.device_put(state, self._shardings)

    def _with_parameters(self, parameters: Any) -> Wrapper:
        env: Any = self._env
        return wrap_for_training(env.with_parameters(parameters) if hasattr(env, "with_parameters") else env)

    def _make_first(self, key: UInt32[Array, 2], parameters: Any) -> TrainingState:
        key_networks, key = jax.random.split(key)
        key, key_environments, _ = jax.random.split(jax.random.fold_in(key, 0), 3)
        key_policy, key_value = jax.random.split(key_networks)
        env = self._with_parameters(parameters)
        policy: Any = self._networks.policy_network.init(key_policy)
        if hasattr(env, "initial_action"):
            policy = with_mean(policy, env.initial_action)
        networks = PPONetworkParams(
            policy=policy,  # pyright: ignore[reportCallIssue]
            value=self._networks.value_network.init(key_value),  # pyright: ignore[reportCallIssue]
        )
        return with_own_memory(
            TrainingState(
                networks=networks,
                averaged=networks.policy,
                averaged_steps=jnp.zeros((), jnp.int32),
                optimizer=self._optimizer.init(networks),  # pyright: ignore[reportArgumentType]
                normalizer=running_statistics.init_state(self._observation),
                environments=self._reset(jax.random.split(key_environments, self._config.num_envs), parameters),
                key=key,
                steps=to_uint64(0),
            )
        )

    def _make_step(self, state: TrainingState, parameters: Any) -> tuple[TrainingState, dict[str, Array]]:
        """Take a training step on one device, with its share of the environments. Random keys are split as in Brax."""
        config = self._config
        key_step, key = jax.random.split(state.key)
        key_device = jax.random.split(key_step, self._devices)[jax.lax.axis_index(_AXIS)]
        key_learn, key_act, _ = jax.random.split(key_device, 3)

        environments, data, measured = self._collect(self._with_parameters(parameters), state, key_act)

        # An adaptive learning rate compares with the policy that acted, so its normalizer is updated afterwards.
        adaptive = config.desired_kl > 0
        observe = functools.partial(running_statistics.update, batch=data.observation, pmap_axis_name=_AXIS)
        normalizer = state.normalizer if adaptive else observe(state.normalizer)
        (optimizer, networks, _), losses = jax.lax.scan(
            functools.partial(self._epoch, data=data, normalizer=normalizer),
            (state.optimizer, state.networks, key_learn),
            length=config.num_updates_per_batch,
        )
        if adaptive:
            normalizer = observe(state.normalizer)

        averaged_steps = state.averaged_steps + 1
        share = 1.0 / jnp.minimum(averaged_steps, config.averaging)
        averaged = jax.tree.map(lambda old, new: old + share * (new - old), state.averaged, networks.policy)
        after = TrainingState(
            networks=networks,
            averaged=averaged,
            averaged_steps=averaged_steps,
            optimizer=optimizer,
            normalizer=normalizer,
            environments=environments,
            key=key,
            steps=state.steps + self.steps_each,
        )
        return with_own_memory(after), jax.lax.pmean(jax.tree.map(jnp.mean, measured | losses), _AXIS)

    def _collect(self, env: Wrapper, state: TrainingState, key: Array) -> tuple[State, Transition, dict[str, Array]]:
        """Collect experience with the current policy.

        **Returns** the environments' states after it, the trajectory segments (leaves of shape (segments,
        unroll_length, ...)), and rewards and metrics.
        """
        config = self._config
        make_policy = brax_networks.make_inference_fn(self._networks)
        policy = make_policy((state.normalizer, state.networks.policy, state.networks.value))

        def unroll(carry: tuple[State, Array], _: None) -> tuple[tuple[State, Array], Transition]:
            environments, key = carry
            key, key_next = jax.random.split(key)
            environments, data = acting.generate_unroll(
                env, environments, policy, key, config.unroll_length, extra_fields=("truncation", MEASURED)
            )
            return (environments, key_next), data

        count = config.batch_size * config.num_minibatches // config.num_envs
        (environments, _), data = jax.lax.scan(unroll, (state.environments, key), length=count)
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 1, 2).reshape(-1, x.shape[1], *x.shape[3:]), data)
        extras = dict(data.extras["state_extras"])
        measured = extras.pop(MEASURED)
        return environments, data._replace(extras={**data.extras, "state_extras": extras}), measured

    def _epoch(
        self, carry: tuple[Any, Any, Array], nothing: None, *, data: Transition, normalizer: RunningStatisticsState
    ) -> tuple[tuple[Any, Any, Array], dict[str, Array]]:
        """Take one pass over the collected experience, in newly shuffled minibatches."""
        optimizer, networks, key = carry
        key, key_shuffle, key_loss = jax.random.split(key, 3)
        # One permutation for all arrays, because each shuffle is a sort and compiles a dozen kernels.
        order = jax.random.permutation(key_shuffle, len(data.reward))

        def minibatches(x: Array) -> Array:
            return x[order].reshape(self._config.num_minibatches, -1, *x.shape[1:])

        (optimizer, networks, _), losses = jax.lax.scan(
            functools.partial(self._minibatch, normalizer=normalizer),
            (optimizer, networks, key_loss),
            jax.tree.map(minibatches, data),
        )
        return (optimizer, networks, key), losses

    def _minibatch(
        self, carry: tuple[Any, Any, Array], data: Transition, *, normalizer: RunningStatisticsState
    ) -> tuple[tuple[Any, Any, Array], dict[str, Array]]:
        """Take one gradient step on a minibatch."""
        optimizer, networks, key = carry
        key, key_loss = jax.random.split(key)
        # One exchange for all that devices average, because each exchange has a fixed cost.
        own, losses = self._gradient(networks, normalizer, data, key_loss)
        flat, apart = jax.flatten_util.ravel_pytree((own, losses["kl_mean"]))
        gradient, change = apart(jax.lax.pmean(flat, _AXIS))
        rate = optimizer[-1].hyperparams["learning_rate"]
        if self._config.desired_kl > 0:
            optimizer, rate = adaptive_kl_learning_rate(optimizer, change, self._config.desired_kl)
        update, optimizer = self._optimizer.update(gradient, optimizer)
        return (optimizer, optax.apply_updates(networks, update), key), {**losses, "learning_rate": rate}


def train(
    env: Env,
    config: PPOConfig,
    callback: Callback | None = None,
    *,
    start: Callable[[Learner], TrainingState] | None = None,
) -> tuple[TrainingState, dict[str, float]]:
    """Train a policy for `env`, on all devices, until `config.num_timesteps` control steps are done.

    **Arguments**

    - `env`: one unbatched environment. `wrap_for_training` lists its requirements.
    - `callback`: called before the first training step, and then after every training step, or every few in a long
      training. It may raise an exception to stop.
    - `start`: returns the initial state (see `Learner.resume` and `Learner.init_from`). By default the state is new. A
      training that resumes from a stored state, on the same machine with the same number of devices, gives the same
      result to the last bit as an uninterrupted one.

    **Returns** the last state, and the metrics of the last callback: `reward` and the environment's metrics per control
    step, `steps_per_second`, and Brax's losses.

    **Raises** `InputError` from `ppo.check`.
    """
    learner = Learner(env, config)
    state = start(learner) if start is not None else learner.init(config.seed)
    call = callback or (lambda step, state, metrics: None)
    step = int(state.steps)
    per_call, calls = _schedule(config, step)
    metrics: dict[str, float] = {}
    learner.compile_step()
    call(step, state, metrics)
    for _ in range(calls):
        began = time.perf_counter()
        means = []
        for _ in range(per_call):
            state, mean = learner.step(state)
            means.append(mean)
        means = jax.device_get(means)  # Waits until they are computed.
        rate = per_call * learner.steps_each / (time.perf_counter() - began)
        step += per_call * learner.steps_each
        metrics = {name: float(np.mean([mean[name] for mean in means])) for name in means[0]}
        metrics["steps_per_second"] = rate
        call(step, state, metrics)
    return state, metrics


def total_timesteps(config: PPOConfig, first_step: int = 0) -> int:
    """Return the control steps done when `train`, started at `first_step`, ends: `num_timesteps` rounded up."""
    per_call, calls = _schedule(config, first_step)
    return first_step + calls * per_call * _step_size(config)


def _seed(config: PPOConfig, steps: int) -> int:
    """Return the seed after `steps` control steps. A resumed run must not draw the same random numbers again."""
    if not steps:
        return config.seed
    return int(np.random.SeedSequence([config.seed, steps]).generate_state(1)[0] >> 1)


def _step_size(config: PPOConfig) -> int:
    """Return the number of control steps in a training step."""
    return config.batch_size * config.unroll_length * config.num_minibatches


def _schedule(config: PPOConfig, first_step: int) -> tuple[int, int]:
    """Return the training steps between two callbacks, and the number of callbacks from `first_step` on."""
    size = _step_size(config)
    per_call = math.ceil(math.ceil(config.num_timesteps / size) / _MAX_CALLS)
    return per_call, max(math.ceil((config.num_timesteps - first_step) / (per_call * size)), 0)
