"""File of a rollout for Rerun's viewer (https://rerun.io), `NAME.rrd`: robots, paths, residual force and commands.

It needs the extra `rerun`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.rollout_file import StoredRollout
from ballu_mjx.viz import robot_meshes
from ballu_mjx.viz.style import colour_of, label_of

TIMELINE = "time"
"""Name of the timeline, which is the time (s) from the rollout's start."""


def write_rerun(path: Path, rollout: StoredRollout) -> None:
    """Write a rollout to `path`, with each robot's bodies under `world/NAME`, and commands and force as plots.

    **Raises** `InputError` if the package rerun-sdk is missing.
    """
    try:
        import rerun as rr  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError(
            f"{path}: Rerun's files need the package rerun-sdk, which is in the extra rerun: "
            'pip install -c constraints.txt -e ".[rerun]".'
        ) from None
    shapes = robot_meshes.RobotShapes(rollout.description)
    model = shapes.model
    stream = rr.RecordingStream("ballu_mjx", recording_id=rollout.name)
    stream.save(path)
    seconds = rollout.time - rollout.time[0]
    states, steps = (rr.TimeColumn(TIMELINE, duration=time) for time in (seconds, seconds[:-1]))
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    poses = {name: shapes.poses(qpos) for name, qpos in rollout.qpos.items()}
    for name, found in poses.items():
        colour = np.array(colour_of(name))
        paths = [f"world/{_entity(label_of(name))}"]
        for body in range(1, model.nbody):
            paths.append(f"{paths[model.body_parentid[body]]}/{_entity(model.body(body).name or f'body-{body}')}")
            moved = rr.Transform3D.columns(
                translation=found.position[:, body],
                quaternion=np.roll(found.quaternion[:, body], -1, axis=1),  # Rerun has w last
            )
            stream.send_columns(paths[body], [states], moved)
        for index, part in enumerate(shapes.parts):
            shape = rr.Mesh3D(
                vertex_positions=part.vertices, triangle_indices=part.faces, albedo_factor=[*colour, part.opacity]
            )
            stream.log(f"{paths[part.body]}/shape-{index}", shape, static=True)
        way = np.column_stack([found.tracked[:, :2], np.zeros(len(seconds))])
        stream.log(f"{paths[0]}/way", rr.LineStrips3D([way], colors=[colour]), static=True)
    pushed = robot_meshes.pushed_robot(rollout)
    if pushed is not None and rollout.force is not None:
        arrows = rr.Arrows3D.columns(
            origins=poses[pushed].pushed[:-1],
            vectors=shapes.arrow_scale * rollout.force,
            colors=np.tile(robot_meshes.ARROW_COLOUR, (len(rollout.force), 1)),
        )
        stream.send_columns("world/force", [steps], arrows)
        for index, axis in enumerate("xyz"):
            stream.send_columns(f"force/{axis}", [steps], rr.Scalars.columns(scalars=rollout.force[:, index]))
    if rollout.command is not None:
        for index, name in enumerate(rollout.description.commands):
            column = rr.Scalars.columns(scalars=rollout.command[:, index])
            stream.send_columns(f"command/{_entity(name)}", [steps], column)
    stream.flush()
    stream.disconnect()


def _entity(name: str) -> str:
    """Return a name as part of an entity's path, without slashes, which would start another level."""
    return name.replace("/", "_")
