# %% [markdown]
# # Another robot: a tethered balloon in wind
#
# The robot is a balloon with two propellers on a tether of two rods. Its model (`balloon.xml`) has no air. The "real"
# balloon flies in wind with gusts, with the drag of MuJoCo's ellipsoid fluid model. It is recorded in the project's
# format. From these recordings, the project's own command learns the forces that the model lacks. The command gets no
# information on the robot other than `balloon.robot.json`. The table has errors on test recordings, in the wind of the
# training recordings and in another wind. The baseline is the best constant wrench, because a steady wind exerts nearly
# constant forces.
#
# `python experiments/tethered_balloon/tethered_balloon.py` takes some minutes for each method and seed on two cores.
# `--methods` selects residual methods. `--quick` is a short trial run.

# %%
from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

FOLDER = Path("experiments/tethered_balloon") if "ipykernel" in sys.modules else Path(__file__).parent
sys.path.append(str(FOLDER.parent))

import _setup

_setup.prepare()

import collect_runs
import jax.numpy as jnp
import mujoco
import numpy as np
from _constant_wrench import fit_constant_wrench
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from ballu_mjx.cli import train
from ballu_mjx.common.results import Table
from ballu_mjx.evaluation.errors import Evaluation
from ballu_mjx.evaluation.errors_file import read_evaluation
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
from ballu_mjx.recordings.csv_format import list_recordings, read_recording, write_recording
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.runs.checkpoints import list_checkpoints
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.viz.style import colour_of, label_of

DESCRIPTION = FOLDER / "balloon.robot.json"

# %% [markdown]
# ## The real balloon and its motion capture

# %%
WIND = np.array([0.6, 0.3, 0.0])
"""Mean wind (m/s)."""
OTHER_WIND = np.array([-0.2, 0.5, 0.0])
"""Mean wind (m/s) of a part of the test recordings. Training has no recording in this wind."""
GUSTS = 0.1
"""Standard deviation of the wind's speed, relative to its mean. The correlation time of gusts is 4 s."""
RATE = 100
"""Rate of motion capture and gusts (Hz)."""
POSITION_NOISE, ROTATION_NOISE = 5e-4, np.deg2rad(0.3)
"""Standard deviations of the noise of positions (m) and rotations (rad), for each axis."""


def real(description: RobotDescription) -> mujoco.MjModel:
    """Return the model of the balloon in air, with a time step of 1 ms."""
    spec = mujoco.MjSpec.from_file(str(description.model))
    spec.option.timestep, spec.option.density, spec.option.viscosity = 1e-3, 1.2, 1.8e-5
    spec.geom("balloon").fluid_ellipsoid = 1
    return spec.compile()


