"""Viewing of robots that are not BALLU: shapes, replays, and every command on a run of the tethered balloon."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rover import write_rover

from ballu_mjx.cli import export, report, view
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.run_config import describe_run
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.runs.folder import Run
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE, StoredRollout, read_rollouts, write_rollouts
from ballu_mjx.viz import robot_meshes, viser_scene
from ballu_mjx.viz.style import label_of

BALLOON = Path(__file__).parents[2] / "experiments" / "tethered_balloon" / "balloon.robot.json"


def swing(robot: RobotDescription, states: int, seed: int) -> StoredRollout:
    """Return a rollout of a robot whose joints swing, as recording and in two simulators."""
    rng, model = np.random.default_rng(seed), robot.load_model()
    time = np.arange(states) * robot.control_timestep
    first = 0 if robot.anchored else 7
    qpos = np.tile(robot.adapter.initial_qpos(robot, model), (states, 1))
    qpos[:, first:] += 0.1 * np.sin(3 * time[:, None] + rng.uniform(0, 6, model.nq - first))
    low, high = np.array(robot.command_ranges).T
    return StoredRollout(
        name="flight-1",
        description=robot,
        robot="hardware",
        time=time,
        qpos={"recording": qpos, "vanilla": qpos + 0.0, "envmimic": qpos + 0.0},
        command=rng.uniform(low, high, (states - 1, len(low))),
        force=0.02 * rng.normal(size=(states - 1, 3)),
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an EnvMimic run of the tethered balloon."""
    folder, robot = tmp_path_factory.mktemp("balloon") / "run", read_description(BALLOON)
    sections = {"env": EnvMimicConfig(), "ppo": PPOConfig()}
    with Run(folder, describe_run("envmimic", sections, {}, [], description=robot)) as made:
        made.log(100, {"reward": 1.0, "validation_error": 0.9})
        made.log(200, {"reward": 1.1, "validation_error": 0.8})
    write_rollouts(folder / ROLLOUT_FILE, [swing(robot, 30, 0)])
    return folder


def test_replays_of_any_robot_are_read_back(tmp_path: Path):
    for robot in (read_description(BALLOON), write_rover(tmp_path)):
        stored = swing(robot, 12, 1)
        write_rollouts(tmp_path / "replay.npz", [stored])
        (found,) = read_rollouts(tmp_path / "replay.npz")
        assert found.description.name == robot.name and found.description.sha256 == robot.sha256
        for name, qpos in stored.qpos.items():
            np.testing.assert_allclose(found.qpos[name], qpos, atol=1e-6)
        assert found.command is not None and stored.command is not None
        np.testing.assert_allclose(found.command, stored.command, atol=1e-5)


def test_replay_of_a_changed_robot_is_refused(tmp_path: Path):
    robot = write_rover(tmp_path)
    write_rollouts(tmp_path / "replay.npz", [swing(robot, 12, 1)])
    robot.model.write_text(robot.model.read_text().replace('mass="1.5"', 'mass="1.6"'))
    with pytest.raises(view.InputError, match=r"rover\.robot\.json: the robot description, or its model, has changed"):
        read_rollouts(tmp_path / "replay.npz")
    robot.file.unlink()
    with pytest.raises(view.InputError, match="the robot description is missing"):
        read_rollouts(tmp_path / "replay.npz")
    with np.load(tmp_path / "replay.npz") as archive:
        arrays = dict(archive)
    arrays["robot/path"] = np.zeros((11, 3))
    np.savez(tmp_path / "replay.npz", **arrays)  # pyright: ignore[reportArgumentType]
    with pytest.raises(view.InputError, match=r"replay\.npz: does not name its robot"):
        read_rollouts(tmp_path / "replay.npz")


def test_rollouts_of_two_robots_in_one_file_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="one robot"):
        write_rollouts(tmp_path / "x.npz", [swing(read_description(BALLOON), 5, 0), swing(write_rover(tmp_path), 5, 0)])


def test_shapes_of_primitives_and_meshes_agree_with_the_model(tmp_path: Path):
    """The bounds of the vertices of each kind of geom are those that MuJoCo computes."""
    robot = write_rover(tmp_path)
    model = robot.load_model()
    parts = {model.body(part.body).name: part for part in robot_meshes.parts(model)}
    assert set(parts) == {"hull", "arm", "rod", "lid"}  # without the floor
    for name, part in parts.items():
        geom = int(np.flatnonzero(model.geom_bodyid == model.body(name).id)[0])
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        local = (part.vertices - model.geom_pos[geom]) @ rotation.reshape(3, 3)
        centre, half = model.geom_aabb[geom][:3], model.geom_aabb[geom][3:]
        np.testing.assert_allclose(local.max(axis=0), centre + half, atol=3e-3, err_msg=name)
        np.testing.assert_allclose(local.min(axis=0), centre - half, atol=3e-3, err_msg=name)
    opaque, translucent = robot_meshes.OPACITY, robot_meshes.TRANSLUCENT_OPACITY
    assert {name: part.opacity for name, part in parts.items()} == {
        "hull": opaque,
        "arm": opaque,
        "rod": translucent,
        "lid": opaque,
    }


