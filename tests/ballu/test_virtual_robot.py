"""The stand-in for the hardware: its air, its actuators, its motion capture, and the wall around it."""

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
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.policies.deploy.estimator import Capture
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.robots.model import assets
from ballu_mjx.robots.registry import load_robot


@pytest.fixture(scope="module")
def virtual() -> virtual_robot.VirtualRobot:
    return virtual_robot.draw_robot(0)


def test_one_newton_accelerates_the_balloon_and_its_air(virtual: virtual_robot.VirtualRobot):
    """From rest: MuJoCo's own fluid model has no added mass, and would let the balloon go at 1 N / 0.159 kg."""
    model = virtual_robot.build(virtual)
    data = mujoco.MjData(model)
    data.qpos[2] = 2.0
    mujoco.mj_forward(model, data)
    before = _balloon_acceleration(model, data)
    data.xfrc_applied[model.body("balloon").id, 2] = 1.0
    mujoco.mj_forward(model, data)
    gained = _balloon_acceleration(model, data)[2] - before[2]
    # Pushed upwards, balloon and base rise together; the legs hang from free hips.
    whole = model.body_mass.sum()
    assert 1 / whole < gained <= 1 / (0.15898 + virtual.added_mass)


def _balloon_acceleration(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    acceleration = np.zeros(6)
    mujoco.mj_rnePostConstraint(model, data)
    mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_BODY, model.body("balloon").id, acceleration, 0)
    return acceleration[3:] + model.opt.gravity


def test_the_air_is_one_added_mass_and_a_magnus_force_beside_drag(virtual: virtual_robot.VirtualRobot):
    """Translating, rotating and accelerating at once, without drag: what the air adds to inverse dynamics.

    Kirchhoff's equations for a mass and inertia alike along all axes: m a and I alpha at the balloon's centre, with
    no further force or torque of velocity (Coriolis, Munk); and the Magnus force of its volume. In the world's axes.
    """
    whole = virtual_robot.build(virtual)
    airless = virtual_robot.build(dataclasses.replace(virtual, added_mass=0.0, added_inertia=0.0))
    airless.opt.density = 0.0
    whole.geom_fluid[whole.geom("air").id, 1:5] = 0.0  # drag and the lift that goes with it
    balloon = whole.body("balloon").id
    air = virtual_robot.AIR_DENSITY * 4 / 3 * np.pi * np.prod(virtual.balloon_semi_axes)
    rng = np.random.default_rng(0)
    for _ in range(4):
        position, rates, accelerations = rng.normal(0, 1.0, (3, whole.nv))
        needed = []
        for model in (whole, airless):
            model.opt.gravity[:] = 0.0
            data = mujoco.MjData(model)
            mujoco.mj_integratePos(model, data.qpos, position, 0.3)
            data.qpos[2] = 3.0
            data.qvel[:], data.qacc[:] = rates, accelerations
            mujoco.mj_inverse(model, data)
            needed.append(data.qfrc_inverse + data.qfrc_constraint)
        velocity, acceleration = np.zeros(6), np.zeros(6)
        mujoco.mj_rnePostConstraint(airless, data)
        mujoco.mj_objectVelocity(airless, data, mujoco.mjtObj.mjOBJ_BODY, balloon, velocity, 0)
        mujoco.mj_objectAcceleration(airless, data, mujoco.mjtObj.mjOBJ_BODY, balloon, acceleration, 0)
        translation, rotation = np.zeros((2, 3, whole.nv))
        mujoco.mj_jacBodyCom(airless, data, translation, rotation, balloon)
        force = virtual.added_mass * acceleration[3:] - air * np.cross(velocity[:3], velocity[3:])
        torque = virtual.added_inertia * acceleration[:3]
        expected = translation.T @ force + rotation.T @ torque
        np.testing.assert_allclose(needed[0] - needed[1], expected, atol=1e-9)


def test_drag_is_that_of_the_balloon_alone(virtual: virtual_robot.VirtualRobot):
    """Along the ellipsoid's shortest axis: half of density, frontal area and squared speed. Legs feel no air."""
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


def test_lift_is_the_stated_share_of_the_robots_weight(virtual: virtual_robot.VirtualRobot):
    """Standing still in still air, the floor carries what lift does not; the added mass of air weighs nothing."""
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


def test_drag_slows_a_flying_balloon_and_a_draught_carries_it(virtual: virtual_robot.VirtualRobot):
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


