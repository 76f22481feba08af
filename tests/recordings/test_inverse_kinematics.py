"""Tests of inverse kinematics: postures, continuous rotation, closed loops, and joints without measurements."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import read_recording, write_recording
from ballu_mjx.recordings.inverse_kinematics import describe_fit
from ballu_mjx.recordings.kinematic_tree import KinematicTree
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription, read_description

RATE = 100.0


def describe(folder: Path, xml: str, **keys: object) -> RobotDescription:
    (folder / "robot.xml").write_text(xml)
    content = {"format": "ballu-robot/1", "name": "made", "model": "robot.xml", "points": [], "commands": {"m": "m"}}
    (folder / "my.robot.json").write_text(json.dumps(content | keys))
    return read_description(folder / "my.robot.json")


def capture(
    robot: RobotDescription, qpos: np.ndarray, *, noise: float = 5e-4, joints: tuple[str, ...] = (), rate: float = RATE
) -> Recording:
    """Return a recording of the model in these poses: noisy motion capture, and encoders of the joints `joints`."""
    model = robot.load_model()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    places: dict[str, list[np.ndarray]] = {site: [] for site in (robot.tracked, *robot.points)}
    turns = []
    for pose in qpos:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        for site, seen in places.items():
            seen.append(data.site(site).xpos + noise * rng.normal(size=3))
        turns.append(data.xquat[model.site_bodyid[model.site(robot.tracked).id]].copy())
    quaternion = np.array(turns)
    flips = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0, -1.0, 1.0))
    points = {site: np.array(seen) for site, seen in places.items()}
    return Recording(
        name="made",
        kind="free",
        robot="made",
        time=np.arange(len(qpos)) / rate,
        command=np.full((len(qpos), len(robot.commands)), robot.command_ranges[0][0]),
        tracked_position=points.pop(robot.tracked),
        tracked_quaternion=quaternion * np.concatenate([[1.0], flips])[:, None],
        points=points,
        joint_angles={joint: qpos[:, model.joint(joint).qposadr[0]] for joint in joints},
    )


def arm(links: int) -> str:
    """Return the MJCF of links of 0.25 m in a vertical plane, with joint angles of at most 3 rad."""
    bodies = "".join(
        f'<body name="l{i}" pos="0 0 {-0.25 if i else 1}"><joint name="j{i}" axis="0 1 0" range="-3 3"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.01" mass="0.05"/>'
        for i in range(links)
    )
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="0.005"/><worldbody>{bodies}<site name="tip" '
        f'pos="0 0 -0.25"/>{"</body>" * links}</worldbody><actuator><motor name="m" joint="j0" ctrlrange="-2 2"/>'
        "</actuator></mujoco>"
    )


@pytest.mark.parametrize("links", [2, 3])
def test_bent_arms_are_reconstructed_within_their_joint_ranges(tmp_path: Path, links: int):
    """The search starts from the straight pose, which is singular. No posture exceeds the joint ranges, and none is
    refused. The tip's pose determines the posture of two links. Three links have two postures, and either is correct.
    """
    robot = describe(tmp_path, arm(links), tracked="tip")
    model, rng = robot.load_model(), np.random.default_rng(0)
    data = mujoco.MjData(model)
    for _ in range(40):
        qpos = rng.uniform(-2.2, 2.2, links) + 0.05 * np.sin(np.pi * np.arange(120) / RATE)[:, None]
        motion = reconstruct(capture(robot, qpos), robot)
        assert np.abs(motion.qpos).max() < 3.01
        assert motion.fit_error_mm["tip"] < 1.0
        assert np.abs(np.diff(motion.qpos, axis=0)).max() < 0.3, "the posture must not change between samples"
        data.qpos[:] = motion.qpos[5]
        mujoco.mj_kinematics(model, data)
        expected = np.asarray(capture(robot, qpos[25:26], noise=0.0).tracked_position)
        np.testing.assert_allclose(data.site("tip").xpos[None], expected, atol=3e-3)
        if links == 2:
            np.testing.assert_allclose(motion.qpos[5], qpos[25], atol=0.02)


def test_keyframe_selects_among_several_postures(tmp_path: Path):
    for sign in (1.0, -1.0):
        home = f'<keyframe><key name="home" qpos="{-sign} {2 * sign} {-sign}"/></keyframe></mujoco>'
        robot = describe(tmp_path, arm(3).replace("</mujoco>", home), tracked="tip", keyframe="home")
        qpos = sign * np.array([-0.9, 1.7, -0.9]) + 0.05 * np.sin(np.pi * np.arange(120) / RATE)[:, None]
        motion = reconstruct(capture(robot, qpos), robot)
        np.testing.assert_allclose(motion.qpos[5], qpos[25], atol=0.02)


FOURBAR = """
<mujoco><option timestep="0.01"/><worldbody>
  <body name="a" pos="0 0 1"><joint name="ja" axis="0 1 0"/><geom size="0.01" mass="0.1"/>
    <body name="b" pos="0 0 -0.2"><joint name="jb" axis="0 1 0"/><geom size="0.01" mass="0.1"/>
      <site name="mid" pos="0.15 0 0"/></body></body>
  <body name="c" pos="0.3 0 1"><joint name="jc" axis="0 1 0"/><geom size="0.01" mass="0.1"/>
    <site name="far" pos="0 0 -0.2"/></body>
