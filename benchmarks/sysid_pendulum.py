"""Compare accuracy and speed of three identification methods on recordings of a real double pendulum.

Recordings and model are those of `experiments/real/double_pendulum/`. The parameters are its friction, armature and
delay, and the strength of the motors. All methods have the same windows, measured starting states, bounds, first point
(nominal, slightly inside of the bounds) and residuals, and no priors. The residuals are the errors of positions at
every sample over `WEIGHT`, with a pseudo-Huber loss. The objective is their root mean square.

- ours: `fit_robot`, Levenberg-Marquardt with exact derivatives through MJX, one start.
- `mujoco.sysid` (`pip install "mujoco[sysid]"`): its own optimizer and finite differences. All windows and perturbed
  parameters go through one `rollout`.
- SciPy's L-BFGS-B: finite differences by C MuJoCo's `rollout`, for all parameters at once, on all cores.

All methods are judged by C MuJoCo with the solver run to convergence. After a search, its visited points are judged.
The reported time is that of the search. The time in which JAX traces, lowers and compiles is reported separately.
`fit_robot` also checks the data before the search and computes standard errors after it. The time of its whole call is
reported too.

    python benchmarks/sysid_pendulum.py --data FOLDER
    python benchmarks/sysid_pendulum.py --data FOLDER --quick     # one recording, few iterations
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ballu_mjx.common import runtime

runtime.prepare()

import jax
import jax.monitoring
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout
from searches import (
    CLOSE,
    DIFFERENCE,
    THREADS,
    Search,
    Trace,
    compare,
    lbfgsb,
    lowest_so_far,
    missing_for_toolbox,
    optimize_by_toolbox,
)

from ballu_mjx.common.results import Cell, Table, write_results
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.fit_robot import FitConfig, fit_robot
from ballu_mjx.identification.measured_motion import MeasuredMotion
from ballu_mjx.identification.parameters import ParameterSet
from ballu_mjx.identification.window_objective import soften
from ballu_mjx.identification.window_simulator import Windows, cut_windows
from ballu_mjx.robots.description import read_description
from ballu_mjx.robots.model import set_fields
from ballu_mjx.sim.drivetrain import filter_commands

EXPERIMENTS = Path(__file__).parents[1] / "experiments" / "real"
sys.path[1:1] = [str(EXPERIMENTS / "double_pendulum"), str(EXPERIMENTS)]
import double_pendulum  # pyright: ignore[reportMissingImports]

WEIGHT = np.deg2rad(2.0)
"""Unit of position residuals (rad), about the error of the identified model."""
SECONDS = 1.0
"""Length of a window (s). Windows are contiguous."""
OUTLIER_THRESHOLD = FitConfig().outlying
"""Threshold of the pseudo-Huber loss."""


class WindowRollouts:
    """Simulator of windows in C MuJoCo, for many sets of parameters in parallel."""

    def __init__(
        self, parameters: ParameterSet, motions: Sequence[MeasuredMotion], windows: Windows, *, exact: bool = False
    ) -> None:
        self.parameters, self.motions, self.windows = parameters, motions, windows
        self.model, self.every = copy.copy(motions[0].model), motions[0].every
        if exact:
            self.model.opt.iterations, self.model.opt.ls_iterations, self.model.opt.tolerance = 50, 50, 0.0
        samples = windows.first[:, None] + np.arange(windows.samples)
        pairs = list(zip(windows.motion, samples, strict=True))
        self.measured = np.array([np.concatenate([motions[m].qpos[s], motions[m].qvel[s]], axis=1) for m, s in pairs])
        first = [np.concatenate([[0.0], motions[m].start_qpos[s[0]], motions[m].qvel[s[0]]]) for m, s in pairs]
        self.start = np.array(first)
        steps = (windows.samples - 1) * self.every
        self._steps = windows.first[:, None] * self.every + np.arange(steps)
        timestep, slots = float(self.model.opt.timestep), parameters.slots(float(self.model.opt.timestep))
        longest = max(len(motion.commands) for motion in motions)
        commands = [np.pad(m.commands, [(0, longest - len(m.commands)), (0, 0)], "edge") for m in motions]
        self._drivetrain = np.flatnonzero(parameters.in_drivetrain)

        def filtered(values: jax.Array) -> jax.Array:
            drivetrain = parameters.drivetrain(values)
            each = jax.vmap(lambda own: filter_commands(drivetrain, own, timestep, slots))
            return each(jnp.asarray(np.stack(commands)))

        self._filtered = jax.jit(filtered)
        self._fields = jax.jit(lambda values: parameters.fields(self.model, values))
        self._pool = rollout.Rollout(nthread=THREADS)
        self._data = [mujoco.MjData(self.model) for _ in range(THREADS)]
        self._scratch = mujoco.MjData(self.model)

    def model_of(self, values: Float[np.ndarray, " parameters"]) -> mujoco.MjModel:
        """Return the model with these parameters."""
        model = copy.copy(self.model)
        set_fields(model, {name: np.asarray(value) for name, value in self._fields(values).items()})
        mujoco.mj_setConst(model, self._scratch)
        return model

    def states(
        self, models: Sequence[mujoco.MjModel], vectors: Float[np.ndarray, "n parameters"]
    ) -> Float[np.ndarray, "n windows samples states"]:
        """Return time (s), positions and velocities at the samples of each window."""
        count, controls = len(self.start), {}
        for vector in vectors:
            key = vector[self._drivetrain].tobytes()
            if key not in controls:  # Most sets differ only in the model.
                controls[key] = np.asarray(self._filtered(vector))[self.windows.motion[:, None], self._steps]
        control = np.concatenate([controls[vector[self._drivetrain].tobytes()] for vector in vectors])
        start = np.tile(self.start, (len(vectors), 1))
        path, _ = self._pool.rollout([m for m in models for _ in range(count)], self._data, start, control)
        found = np.concatenate([start[:, None], np.asarray(path)[:, self.every - 1 :: self.every]], axis=1)
        return found.reshape(len(vectors), count, *found.shape[1:])

    def differences(
        self, vectors: Float[np.ndarray, "n parameters"]
    ) -> Float[np.ndarray, "n windows samples channels"]:
        """Return simulated minus measured positions and velocities."""
        return self.states([self.model_of(vector) for vector in vectors], vectors)[..., 1:] - self.measured

    def objectives(self, vectors: Float[np.ndarray, "n parameters"]) -> Float[np.ndarray, " n"]:
        """Return the objective for each set of parameters."""
        return np.sqrt(np.mean(residuals(self.differences(vectors)) ** 2, axis=(1, 2, 3)))


def residuals(differences: Float[np.ndarray, "*batch channels"]) -> Float[np.ndarray, "*batch positions"]:
    """Return the residuals of positions, which are the first half of the channels."""
    return soften(differences[..., : differences.shape[-1] // 2] / WEIGHT, OUTLIER_THRESHOLD)[0]


class CompileClock:
    """Recorder of the time in which JAX traces, lowers or compiles. Nested events count once."""

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []
        jax.monitoring.register_event_duration_secs_listener(self._note)

    def _note(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            now = time.perf_counter()
            self._spans.append((now - duration_secs, now))

    def between(self, begin: float, end: float) -> float:
        """Return the seconds of compiling between two times of `time.perf_counter`."""
        total = 0.0
        for first, last in sorted(self._spans):
            first, last = max(first, begin), min(last, end)
            total += max(last - first, 0.0)
            begin = max(begin, last)
        return total


@dataclasses.dataclass(frozen=True)
class Found(Search):
    """Result of a search on the pendulum."""

    values: np.ndarray
    """Identified parameters."""
    whole_call: float | None = None
    """Seconds of the whole call of `fit_robot`, without compiling."""


def ours(
    parameters: ParameterSet, training: Sequence[MeasuredMotion], judge: WindowRollouts, clock: CompileClock, steps: int
) -> Found:
    """Identify by `fit_robot`."""
    tried: list[tuple[float, np.ndarray]] = []
    begins: list[float] = []
    config = FitConfig(
        window_seconds=SECONDS, starts=1, steps=steps, outlying=OUTLIER_THRESHOLD, start_spread=0.0, reweigh=False
    )
    called = time.perf_counter()
    fit = fit_robot(
        parameters,
        training,
        training[:1],
        config,
        on_data_check=lambda _: begins.append(time.perf_counter()),
        on_evaluation=lambda values: tried.append((time.perf_counter(), values)),
    )
    ended, (began,) = time.perf_counter(), begins
    when = [now - began - clock.between(began, now) for now, _ in tried]
    trace = judged(judge, [(seconds, values) for seconds, (_, values) in zip(when, tried, strict=True)])
    compiling, objective = clock.between(called, ended), float(judge.objectives(fit.values[None])[0])
    whole = ended - called - compiling
    return Found("ours", len(parameters), when[-1], compiling, objective, trace, fit.values, whole)


def judged(judge: WindowRollouts, visited: Sequence[tuple[float, np.ndarray]]) -> Trace:
    """Return the trace of visited points, with the judge's objective."""
    values = [float(judge.objectives(vector[None])[0]) for _, vector in visited]
    return lowest_so_far([(seconds, value) for (seconds, _), value in zip(visited, values, strict=True)])