def commands(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Return random piecewise constant commands between 0 and 1, of 0.5 to 2 s, for each propeller (steps, 2)."""
    lengths = rng.integers(10, 41, (steps, 2))
    levels = rng.uniform(0, 1, (steps, 2)) * (rng.random((steps, 2)) < 0.7)
    return np.stack([np.repeat(levels[:, side], lengths[:, side])[:steps] for side in range(2)], axis=1)


def record(description: RobotDescription, name: str, seconds: float, seed: int, wind: np.ndarray) -> Recording:
    """Record a flight in wind, after 30 s in which the balloon settles."""
    rng = np.random.default_rng(seed)
    model = real(description)
    data = mujoco.MjData(model)
    before, steps = 30 * RATE, round(seconds * RATE)
    control = round(description.control_timestep * RATE)
    sent = np.repeat(commands(rng, (before + steps) // control), control, axis=0)
    sites = [description.tracked, *description.points]
    gust, decay = 0.0, np.exp(-1 / (4 * RATE))
    places, turns = [], []
    for row in range(before + steps):
        gust = decay * gust + np.sqrt(1 - decay**2) * GUSTS * rng.normal()
        model.opt.wind[:] = (1 + gust) * wind
        data.ctrl[:] = sent[row]
        if row >= before:
            mujoco.mj_kinematics(model, data)
            places.append([data.site(site).xpos.copy() for site in sites])
            turns.append(data.body("balloon").xquat.copy())
        mujoco.mj_step(model, data, round(1 / (RATE * model.opt.timestep)))
    seen = np.array(places) + rng.normal(0, POSITION_NOISE, (steps, len(sites), 3))
    turn = Rotation.from_quat(turns, scalar_first=True)
    turn = turn * Rotation.from_rotvec(rng.normal(0, ROTATION_NOISE, (steps, 3)))
    return Recording(
        name=name,
        kind="free",
        robot="tethered-balloon-0",
        notes=f"Simulated; wind {wind.tolist()} m/s.",
        time=np.arange(steps) / RATE,
        command=sent[before:],
        tracked_position=seen[:, 0],
        tracked_quaternion=turn.as_quat(scalar_first=True),
        points={point: seen[:, 1 + number] for number, point in enumerate(description.points)},
    )


FLIGHTS = {"training": (6, 20.0), "validation": (2, 12.0), "test": (3, 22.0)}
"""Number of recordings and their length (s), by use."""
QUICK_FLIGHTS = {use: (1, 6.0) for use in FLIGHTS}


GROUPS = {"flight": "the same wind", "turned": "another wind"}
"""Titles of the groups of recordings."""


def record_all(description: RobotDescription, folder: Path, quick: bool) -> None:
    """Record flights for training, validation and test into subfolders of `folder`. Test flights are in both winds."""
    for number_of_use, (use, (count, seconds)) in enumerate((QUICK_FLIGHTS if quick else FLIGHTS).items()):
        (folder / use).mkdir(parents=True, exist_ok=True)
        winds = {"flight": WIND, **({"turned": OTHER_WIND} if use == "test" else {})}
        for number_of_wind, (group, wind) in enumerate(winds.items()):
            for number in range(count):
                seed = 1000 * number_of_wind + 100 * number_of_use + number
                flight = record(description, f"{group}-{use}-{number}", seconds, seed, wind)
                write_recording(flight, folder / use / f"{flight.name}.csv.gz", description)


# %% [markdown]
# ## Training of residuals by the project's command

# %%
METHODS = {
    "envmimic": ["envmimic"],
    "envmimic-force": ["envmimic", "--forces", "force"],
    "envmimic-multi": ["envmimic", "--forces", "multi"],
    "supervised": ["supervised"],
    "analytic": ["analytic"],
    "aerodynamic": ["aerodynamic"],
    "fluid": ["fluid"],
}
"""First arguments of the command, by method."""
_FEW = ["--num-timesteps", "4000", "--num-envs", "16", "--batch-size", "16", "--num-minibatches", "4"]
LABELS = {"envmimic-force": "EnvMimic, a force alone", "envmimic-multi": "EnvMimic, forces at balloon and knot"}
SEEDED = ("envmimic", "supervised", "analytic")
"""Subcommands that use a seed."""
COLOURS = {
    label_of(name): colour_of(name)
    for name in ("vanilla", "envmimic", "supervised", "analytic", "aerodynamic", "fluid")
}
"""The project's colours, by label of the simulator."""
QUICK = {
    "envmimic": _FEW,
    "supervised": ["--updates", "50"],
    "analytic": ["--window-seconds", "0.5", "--relinearizations", "1", "--updates", "20"],
    "aerodynamic": ["--window-seconds", "0.5", "--evaluations", "2"],
    "fluid": ["--terms", "linear", "--window-seconds", "0.5", "--steps", "1"],
}
"""Options of a training that takes seconds, by subcommand."""


def arguments_of(recordings: Path, run: Path, method: str, seed: int, quick: bool) -> list[str]:
    """Return the arguments of `ballu_mjx.train`, for a new run or for one that is resumed."""
    command = METHODS[method]
    if list_checkpoints(run) and command[0] == "envmimic":
        return [command[0], "--resume", str(run)]
    shutil.rmtree(run, ignore_errors=True)
    options = ["--robot", str(DESCRIPTION), "--output", str(run)]
    for option, use in (("recordings", "training"), ("validation", "validation"), ("test", "test")):
        options += [f"--{option}", str(recordings / use)]
    if command[0] in SEEDED:
        options += ["--seed", str(seed)]
    return [*command, *options, *(QUICK[command[0]] if quick else [])]


def learn(recordings: Path, run: Path, method: str, seed: int, quick: bool) -> Evaluation:
    """Train a residual unless the run is finished, and return its evaluation on the test recordings."""
    if not (run / "evaluation.json").exists():
        status = train.main(arguments_of(recordings, run, method, seed, quick))
        if status:
            sys.exit(status)
    return read_evaluation(run / "evaluation.json")


def constant_wrench(description: RobotDescription, recordings: Path) -> Evaluation:
    """Fit the constant wrench, which has only six parameters, and return its evaluation on the test recordings."""
    simulator = Simulator(description)
    motions = {
        use: [
            reconstruct(read_recording(path, description), description) for path in list_recordings([recordings / use])
        ]
        for use in ("training", "test")
    }
    model, params = fit_constant_wrench(simulator, motions["training"])
    print(f"Constant wrench: {np.round(params, 4).tolist()} N, N m.")
    return OpenLoopEvaluator(simulator, motions["test"], model)(jnp.asarray(params, jnp.float32))


# %% [markdown]
# ## Table and figure

# %%
HORIZONS = (1.0, 5.0, 20.0)
"""Horizons of the tables (s)."""


def comparison(found: Mapping[str, Sequence[Evaluation]], horizon: float) -> Table:
    """Return the table of vanilla's errors over a horizon (s), and of the ratios of other simulators to it.

    Cells have one value for each seed.
    """
    first = next(iter(found.values()))[0]
    columns = [(group, quantity) for group in GROUPS for quantity in ("position", "orientation")]
    simulators = {label: [run.residual for run in runs] for label, runs in found.items()}
    rows = collect_runs.remaining_errors(first.vanilla, simulators, columns, horizon)
    head = (f"{horizon:g} s", *(f"{GROUPS[group]}: {quantity}" for group, quantity in columns))
    return Table(head, tuple((label, *cells) for label, cells in rows.items()))


def figure(found: Mapping[str, Sequence[Evaluation]], path: Path) -> None:
    """Draw position errors over the horizon, with mean and range over seeds, and a panel for each wind."""
    drawing = Figure(figsize=(9.0, 3.8), layout="constrained")
    first = next(iter(found.values()))[0]
    for axis, group in zip(drawing.subplots(1, len(GROUPS), sharey=True), GROUPS, strict=True):
        horizons = sorted({h for each in first.vanilla if each.group == group for h in each.position})
        curves = {
            "vanilla": [first.vanilla],
            **{label: [run.residual for run in runs] for label, runs in found.items()},
        }
        for label, sides in curves.items():
            values = np.array(
                [[collect_runs.mean_over_recordings(side, group, "position", h) for h in horizons] for side in sides]
            )
            (line,) = axis.plot(horizons, values.mean(axis=0), marker="o", label=label, color=COLOURS.get(label))
            axis.fill_between(horizons, values.min(0), values.max(0), color=line.get_color(), alpha=0.2, linewidth=0)
        axis.set(title=GROUPS[group], xlabel="horizon (s)", xscale="log", ylim=(0, None))
        axis.set_xticks(horizons, [f"{horizon:g}" for horizon in horizons])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    drawing.axes[0].set_ylabel("position RMSE (m)")
    drawing.axes[0].legend()
    drawing.savefig(path, dpi=120)


# %%
def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Learn residuals for a tethered balloon in wind.")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=["envmimic"], help="methods (envmimic)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="training seeds (0 1 2)")
    parser.add_argument("--quick", action="store_true", help="train one seed for seconds; the numbers mean little")
    parser.add_argument("--results", type=Path, help="JSON file to write the tables to")
    options = _setup.parse(parser, Path("runs/tethered-balloon"), arguments)
    _setup.reserve(options.output, quick=options.quick)

    description = read_description(DESCRIPTION)
    recordings = options.output / "recordings"
    record_all(description, recordings, options.quick)
    seeds = options.seeds[:1] if options.quick else options.seeds
    found = {"best constant wrench": [constant_wrench(description, recordings)]}
    for method in options.methods:
        own = seeds if METHODS[method][0] in SEEDED else seeds[:1]
        runs = [learn(recordings, options.output / f"{method}-{seed}", method, seed, options.quick) for seed in own]
        found[LABELS.get(method, label_of(METHODS[method][0]))] = runs
    reached = [h for h in HORIZONS if any(h in each.position for each in next(iter(found.values()))[0].vanilla)]
    figure(found, options.output / "errors.png")
    tables = {f"horizon-{horizon:g}": comparison(found, horizon) for horizon in reached}
    _setup.write_tables(tables, options.output, options.results, {"training": seeds} if options.methods else {})


if __name__ == "__main__":
    _setup.run(main)
