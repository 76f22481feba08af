# %% [markdown]
# # A real helium blimp: air forces from recorded flights
#
# RGBlimp (Peking University) has an envelope with wings, a gondola that moves fore and aft, and two propellers. The
# data are public: `zhu-yj/ABNODE` on GitHub, commit `138a1de`, `data/data_1.csv` to `data_140.csv`, MIT. Papers: Zhu,
# Cheng, Zhang, ABNODE, RA-L 9(12) 2024 (arXiv 2404.18580); Cheng et al., RGBlimp, RA-L 2023 (arXiv 2306.04079).
#
# `--data` is a folder with these files (`data_N.csv`, also `.csv.xz`), or with the recordings that an earlier run made
# of them (`flight-NNN.csv.gz`). File N is flight (N - 1) mod 4 + 1 of input (N - 1) div 4. Commands are constant in a
# flight. Files 1 to 120 are spirals, and files 121 to 140 are straight flights.
#
# | use | files |
# | --- | --- |
# | training | flights 1 and 2 of inputs 0 to 19 |
# | validation | flight 3 of the same inputs |
# | test, near | flight 4 of inputs 0 to 9 |
# | test, between | inputs 20 to 24: pairs of thrusts that training lacks |
# | test, far | files 121 to 130: straight flights |
#
# Results on these test flights have been reported before, so that they are development data. Other flights of the data
# set are kept for a final check; this script does not read them.
#
# `METHODS` lists the methods. Those with networks have several seeds. The baselines are the nominal model without air,
# the constant wrench that explains the training flights best, the published aerodynamic model, with and without its
# asymmetric terms, and the mean motion of the nearest recorded moments. Errors are root mean squares of the errors at
# the end of a horizon, over starts in every second.
#
# Run `python experiments/real/rgblimp/rgblimp.py --data FOLDER`. `--quick` is a short trial run. Finished runs in
# `--output` are used again.

# %%
from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path("experiments/real/rgblimp") if "ipykernel" in sys.modules else Path(__file__).parent
sys.path[1:1] = [str(FOLDER.parent), str(FOLDER.parents[1])]

import _setup

_setup.prepare()

import argparse
import shutil
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import _public
import jax.numpy as jnp
import numpy as np
from _constant_wrench import fit_constant_wrench
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ballu_mjx.cli import train
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation.open_loop import Evaluators, OpenLoopEvaluator, Replay
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.residuals.body_motion import body_motion
from ballu_mjx.residuals.fluid_fit import FluidConfig
from ballu_mjx.residuals.fluid_training import fit_fluid
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.sim.residual import Action, Commands, History, Residual
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.viz import plots

HORIZONS = (1.0, 2.0, 5.0)
"""Horizons of the errors (s)."""
TRAINING = tuple(4 * i + flight for i in range(20) for flight in (1, 2))
VALIDATION = tuple(4 * i + 3 for i in range(20))
TEST: Mapping[str, tuple[int, ...]] = {
    "near": tuple(4 * i + 4 for i in range(10)),
    "between": tuple(range(81, 101)),
    "far": tuple(range(121, 131)),
}
FLIP = np.array([1.0, -1.0, -1.0])
"""Signs that convert between (north, east, down) and (forward, left, up) axes, in both directions."""
GROUPS: Mapping[str, tuple[int, ...]] = {"validation": VALIDATION, **TEST}
"""Groups of flights in the tables."""


class Method(NamedTuple):
    """Method that learns a residual."""

    command: tuple[str, ...]
    """Command of `train`, with its options."""
    earlier: tuple[str, str] | None = None
    """Option that names a run of another method, and this method. It is earlier in `METHODS`."""
    quick: tuple[str, ...] = ()
    """Options for a training that takes seconds."""

    @property
    def kind(self) -> str:
        """Name of the command."""
        return self.command[0]

    @property
    def folder(self) -> str:
        """Name of the method's runs."""
        return "-".join((*self.command, *(self.earlier or ()))).replace("--", "").replace(" ", "-")


