"""Export to other tools: `python -m ballu_mjx export policy`, `... simulator`, `... check`.

JAX and modules that need it are imported inside functions: `runtime.prepare` has to come first.
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
    """Write a locomotion policy as a controller for the robot. The controller needs only Python and NumPy."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""


@dataclasses.dataclass(frozen=True)
class SimulatorOptions(runtime.CommandOptions):
    """Write a run's simulator for C MuJoCo: the model with identified values, and code for drivetrain and residual.

    It needs only Python, NumPy and MuJoCo."""

    run: tyro.conf.Positional[Path]
    """Folder of a run of a residual, of identified actuators, or of a policy. For a policy, the simulator in which it
    was trained is exported."""
    output: Path | None = None
    """Folder to write into, new or empty. Without this option: simulator/ in the run's folder."""
    onnx: bool = False
    """Also write each network of the residual, as NAME.onnx. The file's metadata name inputs and outputs with units.
    Needs the extra onnx."""
    check_seconds: float = 5.0
    """Length (s, 0 to 60) of a reference rollout in double precision, with which the exported simulator tests itself. 0
    for no rollout."""


@dataclasses.dataclass(frozen=True)
class CheckOptions(runtime.CommandOptions):
    """Run an exported policy in C MuJoCo, and compare it with the same policy in its training simulator.

    The exit status is 1 if they differ."""

    folder: tyro.conf.Positional[Path]
    """Folder that `export policy` wrote."""
    simulator: Path | None = None
    """Exported simulator in which to run the policy. Without this option: the simulator in which it was trained."""
    run: Path | None = None
    """Folder of the policy's run. Without this option: the folder from which the policy was exported."""
    seconds: float | None = None
    """Length of the trial (s). Without this option: the task's trial length."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (`runtime.exit_status`)."""
    description = "Export results to other tools. Each subcommand explains its options with --help."
    return run_subcommand("export", description, subcommands(), _run, arguments)


def subcommands() -> dict[str, type]:
    """Return the options of the subcommands by name."""
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
        print(f"MJCF cannot represent {', '.join(found.left_out)}; parameters.npz contains these values.")
    if found.deviation is not None:
        distance, angle = found.deviation
        print(
            f"C MuJoCo differs from the simulator by at most {1000 * distance:.2g} mm and {angle:.2g} deg over "
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
