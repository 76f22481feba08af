"""Robots other than BALLU: invalid descriptions, and simulation and reconstruction of a tethered balloon."""

import dataclasses
import gzip
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import CONTROL_TIMESTEP
from ballu_mjx.cli import train
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import read_recording, write_recording
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv, tracking_state
from ballu_mjx.residuals.network_loads import load_units, world_loads
from ballu_mjx.residuals.run_config import describe_recording, find_recordings, run_robot
from ballu_mjx.robots.description import read_description
from ballu_mjx.robots.model import assets
from ballu_mjx.robots.registry import describe_robot, load_robot
from ballu_mjx.sim.observation import HISTORY, heading_observation
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import count_substeps

BALLOON = Path(__file__).parents[2] / "experiments" / "tethered_balloon"
DESCRIPTION = read_description(BALLOON / "balloon.robot.json")
PUSH = np.array([0.06, 0.03, 0.0])
SECONDS = 6.0


def fly(seconds: float = SECONDS) -> tuple[Recording, np.ndarray, np.ndarray]:
    """Return a flight of the balloon's model under a constant push, without noise, and its qpos and qvel at 100 Hz."""
    model = DESCRIPTION.load_model()
    data = mujoco.MjData(model)
    data.xfrc_applied[model.body("balloon").id, :3] = PUSH
    commands = np.repeat(np.random.default_rng(0).uniform(0, 1, (round(seconds / 0.5), 2)), 50, axis=0)
    site_positions, quaternions, qpos, qvel = [], [], [], []
    for command in commands:
        data.ctrl[:] = command
        mujoco.mj_kinematics(model, data)
        site_positions.append([data.site(site).xpos.copy() for site in ("balloon", "knot")])
        quaternions.append(data.body("balloon").xquat.copy())
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        mujoco.mj_step(model, data)
    positions = np.array(site_positions)
    flight = Recording(
        name="flight", kind="free", robot="balloon-0", time=np.arange(len(commands)) / 100, command=commands,
        tracked_position=positions[:, 0], tracked_quaternion=np.array(quaternions),
        points={"knot": positions[:, 1]},
    )  # fmt: skip
    return flight, np.array(qpos), np.array(qvel)


@pytest.fixture(scope="module")
def flight() -> tuple[Recording, np.ndarray, np.ndarray]:
    return fly()


@pytest.fixture(scope="module")
def motion(flight: tuple[Recording, np.ndarray, np.ndarray]) -> Motion:
    return reconstruct(flight[0], DESCRIPTION)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for name in ("balloon.xml", "balloon.robot.json"):
        shutil.copy(BALLOON / name, tmp_path)
    return tmp_path / "balloon.robot.json"


def test_ballus_description_has_the_columns_of_its_recordings():
    description = load_robot()
    header = (assets() / "recordings" / "training" / "gait-00-take-1.csv.gz").open("rb")
    with header, gzip.open(header) as stream:
        first = stream.readline().decode().strip().split(",")
    assert set(description.columns) == {*first, *description.joints}
    assert not description.anchored


def in_json(**changes: Any) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        content = json.loads(path.read_text()) | changes
        path.write_text(json.dumps({key: value for key, value in content.items() if value is not ...}))

    return damage


def in_model(old: str, new: str) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        text = path.with_name("balloon.xml").read_text()
        assert old in text
        path.with_name("balloon.xml").write_text(text.replace(old, new))

    return damage


