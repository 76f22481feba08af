"""Compare accuracy and speed of three identification methods on the bundled sweep, by the paper's objective.

The objective is the directed Hausdorff distance from simulated to measured curves of settled angles, summed over motor
and knee of both legs. All methods have the same bounds, for the paper's eight parameters and for twelve (with torque
limits and slack):

- ours: `ballu_mjx.ballu.leg_fit` from settled angles only, with either objective. It also keeps the servos' gain below
  `leg_parameters.largest_motor_gain`. The time is that of a second run. Compiling, once for each size of sweep, is
  reported separately.
- the paper's way: SciPy's L-BFGS-B from the nominal values, with finite differences through C MuJoCo. Two measures
  speed it up. The parameters of both legs are perturbed at once, because neither leg affects the other. The joints are
  damped so that they settle early.
- MuJoCo's toolbox `mujoco.sysid` (`pip install "mujoco[sysid]"`), which fits time series. It simulates the whole
  recording and compares the angles at the end of each hold, with its own optimizer and residual, from the nominal
  values.

All results are judged by C MuJoCo, simulated until nothing moves. Mean angle errors are over all holds after a fit to
all of them, and over every fourth hold after a fit to the others.

    python benchmarks/sysid.py
    python benchmarks/sysid.py --quick           # only twelve parameters, fewer draws and iterations, no hold left out
    python benchmarks/sysid.py --output FOLDER   # also write numbers and traces to FOLDER/sysid.json
    python benchmarks/sysid.py --results FILE    # also write the table for `docs/render.py`
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ballu_mjx.common import runtime

runtime.prepare()

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout
from searches import (
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

from ballu_mjx.ballu.actuators import ActuatorParameters, actuator_fields
from ballu_mjx.ballu.curves import curve_distances
from ballu_mjx.ballu.leg_fit import Identifier
from ballu_mjx.ballu.leg_parameters import (
    LEG_PARAMETERS,
    PAPER_PARAMETERS,
    IdentificationConfig,
    ParameterTransform,
    nominal_leg,
)
from ballu_mjx.ballu.leg_results import Identification
from ballu_mjx.ballu.model import SIDES, load_suspended_leg, suspend
from ballu_mjx.ballu.sweep import Sweep, read_sweep
from ballu_mjx.ballu.sysid_report import mean_error
from ballu_mjx.common.results import Cell, Table, write_results
from ballu_mjx.identification.parameters import Shares
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.model import assets, set_fields
from ballu_mjx.robots.registry import load_robot

LEFT_OUT_EVERY = 4
DEGREE = IdentificationConfig().degree
OBJECTIVES = ("pointwise", "hausdorff")

DAMPING = {"hip": 0.12, "knee": 0.01, "motor": 0.0114}
"""Damping (N m s/rad). The hip is nearly critically damped. With more, knee and motor would settle later."""
SEARCH_STEPS, JUDGE_STEPS = 500, 3000
"""Physics steps until the legs are settled: to within 1e-3 rad for searches, and to rounding for the judge.

A longer time step would soften the knee's stop and so change the angles."""

Vectors = Float[np.ndarray, "2 parameters"]
"""Parameters of both legs, in the order of `NAMES`."""


@dataclasses.dataclass(frozen=True)
class Row(Search):
    """Judged result of one method with one set of parameters. Its trace has the method's own settled angles."""

    backward: float
    """Objective in the other direction, from measured to simulated curves."""
    error: float
    """Mean angle error over all holds (deg)."""
    error_left_out: float | None
    """Mean angle error over holds that the fit did not use (deg). None if there are none."""
    vectors: list[list[float]]
    """Identified parameters of both legs."""


