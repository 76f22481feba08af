"""Export of a policy to the robot's own computer: `python -m ballu_mjx export policy RUN`.

The exported files need only Python and NumPy. They are `controller.py` and `estimator.py` of this package, with other
imports, and the policy's parameters as `weights.npz`. JAX, and all modules that need it, are imported inside functions,
because `runtime.prepare` must run first.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import logging
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.standalone import standalone_source
from ballu_mjx.policies.deploy import controller, estimator

if TYPE_CHECKING:
    from ballu_mjx.policies.policy import Policy
    from ballu_mjx.robots.description import RobotDescription

_LOG = logging.getLogger(__name__)

POLICY_FORMAT = "ballu-policy/1"
POLICY_FILE = "policy.json"
_CHECKS = 20
"""Number of features and commands stored with the weights. The robot's computer checks its arithmetic on them."""


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Options of the export of a policy."""

    run: Path
    """Folder of the policy's run."""
    output: Path | None = None
    """Folder to write into, new or empty. Without this option: export/ in the run's folder."""
    seconds: float | None = None
    """Duration of commands.csv, s, at most 3600. Without this option: the duration of a trial of the task."""
    open_loop: bool = True
    """Write commands.csv: the commands that the policy gives in its own simulator."""
    onnx: bool = False
    """Also write policy.onnx, for other runtimes. It computes commands from observations, without estimator, rate limit
    and time-out. Its properties name inputs and outputs, with units. Needs the extra onnx."""
    pulse_low: float = 1000.0
    """Pulse width, microseconds, for the smallest value of a command; above 0 and below 20000."""
    pulse_high: float = 2000.0
    """Pulse width, microseconds, for the largest value of a command; above 0 and below 20000."""


def export_policy(options: ExportOptions) -> Path:
    """Write the exported policy and return its folder.

    **Raises** `InputError` if the run is not one of a locomotion policy, or if the folder is not empty.
    """
    from ballu_mjx.policies.policy import Policy
    from ballu_mjx.policies.tasks import TASKS
    from ballu_mjx.residuals.trained_residual import RESIDUAL_TASKS
    from ballu_mjx.runs.folder import new_folder, read_config

    _check(options)
    if (task := read_config(options.run, *TASKS, *RESIDUAL_TASKS, "sysid")["task"]) in RESIDUAL_TASKS:
        raise InputError(
            f"{options.run}: is a residual ({task}), which acts in simulation only; train a policy in its simulator "
            f"(ballu_mjx train walk --residual {options.run}) and export that."
        )
    read_config(options.run, *TASKS)
    folder = new_folder(options.output or options.run / "export", "export")
    policy = Policy.load(options.run)
    stored = weights(policy)
    commands = None
    if options.open_loop:
        seconds = policy.task.trial_seconds if options.seconds is None else options.seconds
        print("Compiling: about a minute the first time ...", flush=True)
        commands = open_loop(policy, max(round(seconds / policy.robot.control_timestep), 1))

    texts = {
        **sources(),
        POLICY_FILE: json.dumps(describe_policy(policy, stored, options.run), indent=2) + "\n",
        "README.txt": _readme(options, policy, stored, commands),
    }
    graph = policy_onnx(stored) if options.onnx else None
    # Only now, so that an error above leaves no incomplete folder.
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    np.savez(folder / "weights.npz", **stored)  # pyright: ignore[reportArgumentType]
    if graph is not None:
        (folder / "policy.onnx").write_bytes(graph)
    if commands is not None:
        _write_commands(folder / "commands.csv", commands, policy.robot, options)
        if (said := _rate(commands, stored)) is not None:
            print(said)
    print(f"Written to {folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}.")
    return folder


