# %% [markdown]
# # How many recordings does a residual need?
#
# The paper's argument for reinforcement learning is that it needs few recordings, whereas regression needs many. Here,
# each method learns a residual from 1, 2, 4 and 6 bundled training recordings of as many gaits, and from all 14.
# Actuators are identified. The errors are measured on the bundled test recordings: gaits with parameters between those
# of training (near), and commands unlike any gait (far).
#
# `python experiments/recording_counts.py` takes hours on two cores. `--methods` and `--counts` select a part. Finished
# runs are not repeated. `--quick` is a short trial run.

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

from ballu_mjx.common.results import Cell, Table
from ballu_mjx.viz.style import colour_of, label_of

METHODS = {"identified": "envmimic", "regression": "supervised", "analytic": "analytic", "aerodynamic": "aerodynamic"}
"""Key in `fidelity.METHODS` to name of the simulator in figures."""
GROUPS = ("near", "far")
HORIZON = 5.0
"""Horizon of the errors (s)."""
QUANTITIES = {"position": "balloon position", "orientation": "yaw"}

# %% [markdown]
# ## Training


# %%
def learn(arguments: argparse.Namespace) -> dict[str, dict[int, list[Path]]]:
    """Train all residuals, and return their run folders by method and number of recordings, one for each seed."""
    recorded = fidelity.record(fidelity.BUNDLED, arguments.output)
    # The first takes of all gaits come before any second take.
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
# ## Errors relative to vanilla+sysid


# %%
def left(folders: list[Path], group: str, quantity: str) -> Float[np.ndarray, " seeds"]:
    """Return the ratio of the error with the residual to the error without it, by seed."""
    return np.array([fidelity.load(folder).ratio(group, quantity, HORIZON) for folder in folders])


def table(found: dict[str, dict[int, list[Path]]]) -> Table:
    """Return the table of ratios by method and number of recordings, with one value for each seed."""
    columns = [(group, quantity) for group in GROUPS for quantity in QUANTITIES]
    rows = []
    for name, counts in found.items():
        for count, folders in counts.items():
            cells = [Cell(tuple(left(folders, *column).tolist())) for column in columns]
            rows.append((label_of(METHODS[name]), Cell((count,), "g"), *cells))
    return Table(("method", "recordings", *(f"{group}, {quantity}" for group, quantity in columns)), tuple(rows))


def figure(found: dict[str, dict[int, list[Path]]], path: Path) -> None:
    """Draw the ratios over the number of recordings. Lines are means over seeds, and bands are ranges."""
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
# ## Run


# %%
def main() -> None:
    parser = argparse.ArgumentParser(description="Errors of residuals by their number of training recordings.")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS), help="methods (all)")
    parser.add_argument(
        "--counts", type=int, nargs="+", default=[1, 2, 4, 6, 14], help="numbers of recordings (1 2 4 6 14)"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="training seeds (0 1 2)")
    parser.add_argument("--quick", action="store_true", help="learn for seconds; the numbers mean nothing")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    arguments = _setup.parse(parser, Path("runs/recording_counts"))
    _setup.reserve(arguments.output, quick=arguments.quick)
    if arguments.quick:
        arguments.counts, arguments.seeds = arguments.counts[:2], arguments.seeds[:1]
    found = learn(arguments)
    figure(found, arguments.output / "recording_counts.png")
    seeds = {"training": arguments.seeds}
    _setup.write_tables({"recordings": table(found)}, arguments.output, arguments.results, seeds)
    print(f"\nWritten to {arguments.output}.")


if __name__ == "__main__":
    _setup.run(main)
