"""Reader of ROS 1 and ROS 2 bags and of MCAP files (https://mcap.dev): poses, joints and commands by topic.

Bags are read with rosbags and MCAP files with mcap, which the extra `bags` installs. Messages are in ROS's encodings or
JSON.

- A topic with poses is a body with the topic's name. Pose types are PoseStamped, PoseWithCovarianceStamped, Odometry,
  TransformStamped, and PointStamped (a marker). Each transform of a TFMessage is a body `topic:child_frame`.
- Every other topic has one column for each number in its messages: `topic:field.field` or `topic:field[i]`. The columns
  of a JointState are `topic:position[joint]`, `topic:velocity[joint]` and `topic:effort[joint]`.

Units are those of ROS (REP 103): m and rad.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.importers.capture import Capture, Lazy, Series, Stream
from ballu_mjx.recordings.importers.mapping import Clock, RoomMapping
from ballu_mjx.recordings.importers.trajectories import LENGTHS, refuse, shorten, to_quaternion

HEADER, RECEIVED = "header", "received"
"""The two clocks of a bag: the stamps in the messages' headers, and the times at which they were recorded."""
_EITHER = "either"
"""Clock for listing a bag's topics: the stamps of the headers if there are any, else the recorded times."""
_POSES = ("PoseStamped", "PoseWithCovarianceStamped", "Odometry", "TransformStamped", "PointStamped")
_TREE, _JOINTS = "TFMessage", "JointState"
_LONGEST_ARRAY = 256
"""Largest length of an array whose numbers become columns. Longer arrays (images, scans) are left out."""
_DEEPEST = 5
"""Largest depth of nested fields whose numbers become columns."""
_ENDINGS = (".bag", ".mcap", ".db3")


@dataclasses.dataclass(frozen=True)
class _Topic:
    """A topic of a bag, with its messages."""

    name: str
    kind: str
    """Type of the messages, without package."""
    messages: Callable[[], Iterator[tuple[int, Any]]]
    """Iterator over the recorded time (ns) and the message, an object or a dictionary."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Decoded:
    """Times and numbers of a topic or body."""

    received: np.ndarray
    """Recorded times (ns)."""
    stamped: np.ndarray | None
    """Stamps of the headers (ns). None if any message has none."""
    values: Mapping[str, np.ndarray]
    """Numbers by column."""


def recognise_bag(path: Path, start: str) -> bool:
    """Return whether the file's name ends in .bag, .db3 or .mcap, or the folder holds a ROS 2 bag (metadata.yaml)."""
    del start
    return path.suffix.lower() in _ENDINGS or (path.is_dir() and (path / "metadata.yaml").is_file())


def open_bag(path: Path, mapping: RoomMapping | None) -> Capture:
    """Return the bodies and columns of the bag or MCAP file at `path`. A topic is decoded at first use.

    **Raises** `InputError` if a package is not installed, if the file is damaged, or if a topic lacks the selected
    clock.
    """
    if not path.exists():
        refuse(path, "", "there is no such file or folder", "check the path")
    clock = Clock(_EITHER) if mapping is None else mapping.clock
    if mapping is not None and clock.time not in (None, HEADER, RECEIVED):
        fix = f'write "{HEADER}" (stamps of the messages) or "{RECEIVED}" (times of recording)'
        refuse(mapping.path, f"{clock.table} time", f"a bag has no column {shorten(clock.time)!r}", fix)
    length = 1.0 if mapping is None or mapping.length is None else LENGTHS[mapping.length]
    topics = _mcap_topics(path) if path.suffix.lower() == ".mcap" else _bag_topics(path)
    bodies: dict[str, Callable[[], Stream]] = {}
    columns: dict[str, Callable[[], Series]] = {}
    notes: list[str] = []
    for topic in topics:
        if topic.kind in (*_POSES, _TREE):
            poses = functools.cache(functools.partial(_decode, path, topic, _poses_of))
            found = [topic.name]
            if topic.kind == _TREE:
                found = sorted(poses())
            for name in found:
                bodies[name] = functools.partial(_stream, path, topic, poses, name, clock, length)
            continue
        first = _first(path, topic)
        names = [] if first is None else list(_columns_of(topic, first))
        if not names:
            notes.append(f"{shorten(topic.name)} ({shorten(topic.kind)}) holds no readable numbers.")
            continue
        numbers = functools.cache(functools.partial(_decode, path, topic, _columns_of))
        for name in names:
            columns[name] = functools.partial(_series, path, topic, numbers, name, clock)
    if not bodies and not columns:
        refuse(path, "", "holds no topic with poses or numbers", "give a bag with the robot's topics")
    return Capture(path, "a ROS bag or MCAP", Lazy(bodies), Lazy(columns), notes=notes)


