"""Recordings for a residual: which, read and found fit, and the simulator's states in them."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.errors import shortest_recording
from ballu_mjx.identification.actuators import AUTO, NOMINAL, find_actuators, read_actuators
from ballu_mjx.recordings.csv_format import list_recordings, read_recording
from ballu_mjx.recordings.groups import group_of
from ballu_mjx.recordings.load import bundled_recordings
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording, Split
from ballu_mjx.residuals.run_config import find_recordings, run_actuators
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, same_parameters
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import read_config
from ballu_mjx.sim.simulator import Simulator

USES: tuple[Split, ...] = ("training", "validation", "test")
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
    robot: str | None = None
    """Whose recordings these are: the name of a robot that comes with the package, or the file of a description
    (docs/own_robot.md). Without this option: the robot of --resume or --residual, where given, or else ballu."""
    actuators: Path = AUTO
    """File of identified actuators (`train sysid` writes it), or the word nominal, or auto: of actuators.json beside
    the recordings or in the folder above, if it names their robot, and nominal ones, those that replay the validation
    recordings better. With --resume, auto: the run's."""
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
    undecided: bool = False
    """Whether the better ones of the identified and the nominal actuators are to be taken."""

    def with_actuators(self, identified: ModelParameters | None, where: str) -> ResidualDataset:
        """Return the same with actuators that are decided on (None: nominal), and where they come from."""
        return dataclasses.replace(self, identified=identified, where=where, undecided=False)

    @staticmethod
    def read(data: RecordingsData, robot: RobotDescription, earlier: Path | None = None) -> ResidualDataset:
        """Find and read everything, so that nothing wrong with it comes up later; `earlier` is the run that goes on.

        **Raises** `InputError` for recordings or actuators that cannot be used, naming them.
        """
        files = _choose(data, robot, earlier)
        recordings = _read(files, robot)
        found = _actuators(data, earlier, files["training"], recordings["training"], robot)
        undecided = data.actuators == AUTO and earlier is None and found[0] is not None
        return ResidualDataset(files, recordings, *found, robot, undecided)

    def check_base_residual(self, learned_with: ModelParameters | None, run: Path | None) -> None:
        """**Raises** `InputError` where the base residual, of `run`, was learned with other actuators than these."""
        if not same_parameters(learned_with, self.identified):
            raise InputError(f"{run}: was learned with other actuators than {self.where}; give --actuators the same.")

    @property
    def one_set(self) -> bool:
        """Whether test and validation are the same recordings."""
        return self._same("test", "validation")

    @property
    def reused(self) -> list[str]:
        """Return a sentence for each use whose recordings serve an earlier one too."""
        said = []
        if self._same("validation", "training"):
            said.append("Validation is on the training recordings: it will not show how well the residual generalizes.")
        if self._same("test", "training"):
            said.append("The test is on the training recordings: it will not show how well the residual generalizes.")
        elif self.one_set:
            said.append("The test is on the validation recordings, which make the choices: expect low errors.")
        return said

    @property
    def replayed(self) -> str:
        """Return what the final table is of, in words."""
        if self._same("test", "training"):
            return "Open-loop replay of the training recordings (they were learned from)"
        if self.one_set:
            return "Open-loop replay of the validation recordings (they chose the checkpoint)"
        return "Open-loop replay of the test recordings"

    def _same(self, one: str, other: str) -> bool:
        first, second = ({path.resolve() for path in self.files[use]} for use in (one, other))
        return first == second

    def reconstruct(self, simulator: Simulator) -> dict[str, list[Motion]]:
        """Return states of the simulator's robot at the control rate, by use; uses of the same files share a list."""
        motions: dict[str, list[Motion]] = {}
        for use in USES:
            same = next((other for other in motions if self.files[other] == self.files[use]), None)
            if same is not None:
                motions[use] = motions[same]
            else:
                motions[use] = [
                    reconstruct(each, self.robot, simulator.mj_model, drivetrain=simulator.drivetrain)
                    for each in self.recordings[use]
                ]
        return motions


def _choose(data: RecordingsData, robot: RobotDescription, earlier: Path | None) -> dict[str, list[Path]]:
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
        files = {use: bundled_recordings(use, robot) for use in USES if use not in files} | files
    if data.quick:
        few = files["training"][:QUICK_RECORDINGS]
        on_training = files["validation"] == files["training"]
        validation = few if on_training else _one_a_group(files["validation"])
        # Of bundled recordings a second set would be a second program to compile.
        test = _one_a_group(files["test"]) if data.test else validation
        files = {"training": few, "validation": validation, "test": test}
    return files


def _actuators(
    data: RecordingsData,
    earlier: Path | None,
    files: Sequence[Path],
    recordings: Sequence[Recording],
    description: RobotDescription,
) -> tuple[ModelParameters | None, str]:
    """The simulator's actuators (None: nominal), and where they come from, for the user to read."""
    if data.actuators == AUTO and earlier is not None:
        identified = run_actuators(read_config(earlier, "envmimic"), earlier, description)
        return identified, f"{'nominal' if identified is None else 'identified'}, as before"
    if data.actuators == NOMINAL:
        return None, "nominal"
    robots = {recording.robot for recording in recordings}
    path: Path | None = data.actuators
    if path == AUTO:
        path = find_actuators(description, files, next(iter(robots))) if len(robots) == 1 else None
    if path is None:
        return None, "nominal (the recordings' robot has no actuators.json; `train sysid` identifies one from a sweep)"
    robot, identified = read_actuators(description, path)
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
    check_overlap(files)
    read = {path: read_recording(path, description) for paths in files.values() for path in paths}
    for path, recording in read.items():
        check_recording(path, recording, description, long_enough=path in files["validation"] or path in files["test"])
    return {use: [read[path] for path in paths] for use, paths in files.items()}


def check_overlap(files: Mapping[str, Sequence[Path]]) -> None:
    """**Raises** `InputError` where two uses share some of their recordings, but not all."""
    places = {use: {path.resolve(): path for path in paths} for use, paths in files.items()}
    for one, other in itertools.combinations(USES, 2):
        shared = places[one].keys() & places[other].keys()
        if shared and places[one].keys() != places[other].keys():
            path = min(places[other][place] for place in shared)
            raise InputError(f"{path}: is among the {one} and the {other} recordings; take it out of one of them.")


def check_recording(path: Path, recording: Recording, robot: RobotDescription, *, long_enough: bool) -> None:
    """Refuse, with an `InputError`, a recording that EnvMimic cannot use: `long_enough` for an evaluation or not."""
    if recording.kind != "free":
        raise InputError(f"{path}: is a {recording.kind} recording; EnvMimic takes free ones only, leave it out.")
    shortest = shortest_recording(robot.horizons)
    duration = recording.time[-1] - recording.time[0]
    if long_enough and duration < shortest:
        raise InputError(
            f"{path}: lasts {duration:.1f} s; validation and test need {shortest:g} s or more, use it for training."
        )
