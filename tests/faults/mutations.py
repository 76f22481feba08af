"""Give every reader files with many kinds of damage, and count the outcomes.

    python tests/faults/mutations.py --files 10000

A reader must refuse a damaged file by one sentence that names it, or return content that is valid for its format.
Readers are called in this process, and stopped after a time limit. Checkpoints, which
are restored from the disk, get fewer files than other formats.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import gzip
import io
import json
import math
import re
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from ballu_mjx.common import runtime
from ballu_mjx.common.errors import InputError

OUTCOMES = ("refused", "accepted", "nonsense", "crashed", "hung")
LONGEST = 10.0
"""Time (s) after which a reader counts as hung. Formats with a share below 3 get three times as long."""
LONGEST_SENTENCE = 900
"""Largest length of a message (characters), with paths."""
ROBOT = "ballu-room-3"

Random = np.random.Generator


# ---- damage ----

NUMBERS = ("nan", "inf", "-inf", "NaN", "1e308", "1e400", "-0", "-0.0", "1e-320", "0", "-1", "9" * 11,
           "1" + "0" * 400, "1_0", "1,5", "", " ", "²", "1e", "--1", "true", "null", '"', "'", "\0")  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, "", " ", "x", "1", "nan", "\0", "\ud800", "a" * 5000, "../../etc/passwd", [], {}, [[]], [None],
    {"": 0}, -1, 0, 1, 2, 1.5, -0.0, 1e308, -1e308, 1e-320, math.nan, math.inf, -math.inf, 2**31, 2**63, 2**64, 10**400,
)  # fmt: skip


def _cut(content: bytes, random: Random) -> bytes:
    return content[: random.integers(len(content) + 1)]


def _flip(content: bytes, random: Random) -> bytes:
    changed = bytearray(content)
    for place in random.integers(len(content), size=random.integers(1, 4)) if content else ():
        changed[place] ^= 1 << int(random.integers(8))
    return bytes(changed)


def _insert(content: bytes, random: Random) -> bytes:
    place = int(random.integers(len(content) + 1))
    added = random.choice([b"\0", b"\xff\xfe", b"[" * 50_000, b"{", b'"', b"\n", b"\r", b",", bytes(20), b"9" * 6000])
    return content[:place] + added + content[place:]


def _delete(content: bytes, random: Random) -> bytes:
    place = int(random.integers(len(content) + 1))
    return content[:place] + content[place + int(random.integers(1, 40)) :]


def _double(content: bytes, random: Random) -> bytes:
    first, last = sorted(random.integers(len(content) + 1, size=2))
    return content[:last] + content[first:]


def _junk(content: bytes, random: Random) -> bytes:
    return random.bytes(int(random.integers(0, 2000)))


def _nothing(content: bytes, random: Random) -> bytes:
    return random.choice([b"", b"\n", b" ", b"\xef\xbb\xbf", b"\0", bytes(5000)])


BYTES = (_cut, _flip, _insert, _delete, _double, _junk, _nothing)


def _encoding(content: bytes, random: Random) -> bytes:
    text = content.decode(errors="replace")
    return text.encode(str(random.choice(["utf-16", "utf-32", "utf-8-sig", "utf-16-be"])))


def _lines(content: bytes, random: Random) -> bytes:
    lines = content.split(b"\n")
    first, second = (int(i) for i in random.integers(len(lines), size=2))
    match int(random.integers(4)):
        case 0:
            lines[first], lines[second] = lines[second], lines[first]
        case 1:
            lines.insert(second, lines[first])
        case 2:
            del lines[min(first, second) : min(first, second) + int(random.integers(1, 60))]
        case _:
            lines[first] = lines[first][: len(lines[first]) // 2]
    return b"\n".join(lines)


def _number(content: bytes, random: Random) -> bytes:
    places = [match.span() for match in re.finditer(rb"-?\d+(\.\d+)?(e[+-]?\d+)?", content)]
    for _ in range(int(random.integers(1, 3))):
        if places:
            first, last = places[int(random.integers(len(places)))]
            content = content[:first] + str(random.choice(NUMBERS)).encode() + content[last:]
    return content


TEXT = (*BYTES, _encoding, _lines, _number, _number)


def _cells(content: bytes, random: Random) -> bytes:
    rows = [line.split(",") for line in content.decode().split("\n")]
    filled = [row for row in rows if len(row) > 2] or rows
    row = filled[int(random.integers(len(filled)))]
    first, second = (int(i) for i in random.integers(len(row), size=2))
    match int(random.integers(6)):
        case 0:
            row[first] = str(random.choice(NUMBERS))
        case 1:
            row[first], row[second] = row[second], row[first]
        case 2:
            del row[first]
        case 3:
            row.insert(first, row[second])
        case 4:  # two columns exchange their samples, but keep their names
            for each in filled[1:]:
                if max(first, second) < len(each):
                    each[first], each[second] = each[second], each[first]
        case _:
            factor = float(random.choice([1000.0, -1.0, 57.3, 1e-3, 0.0, 1e300]))
            for each in filled[1:]:
                with contextlib.suppress(ValueError, IndexError):
                    each[first] = repr(float(each[first]) * factor)
    return "\n".join(map(",".join, rows)).encode()


def _stream(content: bytes, random: Random) -> bytes:
    """Hold samples, or give several samples almost the same time, as streaming clients do."""
    rows = [line.split(",") for line in content.decode().split("\n")]
    samples = [row for row in rows if len(row) > 2 and re.fullmatch(r"-?\d+(\.\d+)?", row[0])]
    if len(samples) > 1 and random.integers(2):
        start = int(random.integers(1, len(samples)))
        for row in samples[start : start + int(random.integers(1, 120))]:
            row[1:] = samples[start - 1][1:]
    else:
        burst = int(random.integers(2, 12))
        for number, row in enumerate(samples):
            row[0] = repr(float(samples[number - number % burst][0]) + 1e-4 * (number % burst))
    return "\n".join(map(",".join, rows)).encode()


CSV = (*TEXT, _cells, _cells, _cells, _cells, _stream, _stream)


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield container and key of every entry in a tree of dictionaries and lists."""
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield value, key
        yield from _places(value[key])


