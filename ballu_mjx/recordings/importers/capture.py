"""Content of a motion capture file (bodies, markers and columns by name), and selection from it by a mapping."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.filters import count_turns
from ballu_mjx.recordings.importers.contents import Contents, Item
from ballu_mjx.recordings.importers.mapping import MARKER_TOLERANCE, Commands, Joint, RoomMapping, Source
from ballu_mjx.recordings.importers.trajectories import (
    ANGLES,
    LENGTHS,
    Body,
    CommandLog,
    Trajectories,
    find,
    refuse,
    rigid_body,
    shorten,
    suggest,
    to_quaternion,
)
from ballu_mjx.recordings.validation import LONGEST_GAP, describe_slow

_COMMAND_TOLERANCE = 0.005
"""Tolerance as a share of a command's range. Values outside by at most this much count as noise and are clipped."""
_COMMENT_SIGNS = "#% "
"""Characters that may precede the first name of a header. `rostopic echo -p` writes "%time"."""
_LONGEST_BRIDGE = 2.5
"""Longest gap over which a stream is interpolated, in sample spacings. `LONGEST_GAP` limits it too. In longer gaps the
values are NaN (not seen)."""

_Value = TypeVar("_Value")


@dataclasses.dataclass(frozen=True, eq=False)
class Stream:
    """Trajectory of a marker or a rigid body with its own times. NaN where it was not seen."""

    time: Float[np.ndarray, " T"]
    """Times (s), strictly increasing."""
    position: Float[np.ndarray, "T 3"]
    """Position (m, capture frame)."""
    quaternion: Float[np.ndarray, "T 4"] | None = None
    """Orientation of the body's frame in the capture frame (w, x, y, z). None for a marker."""
    angles: Float[np.ndarray, "T 3"] | None = None
    """Three rotation angles (rad) instead of a quaternion, if the file does not state their convention."""
    clock: str | None = None
    """Clock of `time`, if the file has several."""


@dataclasses.dataclass(frozen=True, eq=False)
class Series:
    """Column of numbers. NaN where a sample is missing."""

    values: Float[np.ndarray, " T"]
    time: Float[np.ndarray, " T"] | None = None
    """Times (s). None if the file has one sample per row and a column with the times."""
    si: bool = False
    """Whether the format specifies SI units (rad and m)."""
    clock: str | None = None
    """Clock of `time`, as in `Stream`."""
    label: str | None = None
    """Label of the column in the file, in addition to its name. None if there is none."""


class Lazy(Mapping[str, _Value]):
    """Mapping whose values are computed at first access."""

    def __init__(self, makers: Mapping[str, Callable[[], _Value]]) -> None:
        self._makers = makers
        self._made: dict[str, _Value] = {}

    def __getitem__(self, name: str) -> _Value:
        if name not in self._made:
            self._made[name] = self._makers[name]()
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


@dataclasses.dataclass(frozen=True, eq=False)
class Capture:
    """Content of one file."""

    path: Path
    program: str
    """Kind of the file for messages, such as "a table" or "an OptiTrack Motive CSV"."""
    bodies: Mapping[str, Stream] = dataclasses.field(default_factory=dict)
    """Bodies and markers by name."""
    columns: Mapping[str, Series] = dataclasses.field(default_factory=dict)
    """Columns by name."""
    clock: Callable[[str, str], Float[np.ndarray, " T"]] | None = None
    """Function that returns the times (s) of the rows, given name and unit of the time column. None without rows."""
    rows: int = 0
    """Number of rows, if the columns have one sample per row."""
    time_column: str | None = None
    """Name of the time column, if the format specifies it."""
    notes: Sequence[str] = ()
    """Sentences about parts of the file that are not read, and about uncertain properties."""
    episodes: Sequence[int] = ()
    """Numbers of the episodes, if a mapping must select one. This capture holds the first."""
    first_frame: int = 1
    """Number of the first frame in its trial, counted from 1; see `Trajectories`."""


