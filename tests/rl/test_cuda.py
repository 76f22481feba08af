"""Programs for GPUs. They are traced and lowered here, which needs no GPU."""

from __future__ import annotations

import jax
import pytest
from brax.envs.base import Env

from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.policy import environment_of
from ballu_mjx.policies.tasks import find_task
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv
from ballu_mjx.rl.learner import Learner
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.simulator import Simulator


def environment(kind: str) -> Env:
    robot = load_robot()
    if kind == "walk":
        return environment_of(robot, find_task("walk"), LocomotionConfig())
    simulator = Simulator(robot)
    recording = read_recording(list_bundled("training")[0], robot)
    return EnvMimicEnv(simulator, [reconstruct(recording, robot, simulator.mj_model)], EnvMimicConfig())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["envmimic", "walk"])
def test_a_training_step_can_be_lowered_for_cuda(kind, monkeypatch: pytest.MonkeyPatch):
    """No operation of reset, physics or learning exists on the CPU only."""
    env, config = environment(kind), PPOConfig(num_envs=8192, batch_size=1024)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    one = jax.devices()[:1]
    monkeypatch.setattr(jax, "devices", lambda: one)
    monkeypatch.setattr(jax, "device_count", lambda: 1)
    learner = Learner(env, config)
    key = jax.random.PRNGKey(0)
    state = jax.eval_shape(learner._first, key, learner._parameters)
    first = learner._first.trace(key, learner._parameters).lower(lowering_platforms=("cuda",))
    step = learner._step.trace(state, learner._parameters).lower(lowering_platforms=("cuda",))
    for program in (first.as_text(), step.as_text()):
        assert "8192" in program
        assert "lapack" not in program
        assert "callback" not in program