def _values(content: bytes, random: Random) -> bytes:
    tree = json.loads(content)
    for _ in range(int(random.integers(1, 3))):
        places = list(_places(tree))
        if not places:
            break
        holder, key = places[int(random.integers(len(places)))]
        match int(random.integers(5)):
            case 0 if isinstance(holder, dict):
                holder[f"{key}s"] = holder.pop(key)
            case 1:
                del holder[key]
            case 2:
                other, name = places[int(random.integers(len(places)))]
                holder[key] = json.loads(json.dumps(other[name]))
            case _:
                holder[key] = VALUES[int(random.integers(len(VALUES)))]
    return json.dumps(tree).encode()


JSON = (*TEXT, _values, _values, _values, _values, _values)


def _json_lines(content: bytes, random: Random) -> bytes:
    lines = content.split(b"\n")
    place = int(random.integers(len(lines) - 1))
    lines[place] = _values(lines[place], random)
    return b"\n".join(lines)


def _packed(damages: Sequence[Callable[[bytes, Random], bytes]]) -> Callable[[bytes, Random], bytes]:
    def damage(content: bytes, random: Random) -> bytes:
        return gzip.compress(damages[int(random.integers(len(damages)))](gzip.decompress(content), random), mtime=0)

    return damage


def _arrays(content: bytes, random: Random) -> bytes:
    with np.load(io.BytesIO(content)) as archive:
        arrays = {name: archive[name] for name in archive}
    name = str(random.choice(list(arrays)))
    array = arrays.pop(name)
    other = arrays[str(random.choice(list(arrays)))]
    number = array.dtype.kind == "f" and array.size
    match int(random.integers(8)):
        case 0:
            pass
        case 1:
            arrays[name + "0"] = array
        case 2:
            arrays[name] = other
        case 3:
            arrays[name] = array[..., None]
        case 4:
            arrays[name] = array.astype("S") if array.dtype.kind != "U" else np.array(7)
        case 5 if array.ndim:
            arrays[name] = array[::-1]
        case 6 if array.ndim:
            arrays[name] = array[: len(array) // 2]
        case _ if number:
            value = float(random.choice([np.nan, np.inf, -1.0, 1e30, 0.0]))
            arrays[name] = np.where(random.random(array.shape) < random.choice([0.01, 1.0]), value, array)
        case _:
            arrays[name] = np.array(["x", "\0"])
    output = io.BytesIO()
    np.savez_compressed(output, **arrays)  # pyright: ignore[reportArgumentType]
    return output.getvalue()


ARCHIVE = (*BYTES, _arrays, _arrays, _arrays, _arrays, _arrays)


# ---- what is valid for each format ----


@dataclasses.dataclass(frozen=True)
class Format:
    """A file format, with functions that damage, read and validate one file."""

    name: str
    file: Path
    """The file that is damaged. It and all files read with it are valid before."""
    damages: Sequence[Callable[[bytes, Random], bytes]]
    """Functions that damage the content of the file."""
    read: Callable[[], Any]
    """Function that reads the file and returns its content."""
    fault: Callable[[Any], str | None]
    """Function that returns which part of the content is invalid. None if all is valid."""
    share: int = 10
    """Number of damaged files, relative to other formats."""
    partial: tuple[Path, ...] = ()
    """Files that must not exist after a refusal."""


def finite(*values: Any) -> bool:
    return all(np.isfinite(np.asarray(value, float)).all() for value in values)


def recording_fault(recording: Any) -> str | None:
    time = recording.time
    if not (finite(time) and (np.diff(time) > 0).all() and time[-1] - time[0] > 0.99 and len(time) > 40):
        return "time"
    if not (finite(recording.command) and (recording.command >= 0).all() and (recording.command <= 1).all()):
        return "command"
    named = {"tracked_position": recording.tracked_position, **recording.points, **recording.joint_angles}
    for name, value in named.items():
        if value is not None and not (finite(value) and np.abs(value).max() <= 100 and len(value) == len(time)):
            return name
    for value in (recording.tracked_quaternion, *recording.orientations.values()):
        if value is None:
            continue
        if not (finite(value) and np.abs(np.linalg.norm(value, axis=1) - 1).max() < 1e-6):
            return "length of a quaternion"
        if ((value[1:] * value[:-1]).sum(axis=1) < 0).any():
            return "sign of a quaternion"
    from ballu_mjx.robots.registry import load_robot

    robot = load_robot()
    needed = robot.joints if recording.kind == "suspended" else ("tracked_position", *robot.points)
    if recording.kind not in ("free", "suspended") or any(named.get(name) is None for name in needed):
        return "kind"
    return None if recording.robot.strip() and printable(recording.robot, recording.notes) else "text"


def printable(*texts: str) -> bool:
    try:
        return bool("".join(texts).encode()) or True
    except UnicodeEncodeError:
        return False


def actuators_fault(found: Any) -> str | None:
    name, parameters = found
    for field in ("knee_spring_stiffness", "motor_gain", "torque_limit"):
        value = np.asarray(getattr(parameters, field))
        if not (finite(value) and value.shape == (2,) and (value > 0).all() and (value < 1e4).all()):
            return field
    if not 0 <= np.min(parameters.cable_slack) <= np.max(parameters.cable_slack) < 0.1:
        return "cable_slack"
    angles = np.concatenate([parameters.default_motor_angle, parameters.default_knee_angle])
    return None if finite(angles) and np.abs(angles).max() < 3.2 and printable(name) else "angle"


def description_fault(found: Any) -> str | None:
    """Return which names of a robot description are missing in its model."""
    model = found.load_model()
    sites = {model.site(index).name for index in range(model.nsite)}
    joints = {model.joint(index).name for index in range(model.njnt)}
    if not {found.tracked, *found.points} <= sites or not {*found.joints, *found.held} <= joints:
        return "names"
    if len(found.commands) != model.nu or len(set(found.columns)) != len(found.columns):
        return "commands"
    return None if found.name.strip() and printable(found.name, *found.columns) else "text"


def air_fault(found: Any) -> str | None:
    for name, value in dataclasses.asdict(found).items():
        if not finite(value) or (name not in ("lift", "centre", "friction") and (np.asarray(value) < 0).any()):
            return name
        if np.abs(np.asarray(value)).max() > (0.2 if name == "delay" else 1e3):
            return name
    return None


def observed_fault(found: Any) -> str | None:
    low, high = found
    return None if finite(low, high) and low.shape == high.shape == (87,) and (low <= high).all() else "range"


def options_fault(found: Sequence[Any]) -> str | None:
    """Return which option is invalid. Numbers must be finite. Counts and sizes must be positive."""
    for config in found:
        for field in dataclasses.fields(config):
            value, default = getattr(config, field.name), getattr(type(config)(), field.name)
            if value is None and default is None:
                continue
            kind = float if default is None else type(default)
            if type(value) is not kind and not (kind is float and type(value) is int):
                return f"type of {field.name}"
            numbers: tuple[Any, ...] = value if isinstance(value, tuple) else (value,)
            if not all(isinstance(x, str | bool) or math.isfinite(x) for x in numbers):
                return field.name
            if type(value) is int and kind is int and field.name != "seed" and value < 1:
                return field.name
    return None


def metrics_fault(rows: Any) -> str | None:
    steps = [row["step"] for row in rows]
    if any(type(step) is not int for step in steps) or sorted(steps) != steps or min(steps, default=0) < 0:
        return "steps"
    numbers = [value for row in rows for value in row.values() if value is not None]
    return None if all(type(x) in (int, float) for x in numbers) and finite(*numbers) else "measurements"


def evaluation_fault(found: Any) -> str | None:
    each = [*found.vanilla, *found.residual]
    numbers = [
        x for errors in each for table in (errors.position, errors.orientation) for pair in table.values() for x in pair
    ]
    numbers += [x for e in each for x in (e.mean_com_error, e.final_orientation_error, e.mean_force)]
    numbers = [x for x in [*numbers, found.score] if x != math.inf]  # of simulations that diverged
    return None if finite(*numbers) and printable(*(e.recording for e in each)) else "numbers"


def replay_fault(takes: Any) -> str | None:
    for take in takes:
        arrays = [take.time, *take.qpos.values(), *(a for a in (take.command, take.force) if a is not None)]
        if not finite(*arrays) or (np.diff(take.time) <= 0).any():
            return "numbers"
        if take.command is not None and ((take.command < 0) | (take.command > 1)).any():
            return "command"
        if any(np.abs(np.linalg.norm(qpos[:, 3:7], axis=1) - 1).max() > 0.05 for qpos in take.qpos.values()):
            return "length of a quaternion"
    return None


def mapping_fault(found: Any) -> str | None:
    numbers = [x for source in found.sources.values() for x in (*source.offset, *(source.geometry or ()))]
    numbers += [found.axes, *found.commands.ranges]
    numbers += [x for joint in found.joints.values() for x in (joint.sign, joint.zero)]
    fits = round(float(np.linalg.det(found.axes))) == 1 and (found.rate is None or found.rate > 0)
    return None if fits and all(finite(x) for x in numbers) and found.robot.strip() else "numbers"


def transfers_fault(found: Any) -> str | None:
    return None if found and finite([list(each.to_json().values()) for each in found]) else "figures"


# ---- valid examples ----


def formats(work: Path) -> list[Format]:
    """Return all formats, each with a valid example in its own folder below `work`."""
    from ballu_mjx.ballu.actuators_file import read_actuators
    from ballu_mjx.cli.cached_stages import read_mark, write_mark
    from ballu_mjx.evaluation import transfer
    from ballu_mjx.identification.actuators import ACTUATORS_FILE
    from ballu_mjx.recordings.csv_format import list_bundled, read_recording, write_recording
    from ballu_mjx.recordings.importers.example_mapping import example_mapping
    from ballu_mjx.recordings.importers.mapping import read_mapping
    from ballu_mjx.recordings.recording import cut
    from ballu_mjx.residuals.aerodynamics import AERODYNAMICS_FILE, AERODYNAMICS_FORMAT, read_air_parameters
    from ballu_mjx.residuals.training_range import TrainingRange
    from ballu_mjx.robots.description import read_description
    from ballu_mjx.robots.model import assets
    from ballu_mjx.robots.registry import load_robot

    robot = load_robot()
    short = cut(read_recording(list_bundled("test")[0], robot), slice(130))

    def place() -> Path:  # its name must not contain the file's name, because messages must name the file
        return Path(tempfile.mkdtemp(dir=work))

    found: list[Format] = []

    def add(name: str, file: Path, damages: Sequence[Any], read: Callable[[], Any], fault: Any, **more: Any) -> None:
        found.append(Format(name, file, damages, read, fault, **more))

    for name, ending, damaged, damages, share in (
        ("recording, .csv", ".csv", "walk.csv", CSV, 25),
        ("recording, .csv.gz", ".csv.gz", "walk.csv.gz", (*BYTES, _packed(CSV)), 10),
        ("recording, .json", ".csv", "walk.json", JSON, 12),
    ):
        folder = place()
        path = folder / f"walk{ending}"
        write_recording(short, path, robot)
        add(
            name,
            folder / damaged,
            damages,
            lambda path=path: read_recording(path, robot),
            recording_fault,
            share=share,
        )
    folder = place()
    sweep = folder / "sweep.csv"
    write_recording(cut(read_recording(list_bundled("suspended")[0], robot), slice(130)), sweep, robot)
    add("suspended recording, .csv", sweep, CSV, lambda p=sweep: read_recording(p, robot), recording_fault)

    folder = place()
    path = folder / ACTUATORS_FILE
    shutil.copy(assets() / "recordings" / ACTUATORS_FILE, path)
    add("actuators.json", path, JSON, lambda path=path: read_actuators(path), actuators_fault)
    folder = place()
    path = folder / "mine.robot.json"
    path.write_bytes((assets() / "ballu.robot.json").read_bytes())
    shutil.copy(assets() / "ballu.xml", folder)
    add("robot description", path, JSON, lambda path=path: read_description(path), description_fault)
    folder, ballu = place(), read_description(assets() / "ballu.robot.json")
    path = folder / AERODYNAMICS_FILE
    values = dict.fromkeys(("centre", "linear_drag", "quadratic_drag", "turning_drag"), [0.01, 0.02, 0.03])
    values |= {"added_mass": 0.1, "added_inertia": 0.003, "lift": -0.004, "delay": 0.05, "friction": -0.2}
    path.write_text(json.dumps({"format": AERODYNAMICS_FORMAT, "parameters": values, "windows": 3}))
    add(
        "air.json",
        path,
        JSON,
        lambda path=path: read_air_parameters(path, ballu),
        air_fault,
    )
    folder = place()
    path = folder / "observed.json"
    path.write_text(json.dumps({"low": [-0.5] * 87, "high": [0.5] * 87}))
    add("observed.json", path, JSON, lambda path=path: TrainingRange.read(path.parent, 87), observed_fault, share=6)

    found += _run_formats(place, short.robot)

    folder = place()
    path = folder / "sweep.stage.json"
    write_mark(path, "0123456789abcdef", {"options": {"robot": 0}, "needs": []}, done=True)
    add("stage.json", path, JSON, lambda path=path: read_mark(path),
        lambda mark: None if type(mark["done"]) is bool and len(mark["key"]) == 16 else "key", share=5)  # fmt: skip
    folder = place()
    path = folder / "transfer.json"
    transfer.write_transfer(path, [transfer.Transfer(*np.arange(11.0) / 7), transfer.Transfer(*np.arange(11.0))])
    add("transfer.json", path, JSON, lambda path=path: transfer.read_transfer(path), transfers_fault, share=5)

    folder = place()
    path = folder / "room.toml"
    path.write_text(example_mapping(robot))
    add("mapping, TOML", path, TEXT, lambda path=path: read_mapping(path, robot), mapping_fault)
    folder = place()
    path = folder / "room.json"
    offset = {"offset": [0.1, 0, 0], "turn": [0, 0, 90]}
    tables = {"balloon": {"markers": ["a", "b", "c"], "geometry": [[0.1, 0, 0], [0, 1, 0], [0, 0, 1]], **offset}}
    tables |= {point: {"body": f"ballu:{point}"} for point in robot.points}
    tables |= {"knee_left": {"column": "kl", "sign": -1, "zero": 3.5}, "commands": {"range_left": [0, 90]}}
    content = {"robot": ROBOT, "axes": {"forward": "x"}, "origin": {"floor": 0.1}, "units": {"length": "mm"}, **tables}
    path.write_text(json.dumps(content))
    add("mapping, JSON", path, JSON, lambda path=path: read_mapping(path, robot), mapping_fault)

    found += _import_formats(place, short)
    folder = place()
    add("weights.npz of a controller", _write_weights(folder), ARCHIVE, _Controlled(folder), controller_fault)
    return found


def _run_formats(place: Callable[[], Path], robot_name: str) -> list[Format]:
    """Return the formats in a run's folder."""
    from ballu_mjx.cli import compare, train_envmimic
    from ballu_mjx.evaluation.errors import Errors, Evaluation
    from ballu_mjx.evaluation.errors_file import evaluation_to_json, read_evaluation
    from ballu_mjx.recordings.csv_format import list_bundled
    from ballu_mjx.residuals.envmimic import EnvMimicConfig, check_envmimic_config
    from ballu_mjx.residuals.run_config import describe_run, find_recordings, run_actuators, run_residual
    from ballu_mjx.rl import ppo
    from ballu_mjx.rl.ppo import PPOConfig
    from ballu_mjx.robots.registry import load_robot
    from ballu_mjx.runs.checkpoints import last_checkpoint
    from ballu_mjx.runs.folder import Run, read_config, typed_config
    from ballu_mjx.runs.metrics import read_metrics
    from ballu_mjx.runs.rollout_file import ROLLOUT_FILE, StoredRollout, read_rollouts, write_rollouts
    from ballu_mjx.viz import report_content

    def errors(scale: float) -> tuple[Errors, ...]:
        table = {horizon: (scale * horizon, 0.1) for horizon in (1.0, 5.0, 10.0)}
        return tuple(Errors(f"{group}-1", group, table, table, scale, 2 * scale, 0.1) for group in ("near", "far"))

    def qpos() -> np.ndarray:
        values = np.full((12, 14), 0.1)
        values[:, 3:7] = [1, 0, 0, 0]
        return values

    def write(folder: Path) -> Path:
        sections = {"env": EnvMimicConfig(), "ppo": PPOConfig(), "data": train_envmimic.Data()}
        files = {use: [list_bundled(use)[0]] for use in ("training", "validation", "test")}
        content = describe_run("envmimic", sections, files, ["cpu"]) | {"residual": None}
        with Run(folder, content) as run:
            for step in range(0, 400, 100):
                run.log(step, {"validation_error": 1.0 - step / 1000})
                run.log(step, {"reward": 1.0 + step / 1000, "seconds": step / 7, "loss": math.nan})
                run.save(step, {"w": np.arange(5.0)}, 1.0 - step / 1000, training={"step": np.array(step)})
        (folder / "evaluation.json").write_text(json.dumps(evaluation_to_json(Evaluation(errors(1.0), errors(0.5)))))
        takes = [
            StoredRollout(
                name=name,
                robot=robot_name,
                description=load_robot(),
                time=0.05 * np.arange(12),
                qpos={"recording": qpos(), "vanilla": qpos()},
                command=np.full((11, 2), 0.5),
                force=np.zeros((11, 3)),
            )
            for name in ("near-1", "far-1")
        ]
        write_rollouts(folder / ROLLOUT_FILE, takes)
        return folder

    example = write(place() / "example")

    def copied() -> Path:
        return shutil.copytree(example, place() / "run")

    def read_run(folder: Path) -> Any:
        """Read a run, without checkpoints, as the commands that report, compare, evaluate or resume it do."""
        config = read_config(folder, "envmimic")
        found = [
            typed_config(EnvMimicConfig, config, "env", folder, lambda read: check_envmimic_config(read, 0.05)),
            typed_config(PPOConfig, config, "ppo", folder, ppo.check_values),
        ]
        run_actuators(config, folder, load_robot())
        run_residual(config, folder)
        find_recordings(config, "training", folder, "--recordings")
        report_content.collect(folder)
        compare.rows([folder])
        compare.figures(folder)
        return found

    def metrics_of(folder: Path) -> Any:
        rows = read_metrics(folder)
        report_content.collect(folder)
        return rows

    def evaluation_of(folder: Path) -> Any:
        report_content.collect(folder)
        return read_evaluation(folder / "evaluation.json")

    found = []
    for name, file, damages, read, fault, share in (
        ("config.json of a run", "config.json", JSON, read_run, options_fault, 16),
        ("metrics.jsonl", "metrics.jsonl", (*TEXT, *[_json_lines] * 5), metrics_of, metrics_fault, 10),
        ("evaluation.json", "evaluation.json", JSON, evaluation_of, evaluation_fault, 10),
        ("replay.npz", ROLLOUT_FILE, ARCHIVE, lambda folder: read_rollouts(folder / ROLLOUT_FILE), replay_fault, 10),
    ):
        folder = copied()
        found.append(Format(name, folder / file, damages, lambda f=folder, r=read: r(f), fault, share))

    def read_checkpoint(folder: Path) -> Any:
        messages = io.StringIO()
        with contextlib.redirect_stderr(messages):
            checkpoint = last_checkpoint(folder, training=True)
        if checkpoint.step < 300:
            raise InputError(messages.getvalue().rstrip("\n"))
        return checkpoint

    def checkpoint_fault(found: Any) -> str | None:
        fits = found.training["step"] == 300 and np.array_equal(found.params["w"], np.arange(5.0))
        return None if fits else "content"

    for name, file, share in (
        ("record.json of a checkpoint", "record.json", 2),
        ("score of a checkpoint", "metrics/metrics", 1),
        ("metadata of a checkpoint", "params/_METADATA", 1),
    ):
        folder = copied()
        path = folder / "checkpoints" / "300" / file
        found.append(Format(name, path, JSON, lambda f=folder: read_checkpoint(f), checkpoint_fault, share))
    return found


def _import_formats(place: Callable[[], Path], short: Any) -> list[Format]:
    """Return the formats that `record import` reads."""
    from scipy.spatial.transform import Rotation

    from ballu_mjx.cli import record
    from ballu_mjx.recordings.csv_format import read_recording, sidecar_path
    from ballu_mjx.robots.registry import load_robot

    count, positions = len(short.time), {"balloon": short.tracked_position, **short.points}
    roles = tuple(positions)
    turn = Rotation.from_quat(short.tracked_quaternion, scalar_first=True)

    def rows(header: Sequence[str], *columns: np.ndarray) -> str:
        table = np.column_stack(columns)
        return "\n".join([*header, *(",".join(f"{x:.7g}" for x in row) for row in table)]) + "\n"

    log = rows(["time,command_left,command_right"], short.time, short.command)
    bodies = "\n".join(f'[{role}]\nbody = "ballu:{role}"' for role in roles)
    names = ",".join(f"ballu:{role},,,,," for role in roles)
    units = ",".join(["deg,deg,deg,mm,mm,mm"] * 4)
    vicon = rows(
        ["Segments", "100", f",,{names}", "Frame,Sub Frame," + ",".join(["RX,RY,RZ,TX,TY,TZ"] * 4), f",,{units}"],
        np.arange(1, count + 1),
        np.zeros(count),
        *(np.column_stack([np.rad2deg(turn.as_rotvec()), 1e3 * positions[role]]) for role in roles),
    )
    table = rows(
        ["time,bx,by,bz,bw,bi,bj,bk,px,py,pz,lx,ly,lz,rx,ry,rz,command_left,command_right"],
        short.time,
        positions["balloon"],
        short.tracked_quaternion,
        *(positions[role] for role in roles[1:]),
        short.command,
    )
    columns = '[balloon]\nposition = ["bx", "by", "bz"]\norientation = ["bw", "bi", "bj", "bk"]\n'
    columns += 'rotation = "quaternion"\n' + "\n".join(
        f'[{role}]\nposition = ["{x}x", "{x}y", "{x}z"]' for role, x in zip(roles[1:], "plr", strict=True)
    )
    top = f'robot = "{ROBOT}"\n'

    found = []

    def add(
        name: str,
        damaged: str,
        damages: Sequence[Any],
        captured: str,
        rooms: str,
        capture: bytes,
        logged: bool,
        share: int,
    ) -> None:
        folder = place()
        (folder / captured).write_bytes(capture)
        (folder / "room.toml").write_text(rooms)
        (folder / "log.csv").write_text(log)
        output = folder / "out" / "walk.csv"
        options = record.Import(
            file=folder / captured,
            mapping=folder / "room.toml",
            output=output,
            commands=folder / "log.csv" if logged else None,
            offset=0.0 if logged else None,
        )

        def read() -> Any:
            for path in (output, sidecar_path(output)):
                path.unlink(missing_ok=True)
            record._import(options)
            return read_recording(output, load_robot())

        written = (output, sidecar_path(output))
        found.append(Format(name, folder / damaged, damages, read, recording_fault, share, written))

    metres = top + '[units]\nlength = "m"\n' + columns
    add("Vicon CSV", "walk.csv", CSV, "walk.csv", top + bodies, vicon.encode(), True, 10)
    add("table", "walk.csv", CSV, "walk.csv", metres, table.encode(), False, 10)
    add("command log", "log.csv", CSV, "walk.csv", top + bodies, vicon.encode(), True, 8)
    add("mapping of an import", "room.toml", TEXT, "walk.csv", metres, table.encode(), False, 8)
    sys.path.append(str(Path(__file__).parents[1]))
    from c3d_writer import c3d_bytes

    cluster = np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, 0, 0.1]])
    markers = {f"B{i}": positions["balloon"] + turn.apply(corner) for i, corner in enumerate(cluster)}
    markers |= {f"ballu:{role}": positions[role] for role in roles[1:]}
    points = 1e3 * np.stack(list(markers.values()), axis=1)
    named = ", ".join(f'"B{i}"' for i in range(len(cluster)))
    rooms = f"{top}[balloon]\nmarkers = [{named}]\ngeometry = {cluster.tolist()}\n" + bodies.split("\n", 2)[2]
    c3d = c3d_bytes(points, list(markers))
    add("C3D", "walk.c3d", BYTES, "walk.c3d", rooms, c3d, True, 10)

    quaternions = {role: short.tracked_quaternion for role in roles}
    heads = [f"Format Version,1.23,Capture Frame Rate,{1 / np.diff(short.time)[0]:.6f},Rotation Type,Quaternion,"
             "Length Units,Meters,Coordinate Space,Global", ""]  # fmt: skip
    heads += [f",Type{',Rigid Body' * 28}", ",Name" + "".join(f",{role}" * 7 for role in roles)]
    heads += [
        ",," + ",".join([*["Rotation"] * 4, *["Position"] * 3] * 4),
        "Frame,Time (Seconds)" + ",X,Y,Z,W,X,Y,Z" * 4,
    ]
    poses = [np.column_stack([quaternions[role][:, [1, 2, 3, 0]], positions[role]]) for role in roles]
    motive = rows(heads, np.arange(count), short.time, *poses)
    add("Motive CSV", "walk.csv", CSV, "walk.csv", top + bodies.replace("ballu:", ""), motive.encode(), True, 8)
    heads = [f"NO_OF_FRAMES,{count}", "FREQUENCY,100", "DATA_INCLUDED,6D", "BODY_NAMES," + ",".join(roles)]
    angles = "Y,Z,Roll,Pitch,Yaw,Residual," + ",".join(f"Rot[{i}]" for i in range(9))
    heads.append("Frame,Time," + ",".join(f"{role} X,{angles}" for role in roles))
    matrix = turn.as_matrix().transpose(0, 2, 1).reshape(-1, 9)
    poses = [np.column_stack([1e3 * positions[role], np.ones((count, 4)), matrix]) for role in roles]
    qualisys = rows(heads, np.arange(count) + 1, short.time, *poses).replace(",", "\t").encode()
    add("Qualisys TSV", "walk.tsv", TEXT, "walk.tsv", top + bodies.replace("ballu:", ""), qualisys, True, 8)
    archive = io.BytesIO()
    np.savez(archive, **{name: column for name, column in zip(
        table.partition("\n")[0].split(","), np.loadtxt(io.StringIO(table), delimiter=",", skiprows=1).T, strict=True
    )})  # fmt: skip
    add("NumPy archive", "walk.npz", ARCHIVE, "walk.npz", metres, archive.getvalue(), False, 5)
    pose = np.column_stack([positions["balloon"], short.tracked_quaternion])
    tum = rows([], short.time, pose[:, [0, 1, 2, 4, 5, 6, 3]]).replace(",", " ")
    found.append(_one_body("TUM trajectory", place() / "walk.txt", TEXT, tum))
    ns = [str(1_700_000_000 * 10**9 + round(1e9 * t)) for t in short.time]
    lines = ["#timestamp, p_x [m], p_y [m], p_z [m], q_w [], q_x [], q_y [], q_z []"]
    lines += [f"{t}," + ",".join(f"{x:.7g}" for x in row) for t, row in zip(ns, pose, strict=True)]
    found.append(_one_body("EuRoC CSV", place() / "walk.csv", CSV, "\n".join(lines) + "\n"))
    for name, ending in (("ROS bag", "bag"), ("MCAP", "mcap")):
        bag = _write_bag(place(), ending, short, positions)
        if bag is not None:
            clock = '[clock]\ntime = "received"\n[commands]\nleft = "/cmd:data[0]"\nright = "/cmd:data[1]"\n'
            rooms = top + bodies.replace("ballu:", "/") + "\n" + clock
            add(name, f"walk.{ending}", BYTES, f"walk.{ending}", rooms, bag, False, 3)
    return found


