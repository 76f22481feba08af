"""A policy for the robot's own computer: `python -m ballu_mjx export RUN`.

What is written runs on Python and NumPy alone: `controller.py` and `estimator.py` of this package as they are, but for
their imports, and the policy's parameters as `weights.npz`. JAX, and all that needs it, is imported inside functions:
`runtime.prepare` has to come first.
"""

from __future__ import annotations

import csv
import dataclasses
import importlib.util
import math
import re
import textwrap
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.deploy import controller, estimator

if TYPE_CHECKING:
    from ballu_mjx.policies.policy import Policy
    from ballu_mjx.rl.ppo import PPOConfig

_CHECKS = 20
"""Features and commands that go with the weights, for the robot to check its own arithmetic."""


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """What is exported, and where to."""

    run: Path
    """Folder of the run."""
    output: Path | None = None
    """Folder to write into, new or empty. Without this option: export/ in the run's folder."""
    seconds: float | None = None
    """Length of commands.csv, s. Without this option: that of a trial of the task."""
    open_loop: bool = True
    """Write commands.csv, the commands that the policy gives in its own simulator."""
    onnx: bool = False
    """Write policy.onnx too, for other runtimes: from observation to commands, without estimator, rate limit and
    time-out. Needs the extra onnx."""
    pulse_low: float = 1000.0
    """Pulse width, microseconds, at which the servo stands at command 0."""
    pulse_high: float = 2000.0
    """Pulse width, microseconds, at which the servo stands at command 1."""


def export_policy(options: ExportOptions) -> Path:
    """Write the folder; returns it.

    **Raises** `InputError` where the run is none of a locomotion policy, or the folder holds something.
    """
    from ballu_mjx.policies.policy import Policy
    from ballu_mjx.policies.tasks import TASKS
    from ballu_mjx.rl.ppo import PPOConfig
    from ballu_mjx.robots.model import CONTROL_TIMESTEP
    from ballu_mjx.runs.folder import new_folder, read_config, typed_config

    _check(options)
    ppo_config = typed_config(PPOConfig, read_config(options.run, *TASKS), "ppo", options.run)
    folder = new_folder(options.output or options.run / "export", "export")
    policy = Policy.load(options.run)
    stored = weights(policy, ppo_config)
    commands = None
    if options.open_loop:
        seconds = policy.task.trial_seconds if options.seconds is None else options.seconds
        print("Compiling: about a minute the first time ...", flush=True)
        commands = open_loop(policy, max(round(seconds / CONTROL_TIMESTEP), 1))

    folder.mkdir(parents=True, exist_ok=True)
    for name, text in sources().items():
        (folder / name).write_text(text, encoding="utf-8")
    np.savez(folder / "weights.npz", **stored)  # pyright: ignore[reportArgumentType]
    if options.onnx:
        (folder / "policy.onnx").write_bytes(onnx_model(stored))
    if commands is not None:
        _write_commands(folder / "commands.csv", commands, options)
        print(_rate(commands))
    (folder / "README.txt").write_text(_readme(options, policy, commands), encoding="utf-8")
    print(f"Written to {folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}.")
    return folder


def weights(policy: Policy, ppo_config: PPOConfig) -> dict[str, np.ndarray]:
    """What `controller.Controller` reads: normalizer, layers of the mean's network, and a few features and commands.

    The policy's most likely action is the mean of its Gaussian: the network's output before the deviation, which is a
    parameter of its own and is left out.
    """
    layers = _layers(policy.params.policy["params"])
    mean, std = (np.asarray(m["state"]) for m in (policy.params.normalizer.mean, policy.params.normalizer.std))
    clip = ppo_config.observation_clip
    if not ppo_config.normalize_observations:
        mean, std, clip = np.zeros_like(mean), np.ones_like(std), math.inf
    features = _plausible(np.random.default_rng(0), _CHECKS)
    act = policy.act()
    return {
        "mean": mean,
        "std": std,
        "observation_clip": np.array(clip),
        "activation": np.array(ppo_config.activation),
        **{f"kernel_{i}": kernel for i, (kernel, _) in enumerate(layers)},
        **{f"bias_{i}": bias for i, (_, bias) in enumerate(layers)},
        "check_features": features,
        "check_commands": np.array([act(row) for row in features]),
    }


