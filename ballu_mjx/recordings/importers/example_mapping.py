"""Example of a mapping file: every key with its default and its meaning."""

from __future__ import annotations

from ballu_mjx.recordings.recording_hooks import hooks_of
from ballu_mjx.robots.description import RobotDescription


def example_mapping(robot: RobotDescription) -> str:
    """Return a mapping file for `robot` with every key and its default."""
    tracked, name = robot.tracked, robot.name.lower().replace(" ", "_")
    start = str(not robot.anchored).lower()
    pads = {"pad": " " * max(1, 25 - len(f'robot = "{name}-1"')), "pad_tracked": " " * max(1, 23 - len(tracked))}
    floors = "".join(f'; "{floor}": their lowest height' for floor in hooks_of(robot).floors)
    lines = [_EXAMPLE.format(tracked=tracked, name=name, floors=floors, start=start, **pads)]
    lines += [f'[{point}]\nbody = "{name}:{point}"\n' for point in robot.points]
    if robot.joints:
        lines.append(
            f"# [{robot.joints[0]}]{' ' * max(1, 22 - len(robot.joints[0]))}# from columns: {', '.join(robot.joints)}\n"
            '# column = "angle"\n'
            "# sign = 1               # -1 reverses the direction\n"
            "# zero = 0.0             # the column's value where the model's angle is 0\n"
        )
    lines.append(
        "[commands]               # columns of the command log (--commands), or of the table itself\n"
        'time = "time"\ntime_unit = "s"\n'
        + "".join(f'{command} = "command_{command}"\n' for command in robot.commands)
        + "# Values of the columns at the actuator's smallest and largest command. For angles in deg: [0, 90], or\n"
        "# [90, 0] if the actuator is mounted in reverse.\n"
        + "".join(
            f"range_{command} = [{low:g}, {high:g}]\n"
            for command, (low, high) in zip(robot.commands, robot.command_ranges, strict=True)
        )
    )
    return "\n".join(lines)


_EXAMPLE = """\
# Mapping of the files of one capture room, for `python -m ballu_mjx record import`.
# Required: robot, and the sites of a free robot. All other keys show their defaults unless noted otherwise.

robot = "{name}-1"{pad}# the name of this specimen, the same in all of its recordings
kind = "free"            # or "suspended": the root is held
notes = ""
# rate = 100.0           # Hz; only for files without times or with a wrong rate

[axes]                   # the capture's axis in each direction: "x", "-x", "y", "-y", "z" or "-z"
forward = "x"
left = "y"
up = "z"

[origin]
start = {start}             # move the robot's start to the origin, facing x. false: keep the capture's origin
floor = 0.0              # m, height of the floor in the capture{floors}

[units]                  # only if the file does not state them, or states wrong ones
# length = "mm"          # m, cm, mm
# angle = "deg"          # rad, deg

[clock]                  # times of the captured file, if needed. [commands] has those of the log
# time = "time"          # the time column; default: the name under [commands]. For a bag or MCAP file: "header"
                         # (stamps of the messages) or "received" (times of recording)
# time_unit = "s"        # s, ms, us, ns
# episode = 0            # number of the episode of a LeRobot dataset

[{tracked}]{pad_tracked}# needs an orientation: a Vicon object or segment, three or more markers, or columns
body = "{name}:{tracked}"   # "subject:segment", an object, or the name after the colon if only one subject has it
# section = "Segments"   # only if the name occurs in several sections of a Vicon file
# rotation = "helical"   # RX, RY, RZ are a rotation vector. Euler angles: "XYZ" about the body's axes in turn
                         # (Vicon's "Euler XYZ"), "xyz" about the capture's axes. Default: helical in "Segments",
                         # none in other sections
# markers = ["M1", "M2", "M3", "M4"]                        # instead of body
# geometry = [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, 0, 0.1]]  # positions on the body, m; default: as at the start
# position = ["x", "y", "z"]                                # instead of body: names of columns
# orientation = ["qw", "qx", "qy", "qz"]                    # with rotation = "quaternion" (w, x, y, z), or three angles
offset = [0.0, 0.0, 0.0] # m, position of the model's site `{tracked}` in the tracked body's frame
turn = [0.0, 0.0, 0.0]   # deg, rotation vector: orientation of the model's body frame in the tracked body's frame.
                         # "start": the robot is upright and faces `forward` at the start
"""