_FADING = ("--fade-width", "1")
_REGRESSION = ("supervised", "--forces", "wrench", *_FADING)
_WINDOWS = ("--window-seconds", *map(str, (0.5, 2.0, HORIZONS[-1])), "--windows", "100")
_SHORT_FIT = ("--terms", "linear", "--window-seconds", "0.5", "--windows", "10", "--steps", "2")
_SHORT_REGRESSION = ("--updates", "20")
_SHORT_REINFORCEMENT = ("--num-timesteps", "4000", "--num-envs", "16", "--batch-size", "16", "--num-minibatches", "4")
METHODS: Mapping[str, Method] = {
    "fluid": Method(("fluid", *_WINDOWS), quick=_SHORT_FIT),
    "fluid, then supervised": Method(_REGRESSION, ("--residual", "fluid"), _SHORT_REGRESSION),
    "linear fluid": Method(("fluid", "--terms", "linear", *_WINDOWS), quick=_SHORT_FIT),
    "linear fluid, then supervised": Method(_REGRESSION, ("--residual", "linear fluid"), _SHORT_REGRESSION),
    "supervised": Method(_REGRESSION, quick=_SHORT_REGRESSION),
    "EnvMimic": Method(("envmimic", *_FADING), quick=_SHORT_REINFORCEMENT),
    "EnvMimic from supervised": Method(("envmimic",), ("--start-from", "supervised"), _SHORT_REINFORCEMENT),
    "EnvMimic without fading": Method(("envmimic",), quick=_SHORT_REINFORCEMENT),
    "EnvMimic without fading, `--mirror`": Method(("envmimic", "--mirror"), quick=_SHORT_REINFORCEMENT),
}
"""Methods that learn a residual, by name."""
QUICK_METHODS = ("fluid", "EnvMimic")
"""Methods of a trial run."""
SHORT = ("no air", "published model", "fluid", "fluid, then supervised", "EnvMimic", "nearest moments")
"""Rows of the short table."""
MEANS = ("published model", "published model, symmetric", "fluid", "linear fluid")
"""Methods whose mean yaw errors are listed by thrusts."""
DRAWN = ("published model", "fluid")
"""Methods in the figure."""
TRIMMED = "fluid, trimmed on its group"
"""Row of `trimmed_errors`."""
SHOWN = 20.0
"""Length of the flights in the figure (s)."""
FULL_THRUST, FIRST_PLACE, TRAVEL = 0.07, 0.0647, 0.05
"""Thrust at a command of 1 (N), gondola position at a command of 0 (m), and its travel up to a command of 1 (m)."""

# %% [markdown]
# ## Conversion


# %%
def convert(path: Path, name: str) -> Recording:
    """Return a flight of the public data as a recording at 60 Hz, with the world's z axis up.

    **Raises** `InputError` if the file lacks a column.
    """
    wanted = [*(f"{kind}_{k}" for kind in ("p", "e", "rb_series") for k in (1, 2, 3)), "Fl_series", "Fr_series"]
    columns = np.array([*_public.read_columns(path, wanted).values()])
    place, angles, gondola = columns[:9].reshape(3, 3, -1).swapaxes(1, 2)
    left, right = columns[9:]
    turns = Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix() * FLIP[:, None] * FLIP
    mass = gondola[:, 0]
    return Recording(
        name=name,
        kind="free",
        robot="RGBlimp",
        notes=f"zhu-yj/ABNODE 138a1de data/{path.name}, MIT",
        time=np.arange(len(place)) / 60,
        command=np.stack([left / FULL_THRUST, right / FULL_THRUST, (mass - FIRST_PLACE) / TRAVEL], axis=1),
        tracked_position=place * FLIP,
        tracked_quaternion=Rotation.from_matrix(turns).as_quat(scalar_first=True),
        joint_angles={"mass_x": mass},
    )


def find(data: Path, numbers: Sequence[int], robot: RobotDescription, made: Path) -> list[Path]:
    """Return recordings of flights, given the numbers of their files. Recordings are written to `made`.

    **Raises** `InputError` from `_public.recordings_of`.
    """
    sources = {f"flight-{number:03d}": f"data_{number}.csv" for number in numbers}
    folder = _public.recordings_of(data, made, sources, convert, robot)
    return [folder / f"{name}.csv.gz" for name in sources]


def load(paths: Sequence[Path], robot: RobotDescription) -> list[Motion]:
    """Return the reconstructed flights of recordings."""
    return [reconstruct(read_recording(path, robot), robot) for path in paths]


# %% [markdown]
# ## The published aerodynamic model
#
# The model has lift, drag, side force and moments as functions of angle of attack and sideslip, and rotary damping. It
# is from `models/RGBlimp_dynamics.py` and `utils/parameters.py` of the data's authors. They do not say whether it was
# fitted to these same flights.