BUOY = '<body><freejoint name="afloat"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
SWIVEL = '<joint name="swivel" axis="0 0 1" stiffness="0.008"/>'


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "no such file"),
        (lambda path: path.write_text("{"), "not JSON"),
        (in_json(format="ballu-robot/2"), '"format" is'),
        (in_json(points=...), '"points" is missing'),
        (in_json(feet=["a"]), "no key 'feet'"),
        (in_json(name=" "), '"name" is'),
        (in_json(model="nothing.xml"), "there is no file"),
        (in_json(model="balloon.robot.json"), "MuJoCo cannot read"),
        (in_json(tracked="ballon"), "'ballon', which is no site of the model; there are knot, balloon"),
        (in_json(points="knot"), "a list of names"),
        (in_json(points=["knot", "knot"]), "a name twice"),
        (in_json(points=["balloon"]), "two columns balloon_x"),
        (in_json(points=["kn,ot"]), "letters, digits"),
        (in_json(commands={"left": "propeller_left"}), "all in its order: propeller_left, propeller_right"),
        (in_json(commands={"left": "propeller_right", "right": "propeller_left"}), "in its order"),
        (in_json(commands=[]), '"commands" is'),
        (in_json(joints=["knee"]), "no joint of the model"),
        (in_json(adapter="SpotMini"), 'which cannot be imported'),
        (in_json(adapter="pathlib:Path"), "no RobotAdapter"),
        (in_json(adapter="ballu_mjx.ballu.adapter:Ballu"), "other base than BALLU; leave it out"),
        (in_json(control_timestep=0.0), '"control_timestep" is 0.0'),
        (in_json(control_timestep=0.015), "divide the control step of 0.015 s"),
        (in_json(keyframe="hover"), "no keyframe of the model; there are none"),
        (in_json(oriented_points=["balloon"]), 'not among "points"'),
        (in_json(control_timestep=0.25, horizons=[0.1, 1]), "seconds from 0.25 to 100"),
        (in_json(limits={"height": [3, 1]}), '"limits: height" is'),
        (in_json(limits={"speed": -1}), "above 0"),
        (in_json(limits={"depth": 1}), "some of height, distance, speed, angle"),
        (in_json(mirror={"left": "rihgt"}), '"mirror" names'),
        (in_json(mirror={"left": "right", "right": "left"}), "a name twice"),
        (in_json(commands={"left": {"actuator": "propeller_left"}, "right": "propeller_right"}), "for left"),
        (in_model(SWIVEL, '<joint name="swivel" type="ball"/>'), "a ball joint"),
        (in_model("</worldbody>", BUOY + "</worldbody>"), "a free joint that is not the first joint, 'afloat'"),
        (in_model("<worldbody>", "<worldbody>" + BUOY), "a free joint that does not move the site balloon, 'afloat'"),
        (in_model('timestep="0.01"', 'timestep="0.015"'), "divide the control step"),
        (in_model('ctrlrange="0 1"', 'ctrllimited="false"'), "has no ctrlrange"),
        (in_model('<body name="lower"', '<site name="tripod"/><body name="lower"'), ""),
    ],
)  # fmt: skip
def test_damaged_description_is_refused_with_file_and_key(
    copy: Path, damage: Callable[[Path], None], message: str
) -> None:
    damage(copy)
    if not message:  # a site that does not move is valid unless it is a point
        read_description(copy)
        in_json(points=["tripod"])(copy)
        message = "does not move"
    with pytest.raises(InputError) as refused:
        read_description(copy)
    assert message in str(refused.value) and copy.name in str(refused.value) and "\n" not in str(refused.value)


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
HULL = """<mujoco>
  <asset><mesh name="hull" file="hull.obj"/></asset>
  <worldbody><body name="hull" pos="0 0 1">
    <freejoint/> <inertial pos="0 0 0" mass="0.15" diaginertia="2e-3 2e-3 2e-3"/>
    <geom type="mesh" mesh="hull"/> <site name="imu"/> <site name="thruster"/>
  </body></worldbody>
  <include file="thruster.xml"/>
</mujoco>"""
THRUSTER = '<mujoco><actuator><general site="thruster" name="thruster" ctrlrange="0 1"/></actuator></mujoco>'