class Legs:
    """Simulator of settled angles in C MuJoCo, for many sets of parameters in parallel."""

    def __init__(self, steps: int, *, exact: bool = False) -> None:
        self.steps = steps
        self.models, self.fields, self.places = [], [], []
        for side in SIDES:
            model = load_suspended_leg(side)
            for kind, damping in DAMPING.items():
                model.dof_damping[model.joint(f"{kind}_{side}").dofadr[0]] = damping
            if exact:
                model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 50, 50, 0.0
            self.models.append(model)
            self.fields.append(_fields_of(model))
            self.places.append([model.joint(f"{kind}_{side}").qposadr[0] for kind in ("motor", "knee")])
        self.pool = rollout.Rollout(nthread=THREADS)
        self.data = [mujoco.MjData(self.models[0]) for _ in range(THREADS)]

    def settled(
        self, vectors: Float[np.ndarray, "n 2 parameters"], command: Float[np.ndarray, "holds 2"]
    ) -> Float[np.ndarray, "n holds 2 2"]:
        """Return the settled angles (rad; motor and knee, left and right) for each set of parameters and each hold."""
        holds, kind = len(command), mujoco.mjtState.mjSTATE_FULLPHYSICS
        models, states, controls = [], [], []
        for pair in vectors:
            for leg, vector in enumerate(pair):
                model = copy.copy(self.models[leg])
                set_fields(model, self.fields[leg](vector[:, None]))
                data = self.data[0]
                mujoco.mj_resetData(model, data)
                data.qpos[self.places[leg]] = [
                    vector[LEG_PARAMETERS.index(f"default_{k}_angle")] for k in ("motor", "knee")
                ]
                state = np.zeros(mujoco.mj_stateSize(model, kind))
                mujoco.mj_getState(model, data, state, kind)
                models += [model] * holds
                states += [state] * holds
                controls.append(np.repeat(command[:, leg, None, None], self.steps, axis=1))
        path, _ = self.pool.rollout(models, self.data, np.stack(states), np.concatenate(controls))
        qpos = np.asarray(path)[:, -1, 1 : 1 + self.models[0].nq].reshape(len(vectors), len(SIDES), holds, -1)
        angles = [qpos[:, leg][:, :, place] for leg, place in enumerate(self.places)]
        return np.stack(angles, axis=-1)


def _fields_of(model: mujoco.MjModel) -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """Return `actuator_fields` of a model, compiled, because finite differences call it often."""
    compiled = jax.jit(lambda rows: actuator_fields(model, ActuatorParameters(*rows)))
    return lambda rows: {name: np.asarray(value) for name, value in compiled(rows).items()}


def distances(data: Sweep) -> Callable[[Float[np.ndarray, "n holds 2 2"]], Float[np.ndarray, "n 2"]]:
    """Return a function from settled angles to the paper's objective and to that in the other direction."""

    def both(angles: jax.Array) -> jax.Array:
        return sum(
            jnp.sum(
                curve_distances(data.command[:, leg], angles[:, :, leg], data.settled[:, :, leg], DEGREE),
                axis=1,
            )
            for leg in range(len(SIDES))
        )  # pyright: ignore

    compiled = jax.jit(jax.vmap(both))
    return lambda angles: np.asarray(compiled(angles))


# ---- ours ----


def ours(
    data: Sweep, config: IdentificationConfig, repeats: int
) -> tuple[float, dict[str, tuple[Vectors, float, Identification]]]:
    """Return the seconds of compiling and, by objective, parameters, seconds of the last run, and result."""
    marks: list[float] = []

    def report(stage: str, iteration: int, steps: int, value: float) -> None:
        if stage == "compiling":
            marks.append(time.perf_counter())

    results = {}
    identifier = Identifier(config, data, report)
    for objective in OBJECTIVES:
        # Both objectives share the programs that take long to compile.
        identifier.config = dataclasses.replace(config, objective=objective)
        for _ in range(repeats):
            began = time.perf_counter()
            found = identifier.run(data, report)
            seconds = time.perf_counter() - began
        results[objective] = np.stack([fit.vector for fit in found.fits]), seconds, found
    return marks[1] - marks[0], results


# ---- the paper's way ----


def papers_way(data: Sweep, space: ParameterTransform, iterations: int) -> tuple[Vectors, float, Trace]:
    """Return parameters, seconds and trace of L-BFGS-B with C MuJoCo.

    Coordinates are shares of the span between the bounds.
    """
    legs, judge, free = Legs(SEARCH_STEPS), distances(data), np.flatnonzero(space.free)
    span = Shares(*(np.tile(x[free], len(SIDES)) for x in (space.lower, space.upper, space.relative)))

    def vectors(shares: np.ndarray) -> Vectors:
        pair = np.tile(space.nominal, (len(SIDES), 1))
        pair[:, free] = span.values(shares).reshape(len(SIDES), -1)
        return pair

    def parts(shares: np.ndarray) -> Float[np.ndarray, "n 2"]:
        angles = legs.settled(np.stack([vectors(x) for x in shares]), data.command)
        # Evaluate each leg with the measured angles of the other, which contribute 0.
        alone = np.repeat(angles[:, None], len(SIDES), axis=1)
        for leg in range(len(SIDES)):
            alone[:, leg, :, :, 1 - leg] = data.settled[:, :, 1 - leg]
        return judge(alone.reshape(-1, *angles.shape[1:]))[:, 0].reshape(len(shares), -1)

    def function(shares: np.ndarray) -> tuple[float, np.ndarray]:
        steps = np.where(shares.reshape(len(SIDES), -1) + DIFFERENCE > 1, -DIFFERENCE, DIFFERENCE)
        moves = np.stack(
            [np.zeros_like(steps)] + [np.where(np.arange(len(free)) == i, steps, 0) for i in range(len(free))]
        )
        values = parts(shares + moves.reshape(len(moves), -1))
        return float(values[0].sum()), ((values[1:] - values[0]) / steps.T).T.ravel()

    start = span.of(np.tile(space.nominal[free], len(SIDES)))
    shares, seconds, trace = lbfgsb(function, start, iterations)
    return vectors(shares), seconds, trace


