"""Motion-capture files in the layouts that the vendors document. All hold the same motion of a hull and a tip."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

SAMPLES, RATE = 300, 100.0
TIME = np.arange(SAMPLES) / RATE
HIDDEN = slice(60, 71)
"""Samples without a measurement of the hull, in formats that can mark missing samples."""
Y_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation matrix from Motive's axes (y up, robot facing along z) to those of the recording format."""


@dataclasses.dataclass(frozen=True)
class Pose:
    """Poses of a body over time."""

    place: np.ndarray
    """Positions (m)."""
    turn: Rotation
    """Rotations from the body frame to the world frame."""


def motion() -> tuple[Pose, Pose, np.ndarray]:
    """Return poses of hull and tip, and commands. The hull begins at the origin, faces x and turns about all axes."""
    wave = np.stack([np.sin((1.3 + 0.4 * i) * TIME) for i in range(6)], axis=1)
    place = wave[:, :3] * [0.5, 0.3, 0.05] + [0.0, 0.0, 0.25]
    turn = Rotation.from_rotvec(0.6 * wave[:, 3:])
    tip = Pose(place + turn.apply([0.35, 0.0, 0.05]), turn)
    command = np.stack([0.1 + 0.4 * wave[:, 0], 5 + 4 * wave[:, 1]], axis=1)
    return Pose(place, turn), tip, command


HULL, TIP, COMMAND = motion()
START = 1_700_000_000 * 10**9
"""Start time (ns since 1970) in formats with absolute times."""
NAMED = '[hull]\nbody = "hull"\n[tip]\nbody = "tip"\n'
"""Mapping of bodies by name."""
TABLE = """[units]
length = "m"
[clock]
time = "time"
time_unit = "ms"
[hull]
position = ["hull_x", "hull_y", "hull_z"]
orientation = ["hull_qw", "hull_qx", "hull_qy", "hull_qz"]
rotation = "quaternion"
[tip]
position = ["tip_x", "tip_y", "tip_z"]
"""
"""Mapping of the columns of `write_table`."""
ARCHIVE = """[units]
length = "m"
[hull]
position = ["hull_pos[0]", "hull_pos[1]", "hull_pos[2]"]
orientation = ["hull_quat[0]", "hull_quat[1]", "hull_quat[2]", "hull_quat[3]"]
rotation = "quaternion"
[tip]
position = ["tip_pos[0]", "tip_pos[1]", "tip_pos[2]"]
"""
"""Mapping of the arrays of `write_npz`."""


# ---- the formats ----


def rows(columns: list[np.ndarray], delimiter: str, decimals: int, *, lost: list[int], first: int | None = None) -> str:
    """Return rows of numbers as text. The cells of the columns `lost` are empty in the hidden samples.

    `first`: number of the first frame. None if the rows do not begin with frames.
    """
    lines = []
    for i, row in enumerate(np.column_stack(columns)):
        cells = [f"{x:.{decimals}f}" for x in row]
        if HIDDEN.start <= i < HIDDEN.stop:
            for column in lost:
                cells[column] = ""
        lines.append(delimiter.join(([] if first is None else [f"{first + i}"]) + cells))
    return "\n".join(lines) + "\n"


