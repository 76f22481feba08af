# %% [markdown]
# # Actuators: identified, non-linear, another one on each side
#
# Section "Actuator System Identification" of the paper. Commands reach BALLU's knees through a servo, a cable and a
# spring; friction, saturation and slack make of this a curve that the ideal simulator does not have. The paper holds 20
# commands spread over [0, 1], measures the angles of both motors and both knees, and moves eight parameters of the
# simulator until its four curves lie on the measured ones: directed Hausdorff distance between fitted polynomials,
# L-BFGS-B. Its figure shows the four curves against the command.
#
# Here on the bundled sweep of the virtual robot, hung up by its base, with twelve parameters (torque limits and
# the cables' slack are added), delay, friction and backlash beside them, and least squares over the whole motion;
# docs/actuators.md tells why, and what the paper's objective gives instead.
#
# `python experiments/actuator_curves.py` takes about five minutes, half of it compiling; `--quick` fits settled angles
# alone, from fewer starts.

# %%
from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

from ballu_mjx.ballu.leg_parameters import IdentificationConfig
from ballu_mjx.cli import train_sysid
from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.folder import read_config

OUTPUT, QUICK_OUTPUT = Path("runs/actuator-curves"), Path("runs/actuator-curves-quick")
FIGURE = "actuator_curves.png"
"""The last file that an identification writes."""

# %% [markdown]
# ## Identify
#
# The work is the package's: `python -m ballu_mjx.train sysid` does the same, with every option at hand.


# %%
def identify(folder: Path, config: IdentificationConfig) -> None:
    """Identify from the bundled sweep and print the table; where `folder` has the result already, print that one.

    **Raises** `InputError` where `folder` holds something else.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        train_sysid.train(train_sysid.SysidData(output=folder), config)
        return
    found = read_config(folder, "sysid")["fit"]
    mend = "delete it, or give --output another folder"
    if found != json.loads(json.dumps(dataclasses.asdict(config))):
        raise InputError(f"{folder}: was made with other options (--quick, or not); {mend}.")
    if not (folder / FIGURE).exists():
        raise InputError(f"{folder}: its identification was interrupted; {mend}.")
    print((folder / "identification.txt").read_text())


# %% [markdown]
# ## All of it: table and figure
#
# Dots are measured, lines are the nominal and the identified simulator, dotted is the identified one with the robot's
# friction and backlash. A command lifts the motor's arm and bends the knee; where the servo is at its limit, curves
# flatten.


# %%
def main() -> None:
    parser = argparse.ArgumentParser(description="The paper's figure of the actuators, from the bundled sweep.")
    parser.add_argument(
        "--output", type=Path, help=f"folder of the identification ({OUTPUT}, or {QUICK_OUTPUT} under --quick)"
    )
    parser.add_argument("--quick", action="store_true", help="settled angles alone, from fewer starts")
    options = parser.parse_args()
    folder = options.output or (QUICK_OUTPUT if options.quick else OUTPUT)
    identify(folder, IdentificationConfig(**train_sysid.QUICK if options.quick else {}))
    print(f"Figure: {folder / FIGURE}")


if __name__ == "__main__":
    _setup.run(main)