@pytest.fixture
def split_model(tmp_path: Path) -> Path:
    """Return a description whose model has nested include files, and meshes in two folders."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "meshes").mkdir()
    (tmp_path / "robot.xml").write_text(
        '<mujoco><option timestep="0.01"/><compiler meshdir="meshes"/><include file="parts/hull.xml"/>'
        '<asset><mesh name="fin" file="fin.obj"/></asset></mujoco>'
    )
    (tmp_path / "parts" / "hull.xml").write_text(HULL)
    (tmp_path / "parts" / "thruster.xml").write_text(THRUSTER)
    (tmp_path / "parts" / "hull.obj").write_text(TETRAHEDRON)  # MuJoCo finds it beside the file that names it
    (tmp_path / "meshes" / "fin.obj").write_text(TETRAHEDRON)
    content = {"format": "ballu-robot/1", "name": "blimp", "model": "robot.xml", "tracked": "imu"}
    content |= {"points": [], "commands": {"up": "thruster"}}
    (tmp_path / "blimp.robot.json").write_text(json.dumps(content))
    return tmp_path / "blimp.robot.json"


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("robot.xml", 'timestep="0.01"', 'timestep="0.005"'),
        ("parts/hull.xml", "0.15", "0.30"),
        ("parts/thruster.xml", "0 1", "0 2"),
        ("parts/hull.obj", "v 1 0 0", "v 2 0 0"),
        ("meshes/fin.obj", "v 1 0 0", "v 2 0 0"),
    ],
)
def test_change_of_any_file_of_the_model_is_refused(split_model: Path, name: str, old: str, new: str) -> None:
    # The description passes through JSON, as in a run's folder. Runs of earlier versions have one hash of all files.
    described = json.loads(json.dumps(describe_robot(read_description(split_model))))
    stored, earlier = ({"robot_description": each} for each in (described, {**described, "files": None}))
    run_robot(stored, split_model.parent)
    changed = split_model.parent / name
    text = changed.read_text()
    assert old in text
    changed.write_text(text.replace(old, new))
    problem = "the robot description, or its model, has changed since .* was written"
    with pytest.raises(InputError, match=rf"{problem} \({re.escape(name)}\); restore it"):
        run_robot(stored, split_model.parent)
    with pytest.raises(InputError, match=f"{problem}; restore it"):
        run_robot(earlier, split_model.parent)
    changed.write_text(text)
    run_robot(stored, split_model.parent)


def test_change_of_the_json_file_of_a_recording_is_refused(
    flight: tuple[Recording, np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    path = tmp_path / "flight.csv"
    write_recording(flight[0], path, DESCRIPTION)
    before = describe_recording(path)
    content = json.loads((tmp_path / "flight.json").read_text())
    (tmp_path / "flight.json").write_text(json.dumps(content | {"robot": "another"}))
    assert describe_recording(path)["sha256"] != before["sha256"]
    with pytest.raises(InputError, match="the recording has changed"):
        find_recordings({"recordings": {"test": [before]}}, "test", tmp_path, "--test")


def test_other_robots_require_the_option_recordings(capsys: pytest.CaptureFixture[str]):
    for command in ("sysid", "envmimic", "supervised", "analytic", "aerodynamic"):
        assert train.main([command, "--robot", str(DESCRIPTION.file)]) == 2
        error = capsys.readouterr().err
        assert "--recordings" in error and DESCRIPTION.name in error and error.count("\n") == 1


def test_recordings_are_the_same_after_writing_and_reading(
    flight: tuple[Recording, np.ndarray, np.ndarray], tmp_path: Path
):
    write_recording(flight[0], tmp_path / "flight.csv", DESCRIPTION)
    found = read_recording(tmp_path / "flight.csv", DESCRIPTION)
    np.testing.assert_allclose(found.points["knot"], flight[0].points["knot"], atol=6e-6)
    assert found.tracked_position is not None and flight[0].tracked_position is not None
    np.testing.assert_allclose(found.tracked_position, flight[0].tracked_position, atol=6e-6)
    with pytest.raises(InputError, match="unknown column"):
        read_recording(tmp_path / "flight.csv", load_robot())
    header, rest = (tmp_path / "flight.csv").read_text().split("\n", 1)
    (tmp_path / "flight.csv").write_text(header.replace("knot_y", "knot_w") + "\n" + rest)
    with pytest.raises(InputError, match="knot_w"):
        read_recording(tmp_path / "flight.csv", DESCRIPTION)


def test_reconstruction_recovers_the_states_of_the_balloon(
    flight: tuple[Recording, np.ndarray, np.ndarray], motion: Motion
):
    every = round(CONTROL_TIMESTEP * 100)
    inner = slice(4, -4)  # filters have fewer samples at the ends
    count = len(motion.qpos)
    qpos, qvel = (values[::every][:count] for values in flight[1:])
    assert np.abs(motion.qpos - qpos)[inner].max() < 0.01
    error = np.abs(motion.qvel - qvel)[inner]
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(qvel**2))
    assert max(motion.fit_error_mm.values()) < 0.1


def test_reconstruction_recovers_a_free_robot_far_from_its_initial_pose(tmp_path: Path):
    """The balloon's model has a free joint here. Its pose is far from the one where the search begins."""
    text = (BALLOON / "balloon.xml").read_text()
    joints = '<joint name="tilt_x" axis="1 0 0"/>\n      <joint name="tilt_y" axis="0 1 0"/>'
    assert joints in text
    (tmp_path / "balloon.xml").write_text(text.replace(joints, '<freejoint name="root"/>'))
    shutil.copy(BALLOON / "balloon.robot.json", tmp_path)
    open_ended = read_description(tmp_path / "balloon.robot.json")
    in_json(joints=["bend_x", "bend_y", "swivel"])(tmp_path / "balloon.robot.json")
    found = read_description(tmp_path / "balloon.robot.json")
    assert not found.anchored
    model = found.load_model()
    data = mujoco.MjData(model)
    time = np.arange(150) / 100
    rotation = Rotation.from_euler("ZY", np.column_stack([2.0 + time, 0.5 * np.sin(2 * time)])).as_quat(
        scalar_first=True
    )
    site_positions, quaternions = [], []
    for t, quaternion in zip(time, rotation, strict=True):
        data.qpos[:] = [1 + 0.3 * t, -2, 0.5, *quaternion, 0.2 * np.sin(3 * t), 0.1, 0.3 * t]
        mujoco.mj_kinematics(model, data)
        site_positions.append([data.site(site).xpos.copy() for site in ("balloon", "knot")])
        quaternions.append(data.body("balloon").xquat.copy())
    positions = np.array(site_positions)
    recording = Recording(
        name="loose", kind="free", robot="loose", time=time, command=np.zeros((len(time), 2)),
        tracked_position=positions[:, 0], tracked_quaternion=np.array(quaternions),
        points={"knot": positions[:, 1]},
        joint_angles={"bend_x": 0.2 * np.sin(3 * time), "bend_y": np.full(len(time), 0.1), "swivel": 0.3 * time},
    )  # fmt: skip
    motion = reconstruct(recording, found, model)
    np.testing.assert_allclose(motion.qvel[10, :3], [0.3, 0, 0], atol=0.02)
    np.testing.assert_allclose(motion.qvel[10, -1], 0.3, atol=0.02)
    np.testing.assert_allclose(motion.qpos[10, :3], [1.15, -2, 0.5], atol=0.005)
    with pytest.raises(InputError, match="nothing that is measured shows the joint"):
        reconstruct(dataclasses.replace(recording, joint_angles={}), open_ended, model)