def test_commands_arrive_late_and_through_play():
    servos = virtual_robot._Servos(0.05, np.deg2rad([4.0, 0.0]), [], np.zeros(2))
    servos.send(0.0, np.array([0.5, 0.5]))
    assert servos.at(0.049).tolist() == [0.0, 0.0]
    up = servos.at(0.050)
    assert up[1] == 0.5 and up[0] == pytest.approx(0.5 - 2 / 90)
    servos.send(0.1, np.array([0.48, 0.48]))
    # Turning back by less than the play's width leaves the arm where it is.
    assert servos.at(0.2)[0] == up[0] and servos.at(0.2)[1] == 0.48


def test_a_trial_taken_up_in_its_true_state_goes_on_as_it_went(virtual: virtual_robot.VirtualRobot):
    """In the middle of a gait, with commands under way, the play of the motors on one side, and in a draught."""
    trial, phases = virtual_robot.draw_trial(3), np.arange(60)[:, None] / 13 + np.array([0.0, 0.4])
    commands = np.where(phases % 1.0 < 0.45, 0.9, 0.0)
    qpos, qvel = virtual_robot.record_truth(virtual, trial, virtual_robot.open_loop(commands), 3.0)
    start, ends = 27, slice(5 * 28, 5 * 58, 5)
    state = qpos[5 * start], qvel[5 * start]
    again = virtual_robot.continue_trial(virtual, trial, commands, start, state, 30)
    np.testing.assert_allclose(again, qpos[ends], atol=1e-5)
    loose = dataclasses.replace(virtual, backlash=(0.0, 0.0), latency=0.0)
    other = virtual_robot.continue_trial(loose, trial, commands, start, state, 30)
    assert np.abs(other - qpos[ends]).max() > 0.05


def test_capture_is_as_noisy_and_as_patchy_as_stated(virtual: virtual_robot.VirtualRobot):
    commands = np.zeros((400, 2))
    trial = virtual_robot.draw_trial(7)
    seen = virtual_robot.record(virtual, trial, virtual_robot.open_loop(commands), 20.0, "standing")
    qpos, _ = virtual_robot.record_truth(virtual, trial, virtual_robot.open_loop(commands), 20.0)
    base, feet = base_position(seen), foot_position(seen)
    assert base is not None and feet is not None
    noise = base - qpos[:, :3]
    assert np.nanstd(noise, axis=0) == pytest.approx(np.full(3, 5e-4), rel=0.1)
    hidden = np.isnan(np.concatenate([base, feet.reshape(-1, 6)], axis=1))
    assert 0.0 < hidden.mean() < 0.05


def test_a_controller_sees_only_what_was_captured_before(virtual: virtual_robot.VirtualRobot):
    """Closed loop: frames so far and nothing else; what it answers is what the robot is sent."""
    lengths = []

    def controller(capture: Capture) -> np.ndarray:
        lengths.append(len(capture.time))
        assert len(capture.position) == len(capture.time) == len(capture.command) + 1
        return np.array([0.1, 0.2]) * (len(lengths) % 2)

    seen = virtual_robot.record(virtual, virtual_robot.draw_trial(1), controller, 1.0, "closed")
    assert lengths == list(range(1, 101, 5))
    assert seen.command[:5].tolist() == [[0.1, 0.2]] * 5 and seen.command[5].tolist() == [0.0, 0.0]


def test_the_nominal_member_has_no_side():
    """With the two sides alike and the balloon centred, mirrored commands give the mirrored walk."""
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


def test_a_bundled_recording_is_made_again_bit_for_bit(tmp_path: Path):
    job = dataset.jobs()[0]
    again = dataset.record_job(job, virtual_robot.draw_robot(dataset.ROBOT_SEED), tmp_path)
    shipped = assets() / "recordings" / job.split / again.name
    # The text, not the compressed bytes: those depend on the zlib at hand.
    assert gzip.decompress(again.read_bytes()) == gzip.decompress(shipped.read_bytes())


