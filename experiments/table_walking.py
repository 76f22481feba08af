# %% [markdown]
# # Table I: walking, from simulation to the robot
#
# Section "Improved Sim-to-real Transfer" of the paper. A policy is trained to walk forward (reward: velocity along x)
# in four simulators: with identified actuators (vanilla+sysid), with domain randomization (vanilla+DR), with both
# (vanilla+sysid+DR), and with EnvMimic's forces besides both; and, beyond the paper, in a fifth with the identified air
# besides both (aerodynamic). Each then walks on the robot for 24 s. The table gives the mean distance between the
# centres of mass of simulation and robot, and how far the robot came, along x and in all.
#
# The paper's robot is real and its numbers are one policy's each. Here a virtual robot stands in for it, every policy
# is trained with several seeds and tried five times, each time in another draught; numbers are means with the 95 %
# confidence interval over seeds (Student's t), beside the paper's.
#
# `python experiments/table_walking.py` makes the stages of `python -m ballu_mjx.train all` that it needs; those that
# are there are found again. This takes hours on two cores. Stages made with other options than the defaults of
# `train all` are set aside and made again: for such a folder, `--figure-only` draws the figure and runs nothing.
# `--quick` shows that it works.

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
from ballu_mjx.common import runtime

runtime.prepare()

import transfer_figure

from ballu_mjx.cli import pipeline
from ballu_mjx.common.errors import InputError
from ballu_mjx.policies import pipeline_layout

# %% [markdown]
# ## The table
#
# Training, trials and table are the package's: `ballu_mjx.cli.pipeline` holds the stages,
# `ballu_mjx.evaluation.transfer` the figures of a trial.


# %%
def table(options: pipeline.Options) -> Path:
    """Run what is missing, print the table; the file that holds it."""
    pipeline.run(options)
    return pipeline_layout.table_file(options.output, "walk")


# %% [markdown]
# ## The figure: all ways from above
#
# What the table's means are taken over. A perfect policy goes straight to the right. The lines
# are the recorded base's; the table is about the centre of mass, up in the balloons, some centimetres off.


# %%
def figure(options: pipeline.Options) -> Path:
    """Draw every trial of every seed, a panel a setting; the file that holds the figure."""
    path = options.output / "table_walking.png"
    ways = transfer_figure.read_ways(options.output, "walk", options.seeds)
    transfer_figure.draw(ways, options.seeds, path)
    return path


# %% [markdown]
# ## All of it


# %%
def main() -> None:
    options, figure_only = transfer_figure.options(
        "Table I of the paper: walking on the robot, by the simulator that the policy was trained in.", "walk"
    )
    written = [] if figure_only else [table(options)]
    written.append(figure(options))
    print(f"Written: {', '.join(map(str, written))}.")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("Interrupted; the same command goes on.", file=sys.stderr)
        sys.exit(130)
