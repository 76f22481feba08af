"""Declared parameters: the model fields that they set, their coordinates, and errors in declarations."""

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from robot_files import write_robot

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.body_deformation import BODY_QUANTITIES, deform_body
from ballu_mjx.identification.bounded_solver import bounded_least_squares
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.parameters import IdentifiedParameters, ParameterSet
from ballu_mjx.identification.window_objective import ReducedResiduals, WindowSearch
from ballu_mjx.robots.model import ModelParameters, set_fields
from ballu_mjx.sim.drivetrain import identity_drivetrain

MODEL = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="left" axis="0 1 0" damping="0.1" stiffness="2"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0.2 0.02 -0.3" size="0.02" mass="0.4"/>
      <body name="hand" pos="0 0 -0.3">
        <joint name="right" axis="0 1 0" damping="0.1" stiffness="3"/>
        <geom name="palm" type="box" pos="0.05 0 0" size="0.03 0.04 0.05" mass="0.2"/>
        <site name="tip" pos="0 0 -0.1"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="cable" springlength="0 0.1" stiffness="10"><joint joint="left" coef="1"/></fixed>
  </tendon>
  <actuator>
    <position name="servo_left" joint="left" kp="5" kv="0.2" ctrlrange="-1 1" forcerange="-2 2"/>
    <motor name="servo_right" joint="right" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def arm(folder: Path, *entries: dict[str, Any]) -> tuple[ParameterSet, mujoco.MjModel]:
    commands = {"left": "servo_left", "right": "servo_right"}
    robot = write_robot(folder, "arm", MODEL, tracked="tip", commands=commands, identify=list(entries))
    model = robot.load_model()
    return declared_parameters(robot, model), model


EVERYTHING = (
    {"joint": ["left", "right"], "field": "damping"},
    {"joint": "left", "field": "frictionloss", "bounds": [0, 1]},
    {"actuator": "servo_left", "field": "kp"},
    {"actuator": "servo_left", "field": "kd"},
    {"actuator": "servo_left", "field": "forcerange"},
    {"actuator": "servo_right", "field": "strength"},
    {"tendon": "cable", "field": "springlength"},
    {"body": "hand", "field": "mass_properties"},
    {"command": "left", "field": "delay"},
    {"command": "right", "field": "rate_limit"},
)


def test_nominal_values_change_nothing(tmp_path: Path):
    parameters, model = arm(tmp_path, *EVERYTHING)
    with jax.enable_x64(True):
        fields = parameters.fields(model, parameters.nominal)
    same = copy.copy(model)
    set_fields(same, {name: value for name, value in fields.items() if name not in ("body_inertia", "body_iquat")})
    for name in fields:
        if name not in ("body_inertia", "body_iquat"):
            np.testing.assert_allclose(getattr(same, name), getattr(model, name), rtol=1e-12, atol=1e-8)
    np.testing.assert_allclose(
        np.sort(fields["body_inertia"]), np.sort(model.body_inertia), rtol=1e-5
    )  # the order of the principal axes may change, and the orientation with it
    drivetrain = parameters.drivetrain(parameters.nominal)
    for own, same in zip(drivetrain, identity_drivetrain(2), strict=True):
        ours = jnp.minimum(own, 2 / model.opt.timestep)  # a rate limit this high has no effect
        np.testing.assert_allclose(ours, jnp.minimum(same, 2 / model.opt.timestep))


def test_one_of_the_ten_numbers_of_a_body_can_be_declared_alone(tmp_path: Path):
    """It has the same effect as within `mass_properties`."""
    alone, model = arm(tmp_path, {"body": "hand", "field": "stretch_z", "bounds": [0.5, 2]})
    assert list(alone.names) == ["hand_stretch_z"] and alone.parameters[0].bounds == (0.5, 2.0)
    (tmp_path / "ten").mkdir()
    ten, _ = arm(tmp_path / "ten", {"body": "hand", "field": "mass_properties"})
    values = ten.nominal.copy()
    values[ten.names.index("hand_stretch_z")] = 1.3
    with jax.enable_x64(True):
        found, expected = (
            {name: np.asarray(field) for name, field in parameters.fields(model, own).items()}
            for parameters, own in ((alone, np.array([1.3])), (ten, values))
        )
    for name, field in expected.items():
        np.testing.assert_allclose(found[name], field, rtol=1e-9, atol=1e-12, err_msg=name)
    assert np.abs(found["body_inertia"] - model.body_inertia).max() > 1e-6


