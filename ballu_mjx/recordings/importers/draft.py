"""Draft of a mapping for a file, from the names in it. Guessed entries are marked as guesses."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Container, Mapping, Sequence

from ballu_mjx.recordings.importers.contents import Contents, Item, describe_contents, printable
from ballu_mjx.recordings.importers.trajectories import TIMES
from ballu_mjx.robots.description import RobotDescription

_CLOCKS = ("time", "timestamp", "t", "stamp", "times", "timesec", "seconds", "sec", "clock", "ms", "ns", "us")
_TIME_UNITS = ("s", "ms", "us", "ns", "sec", "secs", "seconds", "msec", "usec", "nsec")
_COMMANDS = ("command", "cmd", "action", "ctrl", "control", "target")
_UP = "OptiTrack Motive"
"""Program whose files have y up by default."""
_LONGEST_M = 20.0
"""Positions with larger values are assumed to be in mm."""
_LISTED = 16
"""Largest number of names in a comment."""
_LONGEST_RAD = 7.0
"""Angles with larger values are assumed to be in deg."""


@dataclasses.dataclass(frozen=True)
class _Part:
    """Lines of a table of the mapping, with the columns and items of the file that they name."""

    lines: Sequence[str]
    columns: Sequence[str] = ()
    items: Sequence[Item] = ()
    empty: bool = False
    """Whether the user must name the columns of positions."""


def draft_mapping(contents: Contents, robot: RobotDescription) -> str:
    """Return a mapping file for `robot`. If the file's names are unambiguous, `record import` accepts it unchanged.

    Each guess has a comment. Entries that were not found are empty, with the possible names in a comment.
    """
    roles = (robot.tracked, *robot.points)
    parts = {role: _role(contents, role, roles, robot) for role in roles}
    joints = {joint: found for joint in robot.joints if (found := _match(joint, _columns(contents))) is not None}
    joints = {joint: item for joint, item in joints.items() if item.name not in parts[robot.tracked].columns}
    taken = {name for part in parts.values() for name in part.columns}
    commands = _find_commands(contents, robot, taken)
    used = [item for part in parts.values() for item in part.items] + [*joints.values(), *commands.values()]
    lines = [
        "# Draft of a mapping, by `ballu_mjx record map`. Check the entries marked as a guess, and fill in empty ones.",
        *(f"# {line}" for line in describe_contents(contents, most=24)),
        "",
        f"robot = {json.dumps(robot.name.lower().replace(' ', '_') + '-1')}  # the name of this specimen",
        *_rate_line(contents),
        "",
        *_axes(contents),
        *_units(parts, joints, contents),
        *_clock(contents, used),
    ]
    for role, part in parts.items():
        lines += [f"[{role}]", *part.lines, ""]
    for joint, item in joints.items():
        lines += [f"[{joint}]", f"column = {json.dumps(item.name)}", "# sign = -1, zero = ...: see example-mapping", ""]
    return "\n".join([*lines, *_command_lines(contents, robot, commands)]) + "\n"


# ---- names ----


def _plain(name: str) -> str:
    """Return the letters and digits of a name, in lower case."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _last(name: str) -> str:
    """Return the last part of a name: after a subject, a topic or a frame, or a name in brackets at its end."""
    inside = re.fullmatch(r".*\[([^\]]*[^\]\d][^\]]*)\]", name)
    return _plain(inside[1] if inside else re.split(r"[:/]", name.rstrip("/"))[-1])


def _match(role: str, items: Sequence[Item]) -> Item | None:
    """Return the only item whose name is `role`, or else ends in it, or else contains it. None if there is none."""
    wanted = _plain(role)
    for fits in (
        lambda item: _plain(item.called) == wanted,
        lambda item: _last(item.called) == wanted,
        lambda item: wanted in _plain(item.called) and "velocity" not in item.called and "effort" not in item.called,
    ):
        found = [item for item in items if fits(item)]
        if "position" in "".join(item.called for item in found) and len(found) > 1:
            found = [item for item in found if "position" in item.called]
        if len(found) == 1:
            return found[0]
    return None


