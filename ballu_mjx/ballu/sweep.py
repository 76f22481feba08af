"""Actuator sweeps: the relation between commands and joint angles in suspended recordings.

A sweep holds one pair of commands after another, each until the joints have settled. Identification uses its settled
angles (the paper's data, section "System Identification") and its whole motion.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from ballu_mjx.ballu.model import SIDES
from ballu_mjx.ballu.recordings import knee, motor
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.filters import mean_command
from ballu_mjx.recordings.recording import Recording

LEVELS = 20
"""Smallest number of command levels of a sweep (paper)."""
SAMPLE_TIMESTEP = 0.01
"""Time (s) between two samples of the motion."""
SHORTEST_HOLD = 0.6
"""Shortest time (s) for which each command must be held."""
_SETTLED_SECONDS = 0.5
"""Longest window (s) at the end of a hold over which settled angles are averaged."""
_SETTLED_WITHIN = float(np.deg2rad(0.5))
"""Drift (rad) within this window above which a joint creeps."""
_MOVING = float(np.deg2rad(2.0))
"""Drift (rad) above which a joint still moves, so that the hold does not show its settled angle."""
_SAME_LEVEL = 0.005
"""Largest difference of neighbouring commands that count as the same level."""
_REACHES = (0.1, 0.9)
"""Upper bound of the lowest command of a sweep, and lower bound of the highest."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sweep:
    """Joint angles (rad) of one or more suspended recordings of a robot, by hold.

    The last two axes of angles are (motor, knee) and (left, right).
    """

    robot: str
    """Name of the robot in its recordings."""
    command: Float[np.ndarray, "holds 2"]
    """Commands (left, right) of each hold."""
    settled: Float[np.ndarray, "holds 2 2"]
    """Settled angles (rad): means over a window at the end of each hold."""
    drift: Float[np.ndarray, "holds 2 2"]
    """Mean angle (rad) over the second half of this window, minus the mean over its first half."""
    samples: Int[np.ndarray, " holds"]
    """Number of samples in this window."""
    motion: Float[np.ndarray, "times 2 2"]
    """All angles (rad), every `SAMPLE_TIMESTEP`, one recording after the other."""
    commanded: Float[np.ndarray, "times 2"]
    """Mean command (left, right) from each of these times to the next. A command may change in between."""
    hold: Int[np.ndarray, " times"]
    """Index of the hold at each of these times."""
    begins: Bool[np.ndarray, " times"]
    """Whether a recording begins at a time. Earlier times then have no influence on later ones."""

    def means(self, motion: Float[np.ndarray, "times 2 2"]) -> Float[np.ndarray, "holds 2 2"]:
        """Return the mean angles (rad) at the end of each hold, of a motion at the same times as this one."""
        count = min(round(_SETTLED_SECONDS / SAMPLE_TIMESTEP), int(np.bincount(self.hold).min()) // 3)
        return np.array([motion[self.hold == hold][-count:].mean(axis=0) for hold in range(len(self.command))])

    @property
    def creep(self) -> str | None:
        """Return a sentence about the holds that end with a joint that still creeps, or None if no hold does."""
        drift = np.abs(self.drift)
        creeping = int(np.sum(drift.max(axis=(1, 2)) > _SETTLED_WITHIN))
        if not creeping:
            return None
        joint, side = np.unravel_index(int(np.argmax(drift.max(axis=0))), (2, 2))
        name = f"{('motor', 'knee')[joint]}_{SIDES[side]}"
        return (
            f"{creeping} of {len(drift)} holds end with a joint that still creeps, by up to "
            f"{np.rad2deg(drift.max()):.1f} deg ({name}). Their settled angles have a lower weight; the motion "
            "has its full weight."
        )

    def settled_without(self, left_out: Sequence[int]) -> Sweep:
        """Return a sweep with the settled angles of all holds except those in `left_out`, and without motion."""
        kept = np.setdiff1d(np.arange(len(self.command)), left_out)
        settled = {name: getattr(self, name)[kept] for name in ("command", "settled", "drift", "samples")}
        motion = {name: getattr(self, name)[:0] for name in ("motion", "commanded", "hold", "begins")}
        return dataclasses.replace(self, **settled, **motion)


def read_sweep(recordings: Mapping[Path, Recording], *, levels: int = LEVELS) -> Sweep:
    """Return the sweep in one or more suspended recordings of one robot.

    The legs may be swept together or one after the other.

    **Arguments**

    - `recordings`: the recordings, by the file that error messages name.
    - `levels`: smallest number of command levels of each leg.

    **Raises** `InputError` for recordings that are valid but are not a usable sweep:

    - They are of another kind, or of several robots.
    - The command of a leg never changes, has too few levels, or its levels do not span [0, 1].
    - A hold is too short, or a joint still moves by more than 2 deg at its end. Slower creep is accepted; see
      `Sweep.creep`.
    """
    names = ", ".join(str(path) for path in recordings)
    robots = sorted({recording.robot for recording in recordings.values()})
    if len(robots) > 1:
        raise InputError(f"{names}: recordings of several robots ({', '.join(robots)}); identify one at a time.")
    parts: list[tuple[np.ndarray, ...]] = []
    for path, recording in recordings.items():
        if recording.kind != "suspended":
            raise InputError(
                f"{path}: this is a {recording.kind} recording; actuators are identified from suspended ones (feet off "
                'the ground, "kind": "suspended").'
            )
        parts.append(_holds(path, recording))
    firsts = np.cumsum([0] + [len(part[0]) for part in parts])
    joined = [np.concatenate([part[i] for part in parts]) for i in range(6)]
    command, settled, drift, samples, motion, commanded = joined
    hold = np.concatenate([part[6] + first for part, first in zip(parts, firsts, strict=False)])
    begins = np.concatenate([np.arange(len(part[6])) == 0 for part in parts])
    for index, side in enumerate(SIDES):
        _check_levels(names, side, command[:, index], levels)
    return Sweep(robots[0], command, settled, drift, samples, motion, commanded, hold, begins)


def _check_levels(names: str, side: str, command: Float[np.ndarray, " holds"], levels: int) -> None:
    """Refuse commands of a leg with too few levels, or with levels that do not span [0, 1]."""
    ordered = np.sort(command)
    count = 1 + int(np.sum(np.diff(ordered) > _SAME_LEVEL))
    if count == 1:
        raise InputError(
            f"{names}: command_{side} stays at {ordered[0]:g}: the {side} leg was not swept; add a recording in which "
            "this leg is swept."
        )
    if count < levels:
        raise InputError(
            f"{names}: there are {count} levels of command_{side}; {levels} spread over [0, 1] are needed (--levels "
            f"{count} accepts these, with larger standard errors)."
        )
    if ordered[0] > _REACHES[0] or ordered[-1] < _REACHES[1]:
        raise InputError(
            f"{names}: command_{side} goes from {ordered[0]:.2f} to {ordered[-1]:.2f}; spread the levels over [0, 1]."
        )


def _holds(path: Path, recording: Recording) -> tuple[np.ndarray, ...]:
    """Return the command, settled angles, drift and number of samples of each hold, the motion, its mean commands, and
    its hold indices.

    All are those of one recording, in the order of the fields of `Sweep`.
    """
    motors, knees = motor(recording), knee(recording)
    assert motors is not None and knees is not None  # mandatory in suspended recordings
    time, angles = recording.time, np.stack([motors, knees], axis=1)
    changes = 1 + np.flatnonzero(np.any(np.abs(np.diff(recording.command, axis=0)) > 1e-9, axis=1))
    starts, ends = np.concatenate([[0], changes]), np.concatenate([changes, [len(time)]])
    durations = time[ends - 1] - time[starts]
    if durations.min() < SHORTEST_HOLD:
        place = int(np.argmin(durations))
        raise InputError(
            f"{path}: the command at {time[starts[place]]:.2f} s is held for {durations[place]:.2f} s only; hold each "
            f"command until the joints settle, for {SHORTEST_HOLD:g} s or more (2 s is good)."
        )
    settled_seconds = min(_SETTLED_SECONDS, durations.min() / 3)
    settled, drifts, samples = [], [], []
    for start, end in zip(starts, ends, strict=True):
        window = angles[start:end][time[start:end] > time[end - 1] - settled_seconds]
        half = len(window) // 2
        drift = window[half:].mean(axis=0) - window[:half].mean(axis=0)
        if np.abs(drift).max() > _MOVING:
            raise InputError(
                f"{path}: a joint still moves by {np.rad2deg(np.abs(drift).max()):.1f} deg at the end of the hold from "
                f"{time[start]:.2f} s; hold each command for longer."
            )
        settled.append(window.mean(axis=0))
        drifts.append(drift)
        samples.append(len(window))
    grid = np.arange(time[0], time[-1] + 1e-9, SAMPLE_TIMESTEP)
    flat = angles.reshape(len(time), 4)
    motion = np.stack([np.interp(grid, time, column) for column in flat.T], axis=1).reshape(-1, 2, 2)
    commanded = np.concatenate([mean_command(recording, grid - time[0]), recording.command[-1:]])
    hold = np.searchsorted(time[starts], grid + 1e-9, side="right") - 1
    command = recording.command[starts]
    return command, np.array(settled), np.array(drifts), np.array(samples), motion, commanded, hold
