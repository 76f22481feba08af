"""A robot that differs from BALLU: a hull with a hinged arm and a sliding rod, and commands with their own ranges."""

from __future__ import annotations

import json
from pathlib import Path

from ballu_mjx.robots.description import RobotDescription, read_description

_MODEL = """\
<mujoco model="rover">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.01" integrator="implicitfast" iterations="4" ls_iterations="8"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.05" friction="0.7"/>
    <body name="hull" pos="0 0 0.1">
      <freejoint/>
      <geom name="hull" type="box" size="0.2 0.15 0.1" mass="1.5" friction="0.8"/>
      <site name="hull" pos="0 0 0.05"/>
      <body name="arm" pos="0.2 0 0.1">
        <joint name="shoulder" axis="0 1 0" range="-0.4 0.6" damping="0.05"/>
        <geom name="arm" type="capsule" fromto="0 0 0 0.15 0 0" size="0.02" mass="0.1" friction="0.6"/>
        <site name="tip" pos="0.15 0 0"/>
      </body>
      <body name="rod" pos="-0.1 0 0.15">
        <joint name="rod" type="slide" axis="0 0 1" range="0 0.05" damping="1"/>
        <geom name="rod" type="cylinder" size="0.02 0.05" mass="0.1" contype="0" conaffinity="0" rgba="1 0 0 0.3"/>
      </body>
      <body name="lid" pos="0 0 0.11">
        <joint name="lid" axis="1 0 0" range="0 1" damping="0.05"/>
        <geom name="lid" type="mesh" mesh="wedge" contype="0" conaffinity="0" mass="0.05"/>
      </body>
    </body>
  </worldbody>
  <asset>
    <mesh name="wedge" vertex="0 0 0  0.1 0 0  0 0.1 0  0 0 0.1"/>
  </asset>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="2" ctrlrange="-0.4 0.6"/>
    <motor name="rod" joint="rod" ctrlrange="0 10"/>
  </actuator>
  <keyframe>
    <key name="home" qpos="0 0 0.1 0.7071068 0 0 0.7071068 0.3 0.02 0.5" ctrl="0.3 1"/>
  </keyframe>
</mujoco>
"""
_DESCRIPTION = {
    "format": "ballu-robot/1",
    "name": "rover",
    "model": "rover.xml",
    "tracked": "hull",
    "points": ["tip"],
    "commands": {"arm": "shoulder", "push": "rod"},
    "control_timestep": 0.04,
    "held": ["lid"],
    "keyframe": "home",
}


def write_rover(folder: Path) -> RobotDescription:
    """Write the robot's model and description to a folder. Return the description."""
    (folder / "rover.xml").write_text(_MODEL)
    (folder / "rover.robot.json").write_text(json.dumps(_DESCRIPTION))
    return read_description(folder / "rover.robot.json")
