# %% [markdown]
# # Fidelity: the README's tables and figure
#
# Section "Improved Simulation Fidelity" of the paper, open loop: recorded commands are replayed from recorded states in
# several simulators, on recordings that training never saw: vanilla, vanilla with identified actuators (vanilla+sysid),
# either with EnvMimic's forces, and the second with what else pushes (a wrench on the balloon; forces at balloon, base
# and feet) and with what the other methods learn: regression on the forces that explain the recordings (supervised;
# with all of its forces, as in the paper, and with the share of them that helps), gradients through the simulator
# (analytic), the air's parameters (aerodynamic; all, or all but the lift), and networks for what the air leaves
# (aerodynamic+analytic, aerodynamic+EnvMimic). One training a method and seed; runs that are there already are not
# repeated.
#
# `python experiments/fidelity.py` takes hours on two cores, `--methods` names some of it; `--robot N` does the same on
# another virtual robot, recorded and its actuators identified first; `--quick` shows that it works.

# %%
from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

if "google.colab" in sys.modules:  # install, from a checkout in the current folder
    if not Path("constraints.txt").exists():
        raise SystemExit("Clone the repository first, and make it the current folder: %cd ballu-mjx.")
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", "-c", "constraints.txt", "-e", "."], check=True)
if "ipykernel" in sys.modules:  # a notebook: write the options here, as on a command line
    sys.argv[1:] = []
    sys.path[:0] = [".", "experiments"]

# %%
import argparse
import dataclasses
from collections.abc import Mapping, Sequence

from ballu_mjx import runtime

runtime.prepare()

import bundled_recordings  # noqa: E402
import numpy as np  # noqa: E402
from jaxtyping import Float  # noqa: E402

from ballu_mjx import aerodynamics, evaluation, plots, reconstruction, recording, residual, robot, runs  # noqa: E402

# %% [markdown]
# ## Train


# %%
@dataclasses.dataclass(frozen=True)
class Method:
    """One way to a simulator that is better than vanilla."""

    label: str
    arguments: tuple[str, ...]
    """Of `python -m ballu_mjx.train`."""
    seeded: bool = True
    nominal: bool = False
    """On nominal actuators instead of identified ones."""
    beside_air: bool = False
    """Learns what the identified air leaves."""


AIR = "aerodynamic"
METHODS = {
    "nominal": Method("EnvMimic on nominal actuators", ("envmimic",), nominal=True),
    "identified": Method("EnvMimic", ("envmimic",)),
    "wrench": Method("EnvMimic, wrench", ("envmimic", "--forces", "wrench")),
    "multi": Method("EnvMimic, forces at balloon, base and feet", ("envmimic", "--forces", "multi")),
    "regression": Method("supervised, all of its forces", ("residual", "--method", "supervised", "--shares", "1")),
    "supervised": Method("supervised", ("residual", "--method", "supervised")),
    "analytic": Method("analytic", ("residual", "--method", "analytic")),
    "analytic-wrench": Method("analytic, wrench", ("residual", "--method", "analytic", "--forces", "wrench")),
    AIR: Method("aerodynamic", ("residual", "--method", "aerodynamic"), seeded=False),
    "air-lift": Method(
        "aerodynamic, the model's lift",
        ("residual", "--method", "aerodynamic", "--free", *(name for name in aerodynamics.NAMES if name != "lift")),
        seeded=False,
    ),
    "air-analytic": Method("aerodynamic+analytic", ("residual", "--method", "analytic"), beside_air=True),
    "air-envmimic": Method("aerodynamic+EnvMimic", ("envmimic",), beside_air=True),
}


def train(folder: Path, *arguments: str, result: str = "evaluation.json") -> None:
    """Run `python -m ballu_mjx.train` into `folder`, unless its result is there. Of what was interrupted, reinforcement
    learning goes on from its last checkpoint; all else, which takes minutes, begins anew."""
    if (folder / result).exists():
        return
    options = [*arguments, "--output", str(folder)]
    if arguments[0] == "envmimic" and runs.checkpoints(folder):
        options = ["envmimic", "--resume", str(folder)]
    elif (folder / "config.json").exists():
        shutil.rmtree(folder)
    subprocess.run([sys.executable, "-m", "ballu_mjx.train", *options], check=True)


def load(folder: Path) -> evaluation.Evaluation:
    """The evaluation of one run."""
    return evaluation.read(folder / "evaluation.json")


def seconds(folder: Path) -> float:
    """Wall time that a run learned for, its validations included, reading and compiling for them not."""
    return float(runs.column(folder, "seconds")[1][-1])


