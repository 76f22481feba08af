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
    """Return an example program that steps the simulator of the robot `name`."""
    return _EXAMPLE_TEXT.format(name=name)


def folder_readme(
    simulator: AugmentedSimulator,
    parts: Sequence[Mapping[str, Any]],
    left_out: tuple[str, ...],
    *,
    onnx: bool,
    checked: bool,
) -> str:
    """Return the README of the folder, which describes its files and their use.

    **Arguments**

    - `parts`: entries of the residual's parts in `simulator.json`.
    - `left_out`: names of model fields whose values MJCF text cannot hold.
    - `onnx`: whether the folder has the networks as ONNX.
    - `checked`: whether the folder has a rollout for the self-test.
    """
    robot, plain = simulator.robot, simulator.simulator
    names = " + ".join(part["name"] for part in parts) or "none"
    option = plain.mj_model.opt
    lines = [
        f"# Improved simulator of {robot.name} for C MuJoCo",
        f"Residual: {names}. Identified actuators: {'no' if simulator.actuators is None else 'yes'}. Drivetrain: "
        f"{'no' if plain.drivetrain is None else 'yes'}.",
        "The folder needs Python 3.10 or newer, NumPy and MuJoCo. It was written with MuJoCo "
        f"{mujoco.__version__}. The solver of another version may differ in the last digits.",
        "| file | content |\n| --- | --- |\n"
        "| `identified.xml` | the model, with the values of identified actuators and of the residual; numbers have six "
        "digits |\n"
        "| `simulator.json` | names, ranges, time steps, the drivetrain, and the residual's settings |\n"
        "| `parameters.npz` | the residual's arrays, and the model's fields in full precision |\n"
        "| `residual.py` | `ImprovedSimulator`, which applies the drivetrain and the residual |\n"
        "| `example.py` | a control loop with random commands |\n"
        + ("| `check.npz` | a rollout of the exported simulator, for the self-test |\n" if checked else "")
        + ("| `*.onnx` | the residual's networks; their outputs are loads |\n" if onnx else ""),
        "```python\n"
        "from residual import ImprovedSimulator\n\n"
        "simulator = ImprovedSimulator(folder)\n"
        "simulator.reset(qpos, qvel)               # without arguments: the initial pose, at rest\n"
        f"data = simulator.step([{', '.join(robot.commands)}])  # mujoco.MjData after a control step\n"
        "```",
    ]
    if checked:
        lines.append("`python residual.py` compares a rollout with one of the exported simulator, in double precision.")
    ranges = "; ".join(
        f"`{name}` from {low:g} to {high:g}"
        for name, (low, high) in zip(robot.commands, robot.command_ranges, strict=True)
    )
    lines += [
        f"A control step lasts {robot.control_timestep:g} s: {plain.substeps} physics steps of {option.timestep:g} s. "
        f"The solver makes at most {option.iterations} iterations, as in training.",
        f"Commands are in the actuators' own units: {ranges}.",
        "`ImprovedSimulator(folder, model)` simulates a scene of your own that contains the robot, with the same names "
        "of sites, joints and actuators. It sets `ctrl` of the robot's actuators. It also sets `xfrc_applied` of the "
        "bodies and `qfrc_applied` of the joints on which the residual acts.",
    ]
    if left_out:
        lines.append(
            f"MJCF text cannot hold the values of these model fields. `parameters.npz` has them: {', '.join(left_out)}."
        )
    for part in parts:
        if part["kind"] == "network":
            inputs = "\n".join(f"{i}. {name}" for i, name in enumerate(part["inputs"]))
            outputs = ", ".join(part["outputs"])
            frame = f"the heading frame of {robot.tracked}" if part["heading_frame"] else "the world frame"
            lines.append(f"## Input and output of the network {part['name']}")
            lines.append(
                f"Vectors are in {frame}."
                + (
                    f" x and y of positions are relative to the current position of {robot.tracked}; z is the height "
                    "above the floor."
                    if part["relative_observation"]
                    else ""
                )
                + f" Outputs: {outputs}. Inputs:"
            )
            lines.append(inputs)
    return "\n\n".join(textwrap.dedent(line) for line in lines) + "\n"
