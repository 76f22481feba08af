"""Fits of declared parameters to recordings of a servo arm from C MuJoCo, with noise and known parameters. The fit
recovers the parameters and reports those that the data do not identify."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from robot_files import write_robot
from servo_arm import write_arm

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.fit_report import fit_details, fit_table, intervals
from ballu_mjx.identification.fit_robot import FitConfig, RobotFit, analyse, check_data, fit_robot, replay
from ballu_mjx.identification.measured_motion import MeasuredMotion, SamplingConfig, measure
from ballu_mjx.identification.parameters import IdentifiedParameters, Parameter, ParameterSet
from ballu_mjx.identification.window_objective import ReducedResiduals, robust_scatter, soften
from ballu_mjx.identification.window_simulator import WindowSimulator, cut_windows
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import FRICTION_ITERATIONS
from ballu_mjx.runs.layout import RUN_FORMAT
from ballu_mjx.viz.report_content import collect

MODEL = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.005" integrator="implicitfast" iterations="4" ls_iterations="10"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="elbow" axis="0 1 0" damping="0.05" armature="0.01" frictionloss="0.02"/>
      <inertial pos="0 0 -0.15" mass="0.3" diaginertia="0.002 0.002 0.0003"/>
      <site name="tip" pos="0 0 -0.3"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="elbow" kp="4" kv="0.1" ctrlrange="0 1" forcerange="-20 20"/>
  </actuator>
</mujoco>
"""
IDENTIFY = [
    {"joint": "elbow", "field": "damping", "bounds": [0.005, 0.5], "prior": 0.05},
    {"joint": "elbow", "field": "frictionloss", "bounds": [0.001, 0.5], "prior": 0.1},
    {"actuator": "servo", "field": "kp"},
    {"body": "arm", "field": "mass", "name": "mass"},
    {"command": "elbow", "field": "delay"},
    {"actuator": "servo", "field": "forcerange", "bounds": [5, 20], "prior": 5},
]
TRUTH = {"elbow_damping": 0.12, "elbow_frictionloss": 0.08, "servo_kp": 3.2, "mass": 0.36, "elbow_delay": 0.033}
NOISE = np.deg2rad(0.2)


def robot(folder: Path) -> tuple[RobotDescription, ParameterSet, mujoco.MjModel]:
    keys = {"tracked": "tip", "commands": {"elbow": "servo"}, "joints": ["elbow"], "identify": IDENTIFY}
    description = write_robot(folder, "arm", MODEL, **keys)
    model = description.load_model()
    return description, declared_parameters(description, model), model