def test_force_arrow_starts_at_the_tracked_body_and_scales_with_the_robot(tmp_path: Path):
    for robot in (read_description(BALLOON), write_rover(tmp_path)):
        shapes, rollout = robot_meshes.RobotShapes(robot), swing(robot, 5, 2)
        data = mujoco.MjData(shapes.model)
        data.qpos[:] = rollout.qpos["envmimic"][3]
        mujoco.mj_kinematics(shapes.model, data)
        poses = shapes.poses(rollout.qpos["envmimic"])
        body = shapes.model.site_bodyid[shapes.model.site(robot.tracked).id]
        np.testing.assert_allclose(poses.pushed[3], data.xipos[body], atol=1e-9)
        np.testing.assert_allclose(poses.tracked[3], data.site(robot.tracked).xpos, atol=1e-9)
        weight = 9.81 * shapes.model.body_mass.sum()
        # A force of 6.5 % of the weight has an arrow as long as the robot.
        assert shapes.arrow_scale * 0.065 * weight == pytest.approx(shapes.extent, rel=0.2)
        assert robot_meshes.pushed_robot(rollout) == "envmimic"


def test_scene_of_any_robot_is_played(tmp_path: Path):
    rollout = swing(write_rover(tmp_path), 10, 3)
    server = viser_scene.serve(0)
    try:
        player = view.Player(server, [rollout], 0)
        place = server.scene.get_handle_by_name("/world/EnvMimic/hull/arm")
        assert place is not None
        turned = np.array(place.wxyz)
        player.advance(0.2)
        assert player.state == 5 and np.abs(place.wxyz - turned).max() > 1e-3
    finally:
        server.stop()


def test_report_of_the_tethered_balloon(run: Path, capsys: pytest.CaptureFixture[str]):
    assert report.main([str(run)]) == 0
    assert "Written to" in capsys.readouterr().out
    text = (run / "report.html").read_text()
    assert "command, left" in text and "flight-1" in text and "the residual force, 1 m long for" in text


def test_view_of_the_tethered_balloon(run: Path):
    (rollout,) = view.load(run)
    assert rollout.description.name == "tethered balloon" and rollout.qpos["envmimic"].shape == (30, 5)


def test_export_of_a_residual_as_a_policy_is_refused(run: Path, capsys: pytest.CaptureFixture[str]):
    assert export.main(["policy", str(run)]) == 2
    error = capsys.readouterr().err
    assert "is a residual (envmimic)" in error and "export that" in error and error.count("\n") == 1
    assert not (run / "export").exists()


def test_replay_has_the_documented_format(run: Path):
    with np.load(run / ROLLOUT_FILE) as file:
        assert str(file["format"]) == "ballu-replay/2" and str(file["robot/path"]).endswith("balloon.robot.json")
        assert json.loads((run / "config.json").read_text())["robot_description"]["sha256"] == str(file["robot/sha256"])


def test_a_rerun_file_holds_the_poses_of_every_robot(run: Path, tmp_path: Path):
    rerun = pytest.importorskip("rerun", reason='rerun-sdk is not installed: pip install -e ".[rerun]"')
    path = tmp_path / "replay.rrd"
    assert view.main([str(run), "--rerun", str(path)]) == 0
    chunks = {
        chunk.entity_path: chunk.to_record_batch() for chunk in rerun.chunk.RrdReader(str(path)).stream().to_chunks()
    }
    (rollout,) = read_rollouts(run / ROLLOUT_FILE)
    model = rollout.description.load_model()
    data = mujoco.MjData(model)
    data.qpos[:] = rollout.qpos["envmimic"][7]
    mujoco.mj_kinematics(model, data)
    # Compose the poses down the tree of bodies, as the viewer does.
    body, place, turn = model.nbody - 1, np.zeros(3), np.array([1.0, 0, 0, 0])
    above = [body]
    while model.body_parentid[above[0]] != 0:
        above.insert(0, model.body_parentid[above[0]])
    entity = f"/world/{label_of('envmimic')}"
    for each in above:
        entity += f"/{model.body(each).name}"
        row = chunks[entity].slice(7, 1).to_pydict()
        (x, y, z, w), moved = row["Transform3D:quaternion"][0][0], np.zeros(3)
        mujoco.mju_rotVecQuat(moved, np.array(row["Transform3D:translation"][0][0], float), turn)
        place, before = place + moved, turn.copy()
        mujoco.mju_mulQuat(turn, before, np.array([w, x, y, z], float))
    np.testing.assert_allclose(place, data.xpos[body], atol=1e-6)
    assert chunks["/world/force"].num_rows == len(rollout.time) - 1
    assert f"/command/{rollout.description.commands[0]}" in chunks


def test_missing_rerun_gives_one_line_with_the_package_to_install(run: Path, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert view.main([str(run), "--rerun", str(tmp_path / "replay.rrd")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and 'pip install -c constraints.txt -e ".[rerun]"' in error
    assert view.main([str(run), "--rerun", "x.rrd", "--mujoco"]) == 2
