"""Recordings of a residual's training: their choice, their check, and the reconstruction of their states."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence, Set
from pathlib import Path

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import shortest_recording
from ballu_mjx.identification.actuators import AUTO, NOMINAL, find_actuators, read_actuators
from ballu_mjx.recordings.csv_format import list_recordings, read_recording
from ballu_mjx.recordings.load import bundled_recordings
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
from ballu_mjx.recordings.recording import Recording, Split
from ballu_mjx.recordings.recording_groups import group_of
from ballu_mjx.recordings.validation import TIME_TOLERANCE
from ballu_mjx.residuals.run_config import find_recordings, run_actuators
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, same_parameters
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import read_config
from ballu_mjx.sim.simulator import Simulator

USES: tuple[Split, ...] = ("training", "validation", "test")
"""Uses of recordings."""
QUICK_RECORDINGS = 2
"""Largest number of recordings for each use with `--quick`."""


@dataclasses.dataclass(frozen=True)
class RecordingsData(loggers.LoggingOptions):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of recordings."""

    recordings: tuple[Path, ...] = ()
    """Recordings to learn from. Without this option: the bundled recordings, also for validation and test."""
    validation: tuple[Path, ...] = ()
    """Recordings that measure progress and choose the best checkpoint. Without this option: those of --recordings, if
    given."""
    test: tuple[Path, ...] = ()
    """Recordings for the final table. Without this option: those for validation, if --recordings is given."""
    robot: str | None = None
    """Robot of the recordings: the name of a bundled robot, or the file of a robot's description (docs/own_robot.md).
    Without this option: the robot of --resume or --residual, if given, or else ballu."""
    actuators: Path = AUTO
    """File of identified actuators (`train sysid` writes it), nominal, or auto. auto looks for actuators.json of the
    same robot beside the recordings or in the folder above. It takes these or the nominal actuators, whichever replay
    the validation recordings better. With --resume, auto takes the actuators of the run."""
    output: Path | None = None
    """Folder of the run, new or empty. Without this option: a new folder under runs/, named after the time."""
    quick: bool = False
    """Run everything within two minutes, on a few recordings. The resulting numbers mean little."""


@dataclasses.dataclass(frozen=True)
class ResidualDataset:
    """Recordings from which a residual is learned and on which it is measured, with robot and actuators.

    **Fields**

    - `files`: files of the recordings, by use (`USES`).
    - `recordings`: the recordings, by use.
    - `identified`: identified actuators of the simulator. None for nominal actuators.
    - `robot`: the robot of the recordings.
    """

    files: Mapping[str, list[Path]]
    recordings: Mapping[str, list[Recording]]
    identified: ModelParameters | None
    where: str
    """Source of the actuators, as text for the user."""
    robot: RobotDescription
    undecided: bool = False
    """Whether the user leaves the choice of actuators open. Those of an earlier run are then taken or, without one, the
    better of identified and nominal ones."""

    def with_actuators(self, identified: ModelParameters | None, where: str) -> ResidualDataset:
        """Return the dataset with actuators that are decided on (None for nominal ones). `where` names their source."""
        return dataclasses.replace(self, identified=identified, where=where, undecided=False)

    @staticmethod
    def read(data: RecordingsData, robot: RobotDescription, earlier: Path | None = None) -> ResidualDataset:
        """Find, read and check recordings and actuators, so that faults appear before the training.

        `earlier` is the run that is resumed. None for a new run.

        **Raises** `InputError` for recordings or actuators that cannot be used. The message names them.
        """
        files = _choose(data, robot, earlier)
        recordings = _read(files, robot)
        found = _actuators(data, earlier, files["training"], recordings["training"], robot)
        undecided = data.actuators == AUTO and earlier is None
        return ResidualDataset(files, recordings, *found, robot, undecided)

    def check_learned_with(self, learned_with: ModelParameters | None, run: Path) -> None:
        """Check that the residual of `run` was learned with the actuators of this dataset.

        **Raises** `InputError` if it was not.
        """
        if not same_parameters(learned_with, self.identified):
            raise InputError(
                f"{run}: was learned with other actuators than {self.where}; give the same actuators by --actuators."
            )

    @property
    def one_set(self) -> bool:
        """Return whether test and validation recordings are the same."""
        return self._same("test", "validation")

    @property
    def reused(self) -> list[str]:
        """Return a warning for each use with the same recordings as an earlier use."""
        warnings = []
        if self._same("validation", "training"):
            warnings.append(
                "Validation is on the training recordings: it will not show how well the residual generalizes."
            )
        if self._same("test", "training"):
            warnings.append(
                "The test is on the training recordings: it will not show how well the residual generalizes."
            )
        elif self.one_set:
            warnings.append("The test is on the validation recordings, which choose the checkpoint: expect low errors.")
        return warnings

    @property
    def replayed(self) -> str:
        """Return the title of the final table, which names its recordings."""
        places = {use: {path.resolve() for path in paths} for use, paths in self.files.items()}
        return replay_title(places["test"], places["validation"], places["training"], "the test recordings")

    def _same(self, one: str, other: str) -> bool:
        first, second = ({path.resolve() for path in self.files[use]} for use in (one, other))
        return first == second

    def reconstruct(self, simulator: Simulator) -> dict[str, list[Motion]]:
        """Return the motions of all recordings, by use. Uses of the same files share one list."""
        motions: dict[str, list[Motion]] = {}
        for use in USES:
            same = next((other for other in motions if self.files[other] == self.files[use]), None)
            if same is not None:
                motions[use] = motions[same]
            else:
                motions[use] = [reconstruct_for_simulator(each, simulator) for each in self.recordings[use]]
        return motions