def finite_differences(
    parameters: ParameterSet, simulator: WindowRollouts, judge: WindowRollouts, start: np.ndarray, iterations: int
) -> Found:
    """Identify by L-BFGS-B with finite differences."""
    size, places = len(parameters), []

    def function(place: np.ndarray) -> tuple[float, np.ndarray]:
        places.append(place.copy())
        steps = np.where(place + DIFFERENCE > 1, -DIFFERENCE, DIFFERENCE)
        beside = place + np.concatenate([np.zeros((1, size)), np.diag(steps)])
        values = simulator.objectives(parameters.at_shares(beside))
        return float(values[0]), (values[1:] - values[0]) / steps

    place, seconds, own = lbfgsb(function, parameters.shares(start), iterations)
    values = parameters.at_shares(place)
    # The first call is not timed.
    visited = [(when, parameters.at_shares(each)) for (when, _), each in zip(own, places[1:], strict=True)]
    trace = judged(judge, visited)
    return Found("L-BFGS-B", size, seconds, None, float(judge.objectives(values[None])[0]), trace, values)


def toolbox(
    parameters: ParameterSet, simulator: WindowRollouts, judge: WindowRollouts, start: np.ndarray, iterations: int
) -> Found:
    """Identify by `mujoco.sysid`."""
    from mujoco import sysid

    def vector(declared: Any) -> np.ndarray:
        return np.asarray(declared.as_vector(), float)

    def simulate(models: Sequence[mujoco.MjModel], param_dicts: Sequence[Any], **_: Any) -> list[Any]:
        paths = simulator.states(models, np.stack([vector(each) for each in param_dicts]))
        paths = paths.reshape(len(models), len(times), -1)
        paths[..., 0] = times
        return [
            sysid.SystemTrajectory(simulator.model, ctrl, measured, simulator.start[0], sysid.TimeSeries(times, path))
            for path in paths
        ]

    def difference(declared: Any, predicted: Any, measured: Any, *_: Any, state: np.ndarray, **__: Any) -> tuple:
        return residuals(state[:, 1:] - measured.data), measured, measured

    # The toolbox gets all windows as one sequence, because separate sequences take it many times as long.
    times = np.arange(simulator.measured[..., 0].size) * simulator.motions[0].sample_timestep
    measured = sysid.TimeSeries(times, simulator.measured.reshape(len(times), -1))
    ctrl = sysid.TimeSeries(times, np.zeros((len(times), simulator.model.nu)))  # `simulate` uses the delayed commands.
    spec = mujoco.MjSpec.from_file(str(read_pendulum().model))
    sequences = sysid.ModelSequences(
        "pendulum", spec, "windows", simulator.start[0], ctrl, measured, allow_missing_sensors=True
    )
    residual = sysid.build_residual_fn(
        models_sequences=[sequences],
        build_model=lambda declared, spec: simulator.model_of(vector(declared)),
        custom_rollout=simulate,
        modify_residual=difference,
        n_threads=THREADS,
        resample_true=False,
    )
    declared = sysid.ParameterDict()
    for parameter, value in zip(parameters.parameters, start, strict=True):
        declared.add(sysid.Parameter(parameter.name, value, *parameter.bounds))
    values, seconds, visited = optimize_by_toolbox(declared, residual, iterations)
    objective = float(judge.objectives(values[None])[0])
    return Found("mujoco.sysid", len(parameters), seconds, None, objective, judged(judge, visited), values)