# ---- messages to numbers ----


def _get(message: Any, *names: str) -> Any:
    for name in names:
        message = message.get(name) if isinstance(message, dict) else getattr(message, name, None)
    return message


def _stamp(message: Any) -> int | None:
    """Return the stamp of a message's header (ns). None without header, or if the stamp is 0."""
    stamp = _get(message, "header", "stamp")
    if stamp is None:
        return None
    seconds, rest = _get(stamp, "sec"), _get(stamp, "nanosec")
    rest = _get(stamp, "nsec") if rest is None else rest
    if not isinstance(seconds, int) or not isinstance(rest, int):
        return None
    return seconds * 10**9 + rest or None


def _poses_of(topic: _Topic, message: Any) -> Iterator[tuple[str, Any, Sequence[float]]]:
    """Yield name, message with the header, and numbers of each pose: x, y, z, qw, qx, qy, qz, or x, y, z of a point."""
    if topic.kind == _TREE:
        for transform in _get(message, "transforms") or ():
            yield f"{topic.name}:{_get(transform, 'child_frame_id')}", transform, _transform(transform)
    elif topic.kind == "TransformStamped":
        yield topic.name, message, _transform(message)
    elif topic.kind == "PointStamped":
        yield topic.name, message, [float(_get(message, "point", axis)) for axis in "xyz"]
    else:
        pose = _get(message, "pose")
        pose = _get(pose, "pose") if topic.kind in ("Odometry", "PoseWithCovarianceStamped") else pose
        place, turn = _get(pose, "position"), _get(pose, "orientation")
        yield topic.name, message, [*(float(_get(place, a)) for a in "xyz"), *(float(_get(turn, a)) for a in "wxyz")]


def _transform(message: Any) -> list[float]:
    place, turn = _get(message, "transform", "translation"), _get(message, "transform", "rotation")
    return [*(float(_get(place, a)) for a in "xyz"), *(float(_get(turn, a)) for a in "wxyz")]


def _columns_of(topic: _Topic, message: Any) -> dict[str, float]:
    """Return the numbers of a message by column."""
    if topic.kind == _JOINTS:
        names = list(_get(message, "name") or ())
        found = {}
        for field in ("position", "velocity", "effort"):
            values = _get(message, field)
            values = [] if values is None else list(values)
            found |= {f"{topic.name}:{field}[{name}]": float(x) for name, x in zip(names, values, strict=False)}
        return found
    return dict(_flatten(f"{topic.name}:", message, 0))


def _flatten(prefix: str, value: Any, depth: int) -> Iterator[tuple[str, float]]:
    """Yield column name and number for each number in the nested fields of a message, without its header."""
    if isinstance(value, bool | int | float | np.bool_ | np.number):
        yield prefix.rstrip(":"), float(value)
    elif isinstance(value, list | tuple | np.ndarray):
        if len(value) <= _LONGEST_ARRAY and depth < _DEEPEST:
            for i, each in enumerate(value):
                yield from _flatten(f"{prefix.rstrip(':') if prefix.endswith(':') else prefix}[{i}]", each, depth + 1)
    elif not isinstance(value, str | bytes | None) and depth < _DEEPEST:
        fields = value if isinstance(value, dict) else getattr(value, "__dataclass_fields__", {})
        for name in fields:
            if name != "header" and not name.startswith("__"):
                part = name if prefix.endswith(":") else f".{name}"
                yield from _flatten(prefix + part, _get(value, name), depth + 1)