# %%
class PublishedAerodynamics(Residual):
    """Residual with the published model. Its parameter scales the asymmetric terms. It is 1 in the published model."""

    pressure_area = 0.5 * 1.2187 * 0.25
    """Half the air density (kg/m^3) times the reference area (m^2)."""
    damping = np.array([-0.0503, -0.0264, -0.0137])
    """Rotary damping about forward, right and down (N m s)."""
    centre = np.array([-0.0436, 0.0003, -0.008])
    """Centre of mass of the hull (m), where the residual's wrench acts."""

    def __init__(self, control_timestep: float) -> None:
        self._control_timestep = control_timestep

    @property
    def name(self) -> str:
        return "published"

    def inputs(self, history: History, commands: Commands) -> Array:
        del commands
        return history[-1]

    def act(self, params: Any, history: History, commands: Commands, key: Array | None = None) -> Action:
        del commands, key
        frame, velocity, rate = body_motion(history, self._control_timestep)
        v, w = FLIP * velocity, FLIP * rate
        speed = jnp.sqrt(jnp.sum(v**2) + 1e-8)
        a, b = jnp.arctan2(v[2], v[0]), jnp.arcsin(jnp.clip(v[1] / speed, -1.0, 1.0))
        size = self.pressure_area * speed**2
        drag = 0.2425 + 4.4195 * a**2 + 7.5080 * b**2
        side = params * (0.0083 - 0.0744 * a**2) - 2.1140 * b
        lift = 0.1594 + 2.9375 * a + 4.5537 * b**2
        moments = jnp.stack(
            [
                params * (0.0131 - 0.0301 * a) - 0.5256 * b,
                0.0568 + 0.0933 * a + 5.2357 * b**4,
                params * (0.0006 - 0.0012 * a) - 0.0936 * b,
            ]
        )
        ca, sa, cb, sb = jnp.cos(a), jnp.sin(a), jnp.cos(b), jnp.sin(b)
        wind = jnp.array([[ca * cb, -ca * sb, -sa], [sb, cb, 0.0], [sa * cb, -sa * sb, ca]])
        force = FLIP * (wind @ (size * jnp.stack([-drag, side, -lift])))
        torque = FLIP * (wind @ (size * moments + self.damping * w))
        torque = torque - jnp.cross(self.centre, force)
        return Action(jnp.concatenate([frame @ force, frame @ torque])[None])


# %% [markdown]
# ## Errors


# %%
Found = Mapping[float, tuple[float, float, int, int]]
"""Position error (m), yaw error (deg), number of starts and number of diverged starts, by horizon (s)."""
Rows = Mapping[str, Mapping[str, Sequence[Found]]]
"""Errors by method and group of flights, for each seed. Deterministic methods have one entry."""


def errors_at(
    evaluator: OpenLoopEvaluator, replay: Replay, horizon: float, flights: Sequence[int]
) -> tuple[Int[np.ndarray, " starts"], Float[np.ndarray, "starts 2"]]:
    """Return the flight of each start, and the distance (m) and signed yaw error (deg) after `horizon` (s).

    `flights` are numbers of flights among those of `evaluator`.
    """
    steps = round(horizon / evaluator.robot.control_timestep)
    recordings, errors = [], []
    for run, (recording, _) in enumerate(evaluator.starts):
        position, yaw = evaluator.recorded(run)
        if recording in flights and len(position) > steps:
            turn = replay.yaw[run, steps] - yaw[steps]
            far = np.linalg.norm(replay.position[run, steps] - position[steps])
            recordings.append(recording)
            errors.append([far, np.rad2deg(np.arctan2(np.sin(turn), np.cos(turn)))])
    return np.array(recordings, int), np.array(errors).reshape(-1, 2)


def end_errors(evaluator: OpenLoopEvaluator, replays: Sequence[tuple[Replay, Sequence[int]]]) -> Found:
    """Return root mean square errors of position (m) and yaw (deg) at each horizon's end, and numbers of starts.

    `replays` are replays, each with the numbers of the flights that count (among those of `evaluator`).
    """
    found = {}
    for horizon in HORIZONS:
        table = np.concatenate([errors_at(evaluator, replay, horizon, flights)[1] for replay, flights in replays])
        kept = table[np.isfinite(table).all(axis=1)]
        rms = np.sqrt(np.mean(kept**2, axis=0)) if len(kept) else np.full(2, np.inf)
        found[horizon] = float(rms[0]), float(rms[1]), len(table), len(table) - len(kept)
    return found


