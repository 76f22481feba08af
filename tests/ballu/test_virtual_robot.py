"""The virtual robot: air, actuators, motion capture, and its separation from the code that trains."""

import ast
import dataclasses
import gzip
import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

import ballu_mjx
from ballu_mjx.ballu.model import load_model, standing_qpos
from ballu_mjx.ballu.recordings import base_position, foot_position, knee, motor
from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.ballu.virtual.hardware import VirtualHardware
from ballu_mjx.ballu.virtual.paper_robot import draw_paper_robot
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.policies.deploy.estimator import Capture
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.robots.model import assets
from ballu_mjx.robots.registry import load_robot


@pytest.fixture(scope="module")
def virtual() -> virtual_robot.VirtualRobot:
    return virtual_robot.draw_robot(0)


def test_force_on_the_balloon_also_accelerates_the_added_mass(virtual: virtual_robot.VirtualRobot):
    """The force is 1 N, from rest. MuJoCo's fluid model has no added mass and would give 1 N / 0.159 kg."""
    model = virtual_robot.build(virtual)
    data = mujoco.MjData(model)
    data.qpos[2] = 2.0
    mujoco.mj_forward(model, data)
    before = _balloon_acceleration(model, data)
    data.xfrc_applied[model.body("balloon").id, 2] = 1.0
    mujoco.mj_forward(model, data)
    gained = _balloon_acceleration(model, data)[2] - before[2]
    # The force points upwards. Balloon and base rise together, and the legs hang from free hips.
    total_mass = model.body_mass.sum()
    assert 1 / total_mass < gained <= 1 / (0.15898 + virtual.added_mass)


def _balloon_acceleration(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    acceleration = np.zeros(6)
    mujoco.mj_rnePostConstraint(model, data)
    mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_BODY, model.body("balloon").id, acceleration, 0)
    return acceleration[3:] + model.opt.gravity


def test_air_without_drag_is_added_mass_and_magnus_force(virtual: virtual_robot.VirtualRobot):
    """Without drag, the air adds only an added mass, an added inertia and a Magnus force to inverse dynamics.

    The balloon translates, rotates and accelerates at once. Kirchhoff's equations for an added mass and inertia that
    are equal along all axes are m a and I alpha at the balloon's centre (world frame). They contain no other force or
    torque that depends on velocity (Coriolis, Munk). The Magnus force is that of the balloon's volume.
    """
    with_air = virtual_robot.build(virtual)
    without_air = virtual_robot.build(dataclasses.replace(virtual, added_mass=0.0, added_inertia=0.0))
    without_air.opt.density = 0.0
    with_air.geom_fluid[with_air.geom("air").id, 1:5] = 0.0  # drag, and the lift that belongs to it
    balloon = with_air.body("balloon").id
    air = virtual_robot.AIR_DENSITY * 4 / 3 * np.pi * np.prod(virtual.balloon_semi_axes)
    rng = np.random.default_rng(0)
    for _ in range(4):
        position, rates, accelerations = rng.normal(0, 1.0, (3, with_air.nv))
        needed = []
        for model in (with_air, without_air):
            model.opt.gravity[:] = 0.0
            data = mujoco.MjData(model)
            mujoco.mj_integratePos(model, data.qpos, position, 0.3)
            data.qpos[2] = 3.0
            data.qvel[:], data.qacc[:] = rates, accelerations
            mujoco.mj_inverse(model, data)
            needed.append(data.qfrc_inverse + data.qfrc_constraint)
        velocity, acceleration = np.zeros(6), np.zeros(6)
        mujoco.mj_rnePostConstraint(without_air, data)
        mujoco.mj_objectVelocity(without_air, data, mujoco.mjtObj.mjOBJ_BODY, balloon, velocity, 0)
        mujoco.mj_objectAcceleration(without_air, data, mujoco.mjtObj.mjOBJ_BODY, balloon, acceleration, 0)
        translation, rotation = np.zeros((2, 3, with_air.nv))
        mujoco.mj_jacBodyCom(without_air, data, translation, rotation, balloon)
        force = virtual.added_mass * acceleration[3:] - air * np.cross(velocity[:3], velocity[3:])
        torque = virtual.added_inertia * acceleration[:3]
        expected = translation.T @ force + rotation.T @ torque
        np.testing.assert_allclose(needed[0] - needed[1], expected, atol=1e-9)