def onnx_model(stored: Mapping[str, np.ndarray]) -> bytes:
    """`weights` as an ONNX graph.

    Input `observation`, float32 [batch, 28], in the order and units of `controller.OBSERVATION`; output `command`,
    float32 [batch, 2], left and right, in [0, 1].
    """
    from onnx import TensorProto, checker, helper, numpy_helper

    nodes, constants = [], []

    def constant(name: str, value: np.ndarray | float) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def node(kind: str, inputs: list[str], output: str) -> str:
        nodes.append(helper.make_node(kind, inputs, [output]))
        return output

    x = node("Sub", ["observation", constant("mean", stored["mean"])], "centred")
    x = node("Div", [x, constant("std", stored["std"])], "normalized")
    clip = float(stored["observation_clip"])
    if math.isfinite(clip):
        x = node("Clip", [x, constant("lowest", -clip), constant("highest", clip)], "clipped")
    last = sum(name.startswith("kernel_") for name in stored) - 1
    for i in range(last + 1):
        kernel, bias = (constant(name, stored[name]) for name in (f"kernel_{i}", f"bias_{i}"))
        x = node("Gemm", [x, kernel, bias], f"layer_{i}")
        if i < last and str(stored["activation"]) == "swish":
            x = node("Mul", [x, node("Sigmoid", [x], f"gate_{i}")], f"active_{i}")
        elif i < last:
            x = node("Tanh", [x], f"active_{i}")
    x = node("Mul", [node("Add", [x, constant("one", 1.0)], "raised"), constant("half", 0.5)], "halved")
    node("Clip", [x, constant("relaxed", 0.0), "one"], "command")
    sizes = {"observation": len(stored["mean"]), "command": len(stored[f"bias_{last}"])}
    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["batch", size]) for n, size in sizes.items()]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    checker.check_model(model)
    return model.SerializeToString()


def sources() -> dict[str, str]:
    """The robot's files by name: the package's own text, free of the package and of jaxtyping."""
    return {
        name: _alone(resources.files("ballu_mjx.policies.deploy").joinpath(name).read_text(encoding="utf-8"))
        for name in _FILES
    }


def open_loop(policy: Policy, steps: int) -> Float[np.ndarray, "steps 2"]:
    """The policy's commands in its own simulator, from standing."""
    loop = policy.closed_loop()
    return np.asarray(loop(policy.params, *loop.standing(), steps).command[0], float)


_FILES = ("controller.py", "estimator.py")
_STAND_IN = '''

class {name}:
    """Stands in for jaxtyping's type of arrays, of which annotations here tell the shape."""

    def __class_getitem__(cls, item):
        return item[0]

'''


def _alone(source: str) -> str:
    """A module's text that imports its neighbour from beside it, and nothing of jaxtyping."""
    source = re.sub(r"^from ballu_mjx\.policies\.deploy\.(\w+) import", r"from \1 import", source, flags=re.MULTILINE)

    def stand_ins(imported: re.Match[str]) -> str:
        return "".join(_STAND_IN.format(name=name.strip()) for name in imported[1].split(","))

    source = re.sub(r"^from jaxtyping import ([\w, ]+)\n", stand_ins, source, flags=re.MULTILINE)
    left = re.search(r"^\s*(from|import) +(jaxtyping|ballu_mjx)\b.*", source, flags=re.MULTILINE)
    assert left is None, left
    return source


def _check(options: ExportOptions) -> None:
    if options.seconds is not None and not 0 < options.seconds <= 3600:
        raise InputError(f"--seconds is {options.seconds:g}: it must be above 0, and 3600 or less.")
    for name in ("pulse_low", "pulse_high"):
        if not 0 < getattr(options, name) < 20_000:
            raise InputError(
                f"--{name.replace('_', '-')} is {getattr(options, name):g}: give microseconds, above 0 and below 20000."
            )
    if options.onnx and importlib.util.find_spec("onnx") is None:
        raise InputError('--onnx: the package onnx is not installed; `pip install "ballu-mjx[onnx]"` brings it.')
    if options.pulse_low == options.pulse_high:
        raise InputError(f"--pulse-low and --pulse-high are both {options.pulse_low:g}: the servos would not move.")


def _layers(tree: dict) -> list[tuple[np.ndarray, np.ndarray]]:
    """Kernel and bias of each layer of Brax's policy network, `PolicyModuleWithStd`."""
    hidden = tree["MLP_0"]
    assert set(tree) == {"MLP_0", "Dense_0", "std_logparam"}, set(tree)
    assert set(hidden) == {f"hidden_{i}" for i in range(len(hidden))}, set(hidden)
    layers = [hidden[f"hidden_{i}"] for i in range(len(hidden))] + [tree["Dense_0"]]
    return [(np.asarray(layer["kernel"]), np.asarray(layer["bias"])) for layer in layers]


def _plausible(rng: np.random.Generator, count: int) -> Float[np.ndarray, "count 27"]:
    """Features of the order of a walking robot's."""
    features = rng.normal(0.0, 0.2, (count, 27))
    features[:, [2, 11]] += 1.1, 0.75
    features[:, 8] = rng.uniform(-np.pi, np.pi, count)
    return features


def _write_commands(path: Path, commands: Float[np.ndarray, "steps 2"], options: ExportOptions) -> None:
    pulses = options.pulse_low + commands * (options.pulse_high - options.pulse_low)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time", "command_left", "command_right", "pulse_left_us", "pulse_right_us"])
        for step, (command, pulse) in enumerate(zip(commands, pulses, strict=True)):
            time = f"{step * controller.CONTROL_PERIOD:.2f}"
            writer.writerow([time, *(f"{x:.4f}" for x in command), *(f"{x:.1f}" for x in pulse)])