def _one_body(name: str, path: Path, damages: Sequence[Any], text: str) -> Format:
    """Return a format that holds one body, from which no recording of BALLU can be made."""
    from ballu_mjx.recordings.importers.mapping import read_mapping
    from ballu_mjx.recordings.importers.readers import read_capture
    from ballu_mjx.robots.registry import load_robot

    room = path.with_name("room.toml")
    robot = load_robot()
    room.write_text(
        f'robot = "{ROBOT}"\n' + "".join(f'[{role}]\nbody = "pose"\n' for role in (robot.tracked, *robot.points))
    )
    path.write_text(text)
    mapping = read_mapping(room, robot)
    names = {"TUM trajectory": "tum", "EuRoC CSV": "euroc"}

    def fault(found: Any) -> str | None:
        body = found.bodies[robot.tracked]
        seen = ~np.isnan(body.quaternion).any(axis=1)
        if not (finite(found.time) and (np.diff(found.time) > 0).all()):
            return "time"
        if np.isinf(body.position).any() or np.nanmax(np.abs(body.position), initial=0) > 1e6:
            return "position"
        return None if np.allclose(np.linalg.norm(body.quaternion[seen], axis=1), 1) else "quaternion"

    return Format(name, path, damages, lambda: read_capture(path, mapping, names[name]), fault, 4)