def test_only_the_balloon_has_drag(virtual: virtual_robot.VirtualRobot):
    """Drag along the ellipsoid's shortest axis is half of density times frontal area times squared speed."""
    model = virtual_robot.build(virtual)
    data = mujoco.MjData(model)
    data.qvel[0], data.qvel[6:] = 0.3, 0.0
    mujoco.mj_forward(model, data)
    _, b, c = virtual.balloon_semi_axes
    drag = 0.5 * virtual_robot.AIR_DENSITY * np.pi * b * c * 0.3**2
    np.testing.assert_allclose(data.qfrc_fluid[:3], [-drag, 0.0, 0.0], atol=1e-9)
    assert np.all(data.qfrc_fluid[7:] == 0.0)
    data.qvel[:7], data.qvel[7:] = 0.0, 5.0
    mujoco.mj_forward(model, data)
    assert np.all(data.qfrc_fluid == 0.0)


def test_lift_is_the_stated_fraction_of_the_weight(virtual: virtual_robot.VirtualRobot):
    """In still air, the floor carries the weight that lift does not carry. The added mass of air has no weight."""
    model = virtual_robot.build(virtual)
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    mujoco.mj_step(model, data, 6000)
    load = 0.0
    for contact in range(data.ncon):
        force = np.zeros(6)
        mujoco.mj_contactForce(model, data, contact, force)
        load += force[0]
    weight = load_model().body_mass.sum() * 9.81
    assert load / weight == pytest.approx(1 - virtual.buoyancy, abs=0.01)


def test_drag_slows_the_balloon_and_a_draught_accelerates_it(virtual: virtual_robot.VirtualRobot):
    still = virtual_robot.build(virtual)
    still.opt.gravity[:] = 0.0
    blown = virtual_robot.build(virtual)
    blown.opt.gravity[:] = 0.0
    blown.opt.wind[0] = 1.0
    ends = []
    for model, speed in ((still, 1.0), (blown, 0.0)):
        data = mujoco.MjData(model)
        data.qpos[2] = 3.0
        data.qvel[0] = speed
        mujoco.mj_step(model, data, 2000)
        ends.append(data.qvel[0])
    assert 0.2 < ends[0] < 0.98
    assert 0.02 < ends[1] < 0.8


def test_latency_and_backlash_act_on_the_commands():
    servos = virtual_robot._Servos(0.05, np.deg2rad([4.0, 0.0]), [], np.zeros(2))
    servos.send(0.0, np.array([0.5, 0.5]))
    assert servos.at(0.049).tolist() == [0.0, 0.0]
    up = servos.at(0.050)
    assert up[1] == 0.5 and up[0] == pytest.approx(0.5 - 2 / 90)
    servos.send(0.1, np.array([0.48, 0.48]))
    # A reversal by less than the backlash does not move the left motor's target.
    assert servos.at(0.2)[0] == up[0] and servos.at(0.2)[1] == 0.48


def test_trial_continues_unchanged_from_its_true_state(virtual: virtual_robot.VirtualRobot):
    """At this state, commands are delayed, the motors are at one end of their backlash, and there is a draught."""
    trial, phases = virtual_robot.draw_trial(3), np.arange(60)[:, None] / 13 + np.array([0.0, 0.4])
    commands = np.where(phases % 1.0 < 0.45, 0.9, 0.0)
    qpos, qvel = virtual_robot.record_truth(virtual, trial, virtual_robot.open_loop(commands), 3.0)
    start, ends = 27, slice(5 * 28, 5 * 58, 5)
    state = qpos[5 * start], qvel[5 * start]
    continued = virtual_robot.continue_trial(virtual, trial, commands, start, state, 30)
    np.testing.assert_allclose(continued, qpos[ends], atol=1e-5)
    loose = dataclasses.replace(virtual, backlash=(0.0, 0.0), latency=0.0)
    other = virtual_robot.continue_trial(loose, trial, commands, start, state, 30)
    assert np.abs(other - qpos[ends]).max() > 0.05


@pytest.mark.slow
def test_capture_has_the_stated_noise_and_dropouts(virtual: virtual_robot.VirtualRobot):
    commands = np.zeros((400, 2))
    trial = virtual_robot.draw_trial(7)
    recording = virtual_robot.record(virtual, trial, virtual_robot.open_loop(commands), 20.0, "standing")
    qpos, _ = virtual_robot.record_truth(virtual, trial, virtual_robot.open_loop(commands), 20.0)
    base, feet = base_position(recording), foot_position(recording)
    assert base is not None and feet is not None
    noise = base - qpos[:, :3]
    assert np.nanstd(noise, axis=0) == pytest.approx(np.full(3, 5e-4), rel=0.1)
    hidden = np.isnan(np.concatenate([base, feet.reshape(-1, 6)], axis=1))
    assert 0.0 < hidden.mean() < 0.05