# ---- MuJoCo's toolbox ----


def _toolbox_spec() -> mujoco.MjSpec:
    """Return the specification of both suspended legs, with a sensor for each recorded angle."""
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    suspend(spec)
    spec.delete(spec.body("balloon"))
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    for kind in ("motor", "knee"):
        for side in SIDES:
            name = f"{kind}_{side}"
            spec.add_sensor(
                name=name, type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=name
            )
    return spec


def toolbox(
    data: Sweep, kept: np.ndarray, source: Recording, space: ParameterTransform, iterations: int
) -> tuple[Vectors, float, Trace]:
    """Return parameters, seconds and trace of `mujoco.sysid.optimize` on the holds `kept` of the sweep `data`."""
    from mujoco import sysid

    spec, free = _toolbox_spec(), np.flatnonzero(space.free)
    model = spec.compile()
    fields = _fields_of(model)
    hips = [model.joint(f"hip_{side}").dofadr[0] for side in SIDES]

    def as_vectors(x: np.ndarray) -> Vectors:
        pair = np.tile(space.nominal, (len(SIDES), 1))
        pair[:, free] = x.reshape(len(free), len(SIDES)).T
        return pair

    def build(parameters: Any, spec: mujoco.MjSpec) -> mujoco.MjModel:
        built = copy.copy(model)
        built.dof_damping[hips] = DAMPING["hip"]
        set_fields(built, fields(as_vectors(parameters.as_vector()).T))
        return built

    seconds = source.time - source.time[0]
    ends = np.append(np.flatnonzero(np.any(np.diff(source.command, axis=0) != 0, axis=1)), len(seconds) - 1)
    grid = np.arange(int(np.ceil(seconds[-1] / model.opt.timestep)) + 2) * model.opt.timestep
    command = source.command[np.searchsorted(seconds, grid + 1e-9, side="right") - 1]
    data0 = mujoco.MjData(model)
    for k, kind in enumerate(("motor", "knee")):
        for s, side in enumerate(SIDES):
            data0.qpos[model.joint(f"{kind}_{side}").qposadr[0]] = data.settled[0, k, s]
    sequences = sysid.ModelSequences(
        "suspended",
        spec,
        "sweep",
        sysid.create_initial_state(model, data0.qpos),
        sysid.TimeSeries(grid, command),
        sysid.TimeSeries.from_names(seconds[ends][kept], data.settled[kept].reshape(len(kept), -1), model),
    )
    residual = sysid.build_residual_fn(models_sequences=[sequences], build_model=build, n_threads=THREADS)
    parameters = sysid.ParameterDict()
    for index in free:
        low, high = (np.full(len(SIDES), bound[index]) for bound in (space.lower, space.upper))
        parameters.add(sysid.Parameter(LEG_PARAMETERS[index], np.full(len(SIDES), space.nominal[index]), low, high))
    found, elapsed, visited = optimize_by_toolbox(parameters, residual, iterations)
    fitted = data.settled_without(np.setdiff1d(np.arange(len(data.command)), kept).tolist())
    angles = Legs(SEARCH_STEPS).settled(np.stack([as_vectors(x) for _, x in visited]), fitted.command)
    trace = [(when, float(value)) for (when, _), value in zip(visited, distances(fitted)(angles)[:, 0], strict=True)]
    return as_vectors(found), elapsed, lowest_so_far(trace)


# ---- comparison ----


def table(rows: list[Row]) -> Table:
    """Return the results as a table for `docs/render.py`."""
    heads = (
        "method",
        "parameters",
        "time (s)",
        "compiling (s)",
        "Hausdorff distance",
        "mean error (deg)",
        "of commands left out (deg)",
    )
    return Table(
        heads,
        tuple(
            (
                row.way,
                str(row.parameters or ""),
                Cell((row.seconds,), ".1f") if row.parameters else "",
                "" if row.compile_seconds is None else Cell((row.compile_seconds,), ".0f"),
                Cell((row.objective,), ".4f"),
                Cell((row.error,), ".2f"),
                "" if row.error_left_out is None else Cell((row.error_left_out,), ".2f"),
            )
            for row in rows
        ),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="only twelve parameters, fewer draws and iterations")
    parser.add_argument("--output", type=Path, help="folder for sysid.json")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    arguments = parser.parse_args()
    with jax.enable_x64(True):
        rows = measure(arguments.quick)
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)
        path = arguments.output / "sysid.json"
        path.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=1) + "\n")
    if arguments.results is not None:
        write_results(arguments.results, {"ways": table(rows)}, "The bundled sweep, of a virtual robot")