def record(folder: Path, name: str, seed: int, seconds: float = 6.0) -> Path:
    """Record the true arm at 100 Hz, simulated by C MuJoCo at the model's time step."""
    spec = mujoco.MjSpec.from_string(MODEL)
    spec.joint("elbow").damping[0] = TRUTH["elbow_damping"]
    spec.joint("elbow").frictionloss = TRUTH["elbow_frictionloss"]
    spec.actuator("servo").gainprm[0] = TRUTH["servo_kp"]
    spec.actuator("servo").biasprm[1] = -TRUTH["servo_kp"]
    spec.body("arm").mass = TRUTH["mass"]
    spec.body("arm").inertia = np.array([0.002, 0.002, 0.0003]) * TRUTH["mass"] / 0.3
    model = spec.compile()
    model.opt.iterations, model.opt.tolerance = 50, 0
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    steps, dt = round(seconds / model.opt.timestep), model.opt.timestep
    command = np.repeat(rng.uniform(0, 1, steps // 80 + 1), 80)[:steps].round(4)
    rows = ["time,command_elbow,tip_x,tip_y,tip_z,tip_qw,tip_qx,tip_qy,tip_qz,elbow"]
    late = np.interp(np.arange(steps) - TRUTH["elbow_delay"] / dt, np.arange(steps), command)
    for step in range(steps):
        if step % 2 == 0:
            mujoco.mj_kinematics(model, data)
            place = np.concatenate([data.site("tip").xpos, data.body("arm").xquat])
            angle = data.qpos[0] + NOISE * rng.normal()
            cells = [step * dt, command[step], *place, angle]
            rows.append(",".join(f"{cell:.6f}" for cell in cells))
        data.ctrl[:] = late[step]
        mujoco.mj_step(model, data)
    path = folder / f"{name}.csv"
    path.write_text("\n".join(rows) + "\n")
    keys = {"format": "ballu-recording/1", "kind": "free", "robot": "arm", "notes": ""}
    path.with_suffix(".json").write_text(json.dumps(keys))
    return path


@pytest.fixture(scope="module")
def motions(tmp_path_factory: pytest.TempPathFactory) -> list[MeasuredMotion]:
    folder = tmp_path_factory.mktemp("arm")
    description, _, model = robot(folder)
    config = SamplingConfig(angle_noise=NOISE, rate_window=0.07)
    return [
        measure(read_recording(record(folder, f"motion-{seed}", seed), description), description, model, config)
        for seed in range(3)
    ]


@pytest.fixture(scope="module")
def parameters(tmp_path_factory: pytest.TempPathFactory) -> ParameterSet:
    return robot(tmp_path_factory.mktemp("arm"))[1]


CONFIG = FitConfig(window_seconds=1.0, starts=2)


@pytest.fixture(scope="module")
def fit(motions: list[MeasuredMotion], parameters: ParameterSet) -> RobotFit:
    return fit_robot(parameters, motions[:2], motions[2:], CONFIG)


def test_known_parameters_are_found_within_two_standard_errors(fit: RobotFit):
    for name, value, error in zip(fit.parameters.names, fit.values, fit.standard_errors, strict=True):
        if name in TRUTH:
            assert abs(value - TRUTH[name]) < 2 * error, (name, value, error)
            assert error < 0.1 * TRUTH[name], (name, value, error)


def test_identified_parameters_improve_held_out_windows(fit: RobotFit):
    assert fit.improves
    assert fit.identified.score < 0.2 * fit.nominal.score
    np.testing.assert_allclose(fit.best.values, fit.values)
    # Only the noise of the angles remains.
    np.testing.assert_allclose(fit.scatter[0], 1.0, atol=0.15)


def test_report_warns_of_held_out_errors_far_above_the_noise(fit: RobotFit, tmp_path: Path):
    doubt, model = "the model may lack a force", robot(tmp_path)[2]
    assert doubt not in fit_table(fit, model, 1.0, "validation recordings")
    lacking = dataclasses.replace(fit, identified=fit.nominal)
    assert lacking.identified.score > 2
    assert doubt in fit_table(lacking, model, 1.0, "validation recordings")


def test_errors_of_diverged_windows_are_null_in_the_file_and_named_in_the_report(fit: RobotFit, tmp_path: Path):
    lost = dataclasses.replace(fit.nominal, errors=np.full_like(fit.nominal.errors, np.nan))
    details = fit_details(dataclasses.replace(fit, nominal=lost), robot(tmp_path)[2])
    text = json.dumps(details, allow_nan=False)
    assert details["held_out"]["nominal"]["score"] is None
    assert set(details["held_out"]["nominal"]["final_median"].values()) == {None}
    (tmp_path / "config.json").write_text(json.dumps({"format": RUN_FORMAT, "task": "sysid"}))
    (tmp_path / "identification.json").write_text(text)
    rows = collect(tmp_path).tables[-1].rows
    assert [row[1].text for row in rows] == ["diverged"] * len(rows)
    assert all(float(row[2].exact or "nan") < 1 for row in rows[1:])


def test_identified_parameters_worse_than_nominal_are_not_chosen(fit: RobotFit):
    swapped = dataclasses.replace(fit, nominal=fit.identified, identified=fit.nominal)
    assert not swapped.improves
    np.testing.assert_allclose(swapped.best.values, fit.parameters.nominal)


def test_fit_names_a_torque_limit_that_no_recording_reaches(parameters: ParameterSet, fit: RobotFit):
    assert fit.unseen == ("servo_forcerange",)
    assert len(fit.unidentified) == 1 and fit.unidentified[0] == "+1.00 servo_forcerange"
    # The parameter keeps the mean of its prior, with the prior's standard deviation. Its bound is no finding.
    place = parameters.names.index("servo_forcerange")
    np.testing.assert_allclose(fit.values[place], 20.0, rtol=0.02)
    np.testing.assert_allclose(fit.standard_errors[place], 5.0, rtol=0.02)
    assert parameters.at_bounds(fit.values) == ("servo_forcerange",) and not fit.at_bounds


@pytest.mark.slow
def test_windows_have_the_solver_iterations_of_models_with_identified_friction(tmp_path: Path):
    """A single iteration does not determine which of two joints stick."""
    friction = tuple({"joint": joint, "field": "frictionloss", "bounds": [0, 1]} for joint in ("shoulder", "elbow"))
    description = dataclasses.replace(write_arm(tmp_path), identify=friction)
    description.model.write_text(description.model.read_text().replace(' iterations="6"', ' iterations="1"'))
    nominal, values, every = description.load_model(), np.array([0.6, 0.3]), 4
    parameters = declared_parameters(description, nominal)
    model = description.load_model(IdentifiedParameters(jnp.asarray(values), parameters))
    assert (nominal.opt.iterations, model.opt.iterations) == (1, FRICTION_ITERATIONS)
    model.opt.ls_iterations = 50  # C MuJoCo's line search needs more evaluations than ours
    data, commands = mujoco.MjData(model), np.repeat(np.random.default_rng(0).uniform(-1, 1, (5, 2)), 40, axis=0)
    states = [np.zeros(4)]
    for command in commands:
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel]))
    qpos, qvel = np.split(np.array(states)[::every], 2, axis=1)
    motion = MeasuredMotion("exact", nominal, every, commands, qpos, qpos, qvel, np.ones(2), np.ones(2))
    with jax.enable_x64(True):
        found = WindowSimulator(parameters, [motion], cut_windows([motion], 1.0)).differences(values)
    assert np.abs(found).max() < 1e-6


