# %% [markdown]
# # EnvMimic over seeds: the README's table and figure
#
# Section "Improved Simulation Fidelity" of the paper, open loop: recorded commands are replayed from recorded states in
# the vanilla simulator and in the one with EnvMimic's forces, on recordings that training never saw. One run of
# `python -m ballu_mjx.train envmimic` a seed; runs that are there already are not repeated.
#
# `python experiments/envmimic_seeds.py` takes about half an hour on two cores; `--quick` shows that it works.

# %%
from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

from ballu_mjx import runtime

runtime.prepare()

import numpy as np  # noqa: E402

from ballu_mjx import evaluation, plots, reconstruction, recording, residual, robot  # noqa: E402

# %% [markdown]
# ## Train


# %%
def train(seed: int, folder: Path, options: list[str]) -> None:
    """Run the main job for one seed, unless its evaluation is there."""
    if not (folder / "evaluation.json").exists():
        command = [sys.executable, "-m", "ballu_mjx.train", "envmimic", "--seed", str(seed), "--output", str(folder)]
        subprocess.run(command + options, check=True)


def errors(rows: list[dict]) -> tuple[evaluation.Errors, ...]:
    """`evaluation.Errors` from their JSON."""

    def table(values: dict[str, list[float]]) -> dict[float, tuple[float, float]]:
        return {float(horizon): (mean, spread) for horizon, (mean, spread) in values.items()}

    return tuple(
        evaluation.Errors(**{**row, "position": table(row["position"]), "yaw": table(row["yaw"])}) for row in rows
    )


def load(folder: Path) -> evaluation.Evaluation:
    """The evaluation of one run."""
    content = json.loads((folder / "evaluation.json").read_text())
    return evaluation.Evaluation(errors(content["vanilla"]), errors(content["envmimic"]))


# %% [markdown]
# ## Table: mean over seeds, with the lowest and the highest


# %%
def spread(values: list[float], digits: int = 2) -> str:
    """Mean and range."""
    return f"{np.mean(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def table(runs: list[evaluation.Evaluation]) -> str:
    """Markdown: RMSE of vanilla and EnvMimic and their ratio, by group and horizon."""
    lines = [
        "| test recordings | horizon (s) | position, vanilla (m) | EnvMimic (m) | ratio | yaw, vanilla (deg) | "
        "EnvMimic (deg) | ratio |",
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
        "| whole recording | CoM error, vanilla (m) | EnvMimic (m) | final yaw error, vanilla (deg) | EnvMimic (deg) |",
    ]
    lines.append("| --- | --- | --- | --- | --- |")
    for index, base in enumerate(runs[0].vanilla):
        ours = [run.residual[index] for run in runs]
        lines.append(
            f"| {base.recording} | {base.mean_com_error:.2f} | {spread([e.mean_com_error for e in ours])} | "
            f"{base.final_yaw_error:.0f} | {spread([e.final_yaw_error for e in ours], 0)} |"
        )
    worst = [run.excess() for run in runs]
    bound = "1.2 times vanilla plus 2 cm and 3 deg"
    lines += ["", f"Worst case against {bound}, over recordings and horizons, by seed (negative: within):"]
    lines += [f"- {relative:+.0%} of the bound, {place}" for relative, place in worst]
    return "\n".join(lines)


# %% [markdown]
# ## Figure: whole recordings, mean and range over seeds


# %%
def figure(folders: list[Path], path: Path) -> None:
    """Replay one near and one far test recording with every seed's forces."""
    model = robot.load_model()
    motions = [reconstruction.reconstruct(recording.read_recording(p), model) for p in recording.bundled("test")]
    policies = [residual.Residual.load(folder) for folder in folders]
    evaluator = evaluation.OpenLoopEvaluator(model, motions, policies[0].config, policies[0].infer)
    replays = [evaluator.replay(policy.params) for policy in policies]
    vanilla = evaluator.replay(policies[0].params, scale=0.0)
    firsts: dict[str, int] = {}
    for run, (index, _) in enumerate(evaluator.starts):
        firsts.setdefault(motions[index].name, run)
    panels = []
    for name, run in firsts.items():
        position, yaw = evaluator.recorded(run)
        states = len(yaw)

        def curve(replay: evaluation.Replay, run: int = run, states: int = states) -> np.ndarray:
            return np.column_stack([replay.position[run, :states, :2], replay.yaw[run, :states]])

        panels.append(
            plots.TrackingPanel(
                title=name,
                time=np.arange(states) * robot.CONTROL_TIMESTEP,
                recording=np.column_stack([position[:, :2], yaw]),
                simulations={"vanilla": curve(vanilla), "envmimic": np.stack([curve(replay) for replay in replays])},
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
    output: Path
    quick: bool


def parse() -> Options:
    parser = argparse.ArgumentParser(description="EnvMimic over seeds: the README's table and figure.")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="one training a seed")
    parser.add_argument("--output", type=Path, default=Path("runs/envmimic-seeds"), help="folder of the runs")
    parser.add_argument("--quick", action="store_true", help="train for seconds; the numbers mean nothing")
    arguments = parser.parse_args()
    return Options(arguments.seeds, arguments.output, arguments.quick)


def main() -> None:
    options = parse()
    folders = [options.output / f"seed-{seed}" for seed in options.seeds]
    extra = ["--quick", "--test", str(robot.assets() / "recordings" / "test")] if options.quick else []
    for seed, folder in zip(options.seeds, folders, strict=True):
        train(seed, folder, extra)
    text = table([load(folder) for folder in folders])
    (options.output / "table.md").write_text(text + "\n")
    figure(folders, options.output / "tracking.png")
    print(text)
    print(f"\nWritten to {options.output}.")


if __name__ == "__main__":
    main()
