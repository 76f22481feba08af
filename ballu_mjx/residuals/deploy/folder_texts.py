"""Texts of the folder of an exported simulator: its README and its example."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco

from ballu_mjx.sim.simulator import AugmentedSimulator

_EXAMPLE_TEXT = '''"""A control loop in the improved simulator of {name}: random commands for 5 s."""

from pathlib import Path

import numpy as np
from residual import ImprovedSimulator

simulator = ImprovedSimulator(Path(__file__).resolve().parent)
low, high = np.array([[command["low"], command["high"]] for command in simulator.settings["commands"]]).T
rng = np.random.default_rng(0)
simulator.reset()
for step in range(round(5 / simulator.control_timestep)):
    if step % 10 == 0:
        command = low + (high - low) * rng.uniform(size=len(low))
        data = simulator.step(command)
        x, y, z = data.site(simulator.names[0]).xpos
        print(f"{{data.time:5.2f}} s  {{simulator.names[0]}} at {{x:.3f}} {{y:.3f}} {{z:.3f}} m")
    else:
        simulator.step(command)
'''


def example_program(name: str) -> str:
    """Return a program that steps the simulator of the robot called `name`."""
    return _EXAMPLE_TEXT.format(name=name)


def folder_readme(
    simulator: AugmentedSimulator,
    parts: Sequence[Mapping[str, Any]],
    left_out: tuple[str, ...],
    *,
    onnx: bool,
    checked: bool,
) -> str:
    """Return what the folder holds and how it is used.

    **Arguments**

    - `parts`: settings of the residual's parts, as `simulator.json` has them.
    - `left_out`: fields of the model that MJCF cannot hold.
    - `onnx`, `checked`: whether the folder has networks as ONNX, and a rollout to compare with.
    """
    robot, plain = simulator.robot, simulator.simulator
    names = " + ".join(part["name"] for part in parts) or "none"
    option = plain.mj_model.opt
    lines = [
        f"# {robot.name}, an improved simulator for C MuJoCo",
        f"Residual: {names}. Identified actuators: {'no' if simulator.actuators is None else 'yes'}. Drivetrain: "
        f"{'no' if plain.drivetrain is None else 'yes'}.",
        "The folder needs Python 3.10, NumPy and MuJoCo. It was written for MuJoCo "
        f"{mujoco.__version__}; the solver of another version may differ in the last digits.",
        "| file | content |\n| --- | --- |\n"
        "| `identified.xml` | the model, with the values of identified actuators and of the residual; numbers have six "
        "digits |\n"
        "| `simulator.json` | names, ranges, time steps, the drivetrain, and the residual's settings |\n"
        "| `parameters.npz` | the residual's arrays, and the model's fields in all digits |\n"
        "| `residual.py` | `ImprovedSimulator`, which applies drivetrain and residual |\n"
        "| `example.py` | a control loop |\n"
        + ("| `check.npz` | a rollout of the simulator that was exported |\n" if checked else "")
        + ("| `*.onnx` | the networks, from what they see to the loads that they push with |\n" if onnx else ""),
        "```python\n"
        "from residual import ImprovedSimulator\n\n"
        "simulator = ImprovedSimulator(folder)\n"
        "simulator.reset(qpos, qvel)               # without arguments: the initial pose, at rest\n"
        f"data = simulator.step([{', '.join(robot.commands)}])  # mujoco.MjData after a control step\n"
        "```",
    ]
    if checked:
        lines.append(
            "`python residual.py` compares a rollout with the simulator that was exported, in double precision."
        )
    ranges = "; ".join(
        f"`{name}` from {low:g} to {high:g}"
        for name, (low, high) in zip(robot.commands, robot.command_ranges, strict=True)
    )
    lines += [
        f"A control step is {robot.control_timestep:g} s: {plain.substeps} physics steps of {option.timestep:g} s. The "
        f"solver makes at most {option.iterations} iterations, as in training.",
        f"Commands are in the actuators' own units: {ranges}.",
        "`ImprovedSimulator(folder, model)` takes a scene of your own that holds the robot, with the same names of "
        "sites and actuators. It sets `ctrl` of the robot's actuators, and `xfrc_applied` of the bodies and "
        "`qfrc_applied` of the joints that the residual pushes.",
    ]
    if left_out:
        lines.append(f"MJCF cannot hold these fields; `parameters.npz` does: {', '.join(left_out)}.")
    for part in parts:
        if part["kind"] == "network":
            seen = "\n".join(f"{i}. {name}" for i, name in enumerate(part["inputs"]))
            pushed = ", ".join(part["outputs"])
            frame = f"the heading frame of {robot.tracked}" if part["heading_frame"] else "the world's axes"
            lines.append(f"## What the network {part['name']} sees")
            lines.append(
                f"Vectors are in {frame}."
                + (
                    f" x and y of positions are from {robot.tracked} now; z is above the floor."
                    if part["relative_observation"]
                    else ""
                )
                + f" It pushes with: {pushed}."
            )
            lines.append(seen)
    return "\n\n".join(textwrap.dedent(line) for line in lines) + "\n"
