"""Files that an evaluation writes to a run's folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ballu_mjx.common import files
from ballu_mjx.evaluation.errors_file import evaluation_to_json
from ballu_mjx.runs.rollout_file import LARGEST_VALUE, ROLLOUT_FILE, StoredRollout, write_rollouts

if TYPE_CHECKING:
    from ballu_mjx.evaluation.errors import Evaluation
    from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator, Replay


def write_evaluation(evaluator: OpenLoopEvaluator, params: Any, folder: Path) -> Evaluation:
    """Evaluate a residual; write `evaluation.txt`, `evaluation.json`, `tracking.png` and `replay.npz` to `folder`."""
    names = evaluator.base, evaluator.name
    replays = dict(zip(names, (evaluator.replay(params, scale=0.0), evaluator.replay(params)), strict=True))
    vanilla, residual = (evaluator.errors(replays[name]) for name in names)
    result = evaluator.compared(vanilla, residual, evaluator.nominal_errors(params))
    files.write(folder / "evaluation.txt", result.table() + "\n")
    files.write(folder / "evaluation.json", json.dumps(evaluation_to_json(result), indent=2) + "\n")
    draw_tracking(evaluator, replays, folder / "tracking.png")
    write_rollouts(folder / ROLLOUT_FILE, stored_rollouts(evaluator, replays))
    return result


def draw_tracking(evaluator: OpenLoopEvaluator, replays: Mapping[str, Replay], path: Path) -> None:
    """Draw the replays of whole recordings by simulator, for the first recording of each group."""
    from ballu_mjx.recordings.recording_groups import group_of
    from ballu_mjx.viz import plots

    shown: dict[str, plots.TrackingPanel] = {}
    for motion, run in zip(evaluator.motions, evaluator.first_runs, strict=True):
        if group_of(motion.name) in shown:
            continue
        position, yaw = evaluator.recorded(run)
        states = len(yaw)
        simulations = {
            simulator: np.column_stack([replay.position[run, :states, :2], replay.yaw[run, :states]])
            for simulator, replay in replays.items()
        }
        shown[group_of(motion.name)] = plots.TrackingPanel(
            title=motion.name,
            time=np.arange(states) * evaluator.robot.control_timestep,
            recording=np.column_stack([position[:, :2], yaw]),
            simulations=simulations,
        )
    plots.tracking(path, list(shown.values()))


def stored_rollouts(evaluator: OpenLoopEvaluator, replays: Mapping[str, Replay]) -> list[StoredRollout]:
    """Return the replays of whole recordings by simulator, for views in 3D. The force is that of the last simulator.

    A simulation that diverges keeps its last finite state, without force.
    """
    found = []
    for index, motion in enumerate(evaluator.motions):
        run = evaluator.first_runs[index]
        first = evaluator.starts[run][1]
        states = len(motion.qpos) - first
        *_, last = replays.values()
        force = last.force[run, : states - 1]
        simulated = {simulator: _while_finite(replay.qpos[index, :states]) for simulator, replay in replays.items()}
        found.append(
            StoredRollout(
                name=motion.name,
                description=evaluator.robot,
                robot=motion.robot,
                time=motion.time[first:],
                qpos={"recording": motion.qpos[first:], **simulated},
                command=motion.command[first:],
                force=np.where(np.abs(force) < LARGEST_VALUE, force, 0.0),
            )
        )
    return found


def _while_finite(qpos: Float[np.ndarray, "states nq"]) -> Float[np.ndarray, "states nq"]:
    """Return positions that stay those of the last state before the first one that is not finite."""
    broken = ~(np.abs(qpos) < LARGEST_VALUE).all(axis=1)
    return qpos if not broken.any() else qpos[np.minimum(np.arange(len(qpos)), max(int(broken.argmax()) - 1, 0))]


def draw_learning_curve(folder: Path, best_step: int) -> None:
    """Draw `learning_curve.png` from the `metrics.jsonl` in a run's folder."""
    from ballu_mjx.runs.metrics import read_column
    from ballu_mjx.viz import plots

    plots.learning_curve(
        folder / "learning_curve.png",
        *read_column(folder, "reward"),
        *read_column(folder, "validation_error"),
        best_step=best_step,
    )