def _columns(contents: Contents) -> list[Item]:
    return [item for item in contents.items if item.kind == "column"]


# ---- sites ----


def _role(contents: Contents, role: str, roles: Sequence[str], robot: RobotDescription) -> _Part:
    """Return the table of a site: from a body, a marker, several markers, or columns."""
    tracked = robot.tracked
    bodies = [item for item in contents.items if item.kind == "body"]
    markers = [item for item in contents.items if item.kind == "marker"]
    found = _match(role, bodies if role == tracked else [*bodies, *markers])
    guess = ""
    if found is None and role == tracked and len(bodies) == 1:
        found, guess = bodies[0], "  # a guess: the only body"
    if found is not None:
        lines = [f"body = {json.dumps(found.name)}{guess}"]
        if found.section is not None:
            lines.append(f"section = {json.dumps(found.section)}")
        if found.rotation is not None:
            comment = '# a guess: the file does not state it. "helical": a rotation vector, "XYZ": Euler angles'
            lines.append(f'rotation = "{found.rotation}"  {comment}')
        return _Part(lines, items=[found])
    cluster = [
        item for item in markers if _plain(item.name).startswith(_plain(role)) or _plain(role) in _last(item.name)
    ]
    if role == tracked and len(cluster) >= 3:
        return _markers(cluster, "its axes are parallel to the capture's in the first sample that shows all markers")
    if (part := _from_columns(contents, role, robot, alone=len(roles) == 1)) is not None:
        return part
    if role == tracked and not bodies:
        points = [_match(point, markers) for point in roles if point != tracked]
        left = [item for item in markers if item not in points]
        if len(left) >= 3:
            return _markers(left, "a guess: keep three or more that sit on the body")
    choice = bodies if role == tracked and bodies else [*bodies, *markers]
    if not choice and _columns(contents):
        lines = [f'position = ["", "", ""]  # choose from {_names(_columns(contents))}']
        return _Part(lines + (_turn_lines(contents, None) if role == tracked else []), empty=True)
    return _Part([f'body = ""  # choose from {_names(choice)}'])


def _markers(items: Sequence[Item], comment: str) -> _Part:
    names = ", ".join(json.dumps(item.name) for item in items)
    return _Part([f"markers = [{names}]  # {comment}"], items=items)


def _names(items: Sequence[Item]) -> str:
    """Return names for a comment. Items with a single sample come last, because they do not move."""
    names = [
        printable(item.name + (f" ({item.label})" if item.label else ""))
        for item in sorted(items, key=lambda item: item.samples < 2)
    ]
    return ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")


