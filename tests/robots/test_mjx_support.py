"""Features that MJX cannot simulate are found before compilation, and reported with their place and a fix."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from ballu_mjx.robots.mjx_support import LARGEST_HULL, LARGEST_PAIR, check_mjx

MODEL = """
<mujoco>PLUGIN<option timestep="0.01" OPTION><flag FLAG/></option><asset>ASSET</asset>
<worldbody><geom name="floor" type="plane" size="0 0 0.1"/>
  <body name="trunk" pos="0 0 1"><freejoint/><geom name="trunk" size="0.1" contype="0" conaffinity="0"/>
    <site name="imu"/>
    <body name="left" pos="0 0.1 0"><joint name="left" axis="0 1 0" JOINT/><geom LEFT/></body>
    <body name="right" pos="0 -0.1 0"><joint name="right" axis="0 1 0"/><geom RIGHT/></body></body></worldbody>
<tendon><fixed name="cable" CABLE><joint joint="left" coef="1"/></fixed></tendon>
<actuator><general name="m" joint="left" MOTOR/></actuator>MORE</mujoco>
"""


def load(**parts: str) -> mujoco.MjModel:
    text = MODEL
    for key, default in (
        ("PLUGIN", ""),
        ("OPTION", ""),
        ("FLAG", ""),
        ("ASSET", ""),
        ("LEFT", 'size="0.02"'),
        ("RIGHT", 'size="0.02"'),
        ("MORE", ""),
        ("JOINT", ""),
        ("CABLE", ""),
        ("MOTOR", ""),
    ):
        text = text.replace(key, parts.get(key.lower(), default))
    return mujoco.MjModel.from_xml_string(text)


def ball(vertices: int, **more: str) -> str:
    """Return a mesh with `vertices` vertices in its convex hull."""
    points = np.random.default_rng(0).normal(size=(vertices, 3))
    points *= 0.03 / np.linalg.norm(points, axis=1, keepdims=True)
    keys = "".join(f' {name}="{value}"' for name, value in more.items())
    return f'<mesh name="ball" vertex="{" ".join(f"{x:.6f}" for x in points.reshape(-1))}"{keys}/>'


PID = (
    '<extension><plugin plugin="mujoco.pid"><instance name="own"><config key="kp" value="3"/></instance></plugin>'
    "</extension>"
)
MESH = 'name="foot" type="mesh" mesh="ball" mass="0.1"'


@pytest.mark.parametrize("vertices", [LARGEST_HULL + 60, 700])
def test_fine_collision_meshes_are_refused_with_limit_and_fix(vertices: int):
    found = check_mjx(load(asset=ball(vertices), left=MESH))
    assert found is not None
    assert f"the mesh ball (foot) has {vertices} vertices" in found[0] and "more than 200" in found[0]
    assert 'maxhullvert="32"' in found[1] and 'contype="0"' in found[1]


@pytest.mark.parametrize("other", [MESH.replace("foot", "other"), 'name="other" type="box" size="0.1 0.1 0.1"'])
def test_meshes_that_collide_with_meshes_or_boxes_must_be_coarser(other: str):
    vertices = (LARGEST_HULL + LARGEST_PAIR) // 2
    assert check_mjx(load(asset=ball(vertices), left=MESH)) is None
    found = check_mjx(load(asset=ball(vertices), left=MESH, right=other))
    assert found is not None and f"{vertices} vertices, and it collides with" in found[0]
    assert check_mjx(load(asset=ball(vertices, maxhullvert="32"), left=MESH, right=other)) is None
    assert check_mjx(load(asset=ball(LARGEST_PAIR), left=MESH, right=other)) is None


def test_visual_meshes_may_have_any_number_of_vertices():
    assert check_mjx(load(asset=ball(3000), left=MESH + ' contype="0" conaffinity="0"')) is None


@pytest.mark.parametrize(
    ("parts", "problem", "fix"),
    [
        ({"option": 'integrator="implicit"'}, 'integrator "implicit"', "implicitfast"),
        ({"option": 'solver="PGS"'}, 'solver "pgs"', "Newton"),
        ({"option": 'integrator="implicitfast" density="1.2"'}, "fluid", "Euler"),
        ({"option": 'integrator="Euler" density="1.2"', "left": 'name="hull" size="0.02" fluidshape="ellipsoid"'},
         'hull has fluidshape="ellipsoid"', "inertia box"),
        ({"option": 'cone="elliptic"', "left": 'size="0.02" condim="1"'}, "elliptic cones", "pyramidal"),
        ({"left": 'name="rod" type="cylinder" size="0.02 0.1"', "right": 'name="cube" type="box" size="0.1 0.1 0.1"'},
         "rod and cube collide, but MJX has no collisions of cylinder and box", "exclude the pair"),
        ({"asset": ball(20), "left": MESH + ' margin="0.01"'}, "foot collide with a margin", 'margin="0"'),
        ({"more": '<sensor><user name="mood" dim="1"/></sensor>'}, 'a sensor "user" (mood)', "leave it out"),
        ({"more": '<sensor><contact name="foot" body1="left"/></sensor>'}, "contact sensor", "name geoms"),
        ({"more": '<actuator><adhesion name="sticky" body="left" ctrlrange="0 1"/></actuator>'},
         'an actuator on "body" (sticky)', "put it on a joint"),
        ({"joint": 'stiffness="1 0.5 0"'}, "the joint left has a nonlinear stiffness", '"stiffness" a single number'),
        ({"joint": 'damping="0.1 0 0.5"'}, "the joint left has a nonlinear damping", '"damping" a single number'),
        ({"cable": 'stiffness="1 0.5 0"'}, "the tendon cable has a nonlinear stiffness", "a single number"),
        ({"cable": 'damping="0.1 0.5 0"'}, "the tendon cable has a nonlinear damping", "a single number"),
        ({"motor": 'damping="0.1"'}, "the actuator m has a damping", "at the joint or tendon"),
        ({"motor": 'damping="0 0.1 0"'}, "the actuator m has a damping", "at the joint or tendon"),
        ({"motor": 'armature="0.01"'}, "the actuator m has an armature", "at the joint or tendon"),
        ({"motor": 'delay="0.02" nsample="4"'}, "the actuator m has a delay", "declare the delay"),
        ({"motor": 'dyntype="filter" dynprm="0.1" actearly="true"'}, 'm has "actearly"', "remove it"),
        ({"flag": 'spring="disable"'}, 'it disables "spring" alone', 'remove the flag, and the stiffness'),
        ({"flag": 'damper="disable"'}, 'it disables "damper" alone', 'remove the flag, and the damping'),
        ({"flag": 'spring="disable" damper="disable"', "joint": 'damping="1"'}, 'it disables "damper" together with',
         'add eulerdamp="disable"'),
        ({"option": 'noslip_iterations="3"'}, "it has noslip_iterations", "remove it"),
        ({"plugin": PID, "more": '<actuator><plugin joint="right" plugin="mujoco.pid" instance="own"/></actuator>'},
         "it has the plugin own", "remove it"),
        ({"option": 'actuatorgroupdisable="0 2"', "motor": 'group="2"'}, "the actuator group 2", "remove the group's"),
    ],
)  # fmt: skip
def test_features_that_mjx_lacks_are_reported_with_a_fix(parts: dict[str, str], problem: str, fix: str):
    found = check_mjx(load(**parts))
    assert found is not None and problem in found[0] and fix in found[1]


def test_features_that_mjx_simulates_are_accepted():
    for option in (
        'integrator="Euler" density="1.2"', 'integrator="RK4"', 'cone="elliptic"', 'solver="CG"',
        'actuatorgroupdisable="1"',
    ):  # fmt: skip
        assert check_mjx(load(option=option)) is None
    both = 'spring="disable" damper="disable"'
    assert check_mjx(load(flag=both)) is None
    assert check_mjx(load(flag=both + ' eulerdamp="disable"', joint='damping="1"')) is None
    assert check_mjx(load(flag=both, option='integrator="implicitfast"', joint='damping="1"')) is None
    assert check_mjx(load(left='size="0.02" fluidshape="ellipsoid"')) is None, "without a fluid, it has no effect"