def test_controller_receives_only_frames_captured_so_far(virtual: virtual_robot.VirtualRobot):
    """In closed loop, the controller receives the frames so far and nothing else. Its result is sent to the robot."""
    lengths = []

    def controller(capture: Capture) -> np.ndarray:
        lengths.append(len(capture.time))
        assert len(capture.position) == len(capture.time) == len(capture.command) + 1
        return np.array([0.1, 0.2]) * (len(lengths) % 2)

    recording = virtual_robot.record(virtual, virtual_robot.draw_trial(1), controller, 1.0, "closed")
    assert lengths == list(range(1, 101, 5))
    assert recording.command[:5].tolist() == [[0.1, 0.2]] * 5 and recording.command[5].tolist() == [0.0, 0.0]


def test_symmetric_robot_mirrors_its_walk_under_mirrored_commands():
    """Both sides have equal parameters, and the balloon is centred."""
    virtual = dataclasses.replace(
        virtual_robot.draw_robot(0),
        balloon_offset=(0.0, 0.0, 0.0),
        **{
            field: (getattr(virtual_robot.draw_robot(0), field)[0],) * 2
            for field in (
                "knee_spring_stiffness default_knee_angle knee_friction motor_gain default_motor_angle torque_limit "
                "motor_friction backlash cable_slack foot_friction"
            ).split()
        },
    )
    trial = virtual_robot.TrialConditions((0.0, 0.0, 0.0), (0.0, 10.0), (0.0, 0.0, 0.0), 0)
    commands = np.zeros((20, 2))
    commands[:10, 0] = commands[10:, 1] = 0.8
    left, _ = virtual_robot.record_truth(virtual, trial, virtual_robot.open_loop(commands), 1.0)
    right, _ = virtual_robot.record_truth(virtual, trial, virtual_robot.open_loop(commands[:, ::-1]), 1.0)
    np.testing.assert_allclose(left[:, [0, 2]], right[:, [0, 2]], atol=1e-5)
    np.testing.assert_allclose(left[:, 1], -right[:, 1], atol=1e-5)
    assert np.abs(left[-1, 0] - left[0, 0]) > 0.01


@pytest.mark.slow
def test_bundled_recording_is_reproduced_bit_for_bit(tmp_path: Path):
    job = dataset.jobs()[0]
    path = dataset.record_job(job, VirtualHardware.draw(dataset.ROBOT_SEED), tmp_path)
    shipped = assets() / "recordings" / job.split / path.name
    # The text is compared, because the compressed bytes depend on the version of zlib.
    assert gzip.decompress(path.read_bytes()) == gzip.decompress(shipped.read_bytes())