def _write_bag(folder: Path, ending: str, short: Any, positions: Mapping[str, Any]) -> bytes | None:
    """Return a bag with poses by topic, and commands. None if rosbags or mcap is not installed."""
    try:
        import mcap  # noqa: F401
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        print("Bags are left out, because the extra `bags` is not installed.", file=sys.stderr)
        return None
    store: Any = get_typestore(Stores.ROS1_NOETIC if ending == "bag" else Stores.ROS2_HUMBLE)
    types, version = store.types, {"seq": 0} if ending == "bag" else {}
    path = folder / ("walk.bag" if ending == "bag" else "walk")
    writer: Any = Writer1(path) if ending == "bag" else Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)
    point, turn = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    pose_type, array_type = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Float64MultiArray"
    serialize = store.serialize_ros1 if ending == "bag" else store.serialize_cdr
    with writer:
        topics = {role: writer.add_connection(f"/{role}", pose_type, typestore=store) for role in positions}
        commands = writer.add_connection("/cmd", array_type, typestore=store)
        for i, time in enumerate(short.time):
            ns = 1_700_000_000_000_000_000 + round(time * 1e9)
            stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
            header = types["std_msgs/msg/Header"](**version, stamp=stamp, frame_id="room")
            w, *vector = short.tracked_quaternion[i].tolist()
            for role, topic in topics.items():
                pose = types["geometry_msgs/msg/Pose"](
                    position=point(*positions[role][i].tolist()), orientation=turn(*vector, w)
                )
                writer.write(topic, ns, serialize(types[pose_type](header=header, pose=pose), pose_type))
            message = types[array_type](layout=layout, data=np.array(short.command[i], float))
            writer.write(commands, ns, serialize(message, array_type))
    return path.read_bytes() if ending == "bag" else next(path.glob("*.mcap")).read_bytes()


