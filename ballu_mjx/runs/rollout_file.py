"""What the robot did, kept for looking at: `replay.npz` in a run's folder, format `ballu-replay/1`.

An archive of NumPy arrays without pickled objects. `format` and `names` (one a take) are strings; the arrays of take
number i are `i/time`, `i/qpos/NAME` for each of its robots (a key of `style.COLOURS`: `recording`, or a simulator),
and where they are known `i/command` and `i/force`; `i/robot` says which robot was recorded.
"""

from __future__ import annotations

import dataclasses
import io
import textwrap
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError

ROLLOUT_FORMAT = "ballu-replay/1"
ROLLOUT_FILE = "replay.npz"

_MEND = "python -m ballu_mjx evaluate RUN --output RUN writes it anew"
_COORDINATES = 14
_TOLERANCE = 0.02
"""Of a quaternion's length."""
_LARGEST = 1e6
"""m, rad and s; what is beyond is no motion."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StoredRollout:
    """Robots that start alike and get the same commands, or one alone, at the control rate. SI units, radians."""

    name: str
    """The recording's, or the task's."""
    robot: str = ""
    """Which robot was recorded, where one was."""
    time: Float[np.ndarray, " states"]
    """s, of the recording."""
    qpos: Mapping[str, Float[np.ndarray, "states nq"]]
    """MuJoCo's generalized positions of each robot, by its name."""
    command: Float[np.ndarray, "steps 2"] | None = None
    """Servo commands (left, right), from each state to the next; one fewer than states."""
    force: Float[np.ndarray, "steps 3"] | None = None
    """Residual force (N, world) on the balloon of the robot with a residual, likewise."""


def write_rollouts(path: Path, takes: Sequence[StoredRollout]) -> None:
    """Write takes in single precision, compressed."""
    arrays: dict[str, np.ndarray] = {
        "format": np.array(ROLLOUT_FORMAT),
        "names": np.array([take.name for take in takes], str),
    }
    for index, take in enumerate(takes):
        arrays[f"{index}/robot"] = np.array(take.robot)
        arrays[f"{index}/time"] = take.time
        arrays |= {f"{index}/qpos/{name}": qpos for name, qpos in take.qpos.items()}
        arrays |= {
            f"{index}/{name}": value for name in ("command", "force") if (value := getattr(take, name)) is not None
        }
    single = {name: a.astype(np.float32) if a.dtype.kind == "f" else a for name, a in arrays.items()}
    archive = io.BytesIO()
    np.savez_compressed(archive, **single)  # pyright: ignore[reportArgumentType]
    files.write(path, archive.getvalue())


def read_rollouts(path: Path) -> list[StoredRollout]:
    """The takes in a file.

    **Raises** `InputError` where it is none of the format, damaged, or holds pickled objects, which are never loaded.
    """
    if not path.exists():
        raise InputError(f"{path}: there is no replay; {_MEND}.")
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > files.LARGEST:
                raise ValueError(f"more than {files.LARGEST >> 20} MiB")
            arrays = {name.removesuffix(".npy"): _array(archive.read(name)) for name in archive.namelist()}
    except Exception as error:  # what unpacking and NumPy make of damage is of many kinds
        said = textwrap.shorten(str(error), 80) or type(error).__name__
        raise InputError(f"{path}: is no archive of plain arrays ({said}); {_MEND}.") from None
    found = arrays.pop("format", None)
    if found is None or str(found) != ROLLOUT_FORMAT:
        raise InputError(f"{path}: is not of the format {ROLLOUT_FORMAT}; {_MEND}.")
    names = arrays.pop("names", np.array([], str))
    return [_take(path, str(name), f"{index}/", arrays) for index, name in enumerate(names.ravel())]


def _array(content: bytes) -> np.ndarray:
    return np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)


def _take(path: Path, name: str, prefix: str, arrays: Mapping[str, np.ndarray]) -> StoredRollout:
    own = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
    qpos = {key.removeprefix("qpos/"): value for key, value in own.items() if key.startswith("qpos/")}
    time = own.get("time")
    states = 0 if time is None else len(np.atleast_1d(time))
    shapes = {"time": (states,), "command": (states - 1, 2), "force": (states - 1, 3)}
    shapes |= {f"qpos/{robot}": (states, _COORDINATES) for robot in qpos}
    for key, shape in shapes.items():
        value = own.get(key)
        if value is None and key in ("command", "force"):
            continue
        if value is None or value.dtype.kind != "f" or value.shape != shape or not (np.abs(value) < _LARGEST).all():
            raise InputError(f"{path}: {prefix}{key} is not an array of {shape} finite numbers; {_MEND}.")
    if time is None or states < 2 or not qpos:
        raise InputError(f"{path}: take {name!r} has no robot, or less than two states; {_MEND}.")
    command = own.get("command", np.zeros(0))
    turns = [np.linalg.norm(value[:, 3:7], axis=1) for value in qpos.values()]
    if (
        not (np.diff(time) > 0).all()
        or ((command < 0) | (command > 1)).any()
        or max(np.abs(turn - 1).max() for turn in turns) > _TOLERANCE
    ):
        raise InputError(
            f"{path}: take {name!r} has times that run back, commands outside of 0 to 1, or quaternions that are none; "
            f"{_MEND}."
        )
    return StoredRollout(
        name=name,
        robot=str(own.get("robot", "")),
        time=time,
        qpos=qpos,
        command=own.get("command"),
        force=own.get("force"),
    )
