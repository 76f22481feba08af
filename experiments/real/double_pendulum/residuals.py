# %% [markdown]
# # Residual torques at the joints of a real double pendulum
#
# The residual methods learn what the model of `double_pendulum.py` lacks, as torques along both joints
# (`--forces joints`), from the same six recordings. The validation recordings choose checkpoints. Nothing tells the
# methods that friction is missing. EnvMimic starts at the mean missing torque, or with the network of *supervised*.
# Identification of declared parameters, and the friction of the data's authors, are the comparison. EnvMimic also
# learns what the identified model lacks. The header of `double_pendulum.py` names the data.
#
# Run `python experiments/real/double_pendulum/residuals.py --data FOLDER`. `--quick` is a short trial run.

# %%
from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path("experiments/real/double_pendulum") if "ipykernel" in sys.modules else Path(__file__).parent
sys.path[1:1] = [str(FOLDER), str(FOLDER.parent), str(FOLDER.parents[1])]

import _setup

_setup.prepare()

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import _fit
import double_pendulum
import jax.numpy as jnp
import numpy as np
from _constant_wrench import ConstantWrench
from _networks import learn_network
from jaxtyping import Float

from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation.open_loop import Evaluators, OpenLoopEvaluator, Replay
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.description import read_description
from ballu_mjx.sim.residual import Residual
from ballu_mjx.sim.simulator import Simulator

NAMES = {
    "training": double_pendulum.TRAINING,
    "validation": double_pendulum.VALIDATION,
    "test": double_pendulum.TEST,
}
"""Times in the names of recordings, by use."""


class Method(NamedTuple):
    """Method that learns what the model lacks."""

    name: str
    """Name of its command."""
    start: str | None = None
    """Row with whose networks its training starts (`train envmimic --start-from`)."""


METHODS: Mapping[str, Mapping[str, Method]] = {
    "nominal": {
        "supervised": Method("supervised"),
        "EnvMimic from supervised": Method("envmimic", start="supervised"),
        "analytic": Method("analytic"),
        "EnvMimic": Method("envmimic"),
    },
    "published friction": {},
    "identified": {"identified, then EnvMimic": Method("envmimic")},
}
"""Methods by row of the tables, by values of the model's parameters."""
QUICK_ROWS = ("supervised", "analytic", "EnvMimic")
"""Rows of a trial run."""

Motions = Mapping[str, Sequence[Motion]]
"""Reconstructed recordings by use."""


def load(data: Path, simulator: Simulator, *, quick: bool) -> dict[str, list[Motion]]:
    """Reconstruct the recordings by use, with the drivetrain of `simulator`. `quick` takes one of each."""
    files = {use: [data / f"sysid-20230629-{name}.csv.gz" for name in names] for use, names in NAMES.items()}
    files["swing-ups"] = double_pendulum.swing_ups(data)
    few = slice(1) if quick else slice(None)
    return {
        use: [reconstruct_for_simulator(read_recording(path, simulator.robot), simulator) for path in paths[few]]
        for use, paths in files.items()
        if paths
    }


# %% [markdown]
# ## Errors


# %%
Angles = tuple[Float[np.ndarray, "starts joints"], Float[np.ndarray, "starts joints"]]
"""Recorded and simulated joint angles (rad). Simulated ones are NaN if the simulation diverged."""


def end_angles(evaluator: OpenLoopEvaluator, replay: Replay, horizon: float) -> Angles:
    """Return the joint angles of a replay at the end of a horizon (s), for starts with that much recording."""
    steps = round(horizon / evaluator.robot.control_timestep)
    recorded, simulated = [], []
    for run, (number, start) in enumerate(evaluator.starts):
        qpos = evaluator.motions[number].qpos
        if start + steps < len(qpos):
            recorded.append(qpos[start + steps])
            simulated.append(replay.joints[run, steps])
    return np.array(recorded, float), np.array(simulated, float)


def median_errors(angles: Angles) -> tuple[float, ...]:
    """Return the median absolute errors (deg) of shoulder and elbow. Simulations that diverged count as infinite."""
    recorded, simulated = angles
    errors = np.abs(np.rad2deg(simulated - recorded))
    return tuple(np.median(np.where(np.isfinite(errors), errors, np.inf), axis=0).tolist())