def test_bundled_sweep_holds_twenty_levels_until_the_joints_settle():
    (path,) = list_bundled("suspended")
    sweep = read_recording(path, load_robot())
    knees = knee(sweep)
    assert sweep.kind == "suspended" and motor(sweep) is not None and knees is not None
    levels, first = np.unique(sweep.command[:, 0], return_index=True)
    assert len(levels) == 20 and (levels[0], levels[-1]) == (0.0, 1.0)
    for start, end in zip(first, [*first[1:], len(sweep.time)], strict=True):
        # The drift is in deg/s. Noise alone gives 0.6.
        settled = np.rad2deg(knees[end - (end - start) // 3 : end])
        assert np.abs(np.polyfit(np.arange(len(settled)) * 0.01, settled, 1)[0]).max() < 1.0
    lifted = np.rad2deg(knees[-1] - knees[0])
    assert lifted.min() > 15 and lifted.max() < 44  # The servos are weak. The nominal robot's knees turn by 45 deg.


def test_bundled_actuators_match_the_virtual_robots_true_parameters(virtual: virtual_robot.VirtualRobot):
    """In the bundled sweep, friction, backlash and slack are not mistaken for properties of springs and servos."""
    content = json.loads((assets() / "recordings" / ACTUATORS_FILE).read_text())
    for name, pair in content["parameters"].items():
        error = np.abs(np.array(pair) - getattr(virtual, name))
        assert np.all(error < 4 * np.array(content["standard_errors"][name])), name
    for name, truth in (("motor_friction", virtual.motor_friction), ("backlash", virtual.backlash)):
        assert content["drivetrain"][name] == pytest.approx(truth, rel=0.05), name


def test_bundled_free_recordings_have_no_joint_angles_and_all_fit_in_2_mib():
    for split in ("training", "validation", "test"):
        for path in list_bundled(split):
            recording = read_recording(path, load_robot())
            assert not recording.joint_angles
            assert recording.time[-1] - recording.time[0] >= 19.9
    assert sum(path.stat().st_size for path in (assets() / "recordings").rglob("*.*")) < 2 * 2**20


USERS = ("ballu/virtual", "cli/pipeline.py", "cli/record_simulate.py")
"""Modules that may import the virtual robot: its own package, and the commands that record on it."""


def imported(path: Path) -> set[str]:
    """Return the dotted names that a file imports, and its strings that look like modules of this package."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("ballu_mjx."):
            names.add(node.value)
    return names


def test_training_code_does_not_import_the_virtual_robot():
    """Training depends on the virtual robot's parameters only through recordings."""
    package = Path(ballu_mjx.__file__).parent
    for path in package.rglob("*.py"):
        if not path.relative_to(package).as_posix().startswith(USERS):
            assert not [name for name in imported(path) if "virtual" in name.split(".")], path


IDENTIFYING = (
    "identification/*.py",
    "ballu/identified_legs.py",
    "ballu/leg_[!a]*.py",  # leg_alignment aligns clocks; its torque limits are fractions of the nominal one
    "ballu/suspended_leg.py",
    "residuals/*.py",
)
"""Modules that identify the robot from recordings."""


def numbers(node: ast.AST) -> set[float]:
    found = (each.value for each in ast.walk(node) if isinstance(each, ast.Constant))
    return {abs(value) for value in found if isinstance(value, int | float) and not isinstance(value, bool)}


def test_identification_code_contains_no_bound_of_the_virtual_robots_ranges():
    """Bounds with two or more significant digits are checked. Others, like 0.1, are too common."""
    package = Path(ballu_mjx.__file__).parent
    drawing = [
        node
        for name in ("robot", "flexible_robot")
        for node in ast.parse((package / f"ballu/virtual/{name}.py").read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("draw_")
    ]
    calls = [node for draw in drawing for node in ast.walk(draw) if isinstance(node, ast.Call)]
    ranges = {x for call in calls for x in numbers(call) if len(f"{x:.9e}".split("e")[0].rstrip("0")) > 2}
    assert {0.0125, 0.021, 0.28, 0.55, 0.14} < ranges, "the ranges were not found"
    found = {pattern: set(package.glob(pattern)) for pattern in IDENTIFYING}
    assert all(found.values()), "every pattern names modules that there are"
    paths = set().union(*found.values())
    for path in paths:
        assert not numbers(ast.parse(path.read_text())) & ranges, path


def test_identification_does_not_load_the_virtual_robot():
    """It does not load it through other modules either."""
    modules = "ballu_mjx.ballu.leg_fit, ballu_mjx.residuals.aerodynamics_fit, ballu_mjx.residuals.envmimic"
    code = f"import sys, {modules}; print([name for name in sys.modules if 'ballu_mjx.ballu.virtual' in name])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_recording_commands_read_no_parameter_of_the_virtual_robot():
    parameters = {field.name for field in dataclasses.fields(virtual_robot.VirtualRobot)} - {"name"}
    package = Path(ballu_mjx.__file__).parent
    for name in ("cli/pipeline.py", "cli/record_simulate.py", "ballu/virtual/trials.py"):
        path = package / name
        attributes = {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
        assert not attributes & parameters, f"{path.name} reads {attributes & parameters}"


def test_robots_of_the_papers_figures_have_the_published_drag_and_the_actuators_of_the_other_family() -> None:
    drawn, other = draw_paper_robot(3), virtual_robot.draw_robot(3)
    for name in ("motor_gain", "torque_limit", "knee_spring_stiffness", "latency", "added_mass"):
        assert getattr(drawn, name) == getattr(other, name), name
    model = virtual_robot.build(drawn)
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    model.opt.wind[:] = (1.0, 0.0, 0.0)
    mujoco.mj_forward(model, data)
    assert data.qfrc_fluid[0] == pytest.approx(0.3, abs=0.005)
    weight = load_model().body_mass.sum() * 9.81
    lift = model.body_gravcomp @ model.body_mass * 9.81 - drawn.added_mass * 9.81
    assert 0.77 < lift / weight < 0.78
