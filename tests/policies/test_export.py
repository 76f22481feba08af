"""The exported controller: it needs only NumPy, gives the policy's commands, and keeps its limits for any input."""

import ast
import dataclasses
import importlib.util
import itertools
import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rover import write_rover
from servo_arm import write_arm

from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.cli import export as export_command
from ballu_mjx.cli import train_policy
from ballu_mjx.cli.export import PolicyOptions as Options
from ballu_mjx.policies.deploy import controller, estimator, export
from ballu_mjx.policies.deploy.check import Agreement, PolicyCheck, Trial, check_policy
from ballu_mjx.policies.deploy.controller import TIMEOUT, Controller, observation_names
from ballu_mjx.policies.deploy.estimator import Capture
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.locomotion_env import locomotion_observation, num_observations
from ballu_mjx.policies.policy import Policy
from ballu_mjx.residuals.aerodynamics import (
    AERODYNAMICS_FILE,
    AERODYNAMICS_FORMAT,
    Aerodynamics,
    AirParameters,
    air_parameters_to_json,
)
from ballu_mjx.residuals.aerodynamics_fit import AirConfig
from ballu_mjx.residuals.deploy.export import export_simulator
from ballu_mjx.residuals.run_config import describe_run
from ballu_mjx.residuals.training_range import TrainingRange
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import Normalizer, Params, PPOConfig
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs.folder import Run
from ballu_mjx.sim.simulator import Simulator

BALLU = load_robot()
NAMES = ("balloon", "base", "foot_left", "foot_right")
FULL_TRAVEL = 0.2
LIMIT = BALLU.control_timestep / FULL_TRAVEL
CLEAN = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("jax", "jaxlib", "jaxtyping", "mujoco", "brax", "flax", "scipy", "ballu_mjx"):
            raise ImportError(name + " is not on the robot")

sys.meta_path.insert(0, Refuse())
sys.path.insert(0, sys.argv[1])
import numpy as np
from controller import Controller

