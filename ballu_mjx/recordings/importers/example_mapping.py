"""A mapping file to start from: every key with its default, and what it means."""

from __future__ import annotations

from ballu_mjx.recordings.hooks import hooks_of
from ballu_mjx.robots.description import RobotDescription


def example_mapping(robot: RobotDescription) -> str:
    """Return a mapping file for `robot` with every key and its default."""
    tracked, name = robot.tracked, robot.name.lower().replace(" ", "_")
    start = str(not robot.anchored).lower()
    pads = {"pad": " " * max(1, 25 - len(f'robot = "{name}-1"')), "pad_tracked": " " * max(1, 23 - len(tracked))}
    floors = "".join(f'; "{floor}": where the lowest of these stands' for floor in hooks_of(robot).floors)
    lines = [_EXAMPLE.format(tracked=tracked, name=name, floors=floors, start=start, **pads)]
    lines += [f'[{point}]\nbody = "{name}:{point}"\n' for point in robot.points]
    if robot.joints:
        lines.append(
            f"# [{robot.joints[0]}]{' ' * max(1, 22 - len(robot.joints[0]))}# from columns: {', '.join(robot.joints)}\n"
            '# column = "angle"\n'
            "# sign = 1               # -1 turns it round\n"
            "# zero = 0.0             # in the column's unit: what it shows where the model's angle is 0\n"
        )
    lines.append(
        "[commands]               # columns of the command log (--commands), or of the table itself\n"
        'time = "time"\ntime_unit = "s"\n'
        + "".join(f'{command} = "command_{command}"\n' for command in robot.commands)
        + "# What the columns show at the actuator's smallest and largest command. Angles: [0, 90]; an actuator\n"
        "# mounted the other way round: [90, 0].\n"
        + "".join(
            f"range_{command} = [{low:g}, {high:g}]\n"
            for command, (low, high) in zip(robot.commands, robot.command_ranges, strict=True)
        )
    )
    return "\n".join(lines)


_EXAMPLE = """\
# What is what in the files of one capture room, for `python -m ballu_mjx record import`.
# Only robot and the sites of a free robot must stand here; all else shows its default unless it says otherwise.

robot = "{name}-1"{pad}# the name that all recordings of this robot carry
kind = "free"            # "suspended": the root is held
notes = ""
# rate = 100.0           # Hz; only for files without times, or where the file's own rate is wrong

[axes]                   # the capture's axes that point along the format's; all of "x", "-x" ... "-z"
forward = "x"
left = "y"
up = "z"

[origin]
start = {start}             # turn and shift so that the robot starts at the origin, looking along x; false: as captured
floor = 0.0              # m, height of the floor in the capture{floors}

[units]                  # only where the file does not say, or says something wrong
# length = "mm"          # m, cm, mm
# angle = "deg"          # rad, deg

[clock]                  # of the captured file, where it does not say; [commands] has the log's own
# time = "time"          # the column of times; default: the name that stands under [commands]. Of a bag or MCAP:
                         # "header" (the messages' stamps), or "received" (when they were recorded)
# time_unit = "s"        # s, ms, us, ns
# episode = 0            # of a LeRobot dataset

[{tracked}]{pad_tracked}# needs an orientation: a Vicon object or segment, three markers or more, or columns
body = "{name}:{tracked}"   # "subject:segment", an object, or the name behind the colon where only one subject has it
# section = "Segments"   # where the name stands in several sections of a Vicon file
# rotation = "helical"   # RX, RY, RZ are a rotation vector. Euler angles: "XYZ" about the body's own axes in turn
                         # (Vicon's "Euler XYZ"), "xyz" about the capture's. Default: helical in "Segments"; others must
                         # say it
# markers = ["M1", "M2", "M3", "M4"]                        # instead of body
# geometry = [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, 0, 0.1]]  # where they sit, m; default: as at the start
# position = ["x", "y", "z"]                                # instead of body: names of columns
# orientation = ["qw", "qx", "qy", "qz"]                    # with rotation = "quaternion" (w, x, y, z), or three angles
offset = [0.0, 0.0, 0.0] # m: the model's site `{tracked}` in the tracked body's frame
turn = [0.0, 0.0, 0.0]   # deg, a rotation vector: the model's frame of this body in the tracked body's frame.
                         # "start": at the start the robot stands upright and looks along `forward`
"""
