# %% [markdown]
# # Identification of BALLU's actuators: non-linear, and different on each side
#
# This experiment belongs to the paper's section "Actuator System Identification". Commands reach BALLU's knees through
# a servo, a cable and a spring. Friction, saturation and slack make the curve of angle over command non-linear, unlike
# in the ideal simulator. The paper holds 20 commands spread over [0, 1], and measures the angles of both motors and
# both knees. It fits eight parameters of the simulator to the four measured curves, by the directed Hausdorff distance
# between fitted polynomials and L-BFGS-B. Its figure shows the four curves over the command.
#
# Here, the recording is the bundled sweep of the virtual robot, which is suspended by its base. The fit has twelve
# parameters (torque limits and the cables' slack are added), and delay, friction and backlash. It is least squares over
# the whole motion. docs/actuators.md gives the reasons, and the results of the paper's objective.
#
# `python experiments/actuator_curves.py` takes about five minutes, half of it compilation. `--quick` fits only settled
# angles, from fewer starts.

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

FIGURE = "actuator_curves.png"
"""The last file that an identification writes."""

# %% [markdown]
# ## Identification
#
# The package does the identification. `python -m ballu_mjx.train sysid` does the same and has all options.


# %%
def identify(folder: Path, config: IdentificationConfig) -> None:
    """Identify the actuators from the bundled sweep, and print the table. If `folder` has the result, only print it.

    **Raises** `InputError` if `folder` has a result of other options, or is unfinished.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        train_sysid.train(train_sysid.SysidData(output=folder), config)
        return
    found = read_config(folder, "sysid")["fit"]
    fix = "delete it, or give --output another folder"
    if found != json.loads(json.dumps(dataclasses.asdict(config))):
        raise InputError(f"{folder}: was made with other options (with or without --quick); {fix}.")
    if not (folder / FIGURE).exists():
        raise InputError(f"{folder}: its identification was interrupted; {fix}.")
    print((folder / "identification.txt").read_text())


# %% [markdown]
# ## Table and figure
#
# Dots are measured angles. Lines are angles in the nominal and in the identified simulator. Dotted lines are the
# identified simulator without friction and backlash. A command lifts the motor's arm and bends the knee. The
# curves flatten where the servo is at its torque limit.


# %%
def main() -> None:
    parser = argparse.ArgumentParser(description="Make the paper's figure of the actuators from the bundled sweep.")
    parser.add_argument("--quick", action="store_true", help="fit only settled angles, from fewer starts")
    options = _setup.parse(parser, Path("runs/actuator-curves"))
    identify(options.output, IdentificationConfig(**train_sysid.QUICK if options.quick else {}))
    print(f"Figure: {options.output / FIGURE}")


if __name__ == "__main__":
    _setup.run(main)
