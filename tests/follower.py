"""A small environment without physics, in which a policy is trained within seconds."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from ballu_mjx.rl.ppo import Params


class Follower(Env):
    """A point mass that is pushed along a line. The reward is high near a goal, which is drawn at reset. The state
    contains an empty array, as that of a robot without joints."""

    limit = 10

    def reset(self, rng: jax.Array) -> State:
        goal = jax.random.uniform(rng, (), minval=-1.0, maxval=1.0)
        physics = {"position": jnp.zeros(()), "velocity": jnp.zeros(()), "goal": goal, "time": jnp.zeros((), jnp.int32)}
        physics["joints"] = jnp.zeros(0)
        zero = jnp.zeros(())
        return State(
            physics,  # pyright: ignore
            self._observe(physics),
            zero,
            zero,
            {"distance": zero},
            {"truncation": zero},
        )

    def step(self, state: State, action: jax.Array) -> State:
        s = physics(state)
        velocity = 0.5 * s["velocity"] + action[0]
        s = s | {"velocity": velocity, "position": s["position"] + velocity, "time": s["time"] + 1}
        distance = jnp.abs(s["position"] - s["goal"])
        escaped = jnp.abs(s["position"]) > 3.0
        late = s["time"] >= self.limit
        return dataclasses.replace(
            state,
            pipeline_state=s,
            obs=self._observe(s),
            reward=jnp.exp(-4.0 * distance),
            done=jnp.asarray(escaped | late, jnp.float32),
            metrics={"distance": distance},
            info=state.info | {"truncation": jnp.asarray(late & ~escaped, jnp.float32)},
        )

    def _observe(self, s: dict) -> jax.Array:
        return jnp.stack([s["position"] - s["goal"], s["velocity"]])

    @property
    def observation_size(self) -> int:
        return 2

    @property
    def action_size(self) -> int:
        return 1

    @property
    def backend(self) -> str:
        return "none"


def weight(params: Params) -> float:
    """Return one weight of the policy. It differs between checkpoints, so it can serve as their validation score."""
    return float(jax.tree.leaves(params.policy)[0].ravel()[0])


def physics(state: State) -> dict[str, Any]:
    return state.pipeline_state  # pyright: ignore