def _rate(commands: Float[np.ndarray, "steps 2"]) -> str:
    """How much of the policy's commands the controller's rate limit would change."""
    largest = controller.CONTROL_PERIOD / controller.FULL_TRAVEL
    beyond = np.abs(np.diff(commands, axis=0, prepend=np.zeros((1, 2)))).max(axis=1) > largest + 1e-6
    return (
        f"In its own simulator the policy changes a command by more than the controller's rate limit allows "
        f"({largest:g} a control step) in {beyond.mean():.0%} of the control steps."
    )


def _readme(options: ExportOptions, policy: Policy, commands: Float[np.ndarray, "steps 2"] | None) -> str:
    indented = textwrap.TextWrapper(width=112, initial_indent="    ", subsequent_indent="    ").fill
    low, high = options.pulse_low, options.pulse_high
    observed = "; ".join(f"{i}: {name}" for i, name in enumerate(controller.OBSERVATION))
    commanded = (
        f"0 is the servo relaxed (knee at its stop, cable just taut), 1 is 90 deg. Pulses: {low:g} us at 0, {high:g} "
        f"us at 1. Commands change at 20 Hz, by {controller.CONTROL_PERIOD / controller.FULL_TRAVEL:g} a control step "
        f"at most: full travel in {controller.FULL_TRAVEL:g} s, for the servo's own no-load speed is 60 deg in 0.14 s "
        "(90 deg in 0.21 s); Controller's full_travel sets it. If a marker has not been seen for "
        f"{controller.TIMEOUT:g} s, commands go to 0 at that rate until all have been seen again."
    )
    estimation = (
        f"Each position is a straight line through the frames of the last {estimator.POSITION_WINDOW:g} s "
        f"(orientation: {estimator.ORIENTATION_WINDOW:g} s), read off now; its slope is the velocity. A hidden marker "
        f"moves on as it last did for {estimator.EXTRAPOLATION_LIMIT:g} s, then rests."
    )
    open_loop = "Not written (--no-open-loop)."
    if commands is not None:
        open_loop = (
            f"{len(commands) * controller.CONTROL_PERIOD:g} s of the policy's commands in its own simulator, from\n"
            "standing, without the rate limit. Each row holds until the next (0.05 s).\n"
            + textwrap.fill(_rate(commands))
        )
    return f"""\
A policy for BALLU: task '{policy.task.name}', trained in the simulator '{policy.setting}', step {policy.step}.

Files
    controller.py    the controller: Controller(folder).step(time, frame) -> (left, right)
    estimator.py     its estimator: positions and velocities from motion capture frames so far
    weights.npz      the policy's network and the normalization of its observation
    commands.csv     see 'Open loop' below
    policy.onnx      with --onnx: the network alone, from 'observation' (as below) to 'command', for other runtimes

Running it
    Needs Python 3.9 or newer and NumPy, nothing else. Copy this folder to the robot and there:

        python3 controller.py        # must print 'Passed.'; tells the time of a control step (50 ms there are)

    In the robot's loop, with every frame of motion capture (best at 100 Hz, 50 Hz or more; or once every
    0.05 s, where velocities lag more):

        import time
        from controller import Controller
        controller = Controller(folder)
        while True:
            frame = newest_frame()                     # or None where nothing came
            left, right = controller.step(time.monotonic(), frame)
            send_pulses({low:g} + left * {high - low:g}, {low:g} + right * {high - low:g})  # microseconds

    Call it with None when no frame came for 0.05 s: the time-out is counted inside step. If the program
    itself stops, the servo driver must cut the pulses; nothing here can. controller.status says what is missing.

A frame
    A dict, or an object with attributes, of arrays; NaN where a marker is hidden.
    World frame: floor at z = 0, z up; x forward and y left as the robot stands at the start.
        balloon_position     x, y, z of the balloon cluster's centre of mass, m (the model's site 'balloon':
                             0.38 m above the neck's hinge, on the robot's middle)
        balloon_quaternion   w, x, y, z from the balloon's axes to the world's; 1, 0, 0, 0 upright, facing x
        base_position        x, y, z of the middle of the hip axis, m (site 'base')
        foot_position        2 x 3: centres of the left and of the right foot's sphere, m

Commands
{indented(commanded)}

Estimator
{indented(estimation)}

What the policy sees
    x and y axes are turned about z into the balloon's heading; x and y of positions are relative to the
    balloon's (so entries 0 and 1 are 0); z is above the floor; m, m/s, rad.
{indented(observed)}

Open loop
{indented(open_loop)}

Measure first
    1. Pulse widths at command 0 (cable just taut, knee at its stop) and at 90 deg, of each servo; whether one runs
       the other way round. Give them by --pulse-low and --pulse-high, or in send_pulses for each servo.
    2. Motion capture: z of the feet standing (the foot sphere's radius, not 0), sign and zero of the yaw (turn the
       robot left: it must grow), which foot is left, base and balloon height.
    3. Time from the camera to the servo. The policy was trained without delay.
    4. Control step's time on the robot (python3 controller.py).
    5. First runs with the robot held, at a fraction of the speed (Controller(folder, full_travel=1.0)).
"""
