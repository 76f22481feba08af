"""The check that a model does not diverge at its time step, before anything is learned in it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from servo_arm import write_arm

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.stable_time_step import check_stability
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.robots.description import RobotDescription, read_description

_HANGING = """
<mujoco><option timestep="0.01" integrator="Euler"/><worldbody><body name="upper" pos="0 0 1">
  <joint name="shoulder" axis="0 1 0" damping="0.02"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".01" mass=".1"/>
  <body name="lower" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.02" stiffness="400"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".01" mass=".1"/><site name="tip" pos="0 0 -.4"/></body></body>
</worldbody><actuator><position name="one" joint="shoulder" kp="1" ctrlrange="-1 1"/>
  <motor name="two" joint="elbow" ctrlrange="-1 1"/></actuator></mujoco>
"""
_FLOATING = """
<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody><body name="hull"><freejoint/><geom size=".1" mass="1"/>
  <site name="tip"/><body name="fin" pos="0.2 0 0"><joint name="elbow" type="slide" axis="1 0 0" stiffness="2e4"/>
    <geom size="0.01" mass="0.01"/></body></body></worldbody><actuator>
  <motor name="one" joint="elbow" ctrlrange="-1 1"/></actuator></mujoco>
"""


def sway(robot: RobotDescription, count: int = 60, seed: int = 0) -> Motion:
    """Return a motion with small movements of all joints about the reference pose."""
    model = robot.load_model()
    rng = np.random.default_rng(seed)
    first = 7 if model.nq > model.nv else 0
    qpos = np.tile(model.qpos0, (count, 1))
    qpos[:, first:] += 0.02 * rng.normal(size=(count, model.nq - first))
    qvel = 0.1 * rng.normal(size=(count, model.nv))
    time = np.arange(count) * robot.control_timestep
    return Motion("sway", time, np.zeros((count - 1, model.nu)), qpos, qvel, {})


@pytest.mark.parametrize(
    ("model", "commands", "step"),
    [(_HANGING, {"shoulder": "one", "elbow": "two"}, "0.0025"), (_FLOATING, {"push": "one"}, "0.00125")],
)
def test_a_model_too_stiff_for_its_time_step_is_refused_with_a_stable_one(
    tmp_path: Path, model: str, commands: dict[str, str], step: str
):
    robot = write_arm(tmp_path)
    (tmp_path / "arm.xml").write_text(model)
    text = robot.file.read_text().replace('"joints": ["shoulder", "elbow"]', '"joints": ["elbow"]')
    text = text[: text.index('"identify"')] + '"control_timestep": 0.05}'
    text = text.replace('"commands": {"shoulder": "one", "elbow": "two"}', f'"commands": {commands}'.replace("'", '"'))
    robot.file.write_text(text)
    robot = read_description(robot.file)
    before = set(os.listdir())
    with pytest.raises(InputError, match=rf'arm\.xml: the model diverges .* within 0\.\d+ s.*write timestep="{step}"'):
        check_stability(robot, [sway(robot)], None)
    assert set(os.listdir()) == before, "MuJoCo wrote a log file"
    (tmp_path / "arm.xml").write_text(model.replace('timestep="0.01"', f'timestep="{step}"')
                                      .replace('timestep="0.005"', f'timestep="{step}"'))  # fmt: skip
    check_stability(read_description(robot.file), [sway(robot)], None)


def test_a_stable_model_passes_despite_a_single_bad_state(tmp_path: Path):
    robot = write_arm(tmp_path)
    motion = sway(robot)
    check_stability(robot, [motion], None)
    motion.qvel[0] = 1e9
    check_stability(robot, [motion, sway(robot, seed=1)], None)