</worldbody>LOOP<actuator><motor name="m" joint="ja" ctrlrange="0 1"/></actuator></mujoco>
"""
LOOP = '<equality><connect body1="b" body2="c" anchor="0.3 0 0"/></equality>'


def test_closed_loop_determines_the_unmeasured_joint(tmp_path: Path):
    robot = describe(tmp_path, FOURBAR.replace("LOOP", LOOP), tracked="mid")
    angle = 0.5 * np.sin(2 * np.pi * 0.5 * np.arange(150) / RATE)
    qpos = np.stack([angle, -angle, angle], axis=1)  # a parallelogram
    motion = reconstruct(capture(robot, qpos), robot)
    np.testing.assert_allclose(motion.qpos[3:-3], qpos[::5][: len(motion.qpos)][3:-3], atol=0.02)
    read_description(describe(tmp_path, FOURBAR.replace("LOOP", LOOP), tracked="mid", points=["far"]).file)
    with pytest.raises(InputError, match="to another robot than mid"):
        describe(tmp_path, FOURBAR.replace("LOOP", ""), tracked="mid", points=["far"])
    open_chain = describe(tmp_path, FOURBAR.replace("LOOP", ""), tracked="mid")
    with pytest.raises(InputError, match="nothing that is measured shows the joint jc"):
        reconstruct(capture(robot, qpos), open_chain)


def test_a_misplaced_site_is_named(tmp_path: Path):
    """A wrong offset of a body may also stretch a fitted leg, which then hides how far it is bent."""
    robot = describe(tmp_path, FOURBAR.replace("LOOP", LOOP), tracked="mid")
    angle = 0.5 * np.sin(2 * np.pi * 0.5 * np.arange(150) / RATE)
    recording = capture(robot, np.stack([angle, -angle, angle], axis=1))
    assert describe_fit([reconstruct(recording, robot)]) is None
    assert recording.tracked_position is not None
    moved = dataclasses.replace(recording, tracked_position=recording.tracked_position + [0, 0.02, 0])
    assert "the recorded mid is 20 mm (RMS) from the model's best fit" in (
        describe_fit([reconstruct(moved, robot)]) or ""
    )
    open_chain = describe(tmp_path, FOURBAR.replace("LOOP", ""), tracked="mid")
    with pytest.raises(InputError, match="the joint jc; the recorded mid is 20 mm"):
        reconstruct(moved, open_chain)


def test_joint_equality_determines_the_coupled_joint(tmp_path: Path):
    """The angle of the second joint is 0.1 rad plus half the angle of the first."""
    coupled = '<equality><joint joint1="jc" joint2="ja" polycoef="0.1 0.5 0 0 0"/></equality>'
    robot = describe(tmp_path, FOURBAR.replace("LOOP", coupled), tracked="mid")
    angle = 0.5 * np.sin(2 * np.pi * 0.5 * np.arange(150) / RATE)
    qpos = np.stack([angle, -angle, 0.1 + 0.5 * angle], axis=1)
    motion = reconstruct(capture(robot, qpos), robot)
    np.testing.assert_allclose(motion.qpos[3:-3, 2], qpos[::5][: len(motion.qpos)][3:-3, 2], atol=0.02)


ROVER = """
<mujoco><option timestep="0.01"/><worldbody><body name="chassis" pos="0 0 0.05"><freejoint/>
  <geom type="box" size="0.1 0.06 0.02" mass="0.5"/><site name="deck" pos="0 0 0.05"/>
  <body name="w" pos="0 0.08 0"><joint name="wheel" axis="0 1 0"/><geom size="0.05" mass="0.05"/>
    <site name="rim" pos="0.04 0 0"/></body>