def test_tied_parameters_set_all_their_targets(tmp_path: Path):
    parameters, model = arm(
        tmp_path,
        {"joint": ["left", "right"], "field": "damping"},
        {"actuator": "servo_left", "field": "kp"},
        {"actuator": "servo_left", "field": "forcerange"},
        {
            "name": "springs",
            "targets": [
                {"joint": "left", "field": "stiffness"},
                {"joint": "right", "field": "stiffness", "factor": 1.5},
            ],
        },
    )
    assert parameters.names == ("left_and_right_damping", "servo_left_kp", "servo_left_forcerange", "springs")
    np.testing.assert_allclose(parameters.nominal, [0.1, 5.0, 2.0, 2.0])
    fields = parameters.fields(model, np.array([0.3, 7.0, 1.5, 4.0]))
    np.testing.assert_allclose(fields["dof_damping"], [0.3, 0.3], rtol=1e-6)
    np.testing.assert_allclose(fields["actuator_gainprm"][0, 0], 7.0, rtol=1e-6)
    np.testing.assert_allclose(fields["actuator_biasprm"][0, :3], [0.0, -7.0, -0.2], rtol=1e-6)
    np.testing.assert_allclose(fields["actuator_forcerange"][0], [-1.5, 1.5], rtol=1e-6)
    np.testing.assert_allclose(fields["jnt_stiffness"], [4.0, 6.0], rtol=1e-6)


def test_centres_of_mass_of_mirrored_bodies_move_in_opposite_directions(tmp_path: Path):
    targets = [{"body": "arm", "field": "com_y", "factor": 2}, {"body": "hand", "field": "com_y", "factor": -1}]
    parameters, model = arm(tmp_path, {"targets": targets})
    (tmp_path / "alone").mkdir()
    alone, _ = arm(tmp_path / "alone", *({**target, "factor": 1} for target in targets))
    with jax.enable_x64(True):
        found, expected = (
            np.asarray(declared.fields(model, np.array(values))["body_ipos"])
            for declared, values in ((parameters, [0.01]), (alone, [0.02, -0.01]))
        )
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(2 * np.array(parameters.parameters[0].bounds), alone.parameters[0].bounds)


def test_shares_0_and_1_are_the_bounds_of_a_parameter(tmp_path: Path):
    parameters, _ = arm(tmp_path, *EVERYTHING)
    for share, bound in ((0.0, parameters.lower), (1.0, parameters.upper)):
        np.testing.assert_allclose(parameters.at_shares(np.full(len(parameters), share)), bound, atol=1e-12)
    values = parameters.draw(0, 20)
    shares = parameters.shares(values)
    np.testing.assert_allclose(parameters.at_shares(shares), values, rtol=1e-9)
    change = (parameters.at_shares(shares + 1e-6) - parameters.at_shares(shares - 1e-6)) / 2e-6
    np.testing.assert_allclose([parameters.with_respect_to_shares(each) for each in values], change, rtol=1e-6)
    assert (values > parameters.lower).all() and (values < parameters.upper).all()
    # The first draw is nominal, except for parameters whose nominal value is a bound.
    inside = (parameters.nominal > parameters.lower) & (parameters.nominal < parameters.upper)
    np.testing.assert_allclose(values[0, inside], parameters.nominal[inside], rtol=1e-9)
    assert parameters.at_bounds(np.where(np.arange(len(parameters)) == 2, parameters.upper, values[1])) == (
        "servo_left_kp",
    )


def test_every_deformation_of_a_body_is_a_valid_rigid_body():
    mass, ipos, inertia = 0.4, np.array([0.1, 0.2, 0.3]), np.array([2e-3, 2e-3, 5e-4])
    iquat = np.array([0.5, -0.5, 0.5, 0.5])
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        for draw in range(50):
            numbers = np.concatenate([np.exp(rng.normal(size=1)), rng.normal(size=3), np.exp(rng.normal(size=3))])
            numbers = np.concatenate([numbers, rng.normal(size=3)])
            if draw == 0:
                numbers = np.array([1.0, 0, 0, 0, 1, 1, 1, 0, 0, 0])
            new_mass, centre, quaternion, own = map(
                np.asarray, deform_body(*map(jnp.asarray, (mass, ipos, iquat, inertia, numbers)))
            )
            assert new_mass > 0 and (own > 0).all()
            assert 2 * own.max() < own.sum()
            np.testing.assert_allclose(np.linalg.norm(quaternion), 1)
            # Expected values: sums over six point masses with the same moments.
            axes, turned = np.zeros(9), np.zeros(9)
            mujoco.mju_quat2Mat(axes, iquat)
            mujoco.mju_quat2Mat(turned, quaternion)
            axes, turned = axes.reshape(3, 3), turned.reshape(3, 3)
            stretch = np.diag(numbers[4:7])
            stretch[[0, 0, 1], [1, 2, 2]] = numbers[7:]
            points = np.sqrt(3 * (inertia.sum() / 2 - inertia) / mass) * np.concatenate([np.eye(3), -np.eye(3)])
            points = points @ stretch.T @ axes.T
            weight = numbers[0] * mass / 6
            whole = weight * sum(np.dot(p, p) * np.eye(3) - np.outer(p, p) for p in points)
            np.testing.assert_allclose(turned @ np.diag(own) @ turned.T, whole, rtol=1e-4, atol=1e-5 * own.max())
            np.testing.assert_allclose(centre, ipos + axes @ numbers[1:4])