def tip_errors(angles: Angles) -> tuple[float, ...]:
    """Return median and 90th percentile of the tip's distance (m). Simulations that diverged count as infinite."""
    recorded, simulated = map(double_pendulum.tip, angles)
    distance = np.linalg.norm(simulated - recorded, axis=1)
    return tuple(np.percentile(np.where(np.isfinite(distance), distance, np.inf), [50, 90]).tolist())


Found = dict[str, tuple[float, ...]]
"""Errors of one simulator, by table and group."""


def errors_of(evaluators: Evaluators, residual: Residual, params: Any, motions: Motions) -> Found:
    """Return the errors of a simulator with a residual."""
    found = {}
    for group in (use for use in motions if use != "training"):
        evaluator = evaluators.of(residual, motions[group])
        replay = evaluator.replay(params, seconds=double_pendulum.HORIZONS[-1])
        if group == "swing-ups":
            found[group] = tip_errors(end_angles(evaluator, replay, double_pendulum.SWING_UP_HORIZON))
            continue
        for horizon in double_pendulum.HORIZONS:
            found[f"{group}, {horizon:g} s"] = median_errors(end_angles(evaluator, replay, horizon))
    return found


def tables(rows: Mapping[str, Sequence[Found]]) -> dict[str, Table]:
    """Return the tables. `rows` holds the errors of each simulator, one for each seed."""

    def cells(key: str, form: str) -> dict[str, list[Cell]]:
        return {
            name: [Cell(values, form) for values in zip(*(found[key] for found in runs), strict=True)]
            for name, runs in rows.items()
        }

    known = next(iter(rows.values()))[0]
    made = {}
    for horizon in double_pendulum.HORIZONS:
        sides = [cells(f"{group}, {horizon:g} s", ".2f") for group in ("validation", "test")]
        heads = [f"{group}: {joint} (deg)" for group in ("validation", "test") for joint in ("shoulder", "elbow")]
        made[f"after_{1000 * horizon:.0f}_ms"] = Table(
            (f"after {horizon:g} s", *heads), tuple((name, *sides[0][name], *sides[1][name]) for name in rows)
        )
    if "swing-ups" in known:
        found = cells("swing-ups", ".4f")
        heads = f"swing-ups: tip after {double_pendulum.SWING_UP_HORIZON:g} s", "median (m)", "90th percentile (m)"
        made["swing_ups"] = Table(heads, tuple((name, *found[name]) for name in rows))
    return made


# %%
def main() -> None:
    description = "Learn torques at the joints of a double pendulum by three methods."
    options = _fit.parse(description, Path("runs/double_pendulum_residuals"), trains=True)
    quick, seeds = options.quick, options.seeds[:1] if options.quick else options.seeds
    robot = read_description(FOLDER / "double_pendulum.robot.json")
    data = double_pendulum.prepare(options.data, options.output / "recordings")
    fit = double_pendulum.identify(data, quick=quick)
    vectors = _fit.candidates(fit, double_pendulum.PUBLISHED)
    rows: dict[str, list[Found]] = {}
    for name, vector in vectors.items():
        actuators = None if name == "nominal" else IdentifiedParameters(jnp.asarray(vector), fit.parameters)
        simulator = Simulator(robot, actuators)
        motions, evaluators = load(data, simulator, quick=quick), Evaluators(simulator)
        nothing = ConstantWrench(anchored=robot.anchored), jnp.zeros(6)
        rows[name] = [errors_of(evaluators, *nothing, motions)]
        learned: dict[str, list[TrainedResidual]] = {}
        for row, method in METHODS[name].items():
            if quick and row not in QUICK_ROWS:
                continue
            print(f"{row}:", flush=True)
            uses = motions["training"], motions["validation"]
            starts = [None] * len(seeds) if method.start is None else learned[method.start]
            learned[row] = [
                learn_network(method.name, simulator, *uses, "joints", seed, quick=quick, start_from=start)
                for seed, start in zip(seeds, starts, strict=True)
            ]
            rows[row] = [errors_of(evaluators, each.model, each.params, motions) for each in learned[row]]
    _setup.write_tables(tables(rows), options.output, options.results, {"training": seeds})


if __name__ == "__main__":
    _setup.run(main)