def _first(path: Path, topic: _Topic) -> Any:
    try:
        return next((message for _, message in topic.messages()), None)
    except InputError:
        raise
    except Exception as error:
        _damaged(path, topic, error)


def _damaged(path: Path, topic: _Topic, error: Exception) -> NoReturn:
    reason = shorten(" ".join(str(error).split()) or type(error).__name__)
    refuse(path, shorten(topic.name), f"a message cannot be decoded ({reason})", "record or copy the bag again")


def _decode(path: Path, topic: _Topic, of: Callable[..., Any]) -> dict[str, _Decoded]:
    """Return all messages of a topic, decoded by `of`: by body, or with all columns under the topic's name."""
    rows: dict[str, list[tuple[int, int | None, Any]]] = {}
    try:
        for received, message in topic.messages():
            if of is _columns_of:
                rows.setdefault(topic.name, []).append((received, _stamp(message), of(topic, message)))
            else:
                for name, holder, numbers in of(topic, message):
                    rows.setdefault(name, []).append((received, _stamp(holder), numbers))
    except InputError:
        raise
    except Exception as error:  # Decoders raise many types for damaged messages.
        _damaged(path, topic, error)
    found = {}
    for name, each in rows.items():
        received = np.array([row[0] for row in each], np.int64)
        stamps = [row[1] for row in each]
        stamped = None if any(stamp is None for stamp in stamps) else np.array(stamps, np.int64)
        if of is _columns_of:
            names = list(dict.fromkeys(column for row in each for column in row[2]))
            values = {column: np.array([row[2].get(column, np.nan) for row in each]) for column in names}
        else:
            table = np.array([row[2] for row in each], float)
            values = {str(i): column for i, column in enumerate(table.T)}
        found[name] = _Decoded(received, stamped, values)
    return found


def _times(path: Path, name: str, decoded: _Decoded, clock: Clock) -> tuple[np.ndarray, str]:
    """Return the times (s) of a topic, and the name of their clock."""
    chosen = clock.time or HEADER
    if chosen == _EITHER:
        chosen = RECEIVED if decoded.stamped is None else HEADER
    if chosen != RECEIVED and decoded.stamped is None:
        fix = f'write time = "{RECEIVED}" under {clock.table} in the mapping, the times of recording'
        refuse(path, shorten(name), "not all of its messages have a stamp in a header", fix)
    ns = decoded.received if chosen == RECEIVED or decoded.stamped is None else decoded.stamped
    back = np.diff(ns) <= 0
    if back.any():
        row = int(back.argmax()) + 1
        other = RECEIVED if chosen != RECEIVED else HEADER
        problem = f"time runs back or stands still at message {row + 1}, by {(ns[row - 1] - ns[row]) * 1e-9:.6f} s"
        fix = f'try time = "{other}" under {clock.table} in the mapping, or cut the bag'
        refuse(path, shorten(name), problem, fix)
    return ns * 1e-9, chosen


def _stream(
    path: Path,
    topic: _Topic,
    decode: Callable[[], Mapping[str, _Decoded]],
    name: str,
    clock: Clock,
    length: float,
) -> Stream:
    decoded = decode().get(name)
    if decoded is None:
        refuse(path, shorten(name), "the topic has no messages", "record it again")
    table = np.stack(list(decoded.values.values()), axis=1)
    bad = ~np.isfinite(table).all(axis=1)
    table[bad] = np.nan
    time, known = _times(path, name, decoded, clock)
    if table.shape[1] == 3:
        return Stream(time, table * length, clock=known)
    quaternion = to_quaternion(path, shorten(name), table[:, 3:], "quaternion", 1.0)
    return Stream(time, table[:, :3] * length, quaternion, clock=known)