def write_motive(folder: Path, version: str = "1.23", unit: str = "Meters") -> Path:
    """Write a Motive CSV, laid out as https://docs.optitrack.com ("Data Export: CSV") and public takes of versions 1.21
    to 1.25."""
    scale = {"Meters": 1.0, "Centimeters": 1e2, "Millimeters": 1e3}[unit]
    hull = Rotation.from_matrix(Y_UP.T) * HULL.turn * Rotation.from_matrix(Y_UP)
    top = f"Format Version,{version},Take Name,trial 1,Take Notes,,Capture Frame Rate,{RATE:.6f},Export Frame Rate,"
    top += f"{RATE:.6f},Capture Start Time,2023-06-02 12.09.45.344 PM,Total Frames in Take,{SAMPLES},Rotation Type,"
    top += f"Quaternion,Length Units,{unit},Coordinate Space,Global"
    kinds = ["Rigid Body"] * 8 + ["Rigid Body Marker"] * 3 + ["Marker"] * 3
    names = ["hull"] * 8 + ["hull:Marker 001"] * 3 + ["tip"] * 3
    ids = ["506381AA"] * 8 + ["506381AB"] * 3 + ["0"] * 3
    parts = ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"] + ["Position"] * 6
    axes = [*"XYZW", *"XYZ", "", *"XYZ", *"XYZ"]
    heads = [["", "Type", *kinds], ["", "Name", *names], ["", "ID", *ids]]
    if version == "1.25":
        heads.append(["", "Parent", *[""] * len(kinds)])
    heads += [["", "", *parts], ["Frame", "Time (Seconds)", *axes]]
    if version == "1.21":  # its header rows have no labels
        heads = [["", "", *cells] for _, _, *cells in heads[:-1]] + [["Frame", "Time", *axes]]
    place, tip = scale * HULL.place @ Y_UP, scale * TIP.place @ Y_UP
    columns = [TIME, *hull.as_quat().T, *place.T, np.full(SAMPLES, 3e-4), *(place + 1).T, *tip.T]
    body = rows(columns, ",", 6, lost=[*range(1, 9)], first=0)
    path = folder / "take.csv"
    path.write_text("\n".join([top, "", *(",".join(row) for row in heads)]) + "\n" + body)
    return path


def qualisys_header(included: str, names: list[str]) -> str:
    kind, key = ("MARKERS", "MARKER_NAMES") if included == "3D" else ("BODIES", "BODY_NAMES")
    keys = [f"NO_OF_FRAMES\t{SAMPLES}", "NO_OF_CAMERAS\t8", f"NO_OF_{kind}\t{len(names)}", f"FREQUENCY\t{RATE:g}"]
    keys += [
        "NO_OF_ANALOG\t0",
        "ANALOG_FREQUENCY\t0",
        "DESCRIPTION\t--",
        "TIME_STAMP\t2022-06-03, 10:47:36.627\t9424.4",
    ]
    return "\n".join([*keys, f"DATA_INCLUDED\t{included}", "\t".join([key, *names])]) + "\n"


def write_qualisys_bodies(folder: Path) -> Path:
    """Write Qualisys 6DOF data, laid out as files of https://github.com/shiplab/dt_cv, with column-major matrices."""
    angles = ["X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{i}]" for i in range(9))]
    names = [
        "Frame",
        "Time",
        *(f"{name} {part}" if part == "X" else part for name in ("hull", "tip") for part in angles),
    ]
    columns = [np.arange(SAMPLES) + 1, TIME]
    for pose in (HULL, TIP):
        matrix = pose.turn.as_matrix().transpose(0, 2, 1).reshape(-1, 9)
        columns += [*(1e3 * pose.place.T), *pose.turn.as_euler("XYZ", degrees=True).T, np.ones(SAMPLES), *matrix.T]
    body = rows(columns, "\t", 5, lost=[]).split("\n")
    for i in range(HIDDEN.start, HIDDEN.stop):
        cells = body[i].split("\t")
        body[i] = "\t".join([*cells[:2], *["0.00000"] * 16, *cells[18:]])
    # Frame numbers are integers, and every row ends with a tab.
    body = [f"{int(float(line.split(chr(9))[0]))}\t{line.partition(chr(9))[2]}\t" if line else line for line in body]
    text = qualisys_header("6D", ["hull", "tip"]) + "\t".join(names) + "\t\n" + "\n".join(body)
    path = folder / "trial.tsv"
    path.write_bytes(text.replace("\n", "\r\n").encode())
    return path


CORNERS = {"hull1": [0.1, 0, 0], "hull2": [-0.1, 0.1, 0], "hull3": [-0.1, -0.1, 0], "hull4": [0, 0, 0.1]}