controller = Controller(sys.argv[1])
features = np.load(sys.argv[2])
np.save(sys.argv[3], [controller.act(row) for row in features])
"""
"""Program that runs an exported policy with NumPy alone."""


def write_run(
    folder: Path,
    task: str = "walk",
    robot: RobotDescription = BALLU,
    residual: Path | None = None,
    actuators: ActuatorParameters | None = None,
    **settings: Any,
) -> Path:
    """Write a run with a random policy whose commands cover their ranges."""
    config = PPOConfig(policy_layers=(16, 12), value_layers=(4,), **settings)
    observations = num_observations(robot)
    networks = ppo.make_networks(observations, len(robot.commands), config)
    tree: Any = jax.device_get(networks.policy_network.init(jax.random.key(1)))
    tree["params"]["Dense_0"]["kernel"] = 100.0 * tree["params"]["Dense_0"]["kernel"]
    rng = np.random.default_rng(2)
    moments = ({"state": rng.uniform(0.1, 0.5, observations).astype(np.float32)} for _ in range(3))
    normalizer = Normalizer(np.float32(100.0), *moments)  # pyright: ignore[reportArgumentType]
    value = jax.device_get(networks.value_network.init(jax.random.key(3)))
    sections = {"env": LocomotionConfig(), "ppo": config, "data": train_policy.Data()}
    content = describe_run(task, sections, {}, [], identified=actuators, description=robot)
    content["residual"] = None if residual is None else str(residual)
    with Run(folder, content) as run:
        run.save(7, ppo.as_tree(Params(normalizer, tree, value)), -1.0)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("export") / "run")


@pytest.fixture(scope="module")
def exported(run: Path) -> Path:
    return export.export_policy(Options(run, open_loop=False))


def random_features(count: int) -> np.ndarray:
    rng = np.random.default_rng(4)
    features = rng.normal(0.0, 1.0, (count, 27))
    features[:, 8] = rng.uniform(-math.pi, math.pi, count)
    return features


def frame_at(time: float) -> dict[str, np.ndarray]:
    """Return a frame of a swaying robot."""
    sway = 0.3 * np.sin(4.0 * time + np.arange(3))
    return {
        "balloon_position": np.array([0.1, 0.0, 1.1]) + 0.2 * sway,
        "balloon_quaternion": np.array([np.cos(sway[0]), 0.0, 0.0, np.sin(sway[0])]),
        "base_position": np.array([0.1, 0.0, 0.75]) + 0.1 * sway,
        "foot_left_position": sway,
        "foot_right_position": -sway,
    }


@pytest.mark.parametrize("settings", [{}, {"activation": "tanh"}, {"normalize_observations": False}])
def test_exported_policy_gives_the_same_commands_with_numpy_alone(settings: dict, tmp_path: Path):
    folder = export.export_policy(Options(write_run(tmp_path / "run", **settings), tmp_path / "robot", open_loop=False))
    features = random_features(1000)
    np.save(tmp_path / "features.npy", features)
    line = [sys.executable, "-I", "-c", CLEAN, folder, tmp_path / "features.npy", tmp_path / "commands.npy"]
    done = subprocess.run(list(map(str, line)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    act = Policy.load(tmp_path / "run").act()
    expected = np.array([act(row) for row in features])
    assert np.mean((expected > 0.01) & (expected < 0.99)) > 0.2  # not all at the limits
    np.testing.assert_allclose(np.load(tmp_path / "commands.npy"), expected, atol=1e-5)


@pytest.mark.parametrize("settings", [{}, {"activation": "tanh"}, {"normalize_observations": False}])
def test_onnx_network_gives_the_same_commands(settings: dict, tmp_path: Path):
    import onnxruntime

    folder = export.export_policy(
        Options(write_run(tmp_path / "run", **settings), tmp_path / "robot", open_loop=False, onnx=True)
    )
    features = random_features(1000)
    observations = np.array([controller.observation(row) for row in features], np.float32)
    session = onnxruntime.InferenceSession(folder / "policy.onnx", providers=["CPUExecutionProvider"])
    commands = np.asarray(session.run(["command"], {"observation": observations})[0])
    act = Policy.load(tmp_path / "run").act()
    np.testing.assert_allclose(commands, np.array([act(row) for row in features]), atol=1e-5)


def test_export_reports_missing_onnx_before_it_writes_anything(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert export_command.main(["policy", str(run), "--output", str(tmp_path / "robot"), "--onnx"]) == 2
    error = capsys.readouterr().err
    assert ".[onnx]" in error and error.count("\n") == 1
    assert not (tmp_path / "robot").exists()


def test_self_test_passes_and_detects_other_weights(exported: Path, tmp_path: Path):
    done = subprocess.run([sys.executable, "controller.py"], cwd=exported, capture_output=True, text=True)
    assert done.returncode == 0 and "Passed." in done.stdout and "ms" in done.stdout, done.stderr
    with np.load(exported / "weights.npz") as file:
        stored: dict[str, Any] = {name: file[name] for name in file.files}
    np.savez(tmp_path / "weights.npz", **stored | {"bias_0": stored["bias_0"] + 1})
    assert controller.self_test(tmp_path, frames=100) == 1


def test_exported_source_runs_on_python_3_9(exported: Path):
    for name in ("controller.py", "estimator.py"):
        text = (exported / name).read_text()
        ast.parse(text, feature_version=(3, 9))
        assert not re.search(r"\bimport (jax|ballu_mjx)|from (jax|ballu_mjx)|strict=", text)
        assert "from __future__ import annotations" in text  # so annotations may use newer syntax


def test_observation_agrees_with_training_and_has_names():
    features = random_features(20)
    for row in features:
        np.testing.assert_allclose(
            controller.observation(row), locomotion_observation(jax.numpy.asarray(row)), atol=1e-5
        )
    names = observation_names(NAMES)
    assert len(names) == len(set(names)) == num_observations(BALLU)
    row = np.zeros(27)
    row[[2, 13, 7]] = 1.1, 0.3, 0.2
    seen = dict(zip(names, controller.observation(row), strict=True))
    some = ("balloon position z, m", "base velocity y, m/s", "balloon pitch, rad", "cosine of balloon yaw")
    assert [seen[name] for name in some] == [1.1, 0.3, 0.2, 1.0]


def test_controller_applies_the_policy_to_estimates_at_every_control_step(exported: Path):
    """Frames come at 100 Hz, some of them hidden. Every 50 ms the controller applies the policy to the estimate."""
    robot = Controller(exported, full_travel=1e-3)  # fast enough to have no effect
    capture = Capture(NAMES)
    start, rng = 1.7e9, np.random.default_rng(5)
    for number in range(300):
        frame = frame_at(number * 0.01)
        for values in frame.values():
            if number > 3 and rng.uniform() < 0.2:
                values[...] = np.nan
        capture.time.append(number * 0.01)
        capture.position.append(np.stack([frame[f"{name}_position"] for name in NAMES]))
        capture.quaternion.append(frame["balloon_quaternion"])
        command = robot.step(start + number * 0.01, frame)
        if number % 5 == 0:
            assert robot.status == "running"
            expected = robot.act(estimator.estimate(capture))
        np.testing.assert_allclose(command, expected, atol=1e-4)  # times this large are rounded to 0.2 us
    assert robot.steps == 60


def test_every_call_at_the_control_rate_is_a_control_step(exported: Path):
    robot = Controller(exported)
    rng = np.random.default_rng(6)
    for number in range(100):
        robot.step(number * 0.05 + rng.uniform(0, 0.004), frame_at(number * 0.05))
    assert robot.steps == 100 and robot.status == "running"


def test_rate_limit_holds_when_the_policy_output_jumps(exported: Path, monkeypatch: pytest.MonkeyPatch):
    robot = Controller(exported)
    target = np.ones(2)
    monkeypatch.setattr(robot, "act", lambda features: target)
    seen = [robot.step(n * 0.01, frame_at(n * 0.01)) for n in range(40)]
    np.testing.assert_allclose(np.array(seen)[::5, 0], [0.25, 0.5, 0.75, 1.0, 1.0, 1.0, 1.0, 1.0], atol=1e-12)
    target[:] = 0.0
    seen = [robot.step(n * 0.01, frame_at(n * 0.01)) for n in range(40, 60)]
    np.testing.assert_allclose(np.array(seen)[::5, 1], [0.75, 0.5, 0.25, 0.0], atol=1e-12)


def without(name: str, value: Any) -> Callable[[float], Any]:
    return lambda time: {**frame_at(time), name: value}


@pytest.mark.parametrize(
    "broken",
    [
        lambda time: None,
        lambda time: {},
        lambda time: "no frame",
        without("base_position", np.full(3, np.nan)),
        without("base_position", [np.inf, 0, 0]),
        without("base_position", [1e9, 0, 0]),
        without("base_position", None),
        without("foot_right_position", np.array([np.nan, 0.0, 0.0])),
        without("foot_left_position", np.zeros((2, 3))),
        without("balloon_quaternion", np.zeros(4)),
        without("balloon_quaternion", ["w", "x", "y", "z"]),
    ],
)
def test_controller_relaxes_after_missing_frames_and_resumes(
    exported: Path, monkeypatch: pytest.MonkeyPatch, broken: Callable[[float], Any]
):
    robot = Controller(exported)
    monkeypatch.setattr(robot, "act", lambda features: np.ones(2))
    for number in range(101):
        robot.step(number * 0.01, frame_at(number * 0.01))
    assert robot.command.tolist() == [1.0, 1.0]
    for number in range(101, 170):
        now = number * 0.01
        command = robot.step(now, broken(now))
        if now < 1.0 + TIMEOUT - 0.001:
            assert command == (1.0, 1.0)
    assert command == (0.0, 0.0)
    assert robot.status.startswith("relaxed: ") and "not seen" in robot.status
    for number in range(170, 200):
        command = robot.step(number * 0.01, frame_at(number * 0.01))
    assert command == (1.0, 1.0) and robot.status == "running"


def ticks(seconds: float = 0.01) -> Callable[[], float]:
    """Return a clock that advances by `seconds` from call to call."""
    return partial(next, (seconds * number for number in itertools.count()))


@pytest.mark.parametrize("rate", [20, 100, 1000])
def test_a_stream_that_stands_still_relaxes_the_commands_at_any_rate_of_calls(exported: Path, rate: int, monkeypatch):
    robot = Controller(exported, clock=ticks(1 / rate))
    monkeypatch.setattr(robot, "act", lambda features: np.ones(2))
    for number in range(rate + 1):
        robot.step(number / rate, frame_at(number / rate))
    assert robot.command.tolist() == [1.0, 1.0]
    relaxed = [robot.step(1.0, frame_at(1.0)) == (0.0, 0.0) for _ in range(rate)]
    assert TIMEOUT < relaxed.index(True) / rate <= TIMEOUT + FULL_TRAVEL + 0.11


def test_repeated_frames_change_neither_the_control_rate_nor_the_rate_limit(exported: Path):
    """Calls at 1 kHz see each frame of a capture at 100 Hz ten times."""
    robot = Controller(exported, clock=ticks(0.001))
    commands = np.array([robot.step(taken, frame_at(taken)) for taken in (np.arange(2000) // 10 * 0.01).tolist()])
    assert robot.steps == pytest.approx(40, abs=1)
    over = 100  # calls, 0.1 s
    change = np.abs(commands[over:] - commands[:-over]).max()
    assert change <= (0.1 + BALLU.control_timestep) / FULL_TRAVEL


@pytest.mark.parametrize("times", [lambda n: 1.0, lambda n: math.nan, lambda n: 1.0 - 0.01 * n, lambda n: "soon"])
def test_controller_relaxes_if_the_clock_does_not_advance(
    exported: Path, monkeypatch: pytest.MonkeyPatch, times: Callable
):
    robot = Controller(exported, clock=ticks())
    monkeypatch.setattr(robot, "act", lambda features: np.ones(2))
    for number in range(101):
        robot.step(number * 0.01, frame_at(number * 0.01))
    for number in range(60):
        robot.step(times(number), frame_at(1.0))
    assert robot.command.tolist() == [0.0, 0.0]
    for number in range(40):
        robot.step(2.0 + number * 0.01, frame_at(2.0 + number * 0.01))
    assert robot.command.tolist() == [1.0, 1.0]


def test_controller_continues_after_the_clock_is_set_back(exported: Path):
    robot = Controller(exported)
    for origin in (100.0, 3.0, 1e9, -50.0):
        for number in range(100):
            robot.step(origin + number * 0.01, frame_at(number * 0.01))
        assert robot.status == "running"
    assert 75 <= robot.steps <= 85


@pytest.mark.parametrize("seed", range(4))
def test_commands_keep_their_limits_for_any_input(exported: Path, seed: int):
    """Frames with random faults come at steady times first, and then at wrong times, too."""
    rng = np.random.default_rng(seed)
    wild: list[Any] = [math.nan, math.inf, -math.inf, 1e308, -1e308, 50.0, None, "x", [], 10**400, 0.0]
    robot = Controller(exported, clock=ticks())
    before, changed = (0.0, 0.0), -math.inf
    time: Any = 0.0
    for number in range(4000):
        faulty_clock = number >= 2000
        frame: Any = frame_at(number * 0.01)
        for name, values in list(frame.items()):
            fault = rng.integers(0, 12)
            if fault == 0:
                frame[name] = wild[rng.integers(len(wild))]
            elif fault == 1:
                values[...] = np.nan
            elif fault == 2:
                values.flat[rng.integers(values.size)] = rng.choice([math.nan, math.inf, 1e308, 99.0, -3.0])
            elif fault == 3:
                del frame[name]
        if rng.uniform() < 0.1:
            frame = [None, (), 3.0, "", object()][rng.integers(5)]
        time = number * 0.01 + rng.uniform(0, 0.009)
        if faulty_clock and rng.uniform() < 0.3:
            time = [*wild, time - 5.0, time - 0.02, time + 0.5, time + 1e6, -1e300][rng.integers(len(wild) + 5)]
        command = robot.step(time, frame)
        assert all(math.isfinite(value) and 0.0 <= value <= 1.0 for value in command)
        change = max(abs(command[0] - before[0]), abs(command[1] - before[1]))
        assert change <= LIMIT + 1e-12
        if change > 0 and not faulty_clock:
            assert change <= (time - changed) / FULL_TRAVEL + 1e-9
            changed = time
        before = command
    assert robot.steps > 500


def test_export_command_refuses_unsuitable_runs_and_options(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("keep")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "config.json").write_text('{"format": "ballu-run/1", "task": "envmimic"}')
    for arguments, words in (
        ([tmp_path / "nothing"], "there is no run"),
        ([tmp_path / "other"], "is a residual (envmimic)"),
        ([run, "--output", tmp_path / "full", "--no-open-loop"], "not empty"),
        ([run, "--seconds", "0"], "--seconds"),
        ([run, "--pulse-low", "-1"], "--pulse-low"),
        ([run, "--pulse-low", "1500", "--pulse-high", "1500"], "nothing would move"),
    ):
        assert export_command.main(["policy", *map(str, arguments)]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["notes.txt"]


def test_commands_are_written_as_pulses(tmp_path: Path):
    commands = np.array([[0.0, 1.0], [0.5, 0.25]])
    export._write_commands(
        tmp_path / "commands.csv", commands, BALLU, Options(tmp_path, pulse_low=900, pulse_high=2100)
    )
    assert (tmp_path / "commands.csv").read_text().splitlines() == [
        "time,command_left,command_right,pulse_left_us,pulse_right_us",
        "0.00,0.0000,1.0000,900.0,2100.0",
        "0.05,0.5000,0.2500,1500.0,1200.0",
    ]


def test_readme_describes_the_run(exported: Path):
    text = (exported / "README.txt").read_text()
    assert "task 'walk'" in text and "step 7" in text and "27: sine of balloon yaw" in text
    assert max(map(len, text.splitlines())) <= 120


def test_readme_states_the_command_delay_of_training(tmp_path: Path):
    """The command delay of an aerodynamic residual counts as a delay of training."""
    text = (export.export_policy(Options(write_run(tmp_path / "plain"), open_loop=False)) / "README.txt").read_text()
    assert "trained without delay" in text
    air = dataclasses.replace(AirParameters.none(), delay=jnp.asarray(0.045))
    with Run(tmp_path / "air", describe_run("aerodynamic", {"fit": AirConfig()}, {}, [])) as made:
        content = {"format": AERODYNAMICS_FORMAT, "parameters": air_parameters_to_json(air)}
        made.write(AERODYNAMICS_FILE, json.dumps(content))
        size = Aerodynamics(BALLU, BALLU.load_model()).inputs(jnp.zeros((3, 27)), jnp.zeros((3, 2))).shape[0]
        TrainingRange.of(np.zeros((2, size))).write(made)
    delayed = write_run(tmp_path / "delayed", residual=tmp_path / "air")
    text = (export.export_policy(Options(delayed, open_loop=False)) / "README.txt").read_text()
    assert "trained with a delay of 45 ms" in text and "without delay" not in text
    assert "simulator 'aerodynamic'" in text


def test_readme_states_the_delay_of_the_identified_drivetrain(tmp_path: Path):
    """The sides have different delays. The README states the longer one."""
    nominal = ActuatorParameters.nominal(BALLU.load_model())
    late = dataclasses.replace(nominal, delay=jnp.array([0.03, 0.05]))
    run = write_run(tmp_path / "late", actuators=late)
    text = (export.export_policy(Options(run, open_loop=False)) / "README.txt").read_text()
    assert "trained with a delay of 50 ms" in text and "without delay" not in text


@pytest.mark.parametrize("stuck", ["balloon_position", "balloon_quaternion", "foot_right_position"])
def test_controller_relaxes_if_a_pose_does_not_change(exported: Path, monkeypatch: pytest.MonkeyPatch, stuck: str):
    """A stream that repeats its last frame, or one marker of it, counts as no measurement."""
    robot = Controller(exported)
    monkeypatch.setattr(robot, "act", lambda features: np.ones(2))
    frames = [frame_at(number * 0.01) for number in range(101)]
    for number, frame in enumerate(frames):
        robot.step(number * 0.01, frame)
    assert robot.command.tolist() == [1.0, 1.0]
    for number in range(101, 170):
        command = robot.step(number * 0.01, frame_at(number * 0.01) | {stuck: frames[-1][stuck]})
        assert command == (1.0, 1.0) or number * 0.01 > 1.0 + TIMEOUT - 0.001
    assert command == (0.0, 0.0)
    assert robot.status.startswith("relaxed: ") and "unchanged" in robot.status
    for number in range(170, 200):
        command = robot.step(number * 0.01, frame_at(number * 0.01))
    assert command == (1.0, 1.0) and robot.status == "running"


def test_export_of_a_policy_of_another_robot(tmp_path: Path):
    """Files and controller take names, command ranges, control rate and resting commands from the description."""
    rover = write_rover(tmp_path)
    folder = export.export_policy(Options(write_run(tmp_path / "run", robot=rover), open_loop=False))
    done = subprocess.run([sys.executable, "controller.py"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0 and "Passed." in done.stdout, done.stdout + done.stderr
    robot = Controller(folder)
    assert (robot.names, robot.commands, robot.period) == (("hull", "tip"), ("arm", "push"), 0.04)
    assert robot.step(0.0, None) == (0.3, 1.0)  # the keyframe's commands
    rng = np.random.default_rng(0)
    features = rng.normal(size=(200, rover.features))
    commands = np.array([robot.act(row) for row in features])
    act = Policy.load(tmp_path / "run").act()
    np.testing.assert_allclose(commands, [act(row) for row in features], atol=1e-4)
    assert commands.min(axis=0) == pytest.approx([-0.4, 0.0]) and commands.max(axis=0) == pytest.approx([0.6, 10.0])
    for number in range(50):
        frame = {"hull_position": rng.normal(size=3), "tip_position": rng.normal(size=3)}
        frame["hull_quaternion"] = np.array([1.0, *rng.normal(0, 0.1, 3)])
        robot.step(number * 0.04, frame)
    assert robot.steps == 50 and robot.status == "running"
    text = (folder / "README.txt").read_text()
    for words in (
        "policy for rover",
        "arm from -0.4 to 0.6",
        "push from 0 to 10, at rest 1",
        "every 0.04 s",
        "hull yaw",
    ):
        assert words in text, words
    assert not re.search("balloon|servo|knee|foot", text)
    assert max(map(len, text.splitlines())) <= 120


def test_observation_of_an_anchored_robot_is_in_the_world_frame():
    features = jnp.asarray(np.random.default_rng(0).normal(size=15), jnp.float32)
    seen = controller.observation(np.asarray(features), anchored=True)
    np.testing.assert_allclose(seen, locomotion_observation(features, anchored=True), atol=1e-6)
    np.testing.assert_allclose(seen[:3], features[:3], atol=1e-6)


def test_exported_controller_can_be_imported_from_any_folder(exported: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(exported))
    spec = importlib.util.spec_from_file_location("controller", exported / "controller.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.Controller(exported).step(0.0, None) == (0.0, 0.0)


@pytest.fixture(scope="module")
def rover_policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exported policy of a small robot that floats without contacts, which differ between MJX and C MuJoCo."""
    folder = tmp_path_factory.mktemp("rover")
    path = write_rover(folder).model
    text = path.read_text().replace("<option ", '<option gravity="0 0 0" ')
    path.write_text(text.replace('size="0 0 0.05"', 'size="0 0 0.05" pos="0 0 -1"'))
    rover = read_description(folder / "rover.robot.json")
    return export.export_policy(Options(write_run(folder / "run", robot=rover), open_loop=False, onnx=True))


