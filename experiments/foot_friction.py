# %% [markdown]
# # Friction of the feet
#
# The aerodynamic residual can also identify the sliding friction of contacts. This experiment shows what it changes. On
# several virtual robots, the air is identified with the model's friction, and together with the friction. Both are
# tested on twelve fresh recordings. The table has ratios of the errors to those of the nominal robot without air. It
# also has the identified coefficient of friction, and the mean of the robot's own two feet.
#
# Robots are of the package's own family (`--own`), or of PyBullet's (`--bullet`, needs the extra `bench`).
# `python experiments/foot_friction.py` takes about a quarter of an hour for each robot on one core. `--quick` is a
# short trial run.

# %%
from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

sys.path += ["experiments", "benchmarks"]  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import collect_runs
import fidelity
import numpy as np
from final_tier import recorded_on

from ballu_mjx.ballu.model import load_model
from ballu_mjx.ballu.virtual.hardware import Hardware, VirtualHardware
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.registry import load_robot

HORIZON = 5.0
"""Horizon of the errors (s)."""
METHODS = (fidelity.AIR, "air-friction")
"""Methods of `fidelity.METHODS`, without and with identified friction."""

# %% [markdown]
# ## Robots


# %%
def robots(own: list[int], bullet: list[int]) -> dict[str, tuple[Hardware, tuple[float, float]]]:
    """Return robots with the coefficients of friction of their feet (left, right), by name."""
    found: dict[str, tuple[Hardware, tuple[float, float]]] = {}
    for seed in own:
        hardware = VirtualHardware.draw(seed)
        found[f"own {seed}"] = hardware, hardware.robot.foot_friction
    if bullet:
        from bullet_family import BulletHardware  # needs the extra `bench`  # pyright: ignore[reportMissingImports]

        for seed in bullet:
            hardware = BulletHardware.draw(seed)
            found[f"PyBullet {seed}"] = hardware, hardware.robot.foot_friction
    return found


# %% [markdown]
# ## Measurement


# %%
def fits(
    hardware: Hardware, recording: int, folder: Path, quick: bool
) -> tuple[fidelity.Recorded, dict[str, list[Path]]]:
    """Return recordings of a robot, and the run folder of each method. Finished stages are kept."""
    recorded = recorded_on(hardware, recording, folder, quick)
    return recorded, fidelity.learn(METHODS, [0], folder / "fits", recorded, quick=quick)


def measure(
    name: str, hardware: Hardware, friction: tuple[float, float], recording: int, folder: Path, quick: bool
) -> list[tuple[str | Cell, ...]]:
    """Identify one robot's actuators and air, and return its rows of the table. Finished stages are kept."""
    recorded, folders = fits(hardware, recording, folder, quick)
    vanilla = fidelity.vanilla_errors(folders[fidelity.AIR][0], recorded.test)
    found = {method: [fidelity.load(folders[method][0]).residual] for method in METHODS}
    columns = [(group, quantity) for group in ("near", "far") for quantity in ("position", "orientation")]
    errors = collect_runs.remaining_errors(vanilla, found, columns, HORIZON)
    nominal = float(load_model().geom("foot_left").friction[0])
    params = TrainedResidual.load(folders["air-friction"][0], load_robot()).params
    coefficients = (Cell((nominal,)), Cell((nominal * (1 + float(params.friction)),)))
    own = Cell((float(np.mean(friction)),))
    return [
        (name, fidelity.METHODS[method].label, *errors[method], coefficient, own)
        for method, coefficient in zip(METHODS, coefficients, strict=True)
    ]


class Chosen(NamedTuple):
    """Robot of the experiment."""

    name: str
    hardware: Hardware
    friction: tuple[float, float]
    """Coefficients of friction of its feet (left, right)."""
    folder: Path
    """Folder of its stages."""


def parse(
    parser: argparse.ArgumentParser, own: list[int], bullet: list[int]
) -> tuple[argparse.Namespace, list[Chosen]]:
    """Add the options of this experiment to a parser, parse the command line, and return options and robots.

    `own` and `bullet` are the default seeds of robots. Under `--quick` there is one robot.
    """

    def seeds(family: str, default: list[int]) -> dict[str, Any]:
        shown = " ".join(map(str, default)) or "none"
        return {"type": int, "nargs": "*", "default": default, "help": f"seeds of {family} ({shown})"}

    parser.add_argument("--own", **seeds("robots of the own family", own))
    parser.add_argument("--bullet", **seeds("PyBullet's robots", bullet))
    parser.add_argument("--fresh", type=int, default=2026, help="seed of the test recordings of the fits")
    parser.add_argument("--quick", action="store_true", help="one robot, for minutes; the numbers mean nothing")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    options = _setup.parse(parser, Path("runs/foot-friction"))
    _setup.reserve(options.output, fresh=options.fresh, quick=options.quick)
    drawn = robots(options.own[:1] or [1], []) if options.quick else robots(options.own, options.bullet)
    return options, [
        Chosen(name, hardware, friction, options.output / name.replace(" ", "-").lower())
        for name, (hardware, friction) in drawn.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure what the identified friction of the feet contributes.")
    options, chosen = parse(parser, [1, 2], [0, 1, 2])
    rows = []
    for robot in chosen:
        rows += measure(robot.name, robot.hardware, robot.friction, options.fresh, robot.folder, options.quick)
    heads = (f"{group}: {called}" for group in ("near", "far") for called in ("position", "yaw"))
    columns = ("robot", f"{HORIZON:g} s", *heads, "friction in the simulator", "friction of the robot")
    seeds = {"own robot": options.own, "PyBullet robot": options.bullet, "recording": [options.fresh]}
    _setup.write_tables({"robots": Table(columns, tuple(rows))}, options.output, options.results, seeds)


if __name__ == "__main__":
    _setup.run(main)
