# %% [markdown]
# # Table II: turning left, from simulation to the robot
#
# Section "Improved Sim-to-real Transfer" of the paper, its second task. The reward is the velocity along y, to the
# left of the robot, which starts looking along x: it must turn and walk. As in Table I, a policy is trained in each of
# four simulators: with identified actuators (vanilla+sysid), with domain randomization (vanilla+DR), with both
# (vanilla+sysid+DR), and with EnvMimic's forces besides both; and, beyond the paper, in a fifth with the identified air
# besides both (aerodynamic). Each then runs on the robot for 22 s. The table gives the difference in final yaw between
# simulation and robot, and how far the robot came along y and how far it turned.
#
# The paper's robot is real, its numbers are one policy's each, and its yaw errors are signed. Here a virtual robot
# stands in for it, every policy is trained with several seeds and tried five times, each time in another draught;
# numbers are means (of the error: of its absolute value, for errors to either side cancel) with the 95 %
# confidence interval over seeds (Student's t), beside the paper's.
#
# `python experiments/table_turning.py` makes the stages of `python -m ballu_mjx.train all` that it needs; those that
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
    return pipeline_layout.table_file(options.output, "turn")


# %% [markdown]
# ## The figure: all ways from above
#
# What the table's means are taken over. A perfect policy ends as far up as it can. The lines
# are the recorded base's; the table is about the centre of mass, up in the balloons, some centimetres off.


# %%
def figure(options: pipeline.Options) -> Path:
    """Draw every trial of every seed, a panel a setting; the file that holds the figure."""
    path = options.output / "table_turning.png"
    ways = transfer_figure.read_ways(options.output, "turn", options.seeds)
    transfer_figure.draw(ways, options.seeds, path)
    return path


# %% [markdown]
# ## All of it


# %%
def main() -> None:
    options, figure_only = transfer_figure.options(
        "Table II of the paper: turning left on the robot, by the simulator that the policy was trained in.", "turn"
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