def test_policy_files_name_observations_and_commands(rover_policy: Path):
    import onnx

    described = json.loads((rover_policy / "policy.json").read_text())
    assert described["robot"] == "rover" and described["task"] == "walk" and Path(described["run"]).is_dir()
    assert described["observation"][3] == {"name": "hull velocity x", "unit": "m/s"}
    assert described["observation"][-1] == {"name": "sine of hull yaw", "unit": "1"}
    assert [(each["name"], each["low"], each["high"]) for each in described["commands"]] == [
        ("arm", -0.4, 0.6),
        ("push", 0.0, 10.0),
    ]
    props = {each.key: json.loads(each.value) for each in onnx.load(rover_policy / "policy.onnx").metadata_props}
    assert [name.partition(", ")[0] for name in props["inputs"]] == [each["name"] for each in described["observation"]]
    assert len(props["outputs"]) == 2


@pytest.mark.slow
def test_check_runs_an_exported_policy_in_c_mujoco(
    rover_policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The check agrees for a correct export. It refuses the simulator of another robot and damaged files."""
    assert export_command.main(["check", str(rover_policy), "--seconds", "2"]) == 0
    output = capsys.readouterr().out
    assert "AGREES" in output and "its own simulator" in output and "from frames" in output
    trials = [line.split() for line in output.splitlines() if line.strip().startswith(("x (m)", "yaw"))]
    assert all(abs(float(line[2]) - float(line[3])) < 0.02 for line in trials)
    arm = export_simulator(Simulator(write_arm(tmp_path)), tmp_path / "arm", check_seconds=0.0).folder
    damaged = tmp_path / "damaged"
    shutil.copytree(rover_policy, damaged)
    with np.load(damaged / "weights.npz") as file:
        stored: dict[str, Any] = {name: file[name] for name in file.files}
    np.savez(damaged / "weights.npz", **stored | {"check_commands": stored["check_commands"] + 1})
    for arguments, words in (
        ([rover_policy, "--simulator", arm], "is a simulator of arm, not of rover"),
        ([rover_policy, "--simulator", tmp_path], "is not an exported simulator"),
        ([rover_policy, "--run", tmp_path / "gone"], "there is no run"),
        ([damaged], "differs from the policy of its run"),
        ([rover_policy, "--seconds", "-1"], "--seconds"),
    ):
        assert export_command.main(["check", *map(str, arguments)]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1, error


def altered(source: Path, copy: Path, file: str, change: Callable[[dict[str, Any]], dict[str, Any]]) -> Path:
    """Return a copy of an exported folder in which `change` replaces arrays of `file`."""
    shutil.copytree(source, copy)
    with np.load(copy / file) as archive:
        stored: dict[str, Any] = {name: archive[name] for name in archive.files}
    np.savez(copy / file, **stored | change(stored))
    return copy


@pytest.mark.slow
def test_check_detects_wrong_exports(rover_policy: Path, tmp_path: Path):
    """In turn, a weight, the order of observations, a scale, and a constant of the simulator are wrong."""
    right = check_policy(rover_policy, seconds=1.0)
    assert right.agrees and "AGREES" in right.verdict()
    assert right.agreement.compared == pytest.approx(1.0) and right.agreement.apart < 1e-6
    wrong: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
        "weight": lambda stored: {"bias_2": stored["bias_2"] + 0.02},
        "order": lambda stored: {"kernel_0": stored["kernel_0"][::-1]},
        "scale": lambda stored: {"command_high": 1.01 * stored["command_high"]},
    }
    for name, change in wrong.items():
        found = check_policy(altered(rover_policy, tmp_path / name, "weights.npz", change), seconds=1.0)
        assert not found.agrees and "on the same observations" in found.verdict(), name
    robot = Policy.load(json.loads((rover_policy / "policy.json").read_text())["run"]).robot
    for gain, agrees in ((1.0, True), (1.02, False)):
        model = robot.load_model()
        model.actuator_gainprm *= gain
        simulator = export_simulator(Simulator(robot, model=model), tmp_path / f"{gain}", check_seconds=0.0).folder
        found = check_policy(rover_policy, simulator=simulator, seconds=1.0)
        assert found.agrees == agrees, found.verdict()
    assert "under the same commands" in found.verdict()


def test_check_agrees_if_trials_differ_only_by_rounding():
    """Contacts amplify rounding, so only commands and the states of the predictable first part are compared."""
    own, other = Trial("own", 0.01, (0.1, 0.2), 10.0), Trial("c", 0.02, (0.4, -0.2), -80.0)
    found = PolicyCheck(Agreement(1e-6, 1.5, 2e-5, 9e-4), own, other, other, 24.0)
    assert found.agrees
    assert found.verdict().startswith("AGREES") and "only the first 1.50 s can be predicted" in found.verdict()
    for worse in (Agreement(0.01, 1.5, 2e-5, 9e-4), Agreement(1e-6, 1.5, 0.02, 9e-4), Agreement(math.nan, 1, 0, 0)):
        assert not dataclasses.replace(found, agreement=worse).agrees
    assert Agreement(0.0, 1.0, 9e-6, 1e-9).problem() is None


def test_check_reports_trials_that_differ():
    own = Trial("own", 0.3, (6.0, 0.5), 10.0)
    assert dataclasses.replace(own, displacement=(6.3, 0.3)).differs_from(own) is None
    assert "1.00 m" in str(dataclasses.replace(own, displacement=(5.0, 0.5)).differs_from(own))
    assert "mean reward is 0.200" in str(dataclasses.replace(own, reward=0.2).differs_from(own))
    assert Trial("c", math.nan, (math.nan, 0.0), 0.0).differs_from(own) is not None
    near = Agreement(0.0, 24.0, 0.0, 0.0)
    found = PolicyCheck(near, own, own, dataclasses.replace(own, reward=0.2), 24.0)
    assert found.agrees and "From frames, with estimator and rate limit, its mean reward is 0.200" in found.table()
