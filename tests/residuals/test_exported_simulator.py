"""The exported simulator: it needs only NumPy and MuJoCo and agrees with ours, for all residuals and a drivetrain."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from plain_push import PlainPush
from rover import write_rover
from servo_arm import TRUTH, identified, write_arm

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.actuators import read_actuators
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.residuals.aerodynamics import Aerodynamics, AirParameters
from ballu_mjx.residuals.deploy.export import export_simulator, rollout_in_double
from ballu_mjx.residuals.deploy.residual import PARAMETERS_FILE, SETTINGS_FILE, ImprovedSimulator, NetworkPart
from ballu_mjx.residuals.fluid import FluidParameters, FluidResidual
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import network_input, network_input_names, num_inputs
from ballu_mjx.residuals.network_loads import load_names, load_units, num_loads
from ballu_mjx.residuals.training_range import FadingResidual, TrainingRange
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.robots.mjcf import write_mjcf
from ballu_mjx.robots.model import assets
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.c_model import improved_model
from ballu_mjx.sim.force_sets import ForceSet
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

BALLOON = Path(__file__).parents[2] / "experiments" / "tethered_balloon" / "balloon.robot.json"
CLEAN = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("jax", "jaxlib", "jaxtyping", "brax", "flax", "scipy", "ballu_mjx"):
            raise ImportError(name + " is not there")

sys.meta_path.insert(0, Refuse())
sys.path.insert(0, sys.argv[1])
import residual

sys.exit(residual.self_test(sys.argv[1]))
"""
"""Program that runs an exported simulator with NumPy and MuJoCo alone."""


SCALES: dict[ForceSet, tuple[float, ...]] = {"joints": (0.05, 0.02), "commands": (0.1, 0.2)}
"""Scales of the arm's loads."""


def network(
    robot: RobotDescription, forces: ForceSet, seed: int = 0, activation: Any = "swish", **settings: Any
) -> BoundResidual:
    """Return a random network residual with forces of tenths of a newton."""
    config = ForceNetworkConfig(
        forces=forces, force_scale=0.1, torque_scale=0.01, force_limit=1.0, scales=SCALES.get(forces, ()), **settings
    )
    options = PPOConfig(policy_layers=(16, 8), value_layers=(4,), activation=activation)
    rng = np.random.default_rng(seed)
    inputs, loads = num_inputs(config, robot), num_loads(config, robot)
    params = ppo.initial_policy(rng.normal(size=(50, inputs)), loads, options)
    tree: Any = jax.device_get(params.policy)
    tree["params"]["Dense_0"]["kernel"] = 100.0 * tree["params"]["Dense_0"]["kernel"]
    infer = ppo.make_inference({ppo.STATE: (inputs,)}, loads, options)
    forces_by_it = NetworkResidual(config, robot, infer, name="envmimic", network=options)
    return BoundResidual(forces_by_it, params._replace(policy=tree))


def fading(bound: BoundResidual) -> BoundResidual:
    """Return a network residual with fading, for a training range that the arm leaves."""
    assert isinstance(bound.model, NetworkResidual)
    observed = seen_range(num_inputs(bound.model.config, bound.model.robot))
    return BoundResidual(FadingResidual(bound.model, 1.0), (bound.params, observed))


def seen_range(inputs: int) -> TrainingRange:
    return TrainingRange(np.full(inputs, -0.6, np.float32), np.full(inputs, 0.6, np.float32))


def fluid(robot: RobotDescription) -> BoundResidual:
    model = FluidResidual(robot, robot.load_model(), "cubic")
    rng = np.random.default_rng(1)
    table = jnp.asarray(0.02 * rng.normal(size=(len(model.terms), 6)), jnp.float32)
    return BoundResidual(model, FluidParameters.without_added_mass(table))


def air(robot: RobotDescription, delay: float) -> BoundResidual:
    params = dataclasses.replace(
        AirParameters.none(),
        added_mass=jnp.float32(0.05),
        added_inertia=jnp.float32(1e-3),
        lift=jnp.float32(0.02),
        centre=jnp.array([0.002, -0.003, 0.001]),
        linear_drag=jnp.array([0.1, 0.2, 0.3]),
        quadratic_drag=jnp.array([0.3, 0.2, 0.1]),
        turning_drag=jnp.array([0.01, 0.02, 0.01]),
        delay=jnp.float32(delay),
        friction=jnp.float32(-0.1),
    )
    return BoundResidual(Aerodynamics(robot, robot.load_model()), params)


