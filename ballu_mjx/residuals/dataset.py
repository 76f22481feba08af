"""Recordings for a residual: which, read and found fit, and the simulator's states in them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.errors_table import base_name
from ballu_mjx.recordings.csv_format import list_bundled, list_recordings, read_recording
from ballu_mjx.recordings.groups import group_of
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.residuals.run_config import find_recordings, run_actuators
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, same_parameters
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import read_config

if TYPE_CHECKING:
    from ballu_mjx.recordings.recording import Recording


USES = ("training", "validation", "test")
QUICK_RECORDINGS = 2
"""Recordings of each kind that `--quick` reads."""


@dataclasses.dataclass(frozen=True)
class RecordingsData(loggers.LoggingOptions):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    recordings: tuple[Path, ...] = ()
    """Recordings to learn from. Without this option: the bundled ones, for validation and test too."""
    validation: tuple[Path, ...] = ()
    """Recordings that measure progress and choose the best checkpoint. Without this option, where --recordings are
    your own: those."""
    test: tuple[Path, ...] = ()
    """Recordings for the final table. Without this option, where --recordings are your own: those for validation."""
    actuators: Path | None = None
    """File of identified actuators (`train sysid` writes it), or the word nominal. Without this option: actuators.json
    beside the recordings or in the folder above, if it names their robot; else nominal."""
    output: Path | None = None
    """Folder of the run, new or empty. Without this option: one under runs/, named after the time."""
    quick: bool = False
    """See everything work within two minutes, on a few recordings; the numbers mean little."""


@dataclasses.dataclass(frozen=True)
class ResidualDataset:
    """What a residual is learned from and measured on.

    **Fields**

    - `files`, `recordings`: by use, a key of `USES`.
    - `identified`: the simulator's actuators (None: nominal).
    - `robot`: whose recordings they are.
    """

    files: Mapping[str, list[Path]]
    recordings: Mapping[str, list[Recording]]
    identified: ModelParameters | None
    where: str
    """Where the actuators come from, for the user to read."""
    robot: RobotDescription

    @staticmethod
    def read(
        data: RecordingsData, earlier: Path | None = None, description: RobotDescription | None = None
    ) -> ResidualDataset:
        """Find and read everything, so that nothing wrong with it comes up later; `earlier` is the run that goes on,
        `description` the robot (None: BALLU).

        **Raises** `InputError` for recordings or actuators that cannot be used, naming them.
        """
        description = description or load_robot()
        files = _choose(data, earlier)
        recordings = _read(files, description)
        found = _actuators(data, earlier, files["training"], recordings["training"], description)
        return ResidualDataset(files, recordings, *found, description)

    @property
    def base(self) -> str:
        """What the simulator without residual is called."""
        return base_name(self.identified is not None)

    def check_beside(self, learned_with: ModelParameters | None, run: Path | None) -> None:
        """**Raises** `InputError` where the residual of `run` was learned beside other actuators than these."""
        if not same_parameters(learned_with, self.identified):
            raise InputError(f"{run}: was learned beside other actuators than {self.where}; give --actuators the same.")

    @property
    def one_set(self) -> bool:
        """Whether test and validation are the same recordings."""
        return self.files["test"] == self.files["validation"]

    def announce(self, folder: Path, quick: bool) -> None:
        """Tell the user what will be used for what."""
        print(f"Run folder: {folder}")
        for use in USES:
            print(f"  {use}: {', '.join(recording.name for recording in self.recordings[use])}")
        print(f"  actuators: {self.where}")
        if self.files["validation"] == self.files["training"]:
            print("  Validation is on the training recordings: it will not show how well the residual generalizes.")
        if quick:
            print("  --quick: sizes so small that the numbers mean little.")

    def reconstruct(self, model: mujoco.MjModel) -> dict[str, list[Motion]]:
        """States at the control rate, by use."""
        print("Reconstructing the recorded states ...", flush=True)
        return {use: [reconstruct(each, model, self.robot) for each in self.recordings[use]] for use in USES}

    def load_model(self) -> mujoco.MjModel:
        """The robot with these actuators."""
        return self.robot.load_model(self.identified)


def _choose(data: RecordingsData, earlier: Path | None) -> dict[str, list[Path]]:
    """The files for each use."""
    own = dict(zip(USES, (data.recordings, data.validation, data.test), strict=True))
    files = {use: list_recordings(paths) for use, paths in own.items() if paths}
    if earlier is not None:
        config = read_config(earlier, "envmimic")
        files = {use: find_recordings(config, use, earlier) for use in USES if use not in files} | files
    elif data.recordings:
        files.setdefault("validation", files["training"])
        files.setdefault("test", files["validation"])
    else:
        files = {use: list_bundled(use) for use in USES if use not in files} | files
    if data.quick:
        few = files["training"][:QUICK_RECORDINGS]
        on_training = files["validation"] == files["training"]
        files = {"training": few, "validation": few if on_training else _one_a_group(files["validation"])}
        files["test"] = files["validation"]  # a second set would be a second program to compile
    return files


def _actuators(
    data: RecordingsData,
    earlier: Path | None,
    files: Sequence[Path],
    recordings: Sequence[Recording],
    description: RobotDescription,
) -> tuple[ModelParameters | None, str]:
    """The simulator's actuators (None: nominal), and where they come from, for the user to read."""
    if data.actuators is None and earlier is not None:
        identified = run_actuators(read_config(earlier, "envmimic"), earlier, description)
        return identified, f"{'nominal' if identified is None else 'identified'}, as before"
    if data.actuators == Path("nominal"):
        return None, "nominal"
    robots = {recording.robot for recording in recordings}
    path = data.actuators
    if path is None and len(robots) == 1:
        path = description.adapter.find_actuators(files, next(iter(robots)))
    if path is None:
        return None, "nominal (the recordings' robot has no actuators.json; `train sysid` identifies one from a sweep)"
    robot, identified = description.adapter.read_actuators(description, path)
    if robots != {robot}:
        raise InputError(
            f"{path}: these are the actuators of {robot!r}, the recordings are of {', '.join(sorted(robots))}; give "
            "the file of the same robot, or --actuators nominal."
        )
    return identified, str(path)