def weights(policy: Policy) -> dict[str, np.ndarray]:
    """Return the arrays that `controller.Controller` reads.

    They are the normalizer, the layers of the network that computes the mean, names and units of observation and
    commands, and a few features with their commands.
    """
    from ballu_mjx.rl.network_export import network_arrays

    robot = policy.robot
    features = _plausible(np.random.default_rng(0), _CHECKS, robot.features)
    act = policy.act()
    low, high = np.array(robot.command_ranges, float).T
    return {
        "robot": np.array(robot.name),
        "names": np.array((robot.tracked, *robot.points)),
        "anchored": np.array(robot.anchored),
        "commands": np.array(robot.commands),
        "command_low": low,
        "command_high": high,
        "command_rest": robot.adapter.rest_command(robot, robot.load_model()),
        "control_timestep": np.array(robot.control_timestep),
        "full_travel": np.array(robot.adapter.full_travel(robot)),
        "observation": np.array(controller.observation_names((robot.tracked, *robot.points))),
        **network_arrays(policy.params, policy.network),
        "check_features": features,
        "check_commands": np.array([act(row) for row in features]),
    }


def describe_policy(policy: Policy, stored: Mapping[str, np.ndarray], run: Path) -> dict[str, Any]:
    """Return the content of `policy.json`: the policy's origin, and names and units of its observation and commands."""
    robot = policy.robot
    ranges = zip(robot.commands, robot.command_ranges, stored["command_rest"].tolist(), strict=True)
    return {
        "format": POLICY_FORMAT,
        "run": str(run.resolve()),
        "robot": robot.name,
        "task": policy.task.name,
        "step": policy.step,
        "simulator": policy.variant.name,
        "control_timestep": robot.control_timestep,
        "observation": [_named(each) for each in stored["observation"].tolist()],
        "commands": [
            {"name": name, "unit": "that of the actuator's ctrl", "low": low, "high": high, "rest": rest}
            for name, (low, high), rest in ranges
        ],
    }


def _named(text: str) -> dict[str, str]:
    name, _, unit = text.partition(", ")
    return {"name": name, "unit": unit or "1"}


def policy_onnx(stored: Mapping[str, np.ndarray]) -> bytes:
    """Return `weights` as an ONNX graph.

    Input `observation`, float32 [batch, observations], in the order and units of `controller.observation_names`; output
    `command`, float32 [batch, commands], in the actuators' units.
    """
    from ballu_mjx.rl.network_export import NetworkPort, OutputScale, onnx_model

    low, high = stored["command_low"], stored["command_high"]
    commands = [f"{name}, the actuator's unit" for name in stored["commands"].tolist()]
    ends = NetworkPort("observation", stored["observation"].tolist()), NetworkPort("command", commands)
    return onnx_model(stored, *ends, OutputScale((high - low) / 2, (high + low) / 2, low, high), "policy")


def sources() -> dict[str, str]:
    """Return the source files for the robot by name.

    They are modules of this package, without imports of the package and of jaxtyping.
    """
    return {name: standalone_source(__package__ or "", name) for name in _FILES}


def open_loop(policy: Policy, steps: int) -> Float[np.ndarray, "steps commands"]:
    """Return the policy's commands in its own simulator, from the initial pose."""
    loop = policy.closed_loop()
    rollout = loop(policy.params, *loop.initial(), steps)
    if rollout.divergence is not None:
        _LOG.warning("%s", rollout.divergence)
    return np.asarray(rollout.command[0], float)


_FILES = ("controller.py", "estimator.py")


def _check(options: ExportOptions) -> None:
    if options.seconds is not None and not options.open_loop:
        raise InputError("--seconds has no effect beside --no-open-loop; leave one of them out.")
    if options.seconds is not None and not 0 < options.seconds <= 3600:
        raise InputError(f"--seconds is {options.seconds:g}: it must be above 0, and 3600 or less.")
    for name in ("pulse_low", "pulse_high"):
        if not 0 < getattr(options, name) < 20_000:
            raise InputError(
                f"--{name.replace('_', '-')} is {getattr(options, name):g}: give microseconds, above 0 and below 20000."
            )
    if options.onnx:
        from ballu_mjx.rl.network_export import check_onnx

        check_onnx()
    if options.pulse_low == options.pulse_high:
        raise InputError(f"--pulse-low and --pulse-high are both {options.pulse_low:g}: nothing would move; give two.")