def mean_yaw_errors(evaluator: OpenLoopEvaluator, replay: Replay, flights: Sequence[int]) -> dict[str, float]:
    """Return the mean signed yaw error (deg) at the last horizon's end, by thrusts of the flights.

    `flights` are the numbers of the flights among those of `evaluator`.
    """
    by_thrusts: dict[str, list[float]] = {}
    for recording, (_, turn) in zip(*errors_at(evaluator, replay, HORIZONS[-1], flights), strict=True):
        left, right = FULL_THRUST * evaluator.motions[recording].command[0, :2]
        by_thrusts.setdefault(f"{left:.4f} and {right:.4f} N", []).append(turn)
    return {thrusts: float(np.mean(turns)) for thrusts, turns in by_thrusts.items()}


def trimmed_errors(
    simulator: Simulator, fluid: TrainedResidual, evaluator: OpenLoopEvaluator, places: Mapping[str, range]
) -> dict[str, Found]:
    """Return the errors of fluid forces with a trim from other flights of the same group, by group.

    Each half of a group is replayed with the trim that is fitted to the other half (`train fluid --fixed-from`). This
    is no prediction from the training flights. It shows how much of the error a constant force and torque explain.
    """
    config = FluidConfig(window_seconds=(HORIZONS[-1],), windows=40, steps=10)
    errors = {}
    for group, place in places.items():
        halves = place[::2], place[1::2]
        replays = []
        for own, other in (halves, halves[::-1]):
            motions = [evaluator.motions[flight] for flight in other]
            found = fit_fluid(simulator, motions, motions, config, fixed_from=fluid, progress=PhaseProgress())
            print(f"\n{group}, flights {tuple(other)}:\n{found.report}\n", flush=True)
            replays.append((evaluator.replay(found.params, seconds=HORIZONS[-1]), own))
        errors[group] = end_errors(evaluator, replays)
    return errors


def neighbour_errors(
    training: Sequence[Motion], test: Sequence[Motion], control_timestep: float, neighbours: int = 20
) -> Found:
    """Return the errors of a prediction by the mean displacement of the most similar training moments.

    Displacements are in the heading frame. Moments are compared by roll, pitch, velocity and angular velocity (both in
    the body frame), and commands.
    """
    found = {}
    for horizon in HORIZONS:
        steps = round(horizon / control_timestep)
        known = [_moments(motion, steps, 1) for motion in training]
        tree, moved = KDTree(np.concatenate([x for x, _ in known])), np.concatenate([y for _, y in known])
        errors = []
        for motion in test:
            seen, truth = _moments(motion, steps, round(1 / control_timestep))
            if len(seen):
                guess = moved[tree.query(seen, neighbours)[1]].mean(axis=1)
                errors += [[np.linalg.norm(e[:3]), np.rad2deg(e[3])] for e in guess - truth]
        rms = np.sqrt(np.mean(np.array(errors) ** 2, axis=0))
        found[horizon] = float(rms[0]), float(rms[1]), len(errors), 0
    return found


_LIKE = np.array([0.01] * 2 + [0.01] * 3 + [0.02] * 3 + [0.001] * 3)
"""Differences of equal weight, of roll and pitch (rad), velocity (m/s), angular velocity (rad/s) and commands."""


def _moments(motion: Motion, steps: int, every: int) -> tuple[np.ndarray, np.ndarray]:
    """Return moments of a motion: features for comparison, and the displacement (m) and turn (rad) after `steps`."""
    count = max(len(motion.qpos) - steps, 0)
    here = np.arange(2, count, every)
    if not len(here):
        return np.zeros((0, len(_LIKE))), np.zeros((0, 4))
    turns = Rotation.from_quat(motion.qpos[:, 3:7], scalar_first=True)
    yaw, pitch, roll = turns.as_euler("ZYX").T
    velocity = turns.inv().apply(motion.qvel[:, :3])
    state = np.column_stack([roll, pitch, velocity, motion.qvel[:, 3:6]])[here]
    heading = Rotation.from_euler("z", -yaw[here, None])
    moved = heading.apply(motion.qpos[here + steps, :3] - motion.qpos[here, :3])
    turned = np.unwrap(yaw)[here + steps] - np.unwrap(yaw)[here]
    return np.column_stack([state, motion.command[here]]) / _LIKE, np.column_stack([moved, turned])


