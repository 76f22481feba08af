"""Export of an improved simulator to C MuJoCo, as a folder with the model, the drivetrain and the residual.

The folder needs only NumPy and MuJoCo. Its `residual.py` is a copy of `residuals/deploy/residual.py`.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.standalone import standalone_source
from ballu_mjx.residuals.aerodynamics import Aerodynamics, air_parameters_to_json
from ballu_mjx.residuals.deploy import residual as standalone
from ballu_mjx.residuals.deploy.folder_texts import example_program, folder_readme
from ballu_mjx.residuals.fluid import FluidResidual
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_input import network_input_names
from ballu_mjx.residuals.network_loads import load_names, load_scales
from ballu_mjx.residuals.network_mirror import network_mirror
from ballu_mjx.residuals.training_range import MARGIN, NARROWEST, FadingResidual
from ballu_mjx.rl.network_export import NetworkPort, OutputScale, check_onnx, network_arrays, onnx_model
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.mjcf import write_mjcf
from ballu_mjx.runs.folder import new_folder
from ballu_mjx.sim.c_model import DERIVED_FIELDS, improved_model, site_poses
from ballu_mjx.sim.drivetrain import QUANTITIES
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.residual import BoundResidual, Residual, SumOfResiduals
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState, Simulator
from ballu_mjx.sim.step import state_at

CHECK_SECONDS = 5.0
"""Default length of the rollout in the folder, which its self-test repeats (s)."""
_SOURCE = "residual.py"
_EXAMPLE = "example.py"
_HOLD = 0.25
"""Time for which this rollout holds each command (s)."""


@dataclasses.dataclass(frozen=True, eq=False)
class ExportedSimulator:
    """Result of `export_simulator`.

    **Fields**

    - `folder`: the folder that was written.
    - `deviation`: largest difference between the simulator in the folder and the exported simulator over the rollout:
      in position of the tracked site (m) and in orientation of its body (deg). None if no rollout was made.
    - `left_out`: names of model fields whose values MJCF text cannot hold. `parameters.npz` has them.
    """

    folder: Path
    deviation: tuple[float, float] | None
    left_out: tuple[str, ...]


class ExportedPart(NamedTuple):
    """A part of a residual: its entry in `simulator.json`, and its arrays in `parameters.npz` by name."""

    settings: dict[str, Any]
    arrays: dict[str, np.ndarray]


def export_simulator(
    simulator: Simulator | AugmentedSimulator,
    folder: Path | str,
    *,
    onnx: bool = False,
    check_seconds: float = CHECK_SECONDS,
) -> ExportedSimulator:
    """Export a simulator, with its actuators, drivetrain and residual, to C MuJoCo.

    **Arguments**

    - `folder`: a new or empty folder.
    - `onnx`: also write each network of the residual as `NAME.onnx`. Its outputs are the loads.
    - `check_seconds`: length of a rollout in double precision that the folder's self-test repeats (s). If 0, the folder
      has no rollout.

    **Raises** `InputError` if the folder is not empty, or if the model cannot be written. It also does so if the
    residual is scaled, has a part of a kind that cannot be exported, or has no network although `onnx` is set.
    """
    augmented = simulator.with_residual(None)
    if augmented.scale is not None:
        raise InputError("A simulator with a scaled residual cannot be exported; make it without the scale.")
    if onnx:
        check_onnx()
    robot, parts = augmented.robot, _parts(augmented)
    networks = [part for part in parts if part.settings["kind"] == "network"]
    if onnx and not networks:
        raise InputError("--onnx: the simulator has no network, only formulas in residual.py; leave the option out.")
    if onnx and any(part.settings["fade"] for part in networks):
        raise InputError("--onnx: the network's loads fade, which only residual.py can compute; leave the option out.")
    place = new_folder(Path(folder), "export")
    place.mkdir(parents=True, exist_ok=True)
    wanted = improved_model(augmented)
    exact = write_mjcf(robot.model, wanted, place, standalone.MODEL_FILE)
    written = mujoco.MjModel.from_xml_path(str(place / standalone.MODEL_FILE))
    left_out = tuple(
        name.partition("/")[2]
        for name, value in exact.items()
        if name.startswith("model/")
        and name.partition("/")[2] not in DERIVED_FIELDS
        and not np.allclose(getattr(written, name.partition("/")[2]), value, rtol=1e-4, atol=1e-7)
    )
    _write_json(place / standalone.SETTINGS_FILE, _settings(augmented, wanted, parts))
    arrays = {f"part_{i}/{name}": value for i, part in enumerate(parts) for name, value in part.arrays.items()}
    np.savez(place / standalone.PARAMETERS_FILE, **exact, **arrays)  # pyright: ignore[reportArgumentType]
    (place / _SOURCE).write_text(standalone_source(__package__ or "", _SOURCE), encoding="utf-8")
    (place / _EXAMPLE).write_text(example_program(robot.name), encoding="utf-8")
    names = dict.fromkeys(part.settings["name"] for part in networks)
    for number, part in enumerate(networks):
        stem = part.settings["name"] if len(names) == len(networks) else f"{part.settings['name']}-{number + 1}"
        if onnx:
            (place / f"{stem}.onnx").write_bytes(_network_onnx(part))
    deviation = None
    if check_seconds > 0:
        _write_check(place / standalone.CHECK_FILE, augmented, wanted, check_seconds)
        distances, angles, _ = standalone.deviations(place)
        deviation = float(distances.max()), float(angles.max())
    settings = [part.settings for part in parts]
    text = folder_readme(augmented, settings, left_out, onnx=onnx, checked=deviation is not None)
    (place / "README.md").write_text(text, encoding="utf-8")
    return ExportedSimulator(place, deviation, left_out)


# ---- parts of the residual ----


def _parts(simulator: AugmentedSimulator) -> list[ExportedPart]:
    bound = simulator.residual
    return [] if bound is None else [_export_part(simulator, *part) for part in _flat(bound.model, bound.params)]


def _flat(model: Residual, params: Any) -> list[tuple[Residual, Any]]:
    """Return the parts of a residual that may be a sum, with their parameters."""
    if isinstance(model, SumOfResiduals):
        return [each for part, own in zip(model.parts, params, strict=True) for each in _flat(part, own)]
    return [(model, params)]


def _export_part(simulator: AugmentedSimulator, model: Residual, params: Any) -> ExportedPart:
    for kind, export in _KINDS.items():
        if isinstance(model, kind):
            return export(simulator, model, jax.device_get(params))
    known = ", ".join(kind.__name__ for kind in _KINDS)
    raise InputError(
        f"The residual {model.name} is of a kind that cannot be exported; kinds that can be exported: {known}."
    )


def _network_part(simulator: AugmentedSimulator, model: NetworkResidual, params: Any) -> ExportedPart:
    if model.network is None:
        raise InputError(f"The options of the network of {model.name} are unknown; load the residual from its run.")
    config, robot = model.config, simulator.robot
    scales = load_scales(config, robot)
    settings = {
        "kind": "network",
        "name": model.name,
        "forces": config.forces,
        "joints": list(robot.force_joints) if config.forces == "joints" else [],
        "relative_observation": config.relative_observation and not robot.anchored,
        "heading_frame": config.heading_frame and not robot.anchored,
        "observe_command": config.observe_command,
        "command_ranges": [list(bounds) for bounds in robot.command_ranges],
        "activation": model.network.activation,
        "inputs": network_input_names(config, robot),
        "outputs": load_names(config, robot),
        "fade": None,
        "unit": scales.units.tolist(),
        "limit": (scales.units * scales.limit).tolist(),
    }
    arrays = network_arrays(params, model.network, network_mirror(config, robot))
    del arrays["activation"]
    return ExportedPart(settings, {name: np.asarray(value, float) for name, value in arrays.items()})


def _fading_part(simulator: AugmentedSimulator, model: FadingResidual, params: Any) -> ExportedPart:
    own, observed = params
    settings, arrays = _export_part(simulator, model.inner, own)
    low, high = (np.asarray(bound, float) for bound in observed)
    widths = np.maximum(high - low, NARROWEST)
    fade = {"width": model.width, "margin": MARGIN}
    return ExportedPart(settings | {"fade": fade}, arrays | {"low": low, "high": high, "widths": widths})


def _aerodynamic_part(simulator: AugmentedSimulator, model: Aerodynamics, params: Any) -> ExportedPart:
    settings = {"kind": "aerodynamic", "name": model.name, **_timing(simulator)}
    return ExportedPart({**settings, "parameters": air_parameters_to_json(params)}, {})


def _fluid_part(simulator: AugmentedSimulator, model: FluidResidual, params: Any) -> ExportedPart:
    gravity = np.asarray(simulator.simulator.mj_model.opt.gravity)
    size = float(np.linalg.norm(gravity))
    settings = {
        "kind": "fluid",
        "name": model.name,
        **_timing(simulator),
        "down": (gravity / size if size > 0 else gravity).tolist(),
        "terms": [
            {"name": term.name, "factors": list(term.factors), "power_of_speed": term.power} for term in model.terms
        ],
    }
    return ExportedPart(settings, {"coefficients": np.asarray(params.coefficients, float)})


_KINDS: Mapping[type, Callable[..., ExportedPart]] = {
    NetworkResidual: _network_part,
    FadingResidual: _fading_part,
    Aerodynamics: _aerodynamic_part,
    FluidResidual: _fluid_part,
}


def _timing(simulator: AugmentedSimulator) -> dict[str, Any]:
    plain = simulator.simulator
    timestep = float(plain.mj_model.opt.timestep)
    return {"control_timestep": plain.control_timestep, "timestep": timestep, "substeps": plain.substeps}


def _network_onnx(part: ExportedPart) -> bytes:
    settings, arrays = part
    unit, limit = np.array(settings["unit"]), np.array(settings["limit"])
    return onnx_model(
        {**arrays, "activation": np.array(settings["activation"])},
        NetworkPort("input", settings["inputs"]),
        NetworkPort("loads", settings["outputs"]),
        OutputScale(unit, np.zeros_like(unit), -limit, limit),
        settings["name"],
    )


# ---- files ----


def _settings(simulator: AugmentedSimulator, model: mujoco.MjModel, parts: list[ExportedPart]) -> dict[str, Any]:
    """Return the content of `simulator.json`."""
    robot, plain = simulator.robot, simulator.simulator
    rest = robot.adapter.rest_command(robot, model)
    commands = [
        {
            "name": name,
            "actuator": model.actuator(index).name,
            "low": low,
            "high": high,
            "rest": float(rest[index]),
        }
        for index, (name, (low, high)) in enumerate(zip(robot.commands, robot.command_ranges, strict=True))
    ]
    drivetrain: dict[str, Any] | None = None
    if plain.drivetrain is not None:
        drivetrain = {
            name: [float(x) if math.isfinite(x) else None for x in np.asarray(value, float)]
            for name, value in zip(QUANTITIES, plain.drivetrain, strict=True)
        }
        slots = plain.drivetrain_at_rest(jnp.asarray(rest, jnp.float32))
        assert slots is not None
        drivetrain["slots"] = len(slots.sent)
    return {
        "format": standalone.FORMAT,
        "robot": robot.name,
        "simulator": "vanilla" if simulator.residual is None else simulator.residual.model.name,
        **_timing(simulator),
        "tracked": robot.tracked,
        "points": list(robot.points),
        "commands": commands,
        "initial_qpos": robot.adapter.initial_qpos(robot, model).tolist(),
        "drivetrain": drivetrain,
        "residual": [part.settings for part in parts],
    }


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


class _Check(NamedTuple):
    """Content of `check.npz`: commands, first state, and poses of the tracked site after each control step."""

    commands: Float[np.ndarray, "steps commands"]
    qpos: Float[np.ndarray, " nq"]
    qvel: Float[np.ndarray, " nv"]
    position: Float[np.ndarray, "steps 3"]
    quaternion: Float[np.ndarray, "steps 4"]


def check_commands(robot: RobotDescription, seconds: float) -> Float[np.ndarray, "steps commands"]:
    """Return random commands for `seconds` (s), uniform over their ranges. Each command is held for 0.25 s."""
    rng = np.random.default_rng(0)
    steps, hold = (max(round(time / robot.control_timestep), 1) for time in (seconds, _HOLD))
    low, high = np.array(robot.command_ranges).T
    drawn = low + (high - low) * rng.uniform(size=(steps // hold + 1, len(low)))
    return np.repeat(drawn, hold, axis=0)[:steps]


def _write_check(path: Path, simulator: AugmentedSimulator, model: mujoco.MjModel, seconds: float) -> None:
    robot = simulator.robot
    qpos = robot.adapter.initial_qpos(robot, model)
    commands = check_commands(robot, seconds)
    states = rollout_in_double(simulator, model, qpos, np.zeros(model.nv), commands)
    check = _Check(commands, qpos, np.zeros(model.nv), *site_poses(model, robot.tracked, states))
    np.savez(path, **check._asdict())  # pyright: ignore[reportArgumentType]


def rollout_in_double(
    simulator: AugmentedSimulator,
    model: mujoco.MjModel,
    qpos: Float[np.ndarray, " nq"],
    qvel: Float[np.ndarray, " nv"],
    commands: Float[np.ndarray, "steps commands"],
) -> Float[np.ndarray, "steps nq"]:
    """Simulate in double precision, and return the generalized positions after each control step.

    `model` is the simulator's model for C MuJoCo (`improved_model`). History and drivetrain start as if the robot had
    been in the first state, under the first command, for a long time.
    """
    with jax.enable_x64(True):
        run = jax.jit(functools.partial(rollout_positions, in_double(simulator, model)))
        return np.asarray(run(qpos, qvel, commands))


def rollout_positions(
    simulator: AugmentedSimulator,
    qpos: Float[Array, " nq"],
    qvel: Float[Array, " nv"],
    commands: Float[Array, "steps commands"],
) -> Float[Array, "steps nq"]:
    """Simulate, and return the generalized positions after each control step.

    The precision is that of the simulator and its arguments. History and drivetrain start as if the robot had been in
    the first state, under the first command, for a long time. The function may be jitted, and vmapped over states.
    """

    def step(state: RolloutState, command: Array) -> tuple[RolloutState, Array]:
        after = simulator.step(state, command).state
        return after, after.physics.qpos

    return jax.lax.scan(step, _begin_rollout(simulator, qpos, qvel, commands[0]), commands)[1]


def in_double(simulator: AugmentedSimulator, model: mujoco.MjModel) -> AugmentedSimulator:
    """Return the simulator in double precision. Call it, and use the result, within `jax.enable_x64`."""

    def double(tree: Any) -> Any:
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64) if np.asarray(x).dtype.kind == "f" else x, tree)

    plain = Simulator(simulator.robot, simulator.actuators, model=model)
    plain = plain.with_drivetrain(double(simulator.simulator.drivetrain))
    bound = simulator.residual
    return AugmentedSimulator(plain, None if bound is None else BoundResidual(bound.model, double(bound.params)))


def _begin_rollout(
    simulator: AugmentedSimulator,
    qpos: Float[Array, " nq"],
    qvel: Float[Array, " nv"],
    command: Float[Array, " commands"],
) -> RolloutState:
    """Return the rollout state of a robot that has been in a state, under a command, for a long time."""
    plain = simulator.simulator
    physics = state_at(qpos, qvel)
    features, _ = plain.observe(physics)
    history, commands = jnp.tile(features, (HISTORY, 1)), jnp.tile(command, (HISTORY - 1, 1))
    return RolloutState(physics, history, commands, plain.drivetrain_at_rest(command))
