"""Tests that the benchmarks' PyBullet robot matches BALLU's MuJoCo model."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, JOINTS, load_model, standing_qpos
from ballu_mjx.robots.model import assets

pytest.importorskip("pybullet", reason="needs the extra bench")
import bullet  # noqa: E402  # pyright: ignore[reportMissingImports]

TIMESTEP = 1e-3


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return load_model()


@pytest.fixture
def bullet_robot(model: mujoco.MjModel) -> Iterator[bullet.Robot]:
    with contextlib.closing(bullet.Robot(model, TIMESTEP)) as robot:
        yield robot


def test_bullet_robot_has_the_model_s_mass(model: mujoco.MjModel, bullet_robot: bullet.Robot) -> None:
    np.testing.assert_allclose(bullet_robot.total_mass(), model.body_mass.sum(), rtol=1e-6)


def test_bullet_robot_has_the_model_s_joint_limits(model: mujoco.MjModel, bullet_robot: bullet.Robot) -> None:
    for name in JOINTS:
        low, high = bullet_robot.joint_limits(name)
        if model.joint(name).limited[0]:
            np.testing.assert_allclose((low, high), model.joint(name).range, rtol=1e-6)
        else:
            assert low > high  # Bullet's convention for a joint without limits


def test_bullet_observation_of_a_pose_matches_the_model(model: mujoco.MjModel, bullet_robot: bullet.Robot) -> None:
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    data.qpos[:3] = 0.3, -0.2, 0.9
    data.qpos[3:7] = np.array([0.9, 0.1, -0.3, 0.2]) / np.linalg.norm([0.9, 0.1, -0.3, 0.2])
    data.qpos[7:] = 0.3, -0.4, 0.8, 0.2, 0.1, 0.6, 1.1
    mujoco.mj_forward(model, data)
    bullet_robot.reset(data.qpos)
    features, com = bullet_robot.observe()
    sites = {"balloon": 0, "base": 9, "foot_left": 15, "foot_right": 21}
    for name, start in sites.items():
        np.testing.assert_allclose(features[start : start + 3], data.site(name).xpos, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(com, data.subtree_com[0], atol=1e-6)
    np.testing.assert_allclose(bullet_robot.qpos(), data.qpos, atol=1e-6)


def test_bullet_robot_stands_as_high_as_the_model(model: mujoco.MjModel, bullet_robot: bullet.Robot) -> None:
    """The comparison ends after 0.5 s, because the balloon's undamped sway then differs between the simulators."""
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    bullet_robot.reset(data.qpos)
    for _ in range(10):
        bullet_robot.step((0.0, 0.0))
        for _ in range(round(CONTROL_TIMESTEP / model.opt.timestep)):
            mujoco.mj_step(model, data)
        assert abs(bullet_robot.qpos()[2] - data.qpos[2]) < 1e-3


def test_bullet_neck_swings_at_the_model_s_frequency(model: mujoco.MjModel) -> None:
    """With the base fixed in the air, the balloon swings about the neck. Its lift is the restoring force."""
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    spec.body("base").pos = [0, 0, 1.5]
    spec.delete(spec.joint("root"))
    hanging = spec.compile()
    hanging.opt.timestep = TIMESTEP
    data = mujoco.MjData(hanging)
    neck = hanging.joint("neck").qposadr[0]
    data.qpos[neck] = 0.3
    with contextlib.closing(bullet.Robot(model, TIMESTEP, held=True)) as bullet_robot:
        start = model.qpos0.copy()
        start[2], start[7] = 1.5, 0.3
        bullet_robot.reset(start)
        model_angles, bullet_angles = [], []
        for _ in range(round(6.0 / TIMESTEP)):
            mujoco.mj_step(hanging, data)
            model_angles.append(data.qpos[neck])
            bullet_robot.physics_step((0.0, 0.0))
            bullet_angles.append(bullet_robot.joint_angle("neck"))
    np.testing.assert_allclose(_period(bullet_angles), _period(model_angles), rtol=5e-3)


def test_bullet_robot_stays_finite_under_random_commands(model: mujoco.MjModel) -> None:
    for timestep in bullet.TIMESTEPS:
        with contextlib.closing(bullet.Robot(model, timestep)) as bullet_robot:
            bullet_robot.reset(standing_qpos(model))
            for command in np.random.default_rng(0).uniform(0.0, 1.0, (round(5.0 / CONTROL_TIMESTEP), 2)):
                bullet_robot.step(command.tolist())
                features, _ = bullet_robot.observe()
                assert np.isfinite(features).all()
                assert 0.3 < features[2] < 2.0  # height of the balloon (m)


def test_gym_rewards_add_up_to_the_distance_and_episodes_end_by_time() -> None:
    pytest.importorskip("gymnasium", reason="needs the extra bench")
    import bullet_gym  # pyright: ignore[reportMissingImports]

    with contextlib.closing(bullet_gym.LocomotionEnv("walk", bullet.TIMESTEPS[0], episode_seconds=2.0)) as env:
        for seed in range(3):
            observation, _ = env.reset(seed=seed)
            assert env.observation_space.contains(observation)
            start, distance, ended = env.robot.observe()[1], 0.0, False
            rng, steps = np.random.default_rng(seed), 0
            while not ended:
                observation, reward, terminated, ended, info = env.step(rng.uniform(-1.0, 1.0, 2))
                assert reward == info["reward"] and not terminated
                distance, steps = distance + reward * CONTROL_TIMESTEP, steps + 1
            assert env.observation_space.contains(observation)
            np.testing.assert_allclose(distance, env.robot.observe()[1][0] - start[0], atol=1e-9)
            assert 20 <= steps <= 60  # 0.5 to 1.5 times the mean


def _period(angles: list[float]) -> float:
    """Return the mean period (s) between the first and the last upward crossing of 0."""
    swing = np.array(angles)
    crossings = np.flatnonzero((swing[:-1] < 0) & (swing[1:] >= 0))
    assert len(crossings) >= 2
    return float((crossings[-1] - crossings[0]) / (len(crossings) - 1) * TIMESTEP)
