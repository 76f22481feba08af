"""Virtual robots with a flexible body: masses, lift, cables, and recordings that the package can read."""

import dataclasses

import mujoco
import numpy as np
import pytest
from jaxtyping import Float

from ballu_mjx.ballu.model import SIDES, load_model, standing_qpos
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.ballu.virtual.flexible_robot import draw_flexible_robot
from ballu_mjx.ballu.virtual.hardware import VirtualHardware
from ballu_mjx.ballu.virtual.robot import VirtualRobot


@pytest.fixture(scope="module")
def drawn() -> VirtualRobot:
    return draw_flexible_robot(0)


def nominal_masses(virtual: VirtualRobot) -> VirtualRobot:
    """Return the robot with the nominal masses and lengths, balloons in their nominal places, and no added mass."""
    assert virtual.flexible is not None
    ones = (1.0,) * len(virtual.flexible.mass_ratio)
    body = dataclasses.replace(virtual.flexible, mass_ratio=ones, thigh_ratio=ones[:2], shank_ratio=ones[:2])
    return dataclasses.replace(virtual, flexible=body, added_mass=0.0, balloon_offset=(0.0, 0.0, 0.0))


def cluster_inertia(model: mujoco.MjModel) -> tuple[float, Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Return mass (kg), centre of mass (m) and inertia about it (kg m^2) of balloons and frame in the pose qpos0."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bodies = [i for i in range(model.nbody) if model.body(i).name.startswith("balloon")]
    mass = model.body_mass[bodies]
    centre = mass @ data.xipos[bodies] / mass.sum()
    inertia = np.zeros((3, 3))
    for body, each in zip(bodies, mass, strict=True):
        axes, arm = data.ximat[body].reshape(3, 3), data.xipos[body] - centre
        inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T + each * (
            arm @ arm * np.eye(3) - np.outer(arm, arm)
        )
    return float(mass.sum()), centre, inertia


def test_balloons_and_frame_have_the_inertia_of_the_rigid_cluster(drawn: VirtualRobot):
    flexible, rigid = (cluster_inertia(model) for model in (virtual_robot.build(nominal_masses(drawn)), load_model()))
    for part, expected in zip(flexible, rigid, strict=True):
        np.testing.assert_allclose(part, expected, rtol=2e-3, atol=2e-5)


def test_the_feet_carry_the_weight_that_the_lift_leaves(drawn: VirtualRobot):
    """The added mass has no weight. Balloons rest at their places in the upright frame."""
    model = virtual_robot.build(drawn)
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    carried = []
    for step in range(16_000):
        mujoco.mj_step(model, data)
        if step >= 12_000:
            carried.append(sum(mujoco_contact_force(model, data, i) for i in range(data.ncon)))
    nominal = load_model()
    weight = (model.body_mass.sum() - drawn.added_mass) * 9.81
    lift = drawn.buoyancy * nominal.body_mass.sum() * 9.81
    assert np.mean(carried) == pytest.approx(weight - lift, rel=0.02)
    slides = [model.joint(f"balloon_{i}_{axis}").qposadr[0] for i in range(6) for axis in "xyz"]
    assert np.abs(data.qpos[slides]).max() < 0.005


def mujoco_contact_force(model: mujoco.MjModel, data: mujoco.MjData, contact: int) -> float:
    """Return the normal force (N) of a contact."""
    force = np.zeros(6)
    mujoco.mj_contactForce(model, data, contact, force)
    return float(force[0])


@pytest.mark.parametrize("index", [0, 1])
def test_a_cable_pulls_softly_at_first_and_then_harder(drawn: VirtualRobot, index: int):
    """The force is the passive torque on the motor over the cable's moment arm."""
    body = drawn.flexible
    assert body is not None
    side = SIDES[index]
    model = virtual_robot.build(drawn)
    data = mujoco.MjData(model)
    dof = model.joint(f"motor_{side}").dofadr[0]
    cable = model.tendon(f"cable_{side}").id
    stretches, forces = [], []
    for angle in np.linspace(0.0, 0.9, 400):
        data.qpos[:] = standing_qpos(model)
        data.qpos[model.joint(f"motor_{side}").qposadr[0]] = angle
        mujoco.mj_forward(model, data)
        lengths = []
        for nudge in (-1e-5, 1e-5):
            other = mujoco.MjData(model)
            other.qpos[:] = data.qpos
            other.qpos[model.joint(f"motor_{side}").qposadr[0]] += nudge
            mujoco.mj_forward(model, other)
            lengths.append(other.ten_length[cable])
        arm = (lengths[1] - lengths[0]) / 2e-5
        stretches.append(data.ten_length[cable] - model.tendon_lengthspring[cable, 1])
        forces.append(-data.qfrc_spring[dof] / arm if abs(arm) > 1e-4 else np.nan)
    stretch, force = np.array(stretches), np.array(forces)
    toe, soft, hard = body.cable_toe[index], body.cable_stiffness[index], body.cable_hardening[index]
    known = ~np.isnan(force)
    assert np.abs(force[known & (stretch < 0)]).max() < 1e-6
    for part, expected in (
        (known & (stretch > 0.1 * toe) & (stretch < toe), soft * stretch),
        (known & (stretch > 1.1 * toe), soft * stretch + hard * (stretch - toe)),
    ):
        assert part.sum() > 3
        np.testing.assert_allclose(force[part], expected[part], rtol=1e-3)


def test_recordings_are_those_of_a_ballu(drawn: VirtualRobot):
    hardware = VirtualHardware.draw(0, "flexible")
    assert hardware.robot == drawn
    rigid = VirtualHardware(dataclasses.replace(drawn, flexible=None))
    commands = np.tile([0.8, 0.1], (20, 1))
    recordings = [each.record(1, virtual_robot.open_loop(commands), 1.0, "short", "") for each in (hardware, rigid)]
    places = []
    for recording in recordings:
        assert recording.tracked_position is not None and set(recording.points) == set(recordings[0].points)
        places.append(recording.tracked_position)
    assert not np.isinf(places).any()
    assert np.nanmax(np.abs(places[0] - places[1])) > 0.003, "the bodies move alike"
    sweep = virtual_robot.record_sweep(drawn, 0, "sweep", commands=2, hold=1.0)
    knee = sweep.joint_angles["knee_left"]
    assert np.ptp(knee[:50]) < np.deg2rad(3) < np.deg2rad(10) < knee[-1] - knee[50], "the servo bends the knee"