def rover(folder: Path) -> AugmentedSimulator:
    """Return a simulator with three residuals: a network for forces at the points, a fluid, and a second network with
    input and forces in the world frame."""
    robot = write_rover(folder)
    text = robot.model.read_text()
    # Contacts are disabled, because MJX and C MuJoCo find different points of contact between a box and a plane.
    robot.model.write_text(text.replace("<option ", '<option gravity="0 0 -0.1" ').replace("<worldbody>", OFF, 1))
    robot = read_description(robot.file)
    simulator = Simulator(robot).with_residual(network(robot, "multi"))
    in_the_world = network(robot, "wrench", 1, "tanh", relative_observation=False, heading_frame=False)
    return simulator.with_residual(fluid(robot)).with_residual(in_the_world)


def arm(folder: Path) -> AugmentedSimulator:
    """Return an anchored robot with an identified drivetrain and networks for its body, its joints and its commands.

    The loads of the first network fade outside of its training range.
    """
    robot = write_arm(folder)
    simulator = Simulator(robot, identified(robot, **TRUTH)).with_residual(fading(network(robot, "force")))
    return simulator.with_residual(network(robot, "joints", 1)).with_residual(network(robot, "commands", 2))


def balloon(folder: Path) -> AugmentedSimulator:
    """Return a simulator with aerodynamics, which change the model's mass and delay commands."""
    robot = read_description(BALLOON)
    return Simulator(robot).with_residual(air(robot, 0.07))


OFF = '<option><flag contact="disable"/></option>\n  <worldbody>'
MAKERS = {"rover": rover, "arm": arm, "balloon": balloon}
EACH = [pytest.param(name, marks=() if name == "arm" else pytest.mark.slow) for name in MAKERS]
CASES: dict[str, tuple[AugmentedSimulator, Path, tuple[float, float]]] = {}


def exported(name: str, folder: Path) -> tuple[AugmentedSimulator, Path, tuple[float, float]]:
    """Return a case, exported once for all tests of this file."""
    if name not in CASES:
        simulator = MAKERS[name](folder)
        found = export_simulator(simulator, folder / "simulator", onnx=name == "rover", check_seconds=2.0)
        assert found.deviation is not None and not found.left_out
        CASES[name] = simulator, found.folder, found.deviation
    return CASES[name]


@pytest.mark.parametrize("name", EACH)
def test_exported_simulator_agrees_with_the_original(name: str, tmp_path_factory: pytest.TempPathFactory):
    simulator, folder, (distance, angle) = exported(name, tmp_path_factory.mktemp(name))
    assert distance < 1e-6 and angle < 1e-3
    with np.load(folder / "check.npz") as check:
        assert np.ptp(check["position"], axis=0).max() > 0.02  # it moves
        # Actuators and residual have a visible effect.
        there, nominal = ImprovedSimulator(folder), simulator.robot.load_model()
        there.reset(check["qpos"], check["qvel"], check["commands"][0])
        plain = mujoco.MjData(nominal)
        plain.qpos[:] = check["qpos"]
        for command in check["commands"]:
            there.step(command)
            plain.ctrl[:] = command
            mujoco.mj_step(nominal, plain, there.substeps)
        assert np.abs(there.data.qpos - plain.qpos).max() > 1e-3


@pytest.mark.parametrize("name", EACH)
def test_exported_folder_runs_with_numpy_and_mujoco_alone(name: str, tmp_path_factory: pytest.TempPathFactory):
    _, folder, _ = exported(name, tmp_path_factory.mktemp(name))
    done = subprocess.run([sys.executable, "-I", "-c", CLEAN, str(folder)], capture_output=True, text=True)
    assert done.returncode == 0 and "Passed." in done.stdout, done.stdout + done.stderr
    example = subprocess.run([sys.executable, "example.py"], cwd=folder, capture_output=True, text=True)
    assert example.returncode == 0 and len(example.stdout.splitlines()) > 3, example.stderr
    text = (folder / "README.md").read_text()
    assert "ImprovedSimulator" in text and "double precision" in text