def tables(rows: Rows) -> dict[str, Table]:
    """Return tables of position and yaw errors (means over seeds), and a short one of both."""
    heads = [f"{group}: {', '.join(f'{horizon:g}' for horizon in HORIZONS)} s" for group in GROUPS]
    last = HORIZONS[-1]

    def cell(found: Sequence[Found], place: int, form: str) -> str:
        starts, diverged = (sum(each[last][k] for each in found) for k in (2, 3))
        numbers = ", ".join(
            "-"
            if any(f[h][3] == f[h][2] for f in found)
            else format(statistics.fmean(f[h][place] for f in found), form)
            for h in HORIZONS
        )
        return numbers + (f" ({diverged} of {starts} diverged)" if diverged else "")

    units = [("position", "m", ".3f"), ("yaw", "deg", ".1f")]
    short = Table(
        ("after 5 s", *(f"{group}: {name} ({unit})" for group in TEST for name, unit, _ in units)),
        tuple(
            (
                method,
                *(
                    Cell(tuple(found[last][place] for found in groups[group]), form.replace("3f", "2f"))
                    for group in TEST
                    for place, (_, _, form) in enumerate(units)
                ),
            )
            for method, groups in rows.items()
            if method in SHORT
        ),
    )
    return {"short": short} | {
        name: Table(
            (f"{name} ({unit})", *heads),
            tuple(
                (method, *(cell(groups[g], place, form) if g in groups else "-" for g in GROUPS))
                for method, groups in rows.items()
            ),
        )
        for place, (name, unit, form) in enumerate(units)
    }


def draw(
    path: Path,
    evaluators: Evaluators,
    residuals: Mapping[str, tuple[Residual, Any]],
    test: Mapping[str, Sequence[Motion]],
) -> None:
    """Draw the first flight of each group, and simulations from its first state."""
    panels = []
    for group, motions in test.items():
        first, runs, recorded, time = motions[:1], {}, np.zeros((0, 3)), np.zeros(0)
        for name, (model, params) in residuals.items():
            evaluator = evaluators.of(model, first)
            position, yaw = evaluator.recorded(0)
            timestep = evaluator.robot.control_timestep
            count = min(round(SHOWN / timestep) + 1, len(position))
            replay = evaluator.replay(params, seconds=SHOWN)
            runs[name] = np.column_stack([replay.position[0, :count, :2], replay.yaw[0, :count]])
            recorded = np.column_stack([position[:count, :2], yaw[:count]])
            time = np.arange(count) * timestep
        panels.append(plots.TrackingPanel(f"{group}: {motions[0].name}", time, recorded, runs))
    plots.tracking(path, panels)


# %% [markdown]
# ## Learning


# %%
DESCRIPTION = FOLDER / "rgblimp.robot.json"
USES = {"training": "--recordings", "validation": "--validation", "near": "--test"}
"""Options of the commands that name flights, by use."""


def learn(name: str, files: Mapping[str, Sequence[Path]], output: Path, seed: int, *, quick: bool) -> TrainedResidual:
    """Learn the residual of a method unless its run in `output` is finished, and return it."""
    method = METHODS[name]
    run = _run(output, method, seed)
    if not (run / "evaluation.json").exists():
        shutil.rmtree(run, ignore_errors=True)
        paths = [text for use in USES for text in (USES[use], *map(str, files[use]))]
        options = [*method.command[1:], *(method.quick if quick else ()), "--robot", str(DESCRIPTION)]
        if method.kind != "fluid":
            options += ["--seed", str(seed)]
        if method.earlier is not None:
            option, other = method.earlier
            options += [option, str(_run(output, METHODS[other], seed))]
        status = train.main([method.kind, *options, "--output", str(run), *paths])
        if status:
            sys.exit(status)
    return TrainedResidual.load(run, read_description(DESCRIPTION))


def with_earlier(names: Iterable[str]) -> list[str]:
    """Return these methods and those that they need, in the order of `METHODS`."""
    wanted = set(names)
    wanted |= {method.earlier[1] for name in wanted if (method := METHODS[name]).earlier is not None}
    return [name for name in METHODS if name in wanted]


def _run(output: Path, method: Method, seed: int) -> Path:
    """Return the run of a method. The same fit of *fluid* is that of all seeds."""
    return output / (method.folder if method.kind == "fluid" else f"{method.folder}-{seed}")


# %% [markdown]
# ## Run