def list_capture(capture: Capture) -> Contents:
    """Return the list of the items in `capture`. The notes name items that cannot be read."""
    items: list[Item] = []
    notes = list(capture.notes)
    for name, stream in _readable(capture.bodies, notes):
        turns = stream.quaternion is not None or stream.angles is not None
        seen = ~np.isnan(stream.position).any(axis=1)
        items.append(
            Item(
                name,
                "body" if turns else "marker",
                len(stream.time),
                _rate(stream.time),
                share=float(seen.mean()),
                unit="m",
                rotation=None if stream.angles is None else "XYZ",
                clock=stream.clock,
                low=float(stream.position[seen].min()) if seen.any() else None,
                high=float(stream.position[seen].max()) if seen.any() else None,
            )
        )
    for name, series in _readable(capture.columns, notes):
        seen = series.values[~np.isnan(series.values)]
        items.append(
            Item(
                name,
                "column",
                len(series.values),
                None if series.time is None else _rate(series.time),
                share=len(seen) / max(len(series.values), 1),
                unit="rad or m" if series.si else None,
                clock=series.clock,
                label=series.label,
                low=float(seen.min()) if len(seen) else None,
                high=float(seen.max()) if len(seen) else None,
                step=_step(series.values),
            )
        )
    rows = capture.clock is not None
    return Contents(capture.path, capture.program, items, rows=rows, notes=notes, episodes=capture.episodes)


def _readable(values: Mapping[str, _Value], notes: list[str]) -> Iterator[tuple[str, _Value]]:
    """Yield name and value of each readable item. The errors of the others are added to `notes`."""
    for name in values:
        try:
            value = values[name]
        except InputError as error:
            notes.append(str(error))
            continue
        yield name, value


def _rate(time: np.ndarray) -> float | None:
    return 1 / float(np.median(np.diff(time))) if len(time) > 1 else None


def _step(values: np.ndarray) -> float | None:
    """Return the median step of a column that always increases, as times do. None for other columns."""
    steps = np.diff(values)
    return float(np.median(steps)) if len(steps) and np.isfinite(steps).all() and (steps > 0).all() else None


# ---- selection by a mapping ----


def select(capture: Capture, mapping: RoomMapping) -> Trajectories:
    """Return the parts of `capture` that `mapping` selects, at the times of the first site, or else of the first joint.

    Streams with other times are interpolated, orientations along the shortest rotation. If the angle of a hinge without
    a range restarts each turn, its turns are counted before it is interpolated.

    **Raises** `InputError` if a selected part is not in the file, has no unit, or lacks times, and if an interpolated
    stream has less than one sample per control step.
    """
    picked = {role: _pick(capture, mapping, source) for role, source in mapping.sources.items()}
    joints = {name: _joint(capture, mapping, joint) for name, joint in mapping.joints.items()}
    clocks = [(mapping.sources[role].body or role, stream.time) for role, stream in picked.items()]
    clocks += [(mapping.joints[name].column, time) for name, (time, _) in joints.items()]
    if not clocks:
        fix = "give a source for its sites or its joints"
        refuse(mapping.path, "", f"it selects nothing from {capture.program}", fix)
    time = clocks[0][1]
    _check_rates(capture, mapping, clocks, time)
    bodies = {role: _on_clock(stream, time) for role, stream in picked.items()}
    angles = {name: _angles_on_clock(mapping.joints[name], *each, time) for name, each in joints.items()}
    commands = None
    if any(_find_column(capture, name) is not None for name in mapping.commands.columns.values()):
        commands = CommandLog(*_commands(capture, mapping.commands, mapping, log=False))
    return Trajectories(capture.path, time, bodies, angles, commands, capture.first_frame)


