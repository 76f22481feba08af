# %% [markdown]
# # Fidelity: the README's tables and figure
#
# Section "Improved Simulation Fidelity" of the paper, open loop: recorded commands are replayed from recorded states in
# five simulators, on recordings that training never saw: vanilla, vanilla with identified actuators (vanilla+sysid),
# either with EnvMimic's forces, and the second with the identified air (aerodynamic); with `--hybrid` also that with
# EnvMimic's forces for what the air leaves. One run of `python -m ballu_mjx.train envmimic` a seed and kind, one of
# `train residual`; runs that are there already are not repeated.
#
# `python experiments/fidelity.py` takes about half an hour on two cores; `--quick` shows that it works.

# %%
from __future__ import annotations

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

from ballu_mjx import runtime

runtime.prepare()

import bundled_recordings  # noqa: E402
import numpy as np  # noqa: E402

from ballu_mjx import evaluation, plots, reconstruction, recording, residual, robot  # noqa: E402

# %% [markdown]
# ## Train


# %%
KINDS = {"nominal": "EnvMimic", "identified": "EnvMimic on identified actuators", "hybrid": "aerodynamic+EnvMimic"}
"""Of EnvMimic, with what their simulators are called in the tables."""


def train(folder: Path, *arguments: str) -> None:
    """Run `python -m ballu_mjx.train` into `folder`, unless its evaluation is there."""
    if not (folder / "evaluation.json").exists():
        command = [sys.executable, "-m", "ballu_mjx.train", *arguments, "--output", str(folder)]
        subprocess.run(command, check=True)


def load(folder: Path) -> evaluation.Evaluation:
    """The evaluation of one run."""
    return evaluation.read(folder / "evaluation.json")


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


def comparison(results: dict[str, list[evaluation.Evaluation]]) -> str:
    """Markdown: RMSE of the simulators, and in brackets what that leaves of vanilla's."""
    nominal, identified = results["nominal"], results["identified"]
    columns = [(group, horizon) for group in nominal[0].groups for horizon in evaluation.SCORE_HORIZONS]
    head = [f"{group}, {horizon:g} s: m, deg" for group, horizon in columns]
    lines = ["| simulator | " + " | ".join(head) + " |", "| --- " * (1 + len(columns)) + "|"]
    rows = {
        "vanilla": [run.vanilla for run in nominal],
        "vanilla+sysid": [run.vanilla for run in identified],
        KINDS["nominal"]: [run.residual for run in nominal],
        KINDS["identified"]: [run.residual for run in identified],
        "aerodynamic": [run.residual for run in results["aerodynamic"]],
    }
    if "hybrid" in results:
        rows[KINDS["hybrid"]] = [run.residual for run in results["hybrid"]]
    for label, runs in rows.items():
        cells = []
        for group, horizon in columns:
            parts = []
            for quantity, digits in (("position", 3), ("yaw", 1)):
                values, base = (
                    [np.mean([getattr(e, quantity)[horizon][0] for e in run if e.group == group]) for run in side]
                    for side in (runs, rows["vanilla"])
                )
                parts.append(f"{np.mean(values):.{digits}f} ({np.mean(values) / np.mean(base):.2f})")
            cells.append(", ".join(parts))
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
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
    return "\n".join([*lines, "", worst_case(runs, base)])


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
def figure(folders: list[Path], air: Path, path: Path) -> None:
    """Replay the test recordings in vanilla, with identified actuators, with every seed's forces beside these, and with
    the identified air."""
    policies, blown = [residual.Residual.load(folder) for folder in folders], residual.Residual.load(air)

    def simulator(actuators: robot.ActuatorParameters | None, kind: residual.Residual) -> evaluation.OpenLoopEvaluator:
        model = robot.load_model(actuators)
        motions = [reconstruction.reconstruct(recording.read_recording(p), model) for p in recording.bundled("test")]
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

    seeds: list[int]
    fresh: int
    hybrid: bool
    output: Path
    quick: bool


def parse() -> Options:
    parser = argparse.ArgumentParser(description="Fidelity of simulators: the README's tables and figure.")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="one training a seed")
    parser.add_argument("--fresh", type=int, default=2026, help="seed of the larger test set")
    parser.add_argument("--hybrid", action="store_true", help="train EnvMimic on the identified air as well")
    parser.add_argument("--output", type=Path, default=Path("runs/fidelity"), help="folder of the runs")
    parser.add_argument("--quick", action="store_true", help="train for seconds; the numbers mean nothing")
    arguments = parser.parse_args()
    return Options(arguments.seeds, arguments.fresh, arguments.hybrid, arguments.output, arguments.quick)


def main() -> None:
    options = parse()
    quick = ["--quick"] if options.quick else []
    # A quick training tests on what it validates on: the tables need the test recordings.
    extra = [*quick, "--test", str(robot.assets() / "recordings" / "test")] if options.quick else []
    air = options.output / "aerodynamic"
    train(air, "residual", "--method", "aerodynamic", *extra)
    kinds = {"nominal": ["--actuators", "nominal"], "identified": []}
    if options.hybrid:
        kinds["hybrid"] = ["--residual", str(air)]
    folders = {kind: [options.output / f"{kind}-seed-{seed}" for seed in options.seeds] for kind in kinds}
    for kind, arguments in kinds.items():
        for seed, folder in zip(options.seeds, folders[kind], strict=True):
            train(folder, "envmimic", "--seed", str(seed), *extra, *arguments)
    folders["aerodynamic"] = [air]
    runs = {kind: [load(folder) for folder in members] for kind, members in folders.items()}
    paths = bundled_recordings.fresh(options.fresh, options.output, 1 if options.quick else 6)
    larger = {kind: evaluate(members, paths) for kind, members in folders.items()}
    parts = []
    for title, results in (("Bundled test recordings", runs), ("Fresh test recordings", larger)):
        parts += [f"### {title}", comparison(results)]
        for kind, name in (("identified", KINDS["identified"]), ("aerodynamic", "aerodynamic")):
            parts += [f"{name}. " + worst_case(against(results["nominal"], results[kind]), "vanilla")]
            parts += [table(results[kind], "vanilla+sysid", name)]
        if options.hybrid:
            parts += [table(results["hybrid"], "vanilla+sysid", KINDS["hybrid"])]
        parts += [table(results["nominal"], "vanilla", KINDS["nominal"])]
    text = "\n\n".join(parts)
    (options.output / "table.md").write_text(text + "\n")
    figure(folders["identified"], air, options.output / "tracking.png")
    print(text)
    print(f"\nWritten to {options.output}.")


if __name__ == "__main__":
    main()