@pytest.mark.slow
def test_derivatives_agree_with_finite_differences(motions: list[MeasuredMotion], parameters: ParameterSet):
    values = np.array([0.12, 0.08, 3.2, 0.36, 0.0333, 20.0])
    with jax.enable_x64(True):
        simulator = WindowSimulator(parameters, motions[:2], cut_windows(motions[:2], CONFIG.window_seconds))
        start = 0.3 * np.random.default_rng(0).normal(size=(simulator.count, simulator.channels))
        found = simulator.linearize(values, start)
        np.testing.assert_allclose(found.values, simulator.differences(values, start), atol=1e-9)
        for place in range(len(values) - 1):
            step = 1e-5 * values * np.eye(len(values))[place]
            change = simulator.differences(values + step, start) - simulator.differences(values - step, start)
            derivative, true = found.by_parameters[..., place], change / (2 * step[place])
            # Finite differences are wrong where a joint begins to stick or slip at another step, which is rare.
            off = np.abs(derivative - true) > 0.01 * np.abs(true).max()
            assert off.mean() < 0.02, (place, off.mean())
        step = np.array([1e-4, 0.0])
        change = simulator.differences(values, start + step) - simulator.differences(values, start - step)
        np.testing.assert_allclose(found.by_start[..., 0], change / 2e-4, atol=0.02)


@pytest.mark.slow
def test_fit_with_fixed_starting_states_returns_the_best_point_tried(
    motions: list[MeasuredMotion], parameters: ParameterSet
):
    tried: list[np.ndarray] = []
    config = FitConfig(window_seconds=1.0, starts=1, start_spread=0.0, reweigh=False)
    fit = fit_robot(parameters, motions[:2], motions[2:], config, on_evaluation=tried.append)
    with jax.enable_x64(True):
        simulator = WindowSimulator(parameters, motions[:2], cut_windows(motions[:2], 1.0))
        # Position errors are divided by the measurement noise alone, and starting states are fixed.
        losses = [
            np.sum(soften(simulator.differences(values)[..., : simulator.nv], config.outlying)[0] ** 2)
            + np.sum(((values - parameters.nominal) / parameters.prior) ** 2)
            for values in (fit.values, *tried)
        ]
        free = simulator.linearize(fit.values, np.zeros((simulator.count, simulator.channels)))
        held = simulator.linearize(fit.values, np.zeros((simulator.count, 0)))
    np.testing.assert_allclose(losses[0], min(losses), rtol=1e-9)
    assert losses[0] < 0.5 * losses[1]
    assert held.by_start.size == 0
    np.testing.assert_allclose(held.by_parameters, free.by_parameters, atol=1e-9)


