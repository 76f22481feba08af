"""Tests of the selection from a capture: streams with clocks of their own, and commands that a log replaces."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from capture_files import CORNERS, HULL, TIME, TIP
from robot_files import write_robot
from scipy.spatial.transform import Rotation

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.importers.capture import Capture, Series, Stream, select
from ballu_mjx.recordings.importers.mapping import RoomMapping, read_mapping

CART = """
<mujoco><option timestep="0.01"/><worldbody><body name="hull" pos="0 0 0.2"><freejoint/>
  <geom size="0.1" mass="1"/><site name="hull"/><site name="tip" pos="0.3 0 0"/>
  <body name="wheel"><joint name="wheel" axis="0 1 0"/><geom size="0.05" mass="0.1"/></body>
</body></worldbody><actuator><motor name="m" joint="wheel" ctrlrange="0 1"/></actuator></mujoco>
"""
LATER = TIME[:-1] + 0.004
"""Times between those of the hull's positions."""
BODIES = '[hull]\nbody = "hull"\n[tip]\nbody = "tip"\n'
COLUMNS = """[units]
length = "m"
angle = "rad"
[hull]
position = ["x", "y", "z"]
orientation = {names}
rotation = "{rotation}"
[tip]
body = "tip"
"""


def room(folder: Path, text: str, control_timestep: float = 0.04) -> RoomMapping:
    robot = write_robot(
        folder, "cart", CART, tracked="hull", points=["tip"], joints=["wheel"], commands={"m": "m"},
        control_timestep=control_timestep,
    )  # fmt: skip
    (folder / "room.toml").write_text('robot = "cart-1"\n' + text)
    return read_mapping(folder / "room.toml", robot)


def capture(**columns: Series) -> Capture:
    """Return a capture of hull and tip, in which each column has its own times."""
    hull = Stream(TIME, HULL.place, HULL.turn.as_quat(scalar_first=True))
    places = {axis: Series(place, TIME) for axis, place in zip("xyz", HULL.place.T, strict=True)}
    bodies = {"hull": hull, "tip": Stream(TIME, TIP.place)}
    return Capture(Path("take.mcap"), "a ROS bag or MCAP", bodies, places | columns)


@pytest.mark.parametrize("lost", [False, True])
def test_encoder_that_restarts_each_turn_is_interpolated_over_its_restarts(tmp_path: Path, lost: bool):
    """The encoder has its own clock. It restarts at 2 pi, and may miss a sample there."""
    angle = (8.0 * LATER) % (2 * np.pi)
    if lost:
        angle[np.flatnonzero(np.abs(np.diff(angle)) > np.pi)] = np.nan
    found = select(
        capture(encoder=Series(angle, LATER, si=True)), room(tmp_path, BODIES + '[wheel]\ncolumn = "encoder"\n')
    )
    np.testing.assert_allclose(found.columns["wheel"][1:-1], 8.0 * TIME[1:-1], atol=1e-9)


def test_a_gap_of_another_clock_is_left_open_up_to_the_samples_at_its_ends(tmp_path: Path):
    angle, late = 0.1 * TIME, np.append(TIME[:-1], TIME[-1] + 0.001)  # equal times but for the last one
    first, last = len(TIME) // 4, len(TIME) // 2
    angle[first + 1 : last] = np.nan
    found = select(
        capture(encoder=Series(angle, late, si=True)), room(tmp_path, BODIES + '[wheel]\ncolumn = "encoder"\n')
    ).columns["wheel"]
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found)), np.arange(first + 1, last))
    np.testing.assert_allclose(found[[first, last]], 0.1 * TIME[[first, last]])


@pytest.mark.parametrize("rotation", ["quaternion", "XYZ", "helical"])
def test_orientation_columns_with_their_own_clock_are_interpolated_along_the_shortest_rotation(
    tmp_path: Path, rotation: str
):
    """Between two samples, quaternions change their sign, and angles restart."""
    turned = Rotation.from_rotvec(np.outer(2.5 * LATER, [0.0, 0.0, 1.0]))
    values = {
        "quaternion": turned.as_quat(canonical=True, scalar_first=True),
        "XYZ": turned.as_euler("XYZ"),
        "helical": turned.as_rotvec(),
    }[rotation]
    assert (np.abs(np.diff(values, axis=0)) > 1.0).any()
    names = ["a", "b", "c", "d"][: values.shape[1]]
    mapping = room(tmp_path, COLUMNS.format(names=names, rotation=rotation))
    columns = {name: Series(column, LATER) for name, column in zip(names, values.T, strict=True)}
    hull = select(capture(**columns), mapping).bodies["hull"]
    np.testing.assert_array_equal(hull.position, HULL.place)
    found = Rotation.from_quat(np.asarray(hull.quaternion)[1:-1], scalar_first=True)
    assert (Rotation.from_rotvec(np.outer(2.5 * TIME[1:-1], [0.0, 0.0, 1.0])).inv() * found).magnitude().max() < 1e-6


def test_columns_of_an_orientation_must_have_the_same_times(tmp_path: Path):
    names = ["a", "b", "c"]
    columns = {name: Series(0.0 * TIME, TIME) for name in names} | {"c": Series(0.0 * LATER, LATER)}
    with pytest.raises(InputError, match=r"take.mcap, columns a to c: their times differ; give columns of one topic"):
        select(capture(**columns), room(tmp_path, COLUMNS.format(names=names, rotation="XYZ")))


@pytest.mark.parametrize("slow", ["tip", "hull2", "z", "a", "encoder"])
def test_streams_slower_than_the_control_step_are_refused(tmp_path: Path, slow: str):
    """The robot has 25 control steps per second. One stream has 10 samples per second, the others have 100."""
    rare = slice(None, None, 10)
    turn = Series(np.full(len(TIME), 0.5), TIME)
    taken = capture(encoder=Series(0.0 * TIME, TIME, si=True), **dict.fromkeys("abcd", turn))
    columns, bodies = dict(taken.columns), dict(taken.bodies)
    bodies |= {name: Stream(TIME, HULL.place + HULL.turn.apply(corner)) for name, corner in CORNERS.items()}
    for name in [*"abcd"] if slow == "a" else [slow]:
        if name in bodies:
            bodies[name] = Stream(TIME[rare], bodies[name].position[rare])
        else:
            columns[name] = dataclasses.replace(columns[name], values=columns[name].values[rare], time=TIME[rare])
    by_columns = COLUMNS.format(names=[*"abcd"], rotation="quaternion")
    by_markers = BODIES.replace('body = "hull"', f"markers = {list(CORNERS)}")
    text = {"hull2": by_markers, "z": by_columns, "a": by_columns}.get(slow, BODIES)
    mapping = room(tmp_path, text + '[wheel]\ncolumn = "encoder"\n')
    with pytest.raises(
        InputError, match=f"take.mcap, {slow}: 10 samples per second are fewer than 25, one per control"
    ):
        select(dataclasses.replace(taken, columns=columns, bodies=bodies), mapping)


def test_streams_are_not_interpolated_over_half_a_second(tmp_path: Path):
    """A tip with 0.4 s between two samples would be interpolated over a lost sample, if only these times counted."""
    mapping = room(tmp_path, BODIES, control_timestep=0.4)
    time = np.delete(TIME[::40], 4)
    taken = capture()
    tip = Stream(time, TIP.place[np.isin(TIME, time)])
    found = select(dataclasses.replace(taken, bodies={**taken.bodies, "tip": tip}), mapping).bodies["tip"].position
    seen = np.isfinite(found[:, 0])
    assert seen[:121].all() and not seen[121:200].any() and seen[201:281].all()