def _write_weights(folder: Path) -> Path:
    """Write a controller's network, as `export policy` does. Return its path."""
    random = np.random.default_rng(0)
    sizes = [28, 8, 2]
    arrays: dict[str, np.ndarray] = {"mean": np.zeros(28), "std": np.ones(28), "observation_clip": np.array(10.0)}
    for i, (rows, columns) in enumerate(zip(sizes, sizes[1:], strict=False)):
        arrays |= {f"kernel_{i}": random.normal(size=(rows, columns)), f"bias_{i}": np.zeros(columns)}
    levels = {"command_low": np.zeros(2), "command_high": np.ones(2), "command_rest": np.zeros(2)}
    arrays |= levels | {"control_timestep": np.array(0.05), "full_travel": np.array(0.2)}
    arrays = {name: value.astype(np.float32) for name, value in arrays.items()} | {
        "activation": np.array("swish"),
        "anchored": np.array(False),
        "names": np.array(["balloon", "base", "foot_left", "foot_right"]),
        "commands": np.array(["left", "right"]),
    }
    np.savez(folder / "weights.npz", **arrays)  # pyright: ignore[reportArgumentType]
    return folder / "weights.npz"


class _Controlled:
    """Reader of a controller. It converts `ValueError`, because the controller does not use this package's errors."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self) -> Any:
        from ballu_mjx.policies.deploy.controller import Controller

        try:
            return Controller(self.folder)
        except ValueError as error:
            raise InputError(str(error)) from error


def controller_fault(controller: Any) -> str | None:
    command = controller.act(np.linspace(-1, 1, 27))
    return None if finite(command) and command.shape == (2,) and (0 <= command).all() else "command"


# ---- the campaign ----


class _Hang(BaseException):
    """Time limit of a reader. Not an `Exception`, which readers may catch."""


@contextlib.contextmanager
def limited(seconds: float) -> Iterator[None]:
    def end(number: int, frame: Any) -> None:
        raise _Hang

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def judge(form: Format) -> tuple[str, str]:
    """Return the outcome of reading the file as it is now, one of `OUTCOMES`, and its reason."""
    printed = io.StringIO()
    try:
        with (
            warnings.catch_warnings(),
            contextlib.redirect_stdout(printed),
            limited(LONGEST * (3 if form.share < 3 else 1)),
        ):
            warnings.simplefilter("error")  # users must get a sentence instead of a warning
            found = form.read()
        fault = form.fault(found)
    except InputError as error:
        sentence = str(error)
        left = [path.name for path in form.partial if path.exists()]
        if form.file.name not in sentence or "\n" in sentence or len(sentence) > LONGEST_SENTENCE or left:
            return "crashed", f"refused without naming the file, or leaving {left}: {sentence[:300]!r}"
        return "refused", sentence
    except _Hang:
        return "hung", ""
    except Exception as error:
        return "crashed", f"{type(error).__name__}: {str(error)[:200]}\n{traceback.format_exc(limit=-3)}"
    return ("nonsense", fault) if fault else ("accepted", "")


def campaign(
    files: int, seed: int, *, only: str = "", keep: Path | None = None
) -> tuple[dict[str, dict[str, int]], list[str]]:
    """Damage about `files` files. Return counts of the outcomes by format, and descriptions of wrong outcomes.

    **Arguments**

    - `only`: only formats whose name contains this text.
    - `keep`: folder for copies of the files with wrong outcomes.
    """
    table: dict[str, dict[str, int]] = {}
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as work:
        chosen = [form for form in formats(Path(work)) if only in form.name]
        whole = sum(form.share for form in chosen)
        counts = [max(math.ceil(files * form.share / whole), 1) for form in chosen]
        with tqdm(total=sum(counts), unit="files", dynamic_ncols=True) as bar:
            for form, count in zip(chosen, counts, strict=True):
                row = table[form.name] = dict.fromkeys(OUTCOMES, 0)
                valid = form.file.read_bytes()
                outcome, why = judge(form)
                if outcome != "accepted":
                    raise AssertionError(f"the valid example of {form.name} is {outcome}: {why}")
                for number in range(count):
                    random = np.random.default_rng([seed, sum(form.name.encode()), number])
                    damage = form.damages[int(random.integers(len(form.damages)))]
                    form.file.write_bytes(damage(valid, random))
                    outcome, why = judge(form)
                    row[outcome] += 1
                    bar.update()
                    if outcome not in OUTCOMES[:2]:
                        wrong.append(f"{form.name}, number {number} ({damage.__name__[1:]}): {outcome}, {why}")
                        if keep is not None:
                            keep.mkdir(parents=True, exist_ok=True)
                            shutil.copy(form.file, keep / f"{number}-{form.file.name}")
                form.file.write_bytes(valid)
    return table, wrong


def markdown(table: Mapping[str, Mapping[str, int]]) -> str:
    """Return a Markdown table of the counts and their sums."""
    lines = ["| format | files | " + " | ".join(OUTCOMES) + " |", "| --- |" + " ---: |" * (1 + len(OUTCOMES))]
    total = {outcome: sum(row[outcome] for row in table.values()) for outcome in OUTCOMES}
    for name, row in [*table.items(), ("all", total)]:
        lines.append(f"| {name} | {sum(row.values()):,} | " + " | ".join(f"{row[o]:,}" for o in OUTCOMES) + " |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=10_000, help="number of damaged files, over all formats")
    parser.add_argument("--seed", type=int, default=0, help="seed of the damage")
    parser.add_argument("--only", default="", help="test only formats whose name contains this text")
    parser.add_argument("--keep", type=Path, help="folder for copies of the files with wrong outcomes")
    options = parser.parse_args()
    runtime.prepare()
    table, wrong = campaign(options.files, options.seed, only=options.only, keep=options.keep)
    print("\n".join(wrong), file=sys.stderr)
    print(markdown(table))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
