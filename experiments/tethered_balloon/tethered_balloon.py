# %% [markdown]
# # Another robot: a tethered balloon in wind
#
# Not a biped: a balloon on a tether of two rods, with two propellers. Its model (`balloon.xml`) knows no air. The
# "real" one flies in wind, with the drag of MuJoCo's ellipsoid fluid model and gusts that come and go. From recordings
# of it, in the project's format, the project's own command learns the forces that its simulator lacks; all that it is
# told of the robot stands in `balloon.robot.json`. The table gives errors on recordings that training never saw.
#
# `python experiments/tethered_balloon/tethered_balloon.py` takes some minutes a seed on two cores. `--quick` shows
# that it works. `--method` learns by another residual method than EnvMimic.

# %%
from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

FOLDER = Path("experiments/tethered_balloon") if "ipykernel" in sys.modules else Path(__file__).parent
sys.path.append(str(FOLDER.parent))

import _setup

_setup.prepare()

import mujoco
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from ballu_mjx.cli import train
from ballu_mjx.evaluation.errors import HORIZONS, Errors, Evaluation, read_evaluation
from ballu_mjx.recordings.csv_format import write_recording
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.runs.checkpoints import list_checkpoints
from ballu_mjx.viz.style import colour_of, label_of

DESCRIPTION = FOLDER / "balloon.robot.json"

# %% [markdown]
# ## The real balloon, and what motion capture sees of it

# %%
WIND = np.array([0.6, 0.3, 0.0])
"""Mean wind, m/s."""
GUSTS = 0.1
"""Standard deviation of the wind's strength, as a part of it; gusts last some 4 s."""
RATE = 100
"""Hz, of capture and gusts."""
POSITION_NOISE, ROTATION_NOISE = 5e-4, np.deg2rad(0.3)
"""m and rad: standard deviations, each axis."""


def real(description: RobotDescription) -> mujoco.MjModel:
    """The same balloon in air, at a small time step."""
    spec = mujoco.MjSpec.from_file(str(description.model))
    spec.option.timestep, spec.option.density, spec.option.viscosity = 1e-3, 1.2, 1.8e-5
    spec.geom("balloon").fluid_ellipsoid = 1
    return spec.compile()


def commands(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Levels between 0 and 1 for each propeller, of 0.5 to 2 s; (steps, 2)."""
    lengths = rng.integers(10, 41, (steps, 2))
    levels = rng.uniform(0, 1, (steps, 2)) * (rng.random((steps, 2)) < 0.7)
    return np.stack([np.repeat(levels[:, side], lengths[:, side])[:steps] for side in range(2)], axis=1)


def record(description: RobotDescription, name: str, seconds: float, seed: int) -> Recording:
    """A flight in today's wind, after half a minute in which it has found its place there."""
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
        model.opt.wind[:] = (1 + gust) * WIND
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
        notes=f"Simulated; wind {WIND.tolist()} m/s.",
        time=np.arange(steps) / RATE,
        command=sent[before:],
        tracked_position=seen[:, 0],
        tracked_quaternion=turn.as_quat(scalar_first=True),
        points={point: seen[:, 1 + number] for number, point in enumerate(description.points)},
    )


FLIGHTS = {"training": (6, 20.0), "validation": (2, 12.0), "test": (3, 22.0)}
"""Number of recordings and their length (s), by use."""
QUICK_FLIGHTS = {use: (1, 6.0) for use in FLIGHTS}


def record_all(description: RobotDescription, folder: Path, quick: bool) -> None:
    """Recordings for training, validation and test."""
    for number_of_use, (use, (count, seconds)) in enumerate((QUICK_FLIGHTS if quick else FLIGHTS).items()):
        (folder / use).mkdir(parents=True, exist_ok=True)
        for number in range(count):
            flight = record(description, f"flight-{use}-{number}", seconds, 100 * number_of_use + number)
            write_recording(flight, folder / use / f"{flight.name}.csv.gz", description)


# %% [markdown]
# ## A residual, by the command

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
"""Beginnings of the commands, by method."""
_FEW = ["--num-timesteps", "4000", "--num-envs", "16", "--batch-size", "16", "--num-minibatches", "4"]
QUICK = {
    "envmimic": _FEW,
    "supervised": ["--updates", "50"],
    "analytic": ["--window-seconds", "0.5", "--relinearizations", "1", "--updates", "20"],
    "aerodynamic": ["--window-seconds", "0.5", "--evaluations", "2"],
    "fluid": ["--terms", "linear", "--window-seconds", "0.5", "--steps", "1"],
}
"""Options of a training of seconds, by subcommand."""