def test_derivatives_of_inertia_exist_for_equal_principal_moments():
    """Two principal moments of a rod are equal, so its principal axes have no derivatives."""
    mass, ipos, inertia, iquat = 0.4, np.zeros(3), np.array([2e-3, 2e-3, 5e-4]), np.array([1.0, 0, 0, 0])

    def whole(numbers: jax.Array) -> jax.Array:
        nominal = jnp.asarray(mass), jnp.asarray(ipos), jnp.asarray(iquat), jnp.asarray(inertia)
        _, _, quaternion, own = deform_body(*nominal, numbers)
        w, v = quaternion[0], quaternion[1:]
        cross = jnp.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        turned = jnp.eye(3) + 2 * w * cross + 2 * cross @ cross
        return turned @ jnp.diag(own) @ turned.T

    with jax.enable_x64(True):
        nominal = jnp.array([1.0, 0, 0, 0, 1, 1, 1, 0, 0, 0])
        jacobian = np.asarray(jax.jacfwd(whole)(nominal))
        for place in range(len(BODY_QUANTITIES)):
            step = np.eye(10)[place] * 1e-4
            change = (whole(nominal + step) - whole(nominal - step)) / 2e-4
            np.testing.assert_allclose(jacobian[..., place], change, atol=2e-8)


def test_identified_values_are_model_parameters(tmp_path: Path):
    parameters, model = arm(tmp_path, {"joint": "left", "field": "damping"}, {"command": "left", "field": "delay"})
    identified = IdentifiedParameters(jnp.array([0.2, 0.05]), parameters)
    assert isinstance(identified, ModelParameters)
    set_fields(model, identified.fields(model))
    np.testing.assert_allclose(model.dof_damping, [0.2, 0.1], rtol=1e-6)
    np.testing.assert_allclose(identified.drivetrain().delay, [0.05, 0.0])
    assert parameters.slots(0.01) == 12


def test_searches_from_all_starts_end_near_the_nominal_value_of_a_rate_limit_that_data_do_not_show(tmp_path: Path):
    parameters, _ = arm(tmp_path, {"joint": "left", "field": "damping"}, {"command": "left", "field": "rate_limit"})
    slopes = np.random.default_rng(0).normal(size=(3, 40, 2)) * [1e3, 0.0]

    class Linear:
        """Objective of data in which the damping is 0.3 and no command is limited."""

        def __init__(self) -> None:
            self.parameters = parameters

        def __call__(self, values: np.ndarray, start: np.ndarray) -> tuple[ReducedResiduals, Any]:
            residuals = slopes @ (values - [0.3, 0.0]) + 1.0
            reduced = ReducedResiduals(residuals, slopes, start, np.zeros((3, 0, 2)))
            return reduced, SimpleNamespace(values=residuals)

    starts = parameters.shares(parameters.draw(0, 4))
    assert np.ptp(starts[:, 1]) > 0.3
    for begin in starts:
        search: Any = WindowSearch(Linear(), np.zeros((3, 0)), None)  # pyright: ignore[reportArgumentType]
        shares, _ = bounded_least_squares(search, begin, 20, lambda *_: None, 6)
        np.testing.assert_allclose(parameters.at_shares(shares), [0.3, parameters.nominal[1]], rtol=0.02)