def read_pendulum() -> Any:
    """Return the description of the double pendulum, with the strength of its motors instead of mass properties.

    Without priors, the recordings do not determine all mass properties.
    """
    robot = read_description(double_pendulum.FOLDER / "double_pendulum.robot.json")
    kept = (entry for entry in robot.identify if "body" not in entry)
    strengths = ({"actuator": name, "field": "strength"} for name in robot.commands)
    return dataclasses.replace(robot, identify=(*kept, *strengths))


def without_priors(parameters: ParameterSet) -> ParameterSet:
    """Return the parameters with infinitely wide priors."""
    return ParameterSet([dataclasses.replace(p, prior=np.inf) for p in parameters.parameters], parameters.commands)


def table(rounds: Sequence[Sequence[Found]], validation: WindowRollouts) -> Table:
    """Return a table with one row per method, with times of all rounds and errors of the first.

    Errors do not differ between rounds, because the searches use no random numbers.
    """
    best = min(row.objective for row in rounds[0])
    shared = max(min(r.objective for r in rounds[0] if r.way == way) for way in {r.way for r in rounds[0]})
    heads = (
        "method",
        "error at the end",
        "validation: shoulder / elbow after 1 s (deg)",
        "search (s)",
        f"to {best * (1 + CLOSE):.4f} (s)",
        f"to {shared * (1 + CLOSE):.4f} (s)",
        "compiling (s)",
    )
    rows = []
    for number, one in enumerate(rounds[0]):
        same = [each[number] for each in rounds]
        last = np.median(np.abs(validation.differences(one.values[None])[0, :, -1, :2]), axis=0)
        reached = [
            Cell(tuple(r.reached(objective * (1 + CLOSE)) for r in same), ".2f")
            if np.isfinite(one.reached(objective * (1 + CLOSE)))
            else "never"
            for objective in (best, shared)
        ]
        compiled = tuple(r.compile_seconds for r in same if r.compile_seconds is not None)
        rows.append(
            (
                one.way,
                Cell((one.objective,), ".5f"),
                " / ".join(f"{x:.2f}" for x in np.rad2deg(last)),
                Cell(tuple(r.seconds for r in same), ".2f"),
                *reached,
                Cell(compiled[:1], ".0f") if compiled else "none",
            )
        )
    return Table(heads, tuple(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings")
    parser.add_argument("--quick", action="store_true", help="one recording, few iterations")
    parser.add_argument("--repeat", type=int, default=3, help="number of rounds for the times")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    arguments = parser.parse_args()
    robot = read_pendulum()
    parameters = without_priors(declared_parameters(robot, robot.load_model()))
    names = double_pendulum.TRAINING[:1] if arguments.quick else double_pendulum.TRAINING
    training, held_out = (
        [dataclasses.replace(m, position_noise=np.full(2, WEIGHT)) for m in double_pendulum.load(arguments.data, each)]
        for each in (names, double_pendulum.VALIDATION)
    )
    clock, missing = CompileClock(), missing_for_toolbox()
    with jax.enable_x64(True):
        windows = cut_windows(training, SECONDS)
        (start,) = parameters.draw(0, 1)
        simulator, judge = (WindowRollouts(parameters, training, windows, exact=exact) for exact in (False, True))
        validation = WindowRollouts(parameters, held_out, cut_windows(held_out, SECONDS, 0.2), exact=True)
        print(f"{THREADS} threads, {len(windows.first)} windows; start {judge.objectives(start[None])[0]:.5f}")
        rounds = []
        for _ in range(1 if arguments.quick else arguments.repeat):
            load_before = os.getloadavg()[0]
            rows = [ours(parameters, training, judge, clock, 4 if arguments.quick else 50)]
            if not missing:
                rows.append(toolbox(parameters, simulator, judge, start, 4 if arguments.quick else 100))
            rows.append(finite_differences(parameters, simulator, judge, start, 4 if arguments.quick else 100))
            rounds.append(rows)
            for row in rows:
                print(f"{row.way}: {row.objective:.6f} after {row.seconds:.2f} s, {len(row.trace)} points")
            print(
                f"load before {load_before:.1f}, after {os.getloadavg()[0]:.1f}; fit_robot {rows[0].whole_call:.2f} s"
            )
            for row in rows[1:]:
                print(compare(rows[:1], row), flush=True)
        found = table(rounds, validation)
    print(found.to_markdown())
    if missing:
        print(f'mujoco.sysid was left out. Not installed: {", ".join(missing)} (pip install "mujoco[sysid]").')
    if arguments.results is not None:
        data = "Development data: six recordings; two others are the validation"
        write_results(arguments.results, {"ways": found}, data)


if __name__ == "__main__":
    main()
