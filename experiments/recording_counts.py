# %% [markdown]
# # How many recordings does a residual need?
#
# The paper's case for reinforcement learning is data: a few recordings are enough, where regression wants many. Here
# each way to a residual learns from one, two, four and six of the bundled training recordings, of as many gaits, and
# from all of them, on identified actuators, and predicts the bundled test recordings: of gaits between those (near) and
# of commands unlike any gait (far).
#
# `python experiments/recording_counts.py` takes hours on two cores; `--methods` and `--counts` name some of it. Runs
# that are there already are not repeated. `--quick` shows that it works.

# %%
from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import fidelity
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.viz.style import colour_of, label_of

METHODS = {"identified": "envmimic", "regression": "supervised", "analytic": "analytic", "aerodynamic": "aerodynamic"}
"""Of `fidelity.METHODS`, and what they are called in figures."""
GROUPS = ("near", "far")
HORIZON = 5.0
"""s."""
QUANTITIES = {"position": "balloon position", "orientation": "yaw"}

# %% [markdown]
# ## Learn


# %%
def learn(arguments: argparse.Namespace) -> dict[str, dict[int, list[Path]]]:
    """Run folders by method and number of recordings, one a seed."""
    recorded = fidelity.record(dataset.ROBOT_SEED, arguments.output)
    # Every gait once before any a second time.
    ordered = sorted(recorded.training, key=lambda path: path.name.partition("take-")[2])
    folders: dict[str, dict[int, list[Path]]] = {}
    for name in arguments.methods:
        method = fidelity.METHODS[name]
        for count in sorted({min(count, len(ordered)) for count in arguments.counts}):
            given = fidelity.arguments_of(method, recorded, ordered[:count], arguments.quick)
            for seed in arguments.seeds if method.seeded else [None]:
                folder = arguments.output / (f"{name}-of-{count}" + ("" if seed is None else f"-seed-{seed}"))
                fidelity.train(folder, *given, *([] if seed is None else ["--seed", str(seed)]))
                folders.setdefault(name, {}).setdefault(count, []).append(folder)
    return folders


# %% [markdown]
# ## What is left of the error of vanilla+sysid


# %%
def left(folders: list[Path], group: str, quantity: str) -> Float[np.ndarray, " seeds"]:
    """Ratios to the simulator without the residual."""
    return np.array([fidelity.load(folder).ratio(group, quantity, HORIZON) for folder in folders])


def table(found: dict[str, dict[int, list[Path]]]) -> Table:
    """Return mean and range over seeds."""
    columns = [(group, quantity) for group in GROUPS for quantity in QUANTITIES]
    rows = []
    for name, counts in found.items():
        for count, folders in counts.items():
            cells = [Cell(tuple(left(folders, *column).tolist())) for column in columns]
            rows.append((label_of(METHODS[name]), Cell((count,), "g"), *cells))
    return Table(("method", "recordings", *(f"{group}, {quantity}" for group, quantity in columns)), tuple(rows))


def figure(found: dict[str, dict[int, list[Path]]], path: Path) -> None:
    """What is left against the number of recordings; lines are means over seeds, bands the range."""
    whole, axes = plt.subplots(len(QUANTITIES), len(GROUPS), figsize=(8, 6.4), sharex=True, layout="constrained")
    for row, (quantity, title) in zip(axes, QUANTITIES.items(), strict=True):
        for ax, group in zip(row, GROUPS, strict=True):
            for name, counts in found.items():
                values = [left(folders, group, quantity) for folders in counts.values()]
                simulator = METHODS[name]
                colour = colour_of(simulator)
                lowest, middle, highest = ([f(each) for each in values] for f in (np.min, np.mean, np.max))
                ax.plot([*counts], middle, "o-", color=colour, label=label_of(simulator))
                ax.fill_between([*counts], lowest, highest, color=colour, alpha=0.2)
            ax.axhline(1.0, color=colour_of("vanilla+sysid"), linestyle="--", label="vanilla+sysid")
            ax.set_xscale("log", base=2)
            ax.set_yscale("log")
            ax.yaxis.set_major_formatter("{x:g}")
            ax.yaxis.set_minor_formatter("{x:g}")
            ax.grid(alpha=0.3, which="both")
            ax.set_title(f"{title}, {group}, {HORIZON:g} s")
        row[0].set_ylabel("error over that of vanilla+sysid")
    for ax in axes[-1]:
        counts = sorted({count for counts in found.values() for count in counts})
        ax.set_xticks(counts, [str(count) for count in counts], minor=False)
        ax.set_xlabel("training recordings")
    whole.legend(*axes[0, 0].get_legend_handles_labels(), ncols=5, loc="outside lower center")
    whole.savefig(path, dpi=130)
    plt.close(whole)


# %% [markdown]
# ## All of it


# %%
def main() -> None:
    parser = argparse.ArgumentParser(description="What is left of the error, by the number of recordings learned from.")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS), help="which (all)")
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 2, 4, 6, 14], help="recordings (1 2 4 6 14)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="one training a seed (0 1 2)")
    parser.add_argument("--output", type=Path, default=Path("runs/recording_counts"), help="folder of the runs")
    parser.add_argument("--quick", action="store_true", help="learn for seconds; the numbers mean nothing")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.counts, arguments.seeds = arguments.counts[:2], arguments.seeds[:1]
    found = learn(arguments)
    figure(found, arguments.output / "recording_counts.png")
    seeds = {"training": arguments.seeds}
    _setup.write_tables({"recordings": table(found)}, arguments.output, arguments.results, seeds)
    print(f"\nWritten to {arguments.output}.")


if __name__ == "__main__":
    _setup.run(main)