def _one_a_group(paths: Sequence[Path]) -> list[Path]:
    first = {group_of(path.name): path for path in reversed(paths)}
    return sorted(first.values())[:QUICK_RECORDINGS]


def _read(files: Mapping[str, Sequence[Path]], description: RobotDescription) -> dict[str, list[Recording]]:
    """All recordings, read and found fit for their use."""
    seen = {path.resolve() for path in files["training"]}
    for use in ("validation", "test"):
        for path in files[use]:
            if path.resolve() in seen and files[use] != files["training"]:
                raise InputError(f"{path}: is among the training and the {use} recordings; take it out of one of them.")
    read = {path: read_recording(path, description) for paths in files.values() for path in paths}
    for path, recording in read.items():
        check_recording(path, recording, long_enough=path in files["validation"] or path in files["test"])
    return {use: [read[path] for path in paths] for use, paths in files.items()}


def check_recording(path: Path, recording: Recording, *, long_enough: bool) -> None:
    """Refuse, with an `InputError`, a recording that EnvMimic cannot use: `long_enough` for an evaluation or not."""
    from ballu_mjx.evaluation.errors_table import SCORE_HORIZONS

    if recording.kind != "free":
        raise InputError(f"{path}: is a {recording.kind} recording; EnvMimic takes free ones only, leave it out.")
    shortest = min(SCORE_HORIZONS) + 0.5
    duration = recording.time[-1] - recording.time[0]
    if long_enough and duration < shortest:
        raise InputError(
            f"{path}: lasts {duration:.1f} s; validation and test need {shortest:g} s or more, use it for training."
        )
