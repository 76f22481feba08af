"""`python -m ballu_mjx export policy`, `... simulator`, `... check`: into the user's own tools.

JAX, and all that needs it, is imported inside functions: `runtime.prepare` has to come first.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from ballu_mjx.cli._subcommands import run_subcommand
from ballu_mjx.common import runtime
from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.deploy.export import ExportOptions, export_policy


@dataclasses.dataclass(frozen=True)
class PolicyOptions(runtime.CommandOptions, ExportOptions):
    """Write a locomotion policy as a controller for the robot that needs Python and NumPy only."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""


@dataclasses.dataclass(frozen=True)
class SimulatorOptions(runtime.CommandOptions):
    """Write a run's simulator for C MuJoCo: the model with identified values, and what applies drivetrain and residual.

    It needs Python, NumPy and MuJoCo only."""

    run: tyro.conf.Positional[Path]
    """Folder of a run of a residual, of identified actuators, or of a policy (the simulator that it was trained in)."""
    output: Path | None = None
    """Folder to write into, new or empty. Without this option: simulator/ in the run's folder."""
    onnx: bool = False
    """Write each network of the residual too, as NAME.onnx. Its properties name inputs and outputs, with units. Needs
    the extra onnx."""
    check_seconds: float = 5.0
    """Length of a rollout in double precision that goes with the folder for its self-test, s; 0: none."""


@dataclasses.dataclass(frozen=True)
class CheckOptions(runtime.CommandOptions):
    """Run an exported policy in C MuJoCo, beside the simulator that it was trained in.

    The exit status is 1 where they differ."""

    folder: tyro.conf.Positional[Path]
    """What `export policy` wrote."""
    simulator: Path | None = None
    """An exported simulator to run in. Without this option: the policy's own one."""
    run: Path | None = None
    """Folder of the policy's run. Without this option: where it was."""
    seconds: float | None = None
    """Length of the trial, s. Without this option: the task's."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status (`runtime.exit_status`)."""
    description = "Take results into other tools. Each subcommand explains its options with --help."
    return run_subcommand("export", description, subcommands(), _run, arguments)


def subcommands() -> dict[str, type]:
    """Options of the subcommands by name."""
    return {"policy": PolicyOptions, "simulator": SimulatorOptions, "check": CheckOptions}


def _run(options: PolicyOptions | SimulatorOptions | CheckOptions) -> int:
    if isinstance(options, PolicyOptions):
        export_policy(options)
        return 0
    return _simulator(options) if isinstance(options, SimulatorOptions) else _check(options)


def _simulator(options: SimulatorOptions) -> int:
    from ballu_mjx.policies.load_simulator import load_simulator
    from ballu_mjx.residuals.deploy.export import export_simulator

    if not 0 <= options.check_seconds <= 60:
        raise InputError(f"--check-seconds is {options.check_seconds:g}: it must be between 0 and 60.")
    simulator = load_simulator(options.run)
    print("Compiling: about a minute the first time ...", flush=True)
    output = options.output or options.run / "simulator"
    found = export_simulator(simulator, output, onnx=options.onnx, check_seconds=options.check_seconds)
    if found.left_out:
        print(f"MJCF cannot hold {', '.join(found.left_out)}; parameters.npz does.")
    if found.deviation is not None:
        distance, angle = found.deviation
        print(
            f"C MuJoCo differs from the simulator by {1000 * distance:.2g} mm and {angle:.2g} deg at most over "
            f"{options.check_seconds:g} s, in double precision."
        )
    print(f"Written to {found.folder}: {', '.join(sorted(path.name for path in found.folder.iterdir()))}.")
    return 0


def _check(options: CheckOptions) -> int:
    from ballu_mjx.policies.deploy.check import check_policy

    print("Compiling: about a minute the first time ...", flush=True)
    found = check_policy(options.folder, simulator=options.simulator, run=options.run, seconds=options.seconds)
    print(found.table())
    return 0 if found.agrees else 1