</body></worldbody><actuator><motor name="m" joint="wheel" ctrlrange="0 1"/></actuator></mujoco>
"""


@pytest.mark.parametrize(
    ("seen", "speed"),
    [
        ("counted on", 5.0),
        ("wrapped", 5.0),
        ("wrapped, with gaps", 5.0),
        ("by a marker", 5.0),
        ("by a marker", 20.0),
        ("by a marker", -31.4),
    ],
)
def test_wheel_angle_is_continuous_over_many_turns(tmp_path: Path, seen: str, speed: float):
    """The wheel turns at a constant speed (rad/s). It is measured by a continuous encoder, by an encoder that wraps at
    each turn, or by a marker at the rim. The recording is written to a file and read back."""
    marker = seen == "by a marker"
    robot = describe(
        tmp_path, ROVER, tracked="deck", points=["rim"] if marker else [], joints=[] if marker else ["wheel"]
    )
    time = np.arange(600) / RATE
    qpos = np.zeros((600, 8))
    qpos[:, 0], qpos[:, 2], qpos[:, 3], qpos[:, 7] = 0.25 * time, 0.05, 1.0, speed * time
    recording = capture(robot, qpos, joints=robot.joints, noise=1e-4)
    if seen.startswith("wrapped"):
        angle = qpos[:, 7] % (2 * np.pi)
        if seen.endswith("gaps"):  # around each restart, and in between
            angle[(angle < 0.2) | (angle > 6.1) | (np.abs(angle - 3.0) < 0.2)] = np.nan
            angle[0] = 0.0
        recording = dataclasses.replace(recording, joint_angles={"wheel": angle})
    write_recording(recording, tmp_path / "drive.csv", robot)
    motion = reconstruct(read_recording(tmp_path / "drive.csv", robot), robot)
    np.testing.assert_allclose(motion.qvel[3:-3, 6], speed, atol=0.3)
    np.testing.assert_allclose(motion.qpos[3:-3, 7] - motion.qpos[3, 7], speed * (motion.time[3:-3] - 0.15), atol=0.03)


TREE = """
<mujoco><compiler angle="radian"/><worldbody><body name="root" pos="0 0 1"><freejoint/><geom size="0.1" mass="1"/>
  <body name="a" pos="0.1 0.2 0.3" quat="0.9 0.1 0.3 0.2"><joint name="h1" axis="1 2 3" pos="0.01 0.02 0.03"/>
    <joint name="s1" type="slide" axis="0 1 1" ref="0.1"/><joint name="h2" axis="0 0 1" ref="0.4"/>
    <geom size="0.1" mass="1"/>
    <body name="b" pos="0 0 0.2"><geom size="0.1" mass="1"/><site name="tip" pos="0.1 0 0.2"/></body></body>
  <body name="c" pos="-0.1 0 0"><joint name="h3" axis="0 1 0"/><geom size="0.1" mass="1"/></body>
</body></worldbody></mujoco>
"""


def test_kinematics_and_jacobians_match_mujoco():
    model = mujoco.MjModel.from_xml_string(TREE)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    qpos = rng.normal(size=(10, model.nq))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    site, body = model.site("tip"), model.body("b").id
    tree = KinematicTree(model, [(body, site.pos)], [body])
    poses = tree.pose(qpos)
    step = 0.3 * rng.normal(size=(10, model.nv))
    moved = tree.move(qpos, step)
    for i, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        np.testing.assert_allclose(poses.points[0][i], data.site("tip").xpos, atol=1e-12)
        np.testing.assert_allclose(poses.rotations[0][i].ravel(), data.xmat[body], atol=1e-12)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, linear, angular, site.id)
        np.testing.assert_allclose(tree.point_jacobian(poses, 0)[i], linear, atol=1e-12)
        np.testing.assert_allclose(tree.rotation_jacobian(poses, 0)[i], angular, atol=1e-12)
        mujoco.mj_integratePos(model, row, step[i], 1.0)
        np.testing.assert_allclose(moved[i], row, atol=1e-12)