def write_qualisys_markers(folder: Path) -> Path:
    names = [*CORNERS, "tip"]
    places = [HULL.place + HULL.turn.apply(corner) for corner in CORNERS.values()] + [TIP.place]
    header = "\t".join(["Frame", "Time", *(f"{name} {axis}" for name in names for axis in "XYZ")])
    body = rows([TIME, *(1e3 * np.hstack(places).T)], "\t", 3, lost=[*range(1, 7)], first=1)
    path = folder / "trial.tsv"
    path.write_text(qualisys_header("3D", names) + header + "\n" + body)
    return path


def write_npz(folder: Path) -> Path:
    place = HULL.place.copy()
    place[HIDDEN] = np.nan
    path = folder / "trial.npz"
    np.savez(
        path, time=TIME, hull_pos=place, hull_quat=HULL.turn.as_quat(scalar_first=True), tip_pos=TIP.place,
        command_arm=COMMAND[:, 0], command_push=COMMAND[:, 1], note=np.array("first try"),
    )  # fmt: skip
    return path


def write_table(folder: Path) -> Path:
    """Write a table as users write it by hand: with milliseconds, comments and a comma at the end of each row."""
    names = "time,hull_x,hull_y,hull_z,hull_qx,hull_qy,hull_qz,hull_qw,tip_x,tip_y,tip_z,arm_cmd,push_cmd,"
    columns = [1e3 * TIME, *HULL.place.T, *HULL.turn.as_quat().T, *TIP.place.T, *COMMAND.T]
    body = rows(columns, ",", 7, lost=[*range(1, 8)]).replace("\n", ",\n")
    path = folder / "trial.csv"
    path.write_text(f"# exported on a Tuesday, by hand\n{names}\n{body}")
    return path


def tum_text() -> str:
    """Return a TUM trajectory, laid out as https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats."""
    columns = [TIME + 1.7e9, *HULL.place.T, *HULL.turn.as_quat().T]
    return "# timestamp tx ty tz qx qy qz qw\n" + rows(columns, " ", 7, lost=[])


def euroc_text() -> str:
    """Return a EuRoC CSV, laid out as `state_groundtruth_estimate0` of https://projects.asl.ethz.ch/datasets."""
    header = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v [m]\n"
    numbers = np.hstack([HULL.place, HULL.turn.as_quat(scalar_first=True), 0 * HULL.place[:, :1]])
    lines = [f"{START + i * 10**7}," + ",".join(f"{x:.7f}" for x in row) for i, row in enumerate(numbers)]
    return header + "\n".join(lines) + "\n"


def write_tum(folder: Path) -> Path:
    path = folder / "pose.txt"
    path.write_text(tum_text())
    return path


def write_euroc(folder: Path) -> Path:
    path = folder / "data.csv"
    path.write_text(euroc_text())
    return path


# ---- Vicon ----

ROTATIONS: Mapping[str, Callable[[Rotation], np.ndarray]] = {
    "helical": lambda r: r.as_rotvec(),
    "XYZ": lambda r: r.as_euler("XYZ"),
    "quaternion": lambda r: r.as_quat(),
}


def vicon_section(
    title: str,
    bodies: Mapping[str, tuple[np.ndarray, Rotation]],
    *,
    prefix: str = "",
    rotation: str | None = "helical",
    angle: str = "deg",
    length: str = "mm",
    delimiter: str = ",",
    first: int = 1,
    lost: Sequence[str] = (),
    hidden: slice = HIDDEN,
) -> str:
    """Return one section in Vicon's layout. It holds markers if `rotation` is None, else rigid bodies.

    The cells of the bodies `lost` are empty in the samples `hidden`.
    """
    components = [*{None: (), "quaternion": ("RX", "RY", "RZ", "RW")}.get(rotation, ("RX", "RY", "RZ"))]
    components += ["TX", "TY", "TZ"] if rotation else ["X", "Y", "Z"]
    turns = ["" if rotation == "quaternion" else angle] * (len(components) - 3)
    names, cells = ["", ""], []
    for role, (position, turned) in bodies.items():
        names += [f"{prefix}{role}", *[""] * (len(components) - 1)]
        values = [position * {"mm": 1e3, "cm": 1e2, "m": 1.0}[length]]
        if rotation:
            scale = 180 / np.pi if angle == "deg" and rotation != "quaternion" else 1.0
            values.insert(0, ROTATIONS[rotation](turned) * scale)
        text = [[f"{x:.7g}" for x in row] for row in np.hstack(values)]
        if role in lost:
            text[hidden] = [[""] * len(components)] * len(text[hidden])
        cells.append(text)
    lines = [
        [title],
        ["100"],
        names,
        ["Frame", "Sub Frame", *components * len(bodies)],
        ["", "", *[*turns, length, length, length] * len(bodies)],
    ]
    samples = zip(*cells, strict=True)
    lines += [[str(first + i), "0", *(cell for body in row for cell in body)] for i, row in enumerate(samples)]
    return "".join(delimiter.join(line) + "\n" for line in lines)