def _choose(data: RecordingsData, robot: RobotDescription, earlier: Path | None) -> dict[str, list[Path]]:
    """Return the files of the recordings, by use."""
    own = dict(zip(USES, (data.recordings, data.validation, data.test), strict=True))
    files = {use: list_recordings(paths) for use, paths in own.items() if paths}
    if earlier is not None:
        config = read_config(earlier, "envmimic")
        options = {use: "--recordings" if use == "training" else f"--{use}" for use in USES if use not in files}
        files = {use: find_recordings(config, use, earlier, option) for use, option in options.items()} | files
    elif data.recordings:
        files.setdefault("validation", files["training"])
        files.setdefault("test", files["validation"])
    else:
        files = {use: bundled_recordings(use, robot) for use in USES if use not in files} | files
    if data.quick:
        few = files["training"][:QUICK_RECORDINGS]
        on_training = files["validation"] == files["training"]
        validation = few if on_training else _one_per_group(files["validation"])
        # Bundled recordings: one set for validation and test, because a second set needs a second compilation.
        test = _one_per_group(files["test"]) if data.test else validation
        files = {"training": few, "validation": validation, "test": test}
    return files


def _actuators(
    data: RecordingsData,
    earlier: Path | None,
    files: Sequence[Path],
    recordings: Sequence[Recording],
    description: RobotDescription,
) -> tuple[ModelParameters | None, str]:
    """Return the identified actuators (None for nominal ones), and their source as text for the user."""
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
        return None, "nominal (the robot has no actuators.json beside the recordings; `train sysid` writes one)"
    robot, identified = read_actuators(description, path)
    if robots != {robot}:
        raise InputError(
            f"{path}: these are the actuators of {robot!r}, but the recordings are of {', '.join(sorted(robots))}; "
            "give the actuators of the same robot, or --actuators nominal."
        )
    return identified, str(path)


def _one_per_group(paths: Sequence[Path]) -> list[Path]:
    """Return the first recording of each group, at most `QUICK_RECORDINGS`."""
    first = {group_of(path.name): path for path in reversed(paths)}
    return sorted(first.values())[:QUICK_RECORDINGS]


def _read(files: Mapping[str, Sequence[Path]], description: RobotDescription) -> dict[str, list[Recording]]:
    """Read all recordings, check them for their use, and return them by use."""
    check_overlap(files)
    read = {path: read_recording(path, description) for paths in files.values() for path in paths}
    for path, recording in read.items():
        check_recording(path, recording, description, long_enough=path in files["validation"] or path in files["test"])
    return {use: [read[path] for path in paths] for use, paths in files.items()}


def replay_title(replayed: Set[object], validation: Set[object], training: Set[object], otherwise: str) -> str:
    """Return the title of a table of open-loop replays. It warns of recordings that training or validation used.

    **Arguments**

    - `replayed`, `validation`, `training`: identifiers of the recordings, such as paths or hashes.
    - `otherwise`: name of the replayed recordings if neither use has exactly the same ones.
    """
    if replayed == training:
        what = "the training recordings (the residual was learned from them)"
    elif replayed == validation:
        what = "the validation recordings (they chose the checkpoint)"
    else:
        what = otherwise
        for use, done in ((training, "the residual was learned from them"), (validation, "they chose the checkpoint")):
            if replayed & use:
                what += f" ({len(replayed & use)} of {len(replayed)} are not new: {done})"
    return f"Open-loop replay of {what}"


def check_overlap(files: Mapping[str, Sequence[Path]]) -> None:
    """Check that two uses share all of their recordings or none.

    **Raises** `InputError` if they share only some. The message names one of them.
    """
    places = {use: {path.resolve(): path for path in paths} for use, paths in files.items()}
    for one, other in itertools.combinations(USES, 2):
        shared = places[one].keys() & places[other].keys()
        if shared and places[one].keys() != places[other].keys():
            path = min(places[other][place] for place in shared)
            raise InputError(f"{path}: is among the {one} and the {other} recordings; take it out of one of them.")


def check_recording(path: Path, recording: Recording, robot: RobotDescription, *, long_enough: bool) -> None:
    """Check that a residual can be learned from a recording and, with `long_enough`, evaluated on it.

    **Raises** `InputError` if the recording is not free, or too short for an evaluation.
    """
    if recording.kind != "free":
        raise InputError(
            f"{path}: is a {recording.kind} recording; residuals need free recordings, which contain the pose of "
            f"{robot.tracked}. Leave it out."
        )
    shortest = shortest_recording(robot)
    duration = recording.time[-1] - recording.time[0]
    if long_enough and duration < shortest * (1 - TIME_TOLERANCE):
        raise InputError(
            f"{path}: lasts {duration:.1f} s; validation and test need {shortest:g} s or more, use it for training."
        )