def read_commands(
    capture: Capture, columns: Commands, mapping: RoomMapping | None = None
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N commands"]]:
    """Return times (s, the log's clock) and commands (in the actuators' units) of a command log.

    In an empty cell the previous command continues.

    **Raises** `InputError` naming file, line and column if a command or time is missing or invalid.
    """
    return _commands(capture, columns, mapping, log=True)


def _pick(capture: Capture, mapping: RoomMapping, source: Source) -> Stream:
    place = f"[{source.role}]"
    if source.section is not None:
        refuse(mapping.path, f"{place} section", f"{capture.program} has no sections", "leave it out")
    if source.position:
        return _from_columns(capture, mapping, source)
    if not capture.bodies:
        fix = 'it has columns, write position = ["x", "y", "z"] there'
        refuse(mapping.path, place, f"it is given by name, but {capture.path.name} is {capture.program}", fix)

    def named(name: str) -> Stream:
        return capture.bodies[find(capture.path, name, capture.bodies, "body or marker", mapping.path)]

    if source.markers:
        streams = [named(name) for name in source.markers]
        time = streams[0].time
        _check_rates(capture, mapping, zip(source.markers, [stream.time for stream in streams], strict=True), time)
        markers = np.stack([_on_clock(stream, time).position for stream in streams])
        geometry = None if source.geometry is None else np.array(source.geometry)
        body = rigid_body(capture.path, source.role, markers, geometry, MARKER_TOLERANCE)
        return Stream(time, body.position, body.quaternion)
    stream = named(source.body or "")
    if stream.angles is None:
        if source.rotation not in (None, "quaternion"):
            fix = "leave rotation out"
            refuse(mapping.path, f"{place} rotation", f"{capture.program} states its convention of rotations", fix)
        return stream
    if source.rotation in (None, "quaternion"):
        fix = (
            'export quaternions, or write rotation = "XYZ" (about the body\'s own axes in turn) or "xyz" (about the '
            "capture's)"
        )
        refuse(mapping.path, place, f"{capture.program} does not state the axes of its angles", fix)
    where = f"the angles of {shorten(source.body or '')}"
    quaternion = to_quaternion(capture.path, where, stream.angles, source.rotation, 1.0)
    return Stream(stream.time, stream.position, quaternion)


def _from_columns(capture: Capture, mapping: RoomMapping, source: Source) -> Stream:
    names = (*source.position, *source.orientation)
    parts = [_column(capture, mapping, name) for name in names]
    places, turns = parts[:3], parts[3:]
    time = places[0][0]
    _check_rates(capture, mapping, zip(names, [own for own, _ in parts], strict=True), time)
    position = np.stack([_values_on_clock(own, series.values, time) for own, series in places], axis=1)
    position *= _unit(capture, mapping, places[0][1], LENGTHS, "length")
    if not source.orientation:
        return Stream(time, position)
    assert source.rotation is not None
    place = f"columns {source.orientation[0]} to {source.orientation[-1]}"
    clock = turns[0][0]
    if not all(_same(own, clock) for own, _ in turns):
        # Components must not be interpolated one by one: quaternions may change their sign, and angles may restart.
        fix = "give columns of one topic, or convert the file to a table"
        refuse(capture.path, place, "their times differ", fix)
    unit = 1.0 if source.rotation == "quaternion" else _unit(capture, mapping, turns[0][1], ANGLES, "angle")
    values = np.stack([series.values for _, series in turns], axis=1)
    fix = f"export unit quaternions, or fix the order of the columns in {mapping.path}"
    quaternion = to_quaternion(capture.path, place, values, source.rotation, unit, fix=fix)
    return Stream(time, position, _rotations_on_clock(clock, quaternion, time))


def _joint(capture: Capture, mapping: RoomMapping, joint: Joint) -> tuple[np.ndarray, np.ndarray]:
    time, series = _column(capture, mapping, joint.column)
    known, kind = (LENGTHS, "length") if joint.slides else (ANGLES, "angle")
    return time, (series.values - joint.zero) * joint.sign * _unit(capture, mapping, series, known, kind)


def _unit(capture: Capture, mapping: RoomMapping, series: Series, known: Mapping[str, float], name: str) -> float:
    unit = mapping.length if name == "length" else mapping.angle
    if unit is None and series.si:
        return 1.0
    if unit is None:
        fix = f'write {name} = "{next(iter(known))}" or another there'
        whose = "a table's" if capture.program == "a table" else f"{capture.path.name}'s"
        refuse(mapping.path, "[units]", f"the unit of {name} of {whose} columns is missing", fix)
    return known[unit]


def _find_column(capture: Capture, name: str) -> str | None:
    """Return the column called `name`, or the one whose name differs only by a comment character. None if missing."""
    if name in capture.columns:
        return name
    bare = name.lstrip(_COMMENT_SIGNS)
    return next((column for column in capture.columns if bare and column.lstrip(_COMMENT_SIGNS) == bare), None)


def _look_up(capture: Capture, name: str, mapping: RoomMapping | None) -> Series:
    column = _find_column(capture, name)
    if column is not None:
        return capture.columns[column]
    if not capture.columns:
        bodies = suggest("", capture.bodies)
        problem = f"it is {capture.program}, which has bodies and markers instead of columns such as {shorten(name)!r}"
        refuse(capture.path, "", problem, f'write body = "..." in the mapping, {bodies}')
    where = "the mapping" if mapping is None else mapping.path
    hint = suggest(name, capture.columns).rstrip("?")
    refuse(capture.path, "", f"there is no column {shorten(name)!r}", f"fix {where}, {hint}")


def _column(capture: Capture, mapping: RoomMapping, name: str) -> tuple[np.ndarray, Series]:
    """Return times and values of a column."""
    series = _look_up(capture, name, mapping)
    return (_rows_clock(capture, mapping) if series.time is None else series.time), series


def _rows_clock(capture: Capture, mapping: RoomMapping) -> np.ndarray:
    """Return the times (s) of a file's rows: from the mapping's rate, or else from its time column."""
    if mapping.rate is not None:
        return np.arange(capture.rows) / mapping.rate
    name = mapping.clock.time or capture.time_column or mapping.commands.time
    column = _find_column(capture, name)
    if capture.clock is not None and column is not None:
        return capture.clock(column, mapping.clock.time_unit)
    fix = f'write time = "..." under [clock] in {mapping.path}, {suggest(name, capture.columns)}'.rstrip("?")
    refuse(capture.path, "", f"there is no column {shorten(name)!r} of times", f"{fix}; or rate = ... (Hz)")


def _log_clock(capture: Capture, columns: Commands, mapping: RoomMapping | None) -> np.ndarray:
    """Return the times (s) of a log with one sample per row."""
    column = _find_column(capture, columns.time)
    if column is None:
        where = "the mapping" if mapping is None else mapping.path
        fix = f'write time = "..." under [commands] in {where}, {suggest(columns.time, capture.columns)}'.rstrip("?")
        if mapping is not None and mapping.clock.time is None:
            fix += "; the time column of the captured file belongs under [clock]"
        refuse(capture.path, "", f"there is no column {shorten(columns.time)!r} of times", fix)
    assert capture.clock is not None
    return capture.clock(column, columns.time_unit)


# ---- commands ----


def _commands(
    capture: Capture, columns: Commands, mapping: RoomMapping | None, *, log: bool
) -> tuple[np.ndarray, np.ndarray]:
    series = {command: _look_up(capture, name, mapping) for command, name in columns.columns.items()}
    clocks: list[np.ndarray] = []
    rows: np.ndarray | None = None
    for each in series.values():
        if each.time is None and rows is None:
            if log:
                rows = _log_clock(capture, columns, mapping)
            else:
                assert mapping is not None
                rows = _rows_clock(capture, mapping)
        clocks.append(rows if each.time is None else each.time)  # pyright: ignore[reportArgumentType]
    time = clocks[0]
    if any(len(clock) != len(time) or (clock != time).any() for clock in clocks):
        # A command is held until the next, so take all instants at which any changes, once all are known.
        time = np.unique(np.concatenate(clocks))
        time = time[time >= max(clock[0] for clock in clocks)]
    values = []
    for (command, each), clock, shown, limits in zip(
        series.items(), clocks, columns.ranges, columns.limits, strict=True
    ):
        share = _share(capture, columns.columns[command], command, each.values, shown)
        held = np.searchsorted(clock, time, side="right") - 1
        values.append(limits[0] + share[held] * (limits[1] - limits[0]))
    return time, np.stack(values, axis=1)


def _share(
    capture: Capture, name: str, command: str, raw: Float[np.ndarray, " N"], shown: tuple[float, float]
) -> Float[np.ndarray, " N"]:
    """Return a command's position in its range, from 0 (smallest value) to 1 (largest value)."""
    held = np.maximum.accumulate(np.where(np.isnan(raw), -1, np.arange(len(raw))))
    if held[0] < 0:
        fix = "write the command, or delete the samples before the first one"
        refuse(capture.path, f"column {shorten(name)}", "the first command is missing", fix)
    with np.errstate(over="ignore"):
        share = (raw[held] - shown[0]) / (shown[1] - shown[0])
    outside = (share < -_COMMAND_TOLERANCE) | (share > 1 + _COMMAND_TOLERANCE)
    if outside.any():
        row = int(outside.argmax())
        problem = f"{raw[held][row]:g} is outside of {shown[0]:g} to {shown[1]:g}"
        fix = (
            "write the column's values at the smallest and the largest command under [commands] in the mapping, as "
            f"range_{command}"
        )
        refuse(capture.path, f"sample {row + 1}, column {shorten(name)}", problem, fix)
    return np.clip(share, 0.0, 1.0)


# ---- interpolation to one clock ----


def _check_rates(
    capture: Capture,
    mapping: RoomMapping,
    clocks: Iterable[tuple[str, Float[np.ndarray, " _"]]],
    time: Float[np.ndarray, " T"],
) -> None:
    """Refuse streams that are slower than the control step.

    `clocks`: names and times of the streams. Those with the clock `time` are not interpolated, and are checked with the
    recording.
    """
    for name, own in clocks:
        problem = None if _same(own, time) else describe_slow(np.diff(own), mapping.control_timestep)
        if problem is not None:
            refuse(capture.path, shorten(name), problem, "record it faster")


def _same(own: np.ndarray, time: np.ndarray) -> bool:
    """Return whether two clocks are equal."""
    return own is time or np.array_equal(own, time)


def _on_clock(stream: Stream, time: Float[np.ndarray, " T"]) -> Body:
    """Return a stream interpolated to `time`."""
    position = np.stack([_values_on_clock(stream.time, axis, time) for axis in stream.position.T], axis=1)
    if stream.quaternion is None:
        return Body(position)
    return Body(position, _rotations_on_clock(stream.time, stream.quaternion, time))


def _values_on_clock(own: np.ndarray, values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return values at the times `own` interpolated to `time`."""
    if _same(own, time):
        return values
    found = np.full(len(time), np.nan)
    seen = np.flatnonzero(~np.isnan(values))
    inside = _bridged(own, seen, time)
    if inside.any():
        found[inside] = np.interp(time[inside], own[seen], values[seen])
    return found


def _angles_on_clock(joint: Joint, own: np.ndarray, values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return a joint's values at the times `own` interpolated to `time`."""
    if _same(own, time):
        return values
    return _values_on_clock(own, count_turns(values) if joint.turns else values, time)


def _rotations_on_clock(
    own: Float[np.ndarray, " N"], quaternion: Float[np.ndarray, "N 4"], time: Float[np.ndarray, " T"]
) -> Float[np.ndarray, "T 4"]:
    """Return orientations at the times `own` interpolated to `time`, along the shortest rotation."""
    if _same(own, time):
        return quaternion
    found = np.full((len(time), 4), np.nan)
    seen = np.flatnonzero(~np.isnan(quaternion).any(axis=1))
    inside = _bridged(own, seen, time)
    if inside.any():
        turned = Rotation.from_quat(quaternion[seen], scalar_first=True)
        found[inside] = Slerp(own[seen], turned)(time[inside]).as_quat(scalar_first=True)
    return found


def _bridged(own: np.ndarray, seen: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return which of `time` are times of seen samples, or lie between two with a gap of at most `_LONGEST_BRIDGE`
    spacings and `LONGEST_GAP`."""
    if len(seen) < 2:
        return np.zeros(len(time), bool)
    known = own[seen]
    after = np.clip(np.searchsorted(known, time), 1, len(known) - 1)
    step = known[after] - known[after - 1]
    spacing = max(float(np.median(np.diff(own))), float(np.median(np.diff(time))))
    longest = min(_LONGEST_BRIDGE * spacing, LONGEST_GAP)
    bridged = (step <= longest) | (known[after] - time <= 1e-9)  # or at the sample that ends a gap
    return (time >= known[0] - 1e-9) & (time <= known[-1] + 1e-9) & bridged
