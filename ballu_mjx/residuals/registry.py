"""Registry of the kinds of residual, with the function that loads each kind from a run's folder.

A new kind needs a class with the interface `sim.residual.Residual`, a function that loads it from a run's folder, and
an entry in `KINDS`.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ballu_mjx.common.errors import InputError
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters
from ballu_mjx.runs.layout import Which

if TYPE_CHECKING:
    from ballu_mjx.sim.residual import Residual


CONTROL_STEPS, GRADIENT_STEPS = "control steps", "gradient steps"
"""Units of the steps in a run's metrics."""


class StoredRun(NamedTuple):
    """A run of a residual, with its configuration."""

    folder: Path
    config: Mapping[str, Any]
    """Content of `config.json`."""
    robot: RobotDescription
    actuators: ModelParameters | None
    """Identified actuators of the run's simulator. None if they are nominal."""
    which: Which
    """Checkpoint to read, for kinds with checkpoints."""


class LoadedResidual(NamedTuple):
    """Residual that a run has learned, without its base residual."""

    model: Residual
    params: Any
    inputs: int
    """Number of inputs of the residual."""
    step: int
    """Control steps or gradient steps of training until the checkpoint. 0 for kinds without checkpoints."""
    fade_width: float | None = None
    """See `ForceNetworkConfig.fade_width`."""


@dataclasses.dataclass(frozen=True)
class ResidualKind:
    """A kind of residual."""

    name: str
    """Name of the task of its runs, and of a simulator with this residual."""
    label: str
    """Label in figures and tables."""
    network: bool
    """Whether the residual is a network of forces. Runs of a network have checkpoints and may have a base residual.
    Other kinds are physical models, without either."""
    load: Callable[[StoredRun], LoadedResidual]
    """Function that loads a run. **Raises** `InputError` if files of the run are damaged."""
    steps: str = CONTROL_STEPS
    """Unit of the steps in a run's metrics."""


def _load_network(run: StoredRun) -> LoadedResidual:
    from ballu_mjx.residuals.envmimic import EnvMimicConfig, check_envmimic_config
    from ballu_mjx.residuals.network import NetworkResidual
    from ballu_mjx.residuals.network_input import num_inputs
    from ballu_mjx.residuals.network_loads import load_scales, num_loads
    from ballu_mjx.residuals.network_mirror import network_mirror
    from ballu_mjx.rl import ppo
    from ballu_mjx.runs.checkpoints import restore_checkpoint
    from ballu_mjx.runs.folder import typed_config

    folder, robot, task = run.folder, run.robot, run.config["task"]
    step, tree = restore_checkpoint(folder, run.which)
    params = ppo.from_tree(tree)
    inputs = params.normalizer.mean["state"].shape[0]
    check = functools.partial(check_envmimic_config, control_timestep=robot.control_timestep)
    config = typed_config(EnvMimicConfig, run.config, "env", folder, check)
    network = typed_config(ppo.PPOConfig, run.config, "ppo", folder, ppo.check_values)
    try:
        load_scales(config, robot)
    except ValueError as error:
        raise InputError(f"{folder}: its config.json has no scales of the forces; restore it.") from error
    sizes = inputs, num_loads(config, robot), network, network_mirror(config, robot)
    infer = ppo.make_inference(*sizes)
    if not (inputs == num_inputs(config, robot) and ppo.fits(infer, params, inputs)):
        raise InputError(
            f"{folder}: the stored parameters do not fit the network in its config.json; restore the checkpoint or "
            "config.json."
        )
    sample = ppo.make_sampler(*sizes) if task == "envmimic" else None
    model = NetworkResidual(config, robot, infer, sample, task, network)
    return LoadedResidual(model, params, inputs, step, config.fade_width)


def _load_aerodynamics(run: StoredRun) -> LoadedResidual:
    from ballu_mjx.residuals.aerodynamics import AERODYNAMICS_FILE, Aerodynamics, read_air_parameters
    from ballu_mjx.residuals.network_config import ForceNetworkConfig
    from ballu_mjx.residuals.network_input import num_inputs

    model = Aerodynamics(run.robot, run.robot.load_model(run.actuators))
    params = read_air_parameters(run.folder / AERODYNAMICS_FILE, run.robot)
    return LoadedResidual(model, params, num_inputs(ForceNetworkConfig(), run.robot), 0)


def _load_fluid(run: StoredRun) -> LoadedResidual:
    from ballu_mjx.residuals.fluid import FLUID_FILE, read_fluid
    from ballu_mjx.residuals.network_config import ForceNetworkConfig
    from ballu_mjx.residuals.network_input import num_inputs

    found = read_fluid(run.folder / FLUID_FILE)
    model = found.residual(run.robot, run.robot.load_model(run.actuators))
    return LoadedResidual(model, found.params, num_inputs(ForceNetworkConfig(), run.robot), 0)


KINDS: Mapping[str, ResidualKind] = {
    kind.name: kind
    for kind in (
        ResidualKind("envmimic", "EnvMimic", True, _load_network),
        ResidualKind("supervised", "supervised", True, _load_network, GRADIENT_STEPS),
        ResidualKind("analytic", "analytic", True, _load_network, GRADIENT_STEPS),
        ResidualKind("aerodynamic", "aerodynamic", False, _load_aerodynamics),
        ResidualKind("fluid", "fluid forces", False, _load_fluid),
    )
}
"""All kinds of residual, by name."""
RESIDUAL_TASKS = tuple(KINDS)
"""Tasks whose runs have a residual."""
NETWORKS = tuple(name for name, kind in KINDS.items() if kind.network)
"""Tasks whose runs have a network that computes loads."""


def steps_of(task: str) -> str:
    """Return the unit of the steps in the metrics of a task's runs."""
    return KINDS[task].steps if task in KINDS else CONTROL_STEPS
