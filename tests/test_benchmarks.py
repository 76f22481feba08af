"""Is the robot that the benchmarks run in PyBullet the same robot?"""

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
def rival(model: mujoco.MjModel) -> Iterator[bullet.Robot]:
    with contextlib.closing(bullet.Robot(model, TIMESTEP)) as found:
        yield found


def test_it_weighs_the_same(model: mujoco.MjModel, rival: bullet.Robot) -> None:
    np.testing.assert_allclose(rival.total_mass(), model.body_mass.sum(), rtol=1e-6)


def test_its_joints_stop_at_the_same_angles(model: mujoco.MjModel, rival: bullet.Robot) -> None:
    for name in JOINTS:
        low, high = rival.joint_limits(name)
        if model.joint(name).limited[0]:
            np.testing.assert_allclose((low, high), model.joint(name).range, rtol=1e-6)
        else:
            assert low > high  # Bullet's way to say none


def test_it_sees_what_the_model_sees_of_a_bent_and_turned_pose(model: mujoco.MjModel, rival: bullet.Robot) -> None:
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    data.qpos[:3] = 0.3, -0.2, 0.9
    data.qpos[3:7] = np.array([0.9, 0.1, -0.3, 0.2]) / np.linalg.norm([0.9, 0.1, -0.3, 0.2])
    data.qpos[7:] = 0.3, -0.4, 0.8, 0.2, 0.1, 0.6, 1.1
    mujoco.mj_forward(model, data)
    rival.reset(data.qpos)
    features, com = rival.observe()
    sites = {"balloon": 0, "base": 9, "foot_left": 15, "foot_right": 21}
    for name, start in sites.items():
        np.testing.assert_allclose(features[start : start + 3], data.site(name).xpos, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(com, data.subtree_com[0], atol=1e-6)
    np.testing.assert_allclose(rival.qpos(), data.qpos, atol=1e-6)


def test_it_stands_as_high(model: mujoco.MjModel, rival: bullet.Robot) -> None:
    """For half a second: then the balloon, whose swaying nothing steadies, has begun to sway its own way in each."""
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    rival.reset(data.qpos)
    for _ in range(10):
        rival.step((0.0, 0.0))
        for _ in range(round(CONTROL_TIMESTEP / model.opt.timestep)):
            mujoco.mj_step(model, data)
        assert abs(rival.qpos()[2] - data.qpos[2]) < 1e-3


def test_its_neck_swings_at_the_same_frequency(model: mujoco.MjModel) -> None:
    """The base held still in the air, the balloon swings about the neck, its lift pulling it upright."""
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    spec.body("base").pos = [0, 0, 1.5]
    spec.delete(spec.joint("root"))
    hanging = spec.compile()
    hanging.opt.timestep = TIMESTEP
    data = mujoco.MjData(hanging)
    neck = hanging.joint("neck").qposadr[0]
    data.qpos[neck] = 0.3
    with contextlib.closing(bullet.Robot(model, TIMESTEP, held=True)) as rival:
        start = model.qpos0.copy()
        start[2], start[7] = 1.5, 0.3
        rival.reset(start)
        ours, theirs = [], []
        for _ in range(round(6.0 / TIMESTEP)):
            mujoco.mj_step(hanging, data)
            ours.append(data.qpos[neck])
            rival.physics_step((0.0, 0.0))
            theirs.append(rival.joint_angle("neck"))
    np.testing.assert_allclose(_period(theirs), _period(ours), rtol=5e-3)


def test_it_stays_whole_under_random_commands(model: mujoco.MjModel) -> None:
    for timestep in bullet.TIMESTEPS:
        with contextlib.closing(bullet.Robot(model, timestep)) as rival:
            rival.reset(standing_qpos(model))
            for command in np.random.default_rng(0).uniform(0.0, 1.0, (round(5.0 / CONTROL_TIMESTEP), 2)):
                rival.step(command.tolist())
                features, _ = rival.observe()
                assert np.isfinite(features).all()
                assert 0.3 < features[2] < 2.0  # the balloon is neither on the floor nor gone


def test_rewards_add_up_to_the_way_and_episodes_end_by_time() -> None:
    pytest.importorskip("gymnasium", reason="needs the extra bench")
    import bullet_gym  # pyright: ignore[reportMissingImports]

    with contextlib.closing(bullet_gym.LocomotionEnv("walk", bullet.TIMESTEPS[0], episode_seconds=2.0)) as env:
        for seed in range(3):
            observation, _ = env.reset(seed=seed)
            assert env.observation_space.contains(observation)
            start, way, ended = env.robot.observe()[1], 0.0, False
            rng, steps = np.random.default_rng(seed), 0
            while not ended:
                observation, reward, terminated, ended, info = env.step(rng.uniform(-1.0, 1.0, 2))
                assert reward == info["reward"] and not terminated
                way, steps = way + reward * CONTROL_TIMESTEP, steps + 1
            assert env.observation_space.contains(observation)
            np.testing.assert_allclose(way, env.robot.observe()[1][0] - start[0], atol=1e-9)
            assert 20 <= steps <= 60  # half to one and a half times the mean


def _period(angles: list[float]) -> float:
    """s; between the first and the last upward crossing of 0."""
    swing = np.array(angles)
    ups = np.flatnonzero((swing[:-1] < 0) & (swing[1:] >= 0))
    assert len(ups) >= 2
    return float((ups[-1] - ups[0]) / (len(ups) - 1) * TIMESTEP)