def _plausible(rng: np.random.Generator, count: int, size: int) -> Float[np.ndarray, "count size"]:
    """Return random features with the magnitude of those of a moving robot."""
    from ballu_mjx.sim.observation import ObservationLayout

    features = rng.normal(0.0, 0.2, (count, size))
    features[:, ObservationLayout.yaw] = rng.uniform(-np.pi, np.pi, count)
    return features


def _write_commands(
    path: Path, commands: Float[np.ndarray, "steps commands"], robot: RobotDescription, options: ExportOptions
) -> None:
    low, high = np.array(robot.command_ranges, float).T
    pulses = options.pulse_low + (commands - low) / (high - low) * (options.pulse_high - options.pulse_low)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        names = (*(f"command_{name}" for name in robot.commands), *(f"pulse_{name}_us" for name in robot.commands))
        writer.writerow(["time", *names])
        for step, (command, pulse) in enumerate(zip(commands, pulses, strict=True)):
            time = f"{step * robot.control_timestep:.{_decimals(robot.control_timestep)}f}"
            writer.writerow([time, *(f"{x:.4f}" for x in command), *(f"{x:.1f}" for x in pulse)])


def _decimals(step: float) -> int:
    """Return the number of decimals that multiples of a step need, at least two."""
    return max(2, len(f"{step:.6f}".rstrip("0").partition(".")[2]))


def _rate(commands: Float[np.ndarray, "steps commands"], stored: Mapping[str, np.ndarray]) -> str | None:
    """Return a sentence on how often the controller's rate limit would act in `commands`. None if there is no limit."""
    if not stored["full_travel"] > 0:
        return None
    largest = stored["control_timestep"] / stored["full_travel"]
    shares = np.diff(commands, axis=0, prepend=stored["command_rest"][None])
    beyond = (np.abs(shares) / (stored["command_high"] - stored["command_low"])).max(axis=1) > largest + 1e-6
    return (
        f"In its own simulator the policy changes a command by more than the controller's rate limit allows "
        f"({largest:g} of its range a control step) in {beyond.mean():.0%} of the control steps."
    )