@pytest.mark.slow
def test_exported_simulator_agrees_over_five_seconds_with_contacts(tmp_path: Path):
    """The test uses a bundled recording with its actuators and air, so it includes contacts and cables."""
    robot = load_robot()
    _, actuators = read_actuators(robot, assets() / "recordings" / "actuators.json")
    simulator = Simulator(robot, actuators).with_residual(air(robot, 0.03))
    folder = export_simulator(simulator, tmp_path / "simulator", check_seconds=0.0).folder
    motion = reconstruct(read_recording(list_bundled("test")[0], robot), robot)
    qpos, qvel, commands = motion.qpos[0], motion.qvel[0], motion.command[:100]
    ours = rollout_in_double(simulator, improved_model(simulator), qpos, qvel, commands)
    there = ImprovedSimulator(folder)
    there.reset(qpos, qvel, commands[0])
    theirs = np.array([there.step(command).qpos.copy() for command in commands])
    assert np.linalg.norm(ours[-1, :3] - qpos[:3]) > 0.02
    assert np.abs(ours[:, :3] - theirs[:, :3]).max() < 1e-5
    assert np.rad2deg(np.abs(ours[:, 3:] - theirs[:, 3:]).max()) < 1e-3


@pytest.mark.slow
def test_exported_robot_can_be_simulated_in_another_scene(tmp_path_factory: pytest.TempPathFactory):
    _, folder, _ = exported("rover", tmp_path_factory.mktemp("rover"))
    alone = ImprovedSimulator(folder)
    scene = mujoco.MjSpec.from_file(str(folder / "identified.xml"))
    ball = scene.worldbody.add_body(name="ball", pos=[5, 0, 1])
    ball.add_freejoint()
    ball.add_geom(size=[0.1, 0, 0])
    inside = ImprovedSimulator(folder, scene.compile())
    start = alone.data.qpos.copy()
    inside.reset(np.concatenate([start, [5, 0, 1, 1, 0, 0, 0]]))
    for _ in range(5):
        command = alone.rest + 0.1
        alone.step(command)
        inside.step(command)
    np.testing.assert_allclose(inside.data.qpos[: len(start)], alone.data.qpos, atol=1e-3)
    other = mujoco.MjModel.from_xml_string("<mujoco><option timestep='0.01'/><worldbody/></mujoco>")
    with pytest.raises(ValueError, match="'hull'"):
        ImprovedSimulator(folder, other)


@pytest.mark.slow
def test_onnx_networks_agree_and_name_their_inputs(tmp_path_factory: pytest.TempPathFactory):
    import onnx
    import onnxruntime

    simulator, folder, _ = exported("rover", tmp_path_factory.mktemp("rover"))
    files = sorted(path.name for path in folder.glob("*.onnx"))
    assert files == ["envmimic-1.onnx", "envmimic-2.onnx"]
    there = ImprovedSimulator(folder)
    rng = np.random.default_rng(3)
    for file, part in zip(files, (there.residual[0], there.residual[2]), strict=True):
        described = {each.key: json.loads(each.value) for each in onnx.load(folder / file).metadata_props}
        seen = rng.normal(size=(20, len(described["inputs"]))).astype(np.float32)
        session = onnxruntime.InferenceSession(folder / file, providers=["CPUExecutionProvider"])
        loads = np.asarray(session.run(["loads"], {"input": seen})[0])
        np.testing.assert_allclose(loads, [part.loads(row) for row in seen], atol=1e-5)
        assert len(described["outputs"]) == loads.shape[1] and described["outputs"][0] == "force on hull x, N"


def test_exported_loads_fade_as_the_original_ones(tmp_path_factory: pytest.TempPathFactory):
    _, folder, _ = exported("arm", tmp_path_factory.mktemp("arm"))
    part = ImprovedSimulator(folder).residual[0]
    assert isinstance(part, NetworkPart)
    size = len(json.loads((folder / SETTINGS_FILE).read_text())["residual"][0]["inputs"])
    inputs = 0.6 * np.random.default_rng(0).normal(size=(20, size)).astype(np.float32)
    expected = [float(seen_range(size).fade(jnp.asarray(each), 1.0)) for each in inputs]
    np.testing.assert_allclose([part.fade(each) for each in inputs], expected, atol=1e-5)
    assert min(expected) < 0.1 and max(expected) > 0.9


def test_names_describe_inputs_and_loads_of_a_network(tmp_path: Path):
    robot = write_rover(tmp_path)
    config = ForceNetworkConfig(forces="multi", force_scale=0.1, force_limit=1.0)
    names = network_input_names(config, robot)
    assert len(names) == len(set(names)) == num_inputs(config, robot)
    assert len(load_names(config, robot)) == num_loads(config, robot) == len(load_units(config, robot))
    history = np.zeros((3, robot.features))
    history[0, 6], history[1, 12], history[2, 2], history[2, 11] = 0.1, 0.2, 0.3, 0.7
    commands = np.array([[-0.4, 0.0], [0.6, 0.0], [0.1, 2.0]])
    seen = dict(zip(names, network_input(jnp.asarray(history), jnp.asarray(commands), config, robot), strict=True))
    for name, value in {
        "hull roll, rad, two control steps ago": 0.1,
        "tip velocity x, m/s, one control step ago": 0.2,
        "hull position z, m, now": 0.3,
        "tip position z, m, now": 0.7,
        "command arm, share of its range, last but one": 0.0,
        "command arm, share of its range, last": 1.0,
        "command push, share of its range, coming": 0.2,
    }.items():
        assert float(seen[name]) == pytest.approx(value, abs=1e-6), name


