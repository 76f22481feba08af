"""Rollouts for reports and views: `replay.npz` in a run's folder, format `ballu-replay/2`.

The file is an archive of NumPy arrays without pickled objects. It has the strings `format`, `robot/path` and
`robot/sha256` (the description of the robot, as in `config.json`), and `names` (one per rollout). Rollout number i has
the arrays `i/time`, and `i/qpos/NAME` for each of its robots (`recording`, or a simulator). It has `i/command` and
`i/force` if they are known. `i/robot` is the robot that was recorded.

JAX and MuJoCo are imported inside functions, because commands import this module before `runtime.prepare`.
"""

from __future__ import annotations

import dataclasses
import io
import textwrap
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError

if TYPE_CHECKING:
    from ballu_mjx.robots.description import RobotDescription

ROLLOUT_FORMAT = "ballu-replay/2"
ROLLOUT_FILE = "replay.npz"

_MEND = "write it again with `python -m ballu_mjx evaluate RUN --output RUN`"
_TOLERANCE = 0.02
"""Tolerance of a quaternion's length, and of commands in units of their range's width."""
LARGEST_VALUE = 1e6
"""Largest valid number (m, rad, s) in a rollout."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StoredRollout:
    """One robot, or several that start in the same state and get the same commands, at the control rate.

    Units are SI units and radians.
    """

    name: str
    """Name of the recording or of the task."""
    description: RobotDescription
    """Description of the robots."""
    robot: str = ""
    """Robot that was recorded. Empty if none was."""
    time: Float[np.ndarray, " states"]
    """Times of the recording (s)."""
    qpos: Mapping[str, Float[np.ndarray, "states nq"]]
    """MuJoCo's generalized positions of each robot, by its name."""
    command: Float[np.ndarray, "steps commands"] | None = None
    """Commands (in the actuators' units) from each state to the next, one fewer than states. None if unknown."""
    force: Float[np.ndarray, "steps 3"] | None = None
    """Residual force (N, world frame) on the tracked body of the last robot, from each state to the next. None if
    unknown."""


def write_rollouts(path: Path, rollouts: Sequence[StoredRollout]) -> None:
    """Write rollouts of one robot to a compressed file, in single precision.

    **Raises** `ValueError` if there are no rollouts, if their robots have different descriptions, or if a number is
    not below `LARGEST_VALUE`.
    """
    from ballu_mjx.robots.registry import describe_robot

    if len({rollout.description.sha256 for rollout in rollouts}) != 1:
        raise ValueError("A file needs at least one rollout, and all must be of one robot.")
    described = describe_robot(rollouts[0].description)
    arrays: dict[str, np.ndarray] = {
        "format": np.array(ROLLOUT_FORMAT),
        "robot/path": np.array(described["path"]),
        "robot/sha256": np.array(described["sha256"]),
        "names": np.array([rollout.name for rollout in rollouts], str),
    }
    for index, rollout in enumerate(rollouts):
        arrays[f"{index}/robot"] = np.array(rollout.robot)
        arrays[f"{index}/time"] = rollout.time
        arrays |= {f"{index}/qpos/{name}": qpos for name, qpos in rollout.qpos.items()}
        arrays |= {
            f"{index}/{name}": value for name in ("command", "force") if (value := getattr(rollout, name)) is not None
        }
    if not all((np.abs(a) < LARGEST_VALUE).all() for a in arrays.values() if a.dtype.kind == "f"):
        raise ValueError("A rollout has a number that is not finite, or too large.")
    single = {name: a.astype(np.float32) if a.dtype.kind == "f" else a for name, a in arrays.items()}
    archive = io.BytesIO()
    np.savez_compressed(archive, **single)  # pyright: ignore[reportArgumentType]
    files.write(path, archive.getvalue())


def read_rollouts(path: Path) -> list[StoredRollout]:
    """Return the rollouts in a file.

    **Raises** `InputError` if the file has another format, is damaged, or holds pickled objects, which are never
    loaded. It does so too if the robot's description is missing or has changed.
    """
    from ballu_mjx.robots.registry import find_robot

    if not path.exists():
        raise InputError(f"{path}: there is no such file; {_MEND}.")
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > files.LARGEST:
                raise ValueError(f"more than {files.LARGEST >> 20} MiB")
            arrays = {name.removesuffix(".npy"): _array(archive.read(name)) for name in archive.namelist()}
    except Exception as error:  # damage causes many kinds of errors
        said = textwrap.shorten(str(error), 80) or type(error).__name__
        raise InputError(f"{path}: not an archive of plain arrays ({said}); {_MEND}.") from None
    found = arrays.pop("format", None)
    if found is None or str(found) != ROLLOUT_FORMAT:
        raise InputError(f"{path}: the format is not {ROLLOUT_FORMAT}; {_MEND}.")
    said = {key: arrays.pop(f"robot/{key}", np.zeros(1)) for key in ("path", "sha256")}
    if any(value.dtype.kind != "U" or value.ndim for value in said.values()):
        raise InputError(f"{path}: does not name its robot; {_MEND}.")
    robot = find_robot({key: str(value) for key, value in said.items()}, path)
    names, nq = arrays.pop("names", np.array([], str)), robot.load_model().nq
    return [_rollout(path, str(name), f"{index}/", arrays, robot, nq) for index, name in enumerate(names.ravel())]


def _array(content: bytes) -> np.ndarray:
    return np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)


def _rollout(
    path: Path, name: str, prefix: str, arrays: Mapping[str, np.ndarray], robot: RobotDescription, nq: int
) -> StoredRollout:
    own = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
    qpos = {key.removeprefix("qpos/"): value for key, value in own.items() if key.startswith("qpos/")}
    time = own.get("time")
    states = 0 if time is None else len(np.atleast_1d(time))
    shapes = {"time": (states,), "command": (states - 1, len(robot.commands)), "force": (states - 1, 3)}
    shapes |= {f"qpos/{each}": (states, nq) for each in qpos}
    for key, shape in shapes.items():
        value = own.get(key)
        if value is None and key in ("command", "force"):
            continue
        if (
            value is None
            or value.dtype.kind != "f"
            or value.shape != shape
            or not (np.abs(value) < LARGEST_VALUE).all()
        ):
            raise InputError(f"{path}: {prefix}{key} is not an array of {shape} finite numbers; {_MEND}.")
    if time is None or states < 2 or not qpos:
        raise InputError(f"{path}: rollout {name!r} has no robot, or fewer than two states; {_MEND}.")
    problem = None
    if not (np.diff(time) > 0).all():
        problem = "times that do not increase"
    elif not robot.anchored and any(
        np.abs(np.linalg.norm(value[:, 3:7], axis=1) - 1).max() > _TOLERANCE for value in qpos.values()
    ):
        problem = "quaternions without unit length"
    elif (command := own.get("command")) is not None:
        low, high = np.array(robot.command_ranges).T
        slack = _TOLERANCE * (high - low)
        if ((command < low - slack) | (command > high + slack)).any():
            problem = "commands outside their ranges"
    if problem is not None:
        raise InputError(f"{path}: rollout {name!r} has {problem}; {_MEND}.")
    return StoredRollout(
        name=name,
        description=robot,
        robot=str(own.get("robot", "")),
        time=time,
        qpos=qpos,
        command=own.get("command"),
        force=own.get("force"),
    )