def _readme(
    options: ExportOptions,
    policy: Policy,
    stored: Mapping[str, np.ndarray],
    commands: Float[np.ndarray, "steps commands"] | None,
) -> str:
    robot = policy.robot
    notes, names = robot.adapter.deployment_notes(robot), (robot.tracked, *robot.points)
    step, travel, simulator = robot.control_timestep, float(stored["full_travel"]), policy.variant.name
    low, high = options.pulse_low, options.pulse_high

    def indented(text: str, hang: int = 4) -> str:
        return textwrap.fill(text, 112, initial_indent="    ", subsequent_indent=" " * hang)

    observed = "; ".join(f"{i}: {name}" for i, name in enumerate(stored["observation"].tolist()))
    frame = "World frame: floor at z = 0, z up; x forward and y left as the robot stands at the start."
    seen = "x and y axes are rotated about z into the heading (yaw) of {0}; x and y of positions are relative to {0}"
    seen = seen.format(robot.tracked) + " (so entries 0 and 1 are 0); z is the height above the floor; m, m/s, rad."
    if robot.anchored:
        frame = "World frame of the robot's model, z up."
        seen = "Everything is in the world frame; m, m/s, rad."
    markers = [
        f"{name}_position: x, y, z of the site {name!r}" + (f", {notes.markers[name]}" if name in notes.markers else "")
        for name in names
    ]
    markers.insert(
        1,
        f"{robot.tracked}_quaternion: w, x, y, z from the axes of {robot.tracked} to the world's; 1, 0, 0, 0 in the "
        "model's reference pose",
    )
    ranges = "; ".join(
        f"{name} from {bounds[0]:g} to {bounds[1]:g}, at rest {rest:g}"
        for name, bounds, rest in zip(robot.commands, robot.command_ranges, stored["command_rest"], strict=True)
    )
    commanded = [f"In the actuators' own units: {ranges}.", notes.commands]
    commanded += [f"Pulses: {low:g} us for the smallest value, {high:g} us for the largest.", _limit(step, travel)]
    commanded.append(
        f"If a marker has not been seen for {controller.TIMEOUT:g} s, or its pose has not changed for as long, "
        "commands go to those at rest until all have been seen again."
    )
    estimation = (
        f"A straight line is fitted to each position in the frames of the last {estimator.POSITION_WINDOW:g} s "
        f"(orientation: {estimator.ORIENTATION_WINDOW:g} s). Its present value is the position, its slope the velocity."
        f" A hidden marker is assumed to continue its motion for {estimator.EXTRAPOLATION_LIMIT:g} s, and then to rest."
    )
    open_loop = "Not written (--no-open-loop)."
    if commands is not None:
        open_loop = (
            f"{len(commands) * step:g} s of the policy's commands in its own simulator, from its initial pose, without "
            f"the rate limit. Each row holds until the next ({step:g} s). {_rate(commands, stored) or ''}"
        )
    measure = [
        *notes.measure,
        "Motion capture: sign and zero of the yaw (it must grow when the robot turns left), heights, and which marker "
        "is which.",
        f"Time from the camera to the actuator. {_latency(policy.latency)}",
        "Time of a control step on the robot (python3 controller.py).",
        "First runs: hold the robot, and limit the speed (Controller(folder, full_travel=1.0)).",
    ]
    return f"""\
A policy for {robot.name}: task '{policy.task.name}', trained in the simulator '{simulator}', step {policy.step}.

Files
    controller.py    the controller: Controller(folder).step(time, frame) -> {", ".join(robot.commands)}
    estimator.py     its estimator: positions and velocities from motion capture frames so far
    weights.npz      the policy's network, the normalization of its observation, and names and units of its
                     observation and commands
    policy.json      the policy's run, and the same names and units, for other programs
    commands.csv     see 'Open loop' below
    policy.onnx      with --onnx: the network alone, from 'observation' (as below) to 'command', for other runtimes

Running it
    Needs Python 3.9 or newer and NumPy, nothing else. Copy this folder to the robot and there:

        python3 controller.py        # must print 'Passed.'; measures the time of a control step

    In the robot's loop, call step with every frame of motion capture (50 Hz or more, best 100 Hz). Calls once every
    {step:g} s work too, but then velocities lag more.

        import time
        from controller import Controller
        controller = Controller(folder)
        while True:
            frame = newest_frame()                     # or None if no frame came
            commands = controller.step(time.monotonic(), frame)
            send(commands)                             # {", ".join(robot.commands)}

    Call it with None when no frame came for {step:g} s, because step itself measures the time-out. If the program
    stops, the actuators' driver must stop them; the controller cannot. controller.status says what is missing.

A frame
    A dict, or an object with attributes, of arrays (m); NaN where a marker is hidden.
{indented(frame)}
{chr(10).join(indented(f"    {marker}", 12) for marker in markers)}

Commands
{indented(" ".join(filter(None, commanded)))}

Estimator
{indented(estimation)}

The policy's observation
{indented(seen)}
{indented(observed)}

Open loop
{indented(open_loop)}

Measure first
{chr(10).join(indented(f"{number}. {text}", 7) for number, text in enumerate(measure, start=1))}
"""


def _limit(step: float, travel: float) -> str:
    """Return the README's text on the rate limit."""
    changing = f"Commands change every {step:g} s"
    if travel == 0:
        return f"{changing}, without a rate limit; Controller's full_travel sets one."
    return (
        f"{changing}, by at most {step / travel:g} of their range: full travel in {travel:g} s; Controller's "
        "full_travel sets this limit."
    )


def _latency(seconds: float) -> str:
    """Return the README's text on the latency in training."""
    if seconds == 0:
        return "The policy was trained without delay."
    return f"The policy was trained with a delay of {1000 * seconds:.0f} ms from its command to the actuator."