def arguments_of(recordings: Path, run: Path, method: str, seed: int, quick: bool) -> list[str]:
    """The arguments of `ballu_mjx.train`: of a new run, or of one that goes on."""
    command = METHODS[method]
    if list_checkpoints(run) and command[0] == "envmimic":
        return [command[0], "--resume", str(run)]
    shutil.rmtree(run, ignore_errors=True)
    options = ["--robot", str(DESCRIPTION), "--output", str(run)]
    for option, use in (("recordings", "training"), ("validation", "validation"), ("test", "test")):
        options += [f"--{option}", str(recordings / use)]
    if command[0] in ("envmimic", "supervised", "analytic"):  # the others draw nothing
        options += ["--seed", str(seed)]
    return [*command, *options, *(QUICK[command[0]] if quick else [])]


def learn(recordings: Path, run: Path, method: str, seed: int, quick: bool) -> Evaluation:
    """Train, unless the run is there already, or go on with it; its evaluation on the test recordings."""
    if not (run / "evaluation.json").exists():
        status = train.main(arguments_of(recordings, run, method, seed, quick))
        if status:
            sys.exit(status)
    return read_evaluation(run / "evaluation.json")


def errors(found: tuple[Errors, ...], quantity: str, horizon: float) -> float:
    """Mean over recordings of the RMSE (m or deg) over a horizon (s)."""
    return float(np.mean([getattr(each, quantity)[horizon][0] for each in found if horizon in each.position]))


# %% [markdown]
# ## Table and figure


# %%
def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="A residual for a tethered balloon in wind.")
    parser.add_argument("--method", choices=METHODS, default="envmimic", help="how the residual is learned")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="seeds of the trainings")
    parser.add_argument("--output", type=Path, default=Path("runs/tethered-balloon"), help="folder of all that is made")
    parser.add_argument("--quick", action="store_true", help="one seed, for seconds; the numbers mean little")
    options = parser.parse_args(arguments)

    description = read_description(DESCRIPTION)
    recordings = options.output / "recordings"
    record_all(description, recordings, options.quick)
    seeds = options.seeds[:1] if options.quick else options.seeds
    method = options.method
    found = [learn(recordings, options.output / f"{method}-{seed}", method, seed, options.quick) for seed in seeds]
    name = METHODS[method][0]

    horizons = [h for h in HORIZONS if any(h in each.position for each in found[0].vanilla)]
    lines = [
        f"| horizon (s) | vanilla: m, deg | {label_of(name)}: m, deg | left of vanilla's: position | yaw |",
        "| ---: | --- | --- | --- | --- |",
    ]
    curves: dict[str, list[list[float]]] = {"vanilla": [], name: []}
    for horizon in horizons:
        absolute, left = [], []
        for quantity in ("position", "orientation"):
            without = errors(found[0].vanilla, quantity, horizon)
            each = [errors(result.residual, quantity, horizon) for result in found]
            absolute.append((without, float(np.mean(each))))
            low, mean, high = np.array([np.min(each), np.mean(each), np.max(each)]) / without
            left.append(f"{mean:.2f} [{low:.2f}, {high:.2f}]")
            if quantity == "position":
                curves["vanilla"].append([without])
                curves[name].append(each)
        (place, place_with), (yaw, yaw_with) = absolute
        lines.append(
            f"| {horizon:g} | {place:.3f}, {yaw:.1f} | {place_with:.3f}, {yaw_with:.1f} | {' | '.join(left)} |"
        )
    text = "\n".join(lines)
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axis = figure.subplots()
    for name, values in curves.items():
        mean, low, high = (reduce(np.array(values), axis=1) for reduce in (np.mean, np.min, np.max))
        axis.plot(horizons, mean, color=colour_of(name), marker="o", label=label_of(name))
        axis.fill_between(horizons, low, high, color=colour_of(name), alpha=0.2, linewidth=0)
    axis.set(xlabel="horizon (s)", ylabel="position RMSE (m)", xscale="log", ylim=(0, None))
    axis.set_xticks(horizons, [f"{horizon:g}" for horizon in horizons])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.legend()
    figure.savefig(options.output / "errors.png", dpi=120)
    _setup.write_table(text, options.output)


if __name__ == "__main__":
    _setup.run(main)