def test_the_sweep_holds_twenty_levels_until_the_joints_settle():
    (path,) = list_bundled("suspended")
    sweep = read_recording(path, load_robot())
    knees = knee(sweep)
    assert sweep.kind == "suspended" and motor(sweep) is not None and knees is not None
    levels, first = np.unique(sweep.command[:, 0], return_index=True)
    assert len(levels) == 20 and (levels[0], levels[-1]) == (0.0, 1.0)
    for start, end in zip(first, [*first[1:], len(sweep.time)], strict=True):
        # In deg/s; noise alone gives 0.6.
        settled = np.rad2deg(knees[end - (end - start) // 3 : end])
        assert np.abs(np.polyfit(np.arange(len(settled)) * 0.01, settled, 1)[0]).max() < 1.0
    lifted = np.rad2deg(knees[-1] - knees[0])
    assert lifted.min() > 15 and lifted.max() < 44  # weak servos: the nominal robot's knees gain 45 deg


def test_bundled_actuators_are_the_robots(virtual: virtual_robot.VirtualRobot):
    """Identified from the bundled sweep: friction, backlash and slack do not pass for springs and servos."""
    content = json.loads((assets() / "recordings" / ACTUATORS_FILE).read_text())
    for name, pair in content["parameters"].items():
        error = np.abs(np.array(pair) - getattr(virtual, name))
        assert np.all(error < 4 * np.array(content["standard_errors"][name])), name
    for name, truth in (("motor_friction", virtual.motor_friction), ("backlash", virtual.backlash)):
        assert content["drivetrain"][name] == pytest.approx(truth, rel=0.05), name


def test_bundled_free_recordings_show_no_motors_and_weigh_two_megabytes_at_most():
    for split in ("training", "validation", "test"):
        for path in list_bundled(split):
            seen = read_recording(path, load_robot())
            assert not seen.joint_angles
            assert seen.time[-1] - seen.time[0] >= 19.9
    assert sum(path.stat().st_size for path in (assets() / "recordings").rglob("*.*")) < 2 * 2**20


USERS = ("ballu/virtual", "cli/pipeline.py", "cli/record_simulate.py")
"""Where the virtual robot is built, and the commands that record on it."""


def imported(path: Path) -> set[str]:
    """Return the dotted names that a file imports, and strings that look like modules of this package."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("ballu_mjx."):
            names.add(node.value)
    return names


def test_nothing_that_trains_knows_the_virtual_robot():
    """Its parameters reach training through recordings alone."""
    package = Path(ballu_mjx.__file__).parent
    for path in package.rglob("*.py"):
        if not path.relative_to(package).as_posix().startswith(USERS):
            assert not [name for name in imported(path) if "virtual" in name.split(".")], path


FITTED = (
    "identification/*.py",
    "ballu/*identification*.py",
    "ballu/identified_legs.py",
    "ballu/leg_parameters.py",
    "ballu/suspended_leg.py",
    "residuals/*.py",
)
"""Modules that find out about the robot from recordings."""


def numbers(node: ast.AST) -> set[float]:
    found = (each.value for each in ast.walk(node) if isinstance(each, ast.Constant))
    return {abs(value) for value in found if isinstance(value, int | float) and not isinstance(value, bool)}


def test_no_number_of_the_virtual_robot_s_ranges_stands_where_it_is_identified():
    """Ends of the ranges that robots are drawn from, of two digits or more: 0.01 and 0.1 are everybody's numbers."""
    package = Path(ballu_mjx.__file__).parent
    (draw,) = (
        node
        for node in ast.parse((package / "ballu/virtual/robot.py").read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name == "draw_robot"
    )
    calls = [node for node in ast.walk(draw) if isinstance(node, ast.Call)]
    ranges = {x for call in calls for x in numbers(call) if len(f"{x:.9e}".split("e")[0].rstrip("0")) > 2}
    assert {0.0125, 0.021, 0.28, 0.55, 0.14} < ranges, "the ranges are not found"
    paths = {path for pattern in FITTED for path in package.glob(pattern)}
    assert len(paths) > 10
    for path in paths:
        assert not numbers(ast.parse(path.read_text())) & ranges, path


def test_identification_does_not_load_the_virtual_robot():
    """Not by way of others either."""
    modules = "ballu_mjx.ballu.leg_fit, ballu_mjx.residuals.aerodynamics_fit, ballu_mjx.residuals.envmimic"
    code = f"import sys, {modules}; print([name for name in sys.modules if 'ballu_mjx.ballu.virtual' in name])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_the_commands_that_record_look_at_no_parameter_of_the_robot():
    secrets = {field.name for field in dataclasses.fields(virtual_robot.VirtualRobot)} - {"name"}
    package = Path(ballu_mjx.__file__).parent
    for name in ("cli/pipeline.py", "cli/record_simulate.py", "ballu/virtual/trials.py"):
        path = package / name
        read = {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
        assert not read & secrets, f"{path.name} reads {read & secrets}"