def measure(quick: bool) -> list[Row]:
    """Run all methods, print their results, and return them."""
    (path,) = list_bundled("suspended")
    source = read_recording(path, load_robot())
    whole = read_sweep({path: source})
    everything = np.arange(len(whole.command))
    out = everything[LEFT_OUT_EVERY - 1 :: LEFT_OUT_EVERY]
    kept = np.setdiff1d(everything, out)
    part, left_out = whole.settled_without(out.tolist()), whole.settled_without(kept.tolist())

    judge, distance = Legs(JUDGE_STEPS, exact=True), distances(whole)
    iterations = 10 if quick else 60
    missing = missing_for_toolbox()
    rows: list[Row] = []
    print(f"{THREADS} threads, {len(everything)} holds, {len(out)} of them left out in turn")
    head = ("time", 9), ("compiling", 11), ("Hausdorff", 11), ("back", 9), ("error", 11), ("left out", 11)
    print(f"{'':27}{'parameters':>10}" + "".join(f"{name:>{width}}" for name, width in head))

    def add(
        way: str,
        free: int,
        vectors: Vectors,
        seconds: float,
        compiling: float | None,
        held: Vectors | None,
        trace: Trace,
    ) -> None:
        angles = judge.settled(vectors[None], whole.command)
        there, back = distance(angles)[0]
        unseen = None
        if held is not None:
            unseen = mean_error(judge.settled(held[None], left_out.command)[0], left_out)
        error = mean_error(angles[0], whole)
        row = Row(way, free, seconds, compiling, float(there), trace, float(back), error, unseen, vectors.tolist())
        rows.append(row)
        shown = "" if compiling is None else f"{compiling:.0f} s"
        numbers = f"{there:>11.4f}{back:>9.4f}{error:>7.2f} deg" + ("" if unseen is None else f"{unseen:>7.2f} deg")
        print(f"{way:27}{free or '':>10}{seconds:>7.1f} s{shown:>11}{numbers}", flush=True)

    nominal = np.tile(nominal_leg(), (len(SIDES), 1))
    add("nominal", 0, nominal, 0.0, None, nominal, [])
    comparisons = []
    for beyond in (True,) if quick else (False, True):
        # Use the default number of starts, because the compiled program's size depends on it.
        config = dataclasses.replace(PAPER_PARAMETERS, motion=False, torque_limit=beyond, cable_slack=beyond)
        if quick:
            config = dataclasses.replace(config, draws=15, steps=8)
        space = ParameterTransform(nominal_leg(), config)
        free = len(SIDES) * int(space.free.sum())

        compiling, fits = ours(whole, config, repeats=2)
        held = {} if quick else ours(part, config, repeats=1)[1]
        for objective, (vectors, seconds, found) in fits.items():
            add(f"ours, {objective}", free, vectors, seconds, compiling, held[objective][0] if held else None, [])
            apart = np.abs(judge.settled(vectors[None], whole.command)[0] - found.settled).max()
            if np.rad2deg(apart) > 0.01:
                print(f"  MJX's settled angles and the judge's are up to {np.rad2deg(apart):.3f} deg apart")
        mine = rows[-len(OBJECTIVES) :]

        vectors, seconds, trace = papers_way(whole, space, iterations)
        held_vectors = None if quick else papers_way(part, space, iterations)[0]
        add("the paper's way", free, vectors, seconds, None, held_vectors, trace)
        comparisons.append(compare(mine, rows[-1]))
        if not missing:
            vectors, seconds, trace = toolbox(whole, everything, source, space, 20 if quick else 200)
            held_vectors = None if quick else toolbox(whole, kept, source, space, 200)[0]
            add("mujoco.sysid", free, vectors, seconds, None, held_vectors, trace)
            comparisons.append(compare(mine, rows[-1]))
    print()
    print("\n".join(comparisons))
    if missing:
        print(f'mujoco.sysid was left out. Not installed: {", ".join(missing)} (pip install "mujoco[sysid]").')
    return rows


if __name__ == "__main__":
    main()
