"""Capture noise that is added to recordings of any robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from robot_files import write_robot

from ballu_mjx.recordings.capture_noise import add_capture_noise
from ballu_mjx.recordings.motion import ReconstructionParameters
from ballu_mjx.recordings.recording import Recording

CART = """
<mujoco><worldbody><body name="cart" pos="0 0 1"><joint name="rail" type="slide" axis="1 0 0"/>
<geom size="0.1" mass="1"/><site name="cart"/><body name="pole"><joint name="pivot" axis="0 1 0"/>
<geom size="0.05" pos="0 0 -0.5" mass="0.1"/></body></body></worldbody>
<actuator><motor name="push" joint="rail" ctrlrange="-1 1"/></actuator></mujoco>
"""


def test_slides_have_the_noise_of_positions_and_hinges_that_of_angles(tmp_path: Path):
    joints = ["rail", "pivot"]
    robot = write_robot(tmp_path, "cart", CART, tracked="cart", commands={"push": "push"}, joints=joints)
    count = 2000
    still = Recording(
        name="still",
        kind="free",
        robot="cart-0",
        time=0.01 * np.arange(count),
        command=np.zeros((count, 1)),
        joint_angles={name: np.zeros(count) for name in joints},
    )
    noise = ReconstructionParameters(position_noise=5e-4, rotation_noise=0.1, joint_noise=0.02)
    shaken = add_capture_noise(still, robot.load_model(), noise)
    spread = {name: float(np.std(values)) for name, values in shaken.joint_angles.items()}
    np.testing.assert_allclose([spread["rail"], spread["pivot"]], [5e-4, 0.02], rtol=0.1)