def race(folders: Mapping[str, list[Path]]) -> str:
    """Markdown: how soon methods whose progress is measured open loop are as good on the validation recordings as
    EnvMimic ever is; means over seeds."""

    def curve(folder: Path) -> tuple[Float[np.ndarray, " steps"], Float[np.ndarray, " steps"]]:
        steps, error = runs.column(folder, "validation_error")
        return np.interp(steps, *runs.column(folder, "seconds")), error

    goal = float(np.mean([curve(folder)[1].min() for folder in folders["identified"]]))
    lines = ["| method | lowest validation error (score) | seconds to EnvMimic's lowest |", "| --- | ---: | ---: |"]
    for name, members in folders.items():
        if METHODS[name].nominal or name in ("regression", "supervised", AIR, "air-lift"):
            continue
        curves = [curve(folder) for folder in members]
        first = [float(seconds[np.argmax(error <= goal)]) for seconds, error in curves if np.any(error <= goal)]
        when = f"{np.mean(first):.0f} ({len(first)} of {len(curves)} seeds)" if first else "never"
        lines.append(f"| {METHODS[name].label} | {spread([float(e.min()) for _, e in curves])} | {when} |")
    return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A virtual robot's recordings, and its identified actuators."""

    training: list[Path]
    validation: list[Path]
    test: list[Path]
    actuators: Path


def record(robot_seed: int, folder: Path) -> Recorded:
    """The bundled recordings for robot 0; for another one they are made, and its actuators identified, in `folder`."""
    place = robot.assets() / "recordings"
    if robot_seed != bundled_recordings.ROBOT_SEED:
        place = folder / "recordings"
        if not (place / "suspended" / "sweep.csv.gz").exists():
            bundled_recordings.data_set(robot_seed, place)
        if not (place / "actuators.json").exists():
            train(folder / "sysid", "sysid", "--recordings", str(place / "suspended"), result="actuators.json")
            shutil.copy(folder / "sysid" / "actuators.json", place)
    training, validation, test = (recording.recordings([place / use]) for use in ("training", "validation", "test"))
    return Recorded(training, validation, test, place / "actuators.json")


def evaluate(folders: list[Path], paths: list[Path]) -> list[evaluation.Evaluation]:
    """Runs of the same configuration and actuators, on other recordings than their own."""
    policies = [residual.Residual.load(folder) for folder in folders]
    model = robot.load_model(policies[0].actuators)
    motions = [reconstruction.reconstruct(recording.read_recording(path), model) for path in paths]
    evaluator = evaluation.OpenLoopEvaluator(model, motions, policies[0].model)
    return [evaluator(policy.params) for policy in policies]


# %% [markdown]
# ## Table: mean over seeds, with the lowest and the highest


# %%
def spread(values: list[float], digits: int = 2) -> str:
    """Mean and range, of one value that alone."""
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    return f"{np.mean(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def ratios(values: list[float]) -> str:
    """Mean and, in brackets, the range."""
    return f"{np.mean(values):.2f}" + ("" if len(values) == 1 else f" [{min(values):.2f}, {max(values):.2f}]")


Results = Mapping[str, list[evaluation.Evaluation]]
"""Of each method of `METHODS`, those of all seeds."""


def comparison(results: Results, times: Mapping[str, list[float]], horizon: float) -> str:
    """Markdown: what simulators leave of vanilla's RMSE over `horizon` s, the range of that over seeds, and how long
    learning took. In vanilla's row stand its errors themselves; the least of a column is bold."""
    nominal, identified = results["nominal"], results["identified"]
    groups = sorted(nominal[0].groups, reverse=True)  # near before far
    columns = [(group, quantity) for group in groups for quantity in ("position", "yaw")]
    rows = {"vanilla+sysid": [run.vanilla for run in identified[:1]]}
    rows |= {METHODS[name].label: [run.residual for run in found] for name, found in results.items()}
    took = {METHODS[name].label: f"{np.mean(values):.0f}" for name, values in times.items()}

    def mean(run: Sequence[evaluation.Errors], group: str, quantity: str) -> float:
        return float(np.mean([getattr(e, quantity)[horizon][0] for e in run if e.group == group]))

    head = [f"{group}: {quantity}" for group, quantity in columns]
    lines = [
        f"| {horizon:g} s | " + " | ".join(head) + " | learning (s) |",
        "| --- " + "| ---: " * (1 + len(head)) + "|",
    ]
    whole = {column: mean(nominal[0].vanilla, *column) for column in columns}
    errors = [f"{whole[c]:.3f} m" if c[1] == "position" else f"{whole[c]:.1f} deg" for c in columns]
    lines.append("| vanilla | " + " | ".join(errors) + " | |")
    left = {
        row: [[mean(run, *column) / whole[column] for run in runs] for column in columns] for row, runs in rows.items()
    }
    least = [min(np.mean(cells[place]) for cells in left.values()) for place in range(len(columns))]
    for row, cells in left.items():
        said = [f"**{ratios(c)}**" if np.mean(c) == low else ratios(c) for c, low in zip(cells, least, strict=True)]
        lines.append(f"| {row} | " + " | ".join([*said, took.get(row, "")]) + " |")
    return "\n".join(lines)