FAULTS = {
    "no such joint": ({"joint": "knee", "field": "damping"}, "entry 1 names 'knee', which is no joint of the model"),
    "no such field": ({"joint": "left", "field": "colour"}, 'entry 1 has the field "colour"'),
    "no such key": ({"joint": "left", "field": "damping", "bound": [0, 1]}, 'has the key "bound"'),
    "no bounds": ({"joint": "left", "field": "frictionloss"}, 'has no "bounds"'),
    "bounds without nominal": ({"joint": "left", "field": "damping", "bounds": [1, 2]}, "exclude the nominal 0.1"),
    "bounds the wrong way": ({"joint": "left", "field": "damping", "bounds": [2, 1]}, "the smaller first"),
    "negative": ({"joint": "left", "field": "damping", "bounds": [-1, 1]}, "damping must be 0 or more"),
    "unequal ties": ({"joint": ["left", "right"], "field": "stiffness"}, r"values differ \(2, 3\)"),
    "two kinds": ({"joint": "left", "body": "arm", "field": "damping"}, "names 2 kinds of elements"),
    "no feedback": ({"actuator": "servo_right", "field": "kp"}, "has no such feedback"),
    "no forcerange": ({"actuator": "servo_right", "field": "forcerange"}, "give the actuator a forcerange"),
    "no bias": ({"actuator": "servo_right", "field": "bias", "bounds": [-1, 1]}, "declares the bias of servo_right"),
    "no such command": ({"command": "middle", "field": "delay"}, "names 'middle', which is no command"),
    "a mass by its field": ({"body": "arm", "field": "body_mass"}, "there are mass, com, inertia, mass_properties"),
    "prior": ({"joint": "left", "field": "damping", "prior": 0}, "write a number above 0"),
    "bounds of one number": ({"joint": "left", "field": "damping", "bounds": 3}, "write two numbers"),
    "nominal of a body": ({"body": "arm", "field": "mass", "nominal": 0.25}, 'has "nominal", which follows'),
    "bounds of a body": ({"body": "arm", "field": "mass", "bounds": [1, 2]}, "exclude the nominal 0.4"),
    "negative mass": ({"body": "arm", "field": "mass", "bounds": [-1, 1]}, "mass must be above 0"),
    "no such key of a target": (
        {"targets": [{"joint": "left", "field": "damping", "facotr": 2}]},
        'a target with the key "facotr"',
    ),
    "a field beside targets": (
        {"targets": [{"joint": "left", "field": "damping"}], "field": "damping"},
        'has the key "field" beside "targets"',
    ),
    "a factor beside targets": (
        {"targets": [{"joint": "left", "field": "damping"}], "factor": 2},
        'has the key "factor" beside "targets"',
    ),
    "a factor of a mass": (
        {"targets": [{"body": "arm", "field": "mass"}, {"body": "hand", "field": "mass", "factor": 2}]},
        'has a "factor" of mass',
    ),
    "a body's mass tied to damping": (
        {"targets": [{"body": "arm", "field": "mass"}, {"joint": "left", "field": "damping"}]},
        "tie them to those of other bodies only",
    ),
    "bounds of ten": ({"body": "arm", "field": "mass_properties", "bounds": [0, 1]}, "leave it out"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_errors_in_declarations_name_file_and_entry(tmp_path: Path, fault: str):
    entry, message = FAULTS[fault]
    with pytest.raises(InputError, match=rf'arm\.robot\.json: "identify" .*{message}'):
        arm(tmp_path, entry)


def test_a_tie_of_command_and_model_changes_both(tmp_path: Path):
    ties = [{"command": "left", "field": "scale"}, {"actuator": "servo_left", "field": "strength"}]
    parameters, _ = arm(tmp_path, {"targets": ties}, {"joint": "left", "field": "damping"})
    np.testing.assert_array_equal(parameters.in_drivetrain, [True, False])


def test_repeated_and_missing_declarations_are_refused(tmp_path: Path):
    damping = {"joint": "left", "field": "damping"}
    with pytest.raises(InputError, match="two parameters left_damping"):
        arm(tmp_path, damping, damping)
    with pytest.raises(InputError, match="sets the same number by left_damping and again"):
        arm(tmp_path, damping, {**damping, "name": "again"})
    with pytest.raises(InputError, match='"identify" is missing'):
        arm(tmp_path)


def test_any_model_field_can_be_declared_by_its_mujoco_name(tmp_path: Path):
    parameters, model = arm(
        tmp_path, {"joint": "left", "field": "jnt_range", "index": 1, "bounds": [0, 1], "name": "stop"}
    )
    fields = parameters.fields(model, np.array([0.5]))
    np.testing.assert_allclose(fields["jnt_range"], [[0, 0.5], [0, 0]])


def test_default_names_have_letters_digits_and_underscores(tmp_path: Path):
    parameters, _ = arm(tmp_path, {"joint": "left", "field": "jnt_range", "index": 1, "bounds": [0, 1]})
    assert parameters.names == ("left_jnt_range_1",)


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"joint": "left", "field": "dof_invweight0", "bounds": [0, 9]}, "which MuJoCo derives"),
        ({"actuator": "servo_left", "field": "actuator_damping", "bounds": [0, 9]}, "which MJX does not simulate"),
        ({"command": "left", "field": "delay", "factor": -1}, "delay must be 0 or more; write a factor above 0"),
        ({"joint": "left", "field": "frictionloss", "bounds": [0, 1], "factor": -2}, "write a factor above 0"),
    ],
)
def test_fields_and_factors_that_cannot_be_simulated_are_refused(tmp_path: Path, entry: dict, sentence: str):
    with pytest.raises(InputError, match=sentence):
        arm(tmp_path, {"targets": [entry]} if "factor" in entry and "bounds" not in entry else entry)