def test_joint_that_no_measurement_shows_is_named(flight: tuple[Recording, np.ndarray, np.ndarray], copy: Path):
    inertia = '<inertial pos="0 0 0" mass="0.001" diaginertia="1e-6 1e-6 1e-6"/>'
    site = '<site name="propeller_left"'
    in_model(site, f'<body><joint name="fan"/>{inertia}</body>{site}')(copy)
    hidden = read_description(copy)
    with pytest.raises(InputError, match="joint fan"):
        reconstruct(flight[0], hidden)


def test_points_that_do_not_fit_the_model_are_refused(flight: tuple[Recording, np.ndarray, np.ndarray]):
    moved = {"knot": flight[0].points["knot"] + [0.0, 0.0, 0.4]}
    with pytest.raises(InputError, match="from the model's best fit"):
        reconstruct(dataclasses.replace(flight[0], points=moved), DESCRIPTION)


@pytest.fixture(scope="module")
def env(motion: Motion) -> EnvMimicEnv:
    config = EnvMimicConfig(forces="force", start_noise=0.0, observation_noise=0.0)
    return EnvMimicEnv(Simulator(DESCRIPTION), [motion], config)


def test_environment_steps_as_c_mujoco_does(env: EnvMimicEnv):
    """The action is the push in the recording. The simulation matches C MuJoCo and stays on the recording."""
    state = jax.jit(env.reset)(jax.random.key(3))
    start = tracking_state(state)
    model = DESCRIPTION.load_model()
    data = mujoco.MjData(model)
    physics = start.rollout.physics
    data.qpos[:], data.qvel[:] = np.asarray(physics.qpos), np.asarray(physics.qvel)
    data.xfrc_applied[model.body("balloon").id, :3] = PUSH
    step = jax.jit(env.step)
    for number in range(10):
        data.ctrl[:] = np.asarray(env.reference.command[0, int(start.time) + number])
        mujoco.mj_step(model, data, count_substeps(model, CONTROL_TIMESTEP))
        state = step(state, jnp.asarray(PUSH / load_units(env.config, DESCRIPTION), jnp.float32))
    after = tracking_state(state)
    np.testing.assert_allclose(after.rollout.physics.qpos, data.qpos, atol=2e-4)
    mujoco.mj_forward(model, data)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, model.site("knot").id, velocity, 0)
    features = after.rollout.features
    assert features.shape == (DESCRIPTION.features,)
    np.testing.assert_allclose(features[9:12], data.site("knot").xpos, atol=2e-4)
    np.testing.assert_allclose(features[12:15], velocity[3:], atol=1e-3)
    target = env.reference.features[0, int(after.time)]
    assert float(jnp.linalg.norm(features[:3] - target[:3])) < 0.01