# %%


def main() -> None:
    parser = argparse.ArgumentParser(description="Learn the air forces on a real blimp, and predict test flights.")
    parser.add_argument("--data", type=Path, required=True, help="folder with the public files or recordings of them")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="seeds of EnvMimic (0 1 2)")
    parser.add_argument(
        "--methods", nargs="+", choices=METHODS, metavar="METHOD", help="methods to run (all): " + "; ".join(METHODS)
    )
    parser.add_argument("--quick", action="store_true", help="few flights and steps; the numbers mean little")
    parser.add_argument("--results", type=Path, help="JSON file to write the tables to")
    parser.add_argument("--figure", type=Path, help="PNG file for a figure of three test flights")
    options = _setup.parse(parser, Path("runs/rgblimp"))
    _setup.reserve(options.output, data=str(options.data.resolve()), quick=options.quick)
    robot = read_description(DESCRIPTION)
    few = slice(0, 2) if options.quick else slice(None)
    files = {
        use: find(options.data, numbers[few], robot, options.output / "recordings")
        for use, numbers in {"training": TRAINING, **GROUPS}.items()
    }
    motions = {use: load(paths, robot) for use, paths in files.items()}
    training, groups = motions["training"], {group: motions[group] for group in GROUPS}
    simulator = Simulator(robot)
    seeds = options.seeds[:1] if options.quick else options.seeds
    methods = with_earlier(options.methods or (QUICK_METHODS if options.quick else METHODS))
    published = PublishedAerodynamics(robot.control_timestep)
    residuals: dict[str, list[tuple[Residual, Any]]] = {
        "published model": [(published, jnp.ones(()))],
        "published model, symmetric": [(published, jnp.zeros(()))],
    }
    learned: dict[str, list[TrainedResidual]] = {}
    for name in methods:
        own = seeds[:1] if METHODS[name].kind == "fluid" else seeds
        learned[name] = [learn(name, files, options.output, seed, quick=options.quick) for seed in own]
        residuals[name] = [(each.model, each.params) for each in learned[name]]
    evaluators = Evaluators(simulator)
    drawn = {name: residuals[name][0] for name in DRAWN if name in residuals}
    residuals["constant wrench"] = [fit_constant_wrench(simulator, training)]
    flown = [motion for group in groups.values() for motion in group]  # together, so that one program replays them
    places: dict[str, range] = {}
    for group, flights in groups.items():
        before = sum(map(len, places.values()))
        places[group] = range(before, before + len(flights))
    rows: dict[str, dict[str, list[Found]]] = {}
    means: dict[str, dict[str, float]] = {}
    for name, runs in residuals.items():
        evaluator = evaluators.of(runs[0][0], flown)
        replays = {name: [evaluator.replay(params, seconds=HORIZONS[-1]) for _, params in runs]}
        if not rows:
            replays = {"no air": [evaluator.replay(runs[0][1], scale=0.0, seconds=HORIZONS[-1])]} | replays
        for each, found in replays.items():
            rows[each] = {
                group: [end_errors(evaluator, [(replay, place)]) for replay in found] for group, place in places.items()
            }
        if name in MEANS:
            turns = {group: mean_yaw_errors(evaluator, replays[name][0], places[group]) for group in TEST}
            means[name] = {f"{group}, {thrusts}": turn for group in TEST for thrusts, turn in turns[group].items()}
    if "fluid" in learned and not options.quick:
        (fluid,) = learned["fluid"]
        own = {group: places[group] for group in TEST}
        trimmed = trimmed_errors(simulator, fluid, evaluators.of(fluid.model, flown), own)
        rows[TRIMMED] = {group: [found] for group, found in trimmed.items()}
    rows["nearest moments"] = {
        group: [neighbour_errors(training, flown, robot.control_timestep)] for group, flown in groups.items()
    }
    signed = Table(
        (f"mean yaw error after {HORIZONS[-1]:g} s (deg)", *means),
        tuple((flown, *(Cell((turns[flown],), ".1f") for turns in means.values())) for flown in means[MEANS[0]]),
    )
    shown = tables(rows) | {"means": signed}
    _setup.write_tables(shown, options.output, options.results, {"training": seeds})
    if options.figure is not None:  # last, because a figure in the checkout counts as a change of the code
        draw(options.figure, evaluators, drawn, {group: groups[group] for group in TEST})


if __name__ == "__main__":
    _setup.run(main)