def table(runs: list[evaluation.Evaluation], base: str, name: str) -> str:
    """Markdown: RMSE of the simulator `base` and of `name`, and their ratio, by group and horizon."""
    lines = [
        f"| test recordings | horizon (s) | position, {base} (m) | {name} (m) | ratio | yaw, {base} (deg) | "
        f"{name} (deg) | ratio |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for group in runs[0].groups:
        for horizon in evaluation.HORIZONS:
            cells = []
            for quantity, digits in (("position", 3), ("yaw", 1)):
                mean = [
                    [np.mean([getattr(e, quantity)[horizon][0] for e in side if e.group == group]) for side in pair]
                    for pair in ((run.vanilla, run.residual) for run in runs)
                ]
                cells.append(f"{mean[0][0]:.{digits}f}")
                cells.append(spread([float(pair[1]) for pair in mean], digits))
                cells.append("**" + spread([run.ratio(group, quantity, horizon) for run in runs]) + "**")
            lines.append(f"| {group} | {horizon:g} | " + " | ".join(cells) + " |")
    lines += [
        "",
        f"| whole recording | CoM error, {base} (m) | {name} (m) | final yaw error, {base} (deg) | {name} (deg) |",
    ]
    lines.append("| --- | --- | --- | --- | --- |")
    for index, without in enumerate(runs[0].vanilla):
        ours = [run.residual[index] for run in runs]
        lines.append(
            f"| {without.recording} | {without.mean_com_error:.2f} | {spread([e.mean_com_error for e in ours])} | "
            f"{without.final_yaw_error:.0f} | {spread([e.final_yaw_error for e in ours], 0)} |"
        )
    return "\n".join(lines)


def worst_case(runs: list[evaluation.Evaluation], base: str) -> str:
    """Markdown: how near a run comes to the bound on what it may make worse than the simulator `base`."""
    bound = f"1.2 times {base} plus 2 cm and 3 deg"
    lines = [f"Worst case against {bound}, over recordings and horizons, by seed (negative: within):", ""]
    lines += [f"- {relative:+.0%} of the bound, {place}" for relative, place in (run.excess() for run in runs)]
    return "\n".join(lines)


def against(nominal: list[evaluation.Evaluation], runs: list[evaluation.Evaluation]) -> list[evaluation.Evaluation]:
    """`runs` on identified actuators, beside vanilla instead of vanilla+sysid."""
    return [evaluation.Evaluation(nominal[0].vanilla, run.residual) for run in runs]


# %% [markdown]
# ## Figure: whole recordings, mean and range over seeds


# %%
def figure(folders: list[Path], air: Path, paths: list[Path], path: Path) -> None:
    """Replay recordings in vanilla, with identified actuators, with every seed's forces beside these, and with the
    identified air."""
    policies, blown = [residual.Residual.load(folder) for folder in folders], residual.Residual.load(air)

    def simulator(actuators: robot.ActuatorParameters | None, kind: residual.Residual) -> evaluation.OpenLoopEvaluator:
        model = robot.load_model(actuators)
        motions = [reconstruction.reconstruct(recording.read_recording(p), model) for p in paths]
        return evaluation.OpenLoopEvaluator(model, motions, kind.model)

    evaluator = simulator(policies[0].actuators, policies[0])
    replays = [evaluator.replay(policy.params) for policy in policies]
    identified = evaluator.replay(policies[0].params, scale=0.0)
    vanilla = simulator(None, policies[0]).replay(policies[0].params, scale=0.0)
    aerodynamic = simulator(blown.actuators, blown).replay(blown.params)
    panels = []
    for motion, run in zip(evaluator.motions, evaluator.first_runs, strict=True):
        position, yaw = evaluator.recorded(run)
        states = len(yaw)

        def curve(replay: evaluation.Replay, run: int = run, states: int = states) -> np.ndarray:
            return np.column_stack([replay.position[run, :states, :2], replay.yaw[run, :states]])

        panels.append(
            plots.TrackingPanel(
                title=motion.name,
                time=np.arange(states) * robot.CONTROL_TIMESTEP,
                recording=np.column_stack([position[:, :2], yaw]),
                simulations={
                    "vanilla": curve(vanilla),
                    "vanilla+sysid": curve(identified),
                    "envmimic": np.stack([curve(replay) for replay in replays]),
                    "aerodynamic": curve(aerodynamic),
                },
            )
        )
    plots.tracking(path, panels)


# %% [markdown]
# ## All of it


# %%
@dataclasses.dataclass(frozen=True)
class Options:
    """What the command line says."""

    methods: list[str]
    seeds: list[int]
    robot: int
    fresh: int
    output: Path
    quick: bool


def parse() -> Options:
    parser = argparse.ArgumentParser(description="Fidelity of simulators: the README's tables and figure.")
    always = ("nominal", "identified", AIR)  # the figure and the long tables are of these
    parser.add_argument(
        "--methods",
        nargs="*",
        choices=[name for name in METHODS if name not in always],
        default=[name for name in METHODS if name not in always],
        help=f"beside {', '.join(always)}",
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="one training a seed")
    parser.add_argument("--robot", type=int, default=bundled_recordings.ROBOT_SEED, help="seed of the virtual robot")
    parser.add_argument("--fresh", type=int, default=2026, help="seed of the larger test set")
    parser.add_argument("--output", type=Path, default=Path("runs/fidelity"), help="folder of the runs")
    parser.add_argument("--quick", action="store_true", help="train for seconds; the numbers mean nothing")
    arguments = parser.parse_args()
    methods = [name for name in METHODS if name in always or name in arguments.methods]
    return Options(methods, arguments.seeds, arguments.robot, arguments.fresh, arguments.output, arguments.quick)


def arguments_of(method: Method, recorded: Recorded, training: list[Path], quick: bool) -> list[str]:
    """Of `python -m ballu_mjx.train`, to learn by a method from some of the recordings."""
    arguments = [*method.arguments, *(["--quick"] if quick else [])]
    for use, paths in (("recordings", training), ("validation", recorded.validation), ("test", recorded.test)):
        arguments += [f"--{use}", *map(str, paths)]
    return [*arguments, "--actuators", "nominal" if method.nominal else str(recorded.actuators)]


def learn(options: Options, recorded: Recorded) -> dict[str, list[Path]]:
    """All runs of all methods; the air first, beside which others learn."""
    folders = {}
    for name in sorted(options.methods, key=lambda name: name != AIR):
        method = METHODS[name]
        # A quick training would test on what it validates on: the tables need the test recordings.
        training = recorded.training[:2] if options.quick else recorded.training
        arguments = arguments_of(method, recorded, training, options.quick)
        arguments += ["--residual", str(options.output / AIR)] if method.beside_air else []
        runs = [(options.output / f"{name}-seed-{seed}", ["--seed", str(seed)]) for seed in options.seeds]
        for folder, seed in runs if method.seeded else [(options.output / name, [])]:
            train(folder, *arguments, *seed)
            folders.setdefault(name, []).append(folder)
    return {name: folders[name] for name in options.methods}


def main() -> None:
    options = parse()
    recorded = record(options.robot, options.output)
    folders = learn(options, recorded)
    results = {name: [load(folder) for folder in members] for name, members in folders.items()}
    times = {name: [seconds(folder) for folder in members] for name, members in folders.items()}
    each = 1 if options.quick else 6
    paths = bundled_recordings.fresh(options.fresh, options.output, each, options.robot)
    larger = {name: evaluate(members, paths) for name, members in folders.items()}
    parts = []
    for title, found in (("Bundled test recordings", results), ("Fresh test recordings", larger)):
        parts += [f"### {title}", *(comparison(found, times, horizon) for horizon in evaluation.SCORE_HORIZONS)]
        nominal = found["nominal"]
        legs = [evaluation.Evaluation(nominal[0].vanilla, found["identified"][0].vanilla)]
        parts += ["vanilla+sysid. " + worst_case(legs, "vanilla")]
        for name in options.methods:
            evaluations = found[name] if METHODS[name].nominal else against(nominal, found[name])
            parts += [f"{METHODS[name].label}. " + worst_case(evaluations, "vanilla")]
        for name in ("identified", AIR, "nominal"):
            parts += [table(found[name], "vanilla" if METHODS[name].nominal else "vanilla+sysid", METHODS[name].label)]
    parts += ["### Progress", race(folders)]
    text = "\n\n".join(parts)
    (options.output / "table.md").write_text(text + "\n")
    figure(folders["identified"], folders[AIR][0], recorded.test, options.output / "tracking.png")
    print(text)
    print(f"\nWritten to {options.output}.")


if __name__ == "__main__":
    main()