def _series(path: Path, topic: _Topic, decode: Callable[[], Mapping[str, _Decoded]], name: str, clock: Clock) -> Series:
    decoded = decode()[topic.name]
    values = decoded.values[name]
    if np.isinf(values).any():
        refuse(path, shorten(name), f"message {int(np.isinf(values).argmax()) + 1} is infinite", "cut the bag there")
    time, known = _times(path, topic.name, decoded, clock)
    return Series(values, time, topic.kind == _JOINTS, known)


# ---- files ----


def _missing(path: Path, package: str, error: ImportError) -> NoReturn:
    fix = 'install it by `pip install -c constraints.txt -e ".[bags]"`'
    raise InputError(f"{path}: bags and MCAP files are read with {package}, which is not installed; {fix}.") from error


def _bag_topics(path: Path) -> list[_Topic]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        _missing(path, "rosbags", error)
    # Bags of ROS 2 before Iron do not hold the definitions of their messages.
    store = get_typestore(Stores.ROS2_HUMBLE)

    def messages(name: str) -> Iterator[tuple[int, Any]]:
        with AnyReader([path], default_typestore=store) as reader:
            connections = [each for each in reader.connections if each.topic == name]
            for connection, received, content in reader.messages(connections=connections):
                yield received, reader.deserialize(content, connection.msgtype)

    try:
        with AnyReader([path], default_typestore=store) as reader:
            kinds = {each.topic: each.msgtype for each in reader.connections}
    except Exception as error:
        reason = shorten(" ".join(str(error).split()) or type(error).__name__)
        refuse(path, "", f"not a complete bag ({reason})", "stop recordings cleanly, or reindex or copy the bag again")
    return [_Topic(n, kind.rpartition("/")[2], functools.partial(messages, n)) for n, kind in sorted(kinds.items())]


def _mcap_topics(path: Path) -> list[_Topic]:
    try:
        from mcap.reader import make_reader
    except ImportError as error:
        _missing(path, "mcap", error)
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            if summary is None:
                raise ValueError("its summary is missing")
            channels = {c.topic: (c, summary.schemas.get(c.schema_id)) for c in summary.channels.values()}
    except Exception as error:
        reason = shorten(" ".join(str(error).split()) or type(error).__name__)
        refuse(path, "", f"not a complete MCAP file ({reason})", "repair it with `mcap recover`, or record again")
    decoders = {name: _decoder(path, channel, schema) for name, (channel, schema) in channels.items()}

    def messages(name: str) -> Iterator[tuple[int, Any]]:
        with path.open("rb") as stream:
            for _, _, message in make_reader(stream, validate_crcs=True).iter_messages(topics=[name]):
                yield message.log_time, decoders[name](message.data)

    return [
        _Topic(name, "" if schema is None else schema.name.replace(".", "/").rpartition("/")[2],
               functools.partial(messages, name))
        for name, (_, schema) in sorted(channels.items())
    ]  # fmt: skip


def _decoder(path: Path, channel: Any, schema: Any) -> Callable[[bytes], Any]:
    encoding = channel.message_encoding
    if encoding == "json":
        return json.loads
    if encoding not in ("cdr", "ros1") or schema is None:

        def unknown(data: bytes) -> NoReturn:
            problem = f"its messages are encoded as {shorten(encoding)!r}"
            refuse(path, shorten(channel.topic), problem, "record in an encoding of ROS (cdr, ros1) or in JSON")

        return unknown
    try:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    except ImportError as error:
        _missing(path, "rosbags", error)

    @functools.cache
    def store() -> Any:
        made = get_typestore(Stores.EMPTY if encoding == "cdr" else Stores.ROS1_NOETIC)
        text = schema.data.decode()
        types = get_types_from_idl(text) if schema.encoding == "ros2idl" else get_types_from_msg(text, kind)
        known = get_typestore(Stores.ROS2_HUMBLE) if encoding == "cdr" else made
        made.register({n: t for n, t in {**known.fielddefs, **types}.items() if n not in made.fielddefs})
        return made

    kind = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/", 1)

    def decode(data: bytes) -> Any:
        if encoding == "cdr":
            return store().deserialize_cdr(data, kind)
        return store().deserialize_ros1(data, kind)

    return decode