def test_observation_and_force_of_an_anchored_robot_are_in_world_frame(motion: Motion, env: EnvMimicEnv):
    """Wind does not turn with the robot. The residual's input and its force do not turn either."""
    history = env.reference.features[0, 10:13]
    rotated = history.at[:, 8].add(1.0)
    observation, rotated_observation = (heading_observation(each, anchored=True) for each in (history, rotated))
    changed = np.flatnonzero(np.abs(observation - rotated_observation) > 1e-6)
    assert len(changed) == HISTORY, "only the yaw may change"
    np.testing.assert_allclose(np.sort(np.asarray(observation)[:3]), np.sort(np.asarray(history[0, :3])), atol=1e-6)
    force = world_loads(
        jnp.array([1.0, 2.0, 3.0]),
        rotated[-1, 8],
        EnvMimicConfig(forces="force", force_scale=0.05, force_limit=1.0),
        DESCRIPTION,
    )
    np.testing.assert_allclose(force, [0.05, 0.1, 0.15], atol=1e-6)


@pytest.mark.slow
def test_envmimic_trains_and_evaluates_another_robot_from_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Run the command with a description and a recording, and evaluate the run."""
    from ballu_mjx.cli import evaluate

    write_recording(fly(7.0)[0], tmp_path / "flight.csv", DESCRIPTION)
    arguments = [
        "envmimic", "--robot", str(DESCRIPTION.file), "--recordings", str(tmp_path / "flight.csv"),
        "--output", str(tmp_path / "run"), "--num-timesteps", "160", "--num-envs", "8", "--batch-size", "8",
        "--num-minibatches", "2", "--unroll-length", "5", "--num-updates-per-batch", "1", "--validate-every", "160",
        "--policy-layers", "16", "--value-layers", "16",
    ]  # fmt: skip
    assert train.main(arguments) == 0
    stored = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert stored["residual"][0]["mean_force"] > 0
    capsys.readouterr()
    assert evaluate.main([str(tmp_path / "run")]) == 0
    assert f"{stored['residual'][0]['position']['5.0'][0]:.3f}" in capsys.readouterr().out
    assert train.main(["walk", "--robot", "ballu", "--residual", str(tmp_path / "run")]) == 2
    assert "is of the robot tethered balloon, not of BALLU" in capsys.readouterr().err
    assert train.main(["walk", "--residual", str(tmp_path / "run")]) == 2  # the robot is the one of the residual
    assert "needs a free-floating robot; tethered balloon is anchored" in capsys.readouterr().err