def _stems(names: Sequence[str]) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Return the columns of positions and of quaternions, by stem of their names.

    The names end in x, y, z or in w, x, y, z. Arrays of three, four or seven columns count too.
    """
    known = set(names)
    places: dict[str, list[str]] = {}
    turns: dict[str, list[str]] = {}
    for letters in ("wxyz", "WXYZ"):
        for name in names:
            if not name.endswith(letters[1]):
                continue
            stem = name[:-1]
            three = [stem + letter for letter in letters[1:]]
            if all(each in known for each in three):
                if stem + letters[0] in known:
                    turns[stem] = [stem + letters[0], *three]
                else:
                    places[stem] = three
    arrays: dict[str, int] = {}
    for name in names:
        inside = re.fullmatch(r"(.*)\[(\d+)\]", name)
        if inside:
            arrays[inside[1]] = max(arrays.get(inside[1], 0), int(inside[2]) + 1)
    for stem, count in arrays.items():
        if count in (3, 7):
            places[stem] = [f"{stem}[{i}]" for i in range(3)]
        if count in (4, 7):
            turns[stem] = [f"{stem}[{i}]" for i in range(count - 4, count)]
    return places, turns


def _from_columns(contents: Contents, role: str, robot: RobotDescription, *, alone: bool) -> _Part | None:
    """Return the table of a site from columns of a position, and of a quaternion if needed. None if not found."""
    items = {item.called: item for item in _columns(contents)}
    places, turns = _stems(list(items))

    def choose(stems: Mapping[str, list[str]]) -> str | None:
        found = [stem for stem in stems if _plain(role) in _plain(stem)]
        found = [stem for stem in found if not re.search(r"vel|acc|rate|omega|gyro", stem)] or found
        if len(found) == 1:
            return found[0]
        return next(iter(stems)) if alone and len(stems) == 1 else None

    place = choose(places)
    if place is None:
        return None
    found = [items[name] for name in places[place]]
    chosen = [item.name for item in found]
    lines = [f"position = {json.dumps(chosen)}"]
    turn = choose(turns)
    if role == robot.tracked or (role in robot.oriented_points and turn is not None):
        lines += _turn_lines(contents, turn)
    return _Part(lines, chosen, found)


def _turn_lines(contents: Contents, stem: str | None) -> list[str]:
    """Return the lines of a site's orientation: the quaternion named `stem`, or else the only quaternion."""
    items = {item.called: item for item in _columns(contents)}
    turns, guess = _stems(list(items))[1], ""
    if stem is None and len(turns) == 1:
        stem, guess = next(iter(turns)), "  # a guess: the only quaternion"
    if stem is None:
        return ['orientation = ["", "", "", ""]  # choose its columns', 'rotation = "quaternion"']
    chosen = [items[name] for name in turns[stem]]
    if "[" in turns[stem][0]:
        guess = "  # a guess: w, x, y, z"
        if not _may_be_w(chosen[0]) and _may_be_w(chosen[3]):
            chosen, guess = [chosen[3], *chosen[:3]], "  # a guess: x, y, z, w in the file"
    return [f"orientation = {json.dumps([item.name for item in chosen])}{guess}", 'rotation = "quaternion"']


def _may_be_w(item: Item) -> bool:
    """Return whether the column of a quaternion reaches nearly 1 or -1, as w does near the reference orientation."""
    return item.low is None or item.high is None or max(-item.low, item.high) > _NEARLY_UPRIGHT


_NEARLY_UPRIGHT = 0.9
"""Magnitude of w beyond which the other components are below 0.44."""


# ---- axes, units, clock and commands ----


def _axes(contents: Contents) -> list[str]:
    if _UP in contents.program:
        return ["[axes]  # a guess: y is up, and the robot looks along z at the start",
                'forward = "z"', 'left = "x"', 'up = "y"', ""]  # fmt: skip
    return ["[axes]  # a guess: z is up, and the robot looks along x at the start",
            'forward = "x"', 'left = "y"', 'up = "z"', ""]  # fmt: skip


def _units(parts: Mapping[str, _Part], joints: Mapping[str, Item], contents: Contents) -> list[str]:
    by_name = {item.name: item for item in _columns(contents)}
    places = [by_name[name] for part in parts.values() for name in part.columns if by_name[name].unit is None]
    angles = [item for item in joints.values() if item.unit is None]
    lines = []
    if not places and any(part.empty for part in parts.values()):
        lines.append('length = "m"  # a guess: the unit of the positions that you name below')
    if places:
        unit = "mm" if _largest(places) > _LONGEST_M else "m"
        lines.append(f'length = "{unit}"  # a guess: positions reach {_largest(places):.4g}')
    if angles:
        unit = "deg" if _largest(angles) > _LONGEST_RAD else "rad"
        lines.append(f'angle = "{unit}"  # a guess: angles reach {_largest(angles):.4g}')
    return ["[units]", *lines, ""] if lines else []


def _largest(items: Sequence[Item]) -> float:
    return max((max(abs(item.low), abs(item.high)) for item in items if item.low is not None and item.high is not None),
               default=0.0)  # fmt: skip


def _time_item(contents: Contents) -> Item | None:
    rising = [item for item in _columns(contents) if item.step is not None]
    named = [item for item in rising if _is_clock(item.name)]
    return (named or [None])[0]