def write_nexus(folder: Path) -> Path:
    """Write segments and trajectories of one trial, with sections that do not concern the robot."""
    events = "Events\n100\nSubject,Context,Name,Time (s),Description\nrover,General,Start,0.5,It begins to move\n"
    devices = (
        "Devices\n1000\n,,Load cell - Force,,\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n1,0,0.1,0.2,0.3\n1,1,0.1,0.2,0.3\n"
    )
    path = folder / "trial.csv"
    segments = vicon_section("Segments", {"hull": (HULL.place, HULL.turn)}, prefix="rover:", lost=["hull"])
    markers = vicon_section("Trajectories", {"tip": (TIP.place, TIP.turn)}, prefix="rover:", rotation=None)
    path.write_text("\n".join([events, devices, segments, markers]))
    return path


def write_tracker(folder: Path, rotation: str = "helical") -> Path:
    """Write objects whose rotations have the representation chosen at export."""
    path = folder / "trial.csv"
    objects = {"hull": (HULL.place, HULL.turn), "tip": (TIP.place, TIP.turn)}
    named = {f"{name}:{name}": pose for name, pose in objects.items()}
    section = vicon_section(
        "Objects", named, prefix="Global Angle ", rotation=rotation, angle="rad", lost=["hull:hull"]
    )
    path.write_text(section)
    return path


# ---- damage ----

Damage = Callable[[Path], object]
"""Function that changes a file."""


def replaced(old: str, new: str, count: int = -1) -> Damage:
    """Replace `old` by `new`."""

    def damage(path: Path) -> None:
        text = path.read_bytes().decode()
        assert old in text
        path.write_bytes(text.replace(old, new, count).encode())

    return damage


def in_line(number: int, cell: int, text: str, delimiter: str = ",") -> Damage:
    """Write `text` into a cell (counted from 0) of line `number` (counted from 1, as messages do)."""

    def damage(path: Path) -> None:
        lines = path.read_bytes().decode().split("\n")
        cells = lines[number - 1].split(delimiter)
        cells[cell] = text
        lines[number - 1] = delimiter.join(cells)
        path.write_bytes("\n".join(lines).encode())

    return damage


def shortened(number: int, kept: int, delimiter: str = ",") -> Damage:
    """Keep only the first `kept` cells of a line."""

    def damage(path: Path) -> None:
        lines = path.read_bytes().decode().split("\n")
        lines[number - 1] = delimiter.join(lines[number - 1].split(delimiter)[:kept])
        path.write_bytes("\n".join(lines).encode())

    return damage


def without_line(number: int) -> Damage:
    """Delete a line."""

    def damage(path: Path) -> None:
        lines = path.read_bytes().decode().split("\n")
        del lines[number - 1]
        path.write_bytes("\n".join(lines).encode())

    return damage


def zeroed(first: int, cells: Sequence[int], delimiter: str = ",", *, last: int = 10**6) -> Damage:
    """Write zeros into the given cells of all lines from `first` to `last`, except lines that are too short."""

    def damage(path: Path) -> None:
        lines = path.read_bytes().decode().split("\n")
        for number in range(first - 1, min(last, len(lines))):
            row = lines[number].split(delimiter)
            if len(row) > max(cells):
                for cell in cells:
                    row[cell] = "0"
                lines[number] = delimiter.join(row)
        path.write_bytes("\n".join(lines).encode())

    return damage