MESH = "o\nv 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
SPLIT = """
<mujoco><compiler meshdir="meshes" angle="degree"/><include file="parts/legs.xml"/>
<default><joint damping="0.3"/></default>
<asset><mesh name="one" file="wedge.obj"/><mesh file="more/wedge.obj"/></asset>
<worldbody><body name="a" pos="0 0 1"><joint name="j" axis="0 1 0" range="-30 33.3333333" limited="true" stiffness="1"/>
<geom type="mesh" mesh="one"/><geom type="mesh" mesh="wedge" pos="0.2 0 0"/><site name="s"/></body></worldbody>
<actuator><position name="m" joint="j" kp="2" ctrlrange="-1 1"/></actuator></mujoco>
"""


def test_a_model_of_several_files_is_written_as_one_file(tmp_path: Path):
    for folder, size in (("meshes", "0.1"), ("meshes/more", "0.2")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "wedge.obj").write_text(MESH.replace("0.1", size))
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "legs.xml").write_text(
        '<mujoco><worldbody><body name="b" pos="1 0 1"><joint name="k"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    (tmp_path / "robot.xml").write_text(SPLIT)
    wanted = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    wanted.dof_damping[:] = [0.123456789, 0.25]
    wanted.jnt_stiffness[1], wanted.body_mass[2] = 2.0, 3.3333333333
    wanted.actuator_biasprm[0, 1] = -2.5
    mujoco.mj_setConst(wanted, mujoco.MjData(wanted))
    out = tmp_path / "out"
    out.mkdir()
    exact = write_mjcf(tmp_path / "robot.xml", wanted, out, "identified.xml")
    assert sorted(path.name for path in (out / "assets").iterdir()) == ["1-wedge.obj", "wedge.obj"]
    written = mujoco.MjModel.from_xml_path(str(out / "identified.xml"))
    for field in ("dof_damping", "jnt_stiffness", "jnt_range", "body_mass", "actuator_biasprm", "mesh_vert"):
        np.testing.assert_allclose(getattr(written, field), getattr(wanted, field), rtol=1e-5, err_msg=field)
    for name, value in exact.items():
        np.testing.assert_array_equal(value, getattr(wanted, name.partition("/")[2]))
    assert {"model/dof_damping", "model/jnt_range", "model/body_mass"} <= set(exact)


def test_export_refuses_unsuitable_simulators_and_folders(tmp_path: Path):
    robot = write_arm(tmp_path)
    plain, full = Simulator(robot), tmp_path / "full"
    full.mkdir()
    (full / "notes.txt").write_text("keep")
    for simulator, place, words in (
        (plain, full, "not empty"),
        (plain.with_residual(BoundResidual(PlainPush(), 1.0)), tmp_path / "a", "kind that cannot be exported"),
        (plain.with_residual(network(robot, "force"), 0.5), tmp_path / "b", "scaled"),
    ):
        with pytest.raises(InputError, match=words):
            export_simulator(simulator, place, check_seconds=0.0)
    with pytest.raises(InputError, match="has no network"):
        export_simulator(plain, tmp_path / "c", onnx=True)
    assert not any((tmp_path / name).exists() for name in "abc")


def test_damaged_exported_folder_is_refused(tmp_path: Path):
    robot = write_arm(tmp_path)
    folder = export_simulator(Simulator(robot), tmp_path / "simulator", check_seconds=0.0).folder
    assert ImprovedSimulator(folder).step(np.zeros(2)).time == pytest.approx(robot.control_timestep)
    settings = json.loads((folder / SETTINGS_FILE).read_text())
    (folder / SETTINGS_FILE).write_text(json.dumps(settings | {"format": "other/1"}))
    with pytest.raises(ValueError, match="ballu-simulator/1"):
        ImprovedSimulator(folder)
    (folder / PARAMETERS_FILE).unlink()
    with pytest.raises((ValueError, OSError)):
        ImprovedSimulator(folder)