def _is_clock(name: str) -> bool:
    """Return whether a column has the name of a clock, such as `time`, `timestamp_ns`, `t_ms` or `Stamp [us]`."""
    words = [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word]
    if len(words) > 1 and words[-1] in _TIME_UNITS:
        words = words[:-1]
    called = "".join(words)
    return called in _CLOCKS or called.startswith("time")


def _rate_line(contents: Contents) -> list[str]:
    if not contents.rows or _time_item(contents) is not None:
        return []
    rising = [item for item in _columns(contents) if item.step is not None]
    if rising:
        return [f"rate = 100.0  # Hz; a guess. If one of these is the time, name it under [clock]: {_names(rising)}"]
    return ["rate = 100.0  # Hz; a guess: no column increases as times do"]


def _clock(contents: Contents, used: Sequence[Item]) -> list[str]:
    clocks = {item.clock for item in used if item.clock is not None}
    if clocks:
        if len(clocks) == 1:
            return ["[clock]", f'time = "{clocks.pop()}"', ""]
        return ["[clock]", 'time = "received"  # not all messages have a stamp in a header', ""]
    item = _time_item(contents)
    if not contents.rows or item is None:
        return []
    step = item.step or 0.0
    # Assume a rate of 5 Hz to 5 kHz.
    unit = next((unit for unit, scale in TIMES.items() if 2e-4 <= step * scale <= 0.2), "s")
    return [
        "[clock]",
        f"time = {json.dumps(item.name)}",
        f'time_unit = "{unit}"  # a guess: samples are {step:.4g} apart',
        *([f"episode = {contents.episodes[0]}  # of {len(contents.episodes)}"] if contents.episodes else []),
        "",
    ]


def _find_commands(contents: Contents, robot: RobotDescription, taken: Container[str]) -> dict[str, Item]:
    columns = [item for item in _columns(contents) if item.name not in taken]
    likely = [item for item in columns if any(word in item.name.lower() for word in _COMMANDS)]
    found = {}
    for name in robot.commands:
        called = [item for item in columns if _plain(item.called) == _plain(name)]
        item = _match(f"command_{name}", columns) or _match(name, likely) or (called[0] if len(called) == 1 else None)
        if item is not None:
            found[name] = item
    if len(found) == len(robot.commands):
        return found
    arrays: dict[str, list[Item]] = {}
    for item in likely:
        inside = re.fullmatch(r"(.*)\[\d+\]", item.name)
        arrays.setdefault(inside[1] if inside else item.name, []).append(item)
    whole = [items for items in arrays.values() if len(items) == len(robot.commands)]
    return dict(zip(robot.commands, whole[0], strict=True)) if len(whole) == 1 else {}


def _command_lines(contents: Contents, robot: RobotDescription, commands: Mapping[str, Item]) -> list[str]:
    if not commands:
        return [
            "[commands]  # none were found in the file: give their log by --commands, and name its columns here",
            '# time = "time"  # the column of the log\'s times; in a bag "header" or "received"',
            '# time_unit = "s"  # s, ms, us, ns',
            *(
                line
                for name, (low, high) in zip(robot.commands, robot.command_ranges, strict=True)
                for line in (
                    f"# {name} = {json.dumps(f'command_{name}')}",
                    f"# range_{name} = [{low:g}, {high:g}]  # the column's values at the command's limits",
                )
            ),
        ]
    lines = ["[commands]"]
    for (name, found), (low, high) in zip(commands.items(), robot.command_ranges, strict=True):
        guess = "" if _plain(name) in _plain(found.called) else "  # a guess: by their order"
        lines.append(f"{name} = {json.dumps(found.name)}{guess}")
        shown = f"the column ranges from {found.low:.4g} to {found.high:.4g}" if found.low is not None else ""
        lines.append(f"range_{name} = [{low:g}, {high:g}]  # the column's values at the command's limits; {shown}")
    return lines