@pytest.mark.slow
def test_a_motion_with_its_own_model_is_simulated_with_that_model(
    motions: list[MeasuredMotion], parameters: ParameterSet
):
    spec = mujoco.MjSpec.from_string(MODEL)
    spec.body("arm").mass = 0.9
    loaded = dataclasses.replace(motions[1], model=spec.compile())
    pair = [motions[0], loaded]
    both, alone = (replay(parameters, each, [parameters.nominal], 1.0)[0] for each in (pair, [loaded]))
    np.testing.assert_allclose(both.errors[both.motion == 1], alone.errors, atol=1e-9)
    assert not np.allclose(both.errors[both.motion == 1], both.errors[both.motion == 0], atol=1e-3)


def test_softening_keeps_small_differences_and_flattens_large_ones():
    values = np.array([-100.0, -0.1, 0.0, 0.1, 100.0])
    soft, derivatives = soften(values, 3.0)
    np.testing.assert_allclose(soft**2, 2 * 9 * (np.sqrt(1 + values**2 / 9) - 1), atol=1e-12)
    change = (soften(values + 1e-6, 3.0)[0] - soften(values - 1e-6, 3.0)[0]) / 2e-6
    np.testing.assert_allclose(derivatives, change, atol=1e-6)


def test_diverged_windows_do_not_make_the_scatter_undefined():
    differences = np.random.default_rng(0).normal(size=(20, 30, 2))
    differences[0] = np.nan
    np.testing.assert_allclose(robust_scatter(3 * differences), robust_scatter(3 * differences[1:]), rtol=0.1)


def test_fit_refuses_unsuitable_input(motions: list[MeasuredMotion], parameters: ParameterSet, tmp_path: Path):
    with pytest.raises(InputError, match="no recording lasts 60 s"):
        fit_robot(parameters, motions, None, FitConfig(window_seconds=60.0))
    with pytest.raises(InputError, match="--interval-seconds is 0.2, less than --window-seconds"):
        fit_robot(parameters, motions, None, FitConfig(window_seconds=0.5, interval_seconds=0.2))
    with pytest.raises(InputError, match="--starts is 0"):
        check_data(parameters, motions, FitConfig(starts=0))
    description, _, model = robot(tmp_path)
    path = record(tmp_path, "short", 0, 1.5)
    rows = [line.rpartition(",")[0] for line in path.read_text().splitlines()]
    path.write_text("\n".join(rows) + "\n")
    with pytest.raises(InputError, match="joint elbow was not recorded"):
        measure(read_recording(path, description), description, model)


def test_one_window_has_the_standard_errors_of_white_noise_and_no_interval(fit: RobotFit):
    rng = np.random.default_rng(0)
    jacobian, noise = rng.normal(size=(1, 40, 1)), 0.1 * rng.normal(size=(1, 40))
    parameters = ParameterSet([Parameter("one", "1", 0.0, (-100.0, 100.0), np.inf, False, ())], 0)
    found = analyse(ReducedResiduals(noise, jacobian, np.zeros((1, 0)), np.zeros((1, 0, 1))), parameters)
    exact = np.sqrt(np.sum(noise**2) / 39 / np.sum(jacobian**2))
    np.testing.assert_allclose(found.robust, exact, rtol=1e-6)
    single = dataclasses.replace(fit, windows=fit.windows._replace(motion=np.zeros(1, int), first=np.zeros(1, int)))
    bounds = np.stack([fit.parameters.lower, fit.parameters.upper], axis=1)
    np.testing.assert_array_equal(intervals(single), bounds)
    assert np.all(np.ptp(intervals(fit), axis=1) < np.ptp(bounds, axis=1))


WHEEL = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="rim">
      <joint name="axle" axis="0 0 1"/>
      <geom size="0.1" mass="1"/>
      <site name="rim"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="axle" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize(("rate", "rate_window"), [(100, 0.05), (25, 0.19), (100, 0.19)])
def test_noise_of_velocities_is_at_least_the_noise_of_angles_that_their_filter_passes(
    tmp_path: Path, rate: float, rate_window: float
):
    """With few samples per filter, the filters of full and of half the width are the same."""
    robot = write_robot(tmp_path, "wheel", WHEEL, tracked="rim", commands={"wheel": "motor"}, joints=["axle"])
    time, noise = np.arange(2000) / rate, 0.01
    angle = 0.2 * np.sin(0.5 * time) + noise * np.random.default_rng(0).normal(size=len(time))
    recording = Recording(
        name="slow", kind="free", robot="wheel", time=time, command=np.zeros((2000, 1)), joint_angles={"axle": angle}
    )
    config = SamplingConfig(sample_timestep=1 / rate, angle_noise=noise, rate_window=rate_window)
    found = measure(recording, robot, robot.load_model(), config)
    errors = found.qvel[20:-20, 0] - 0.1 * np.cos(0.5 * time[20:-20])
    assert 0.9 < found.velocity_noise[0] / np.std(errors) < 4


def test_an_angle_that_counts_each_turn_from_0_is_the_same_motion(tmp_path: Path):
    robot = write_robot(tmp_path, "wheel", WHEEL, tracked="rim", commands={"wheel": "motor"}, joints=["axle"])
    time = np.arange(301) / 100
    angle = 4.0 * time + 0.3 * np.sin(3 * time)
    for name, column in (("counted", angle), ("wrapped", (angle + np.pi) % (2 * np.pi) - np.pi)):
        rows = ["time,command_wheel,rim_x,rim_y,rim_z,rim_qw,rim_qx,rim_qy,rim_qz,axle"]
        for t, turn, shown in zip(time, angle, column, strict=True):
            pose = [0, 0, 0, np.cos(turn / 2), 0, 0, np.sin(turn / 2)]
            rows.append(",".join(f"{x:.8f}" for x in [t, 0.0, *pose, shown]))
        (tmp_path / f"{name}.csv").write_text("\n".join(rows) + "\n")
        head = {"format": "ballu-recording/1", "kind": "free", "robot": "wheel", "notes": ""}
        (tmp_path / f"{name}.json").write_text(json.dumps(head))
    counted, wrapped = (
        measure(read_recording(tmp_path / f"{name}.csv", robot), robot, robot.load_model())
        for name in ("counted", "wrapped")
    )
    np.testing.assert_allclose(np.diff(wrapped.qpos, axis=0), np.diff(counted.qpos, axis=0), atol=1e-6)
    np.testing.assert_allclose(wrapped.qvel, counted.qvel, atol=1e-6)
    assert wrapped.qvel.max() < 6.0


def test_robust_standard_errors_agree_with_the_jackknife_over_windows():
    """The model is linear and has no priors, and each window has its own constant error. The expected standard errors
    come from fits that leave out one window at a time (jackknife)."""
    rng = np.random.default_rng(0)
    windows, rows = 7, 5
    jacobian = rng.normal(size=(windows, rows, 2))
    measured = jacobian @ [1.0, -2.0] + rng.normal(size=(windows, 1)) + 0.1 * rng.normal(size=(windows, rows))

    def solved(kept: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(jacobian[kept].reshape(-1, 2), measured[kept].ravel(), rcond=None)[0]

    every = np.ones(windows, bool)
    best = solved(every)
    changes = np.array([solved(every & (np.arange(windows) != left)) - best for left in range(windows)])
    names, bounds = ("one", "other"), (-100.0, 100.0)
    parameters = ParameterSet([Parameter(name, "1", 0.0, bounds, np.inf, False, ()) for name in names], 0)
    none = np.zeros((windows, 0))
    reduced = ReducedResiduals(jacobian @ best - measured, jacobian, none, np.zeros((windows, 0, 2)))
    found = analyse(reduced, parameters)
    expected = np.sqrt((windows - 1) / windows * np.sum(changes**2, axis=0))
    np.testing.assert_allclose(found.robust, expected, rtol=1e-3)
