"""The experiment with a quadrotor in wind, on made files of the public data set's format.

C MuJoCo simulates a free rigid body under a known wind force. A controller lets it fly the figure of eight, and the
files get the columns of the public ones.
"""

from __future__ import annotations

import ast
import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest
from experiment_modules import experiment_module
from scipy.spatial.transform import Rotation

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
from ballu_mjx.recordings.csv_format import read_recording, write_recording
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.sim.simulator import Simulator

SCRIPT = Path(__file__).parents[1] / "experiments" / "real" / "quadrotor" / "quadrotor.py"
COLUMNS = ("t", "p", "p_d", "v", "v_d", "q", "R", "w", "T_sp", "q_sp", "hover_throttle", "fa", "pwm")
USED = ("t", "p", "q", "T_sp", "q_sp", "hover_throttle")
MASS, GRAVITY, HOVER = 2.65, 9.81, 0.46
WIND_FORCES = {
    "nowind": (0.0, 0.0, 0.0),
    "35wind": (-3.0, 0.2, 0.1),
    "70wind": (-8.0, 0.5, -0.4),
    "100wind": (-15.0, 1.0, -1.0),
    "70p20sint": (-8.0, 0.5, -0.4),
}
"""Known constant forces (N) of the made winds."""
SECONDS = 8.0

Row = Mapping[str, object]


@pytest.fixture(scope="module")
def experiment() -> Iterator[ModuleType]:
    with experiment_module(SCRIPT) as module:
        yield module


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return read_description(SCRIPT.with_name("quadrotor.robot.json"))


def fly(wind: Sequence[float], seed: int, seconds: float = SECONDS) -> list[Row]:
    """Return the rows of a flight at 50 Hz under a constant wind force (N, world frame)."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.002"/><worldbody><body pos="0 0 2"><freejoint/>
        <inertial pos="0 0 0" mass="{MASS}" diaginertia="0.03 0.03 0.03"/></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    rng, force = np.random.default_rng(seed), np.asarray(wind)
    phase, heading = rng.uniform(0, 2 * np.pi, 2)
    rows = []
    for number in range(round(seconds * 50)):
        time = number / 50
        angle = time + phase
        place = np.array([1.25 * np.sin(angle), 0.0, 2 + 0.75 * np.sin(2 * angle)])
        speed = np.array([1.25 * np.cos(angle), 0.0, 1.5 * np.cos(2 * angle)])
        push = np.array([-1.25 * np.sin(angle), 0.0, -3 * np.sin(2 * angle)])
        if not number:
            data.qpos[:3], data.qvel[:3] = place, speed
        wanted = push + 4 * (place - data.qpos[:3]) + 3 * (speed - data.qvel[:3])
        thrust = MASS * (wanted + [0, 0, GRAVITY]) - force + rng.normal(0, 0.3, 3)
        yaw = 0.3 * np.sin(0.5 * time + heading)
        x, y, z = Rotation.from_euler("z", -yaw).apply(thrust / np.linalg.norm(thrust))
        set_point = Rotation.from_euler("ZYX", [yaw, np.arctan2(x, z), -np.arcsin(y)])
        turn = Rotation.from_quat(data.qpos[3:], scalar_first=True)
        lift = float(thrust @ turn.as_matrix()[:, 2])
        # Both signs of a quaternion occur in the public files.
        quaternion, wanted_quaternion = -turn.as_quat(), -set_point.as_quat()
        rows.append(
            {
                "t": time,
                "p": data.qpos[:3].tolist(),
                "p_d": place.tolist(),
                "v": data.qvel[:3].tolist(),
                "v_d": speed.tolist(),
                "q": quaternion.tolist(),
                "R": turn.as_matrix().tolist(),
                "w": data.qvel[3:].tolist(),
                "T_sp": [HOVER * lift / (MASS * GRAVITY)],
                "q_sp": wanted_quaternion.tolist(),
                "hover_throttle": [HOVER],
                "fa": force.tolist(),
                "pwm": [1000.0] * 4,
            }
        )
        for _ in range(10):
            turn = Rotation.from_quat(data.qpos[3:], scalar_first=True)
            torque = 0.03 * (100 * (turn.inv() * set_point).as_rotvec() - 17 * data.qvel[3:])
            data.xfrc_applied[1] = np.r_[force + turn.apply([0, 0, lift]), turn.apply(torque)]
            mujoco.mj_step(model, data)
    return rows


def write(path: Path, rows: Sequence[Row], columns: Sequence[str] = COLUMNS) -> Path:
    """Write rows as the public files: an index without a name first, and lists in brackets."""
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["", *columns])
        writer.writerows([number, *(row[column] for column in columns)] for number, row in enumerate(rows))
    return path


def random_rows(seed: int, count: int = 60) -> list[Row]:
    """Return rows with random positions, attitudes and commands, far from hovering."""
    rng = np.random.default_rng(seed)

    def turns() -> list[list[float]]:
        # A pitch near 90 deg would leave roll and yaw undefined.
        quaternions = Rotation.from_euler("ZYX", rng.uniform(-1, 1, (count, 3)) * [3, 1.2, 3]).as_quat()
        return (quaternions * rng.choice([-1, 1], (count, 1))).tolist()

    throttle = rng.uniform(0.4, 0.5, count)
    found = {
        "t": (np.arange(count) / 50 + 3).tolist(),
        "p": rng.normal(0, 2, (count, 3)).tolist(),
        "q": turns(),
        "T_sp": rng.uniform(0.3, 0.9, (count, 1)).tolist(),
        "q_sp": turns(),
        "hover_throttle": throttle[:, None].tolist(),
    }
    return [{name: values[row] for name, values in found.items()} for row in range(count)]


def angles(quaternion: Sequence[float]) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a quaternion x, y, z, w, by the textbook's formulas."""
    x, y, z, w = quaternion
    return (
        np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        np.arcsin(2 * (w * y - z * x)),
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def read_back(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file, by column, with a reader other than the experiment's."""
    with path.open(newline="") as stream:
        return [{name: ast.literal_eval(cell) for name, cell in row.items()} for row in csv.DictReader(stream)]


@pytest.mark.parametrize("make", [random_rows, lambda seed: fly(WIND_FORCES["70wind"], seed, 2.0)])
def test_conversion_keeps_all_numbers(make: Callable[[int], list[Row]], experiment: ModuleType, tmp_path: Path):
    rows = make(0)
    path = write(tmp_path / "flight.csv", rows, [column for column in COLUMNS if column in rows[0]])
    found = experiment.convert(path, "70wind-NF")
    for number, row in enumerate(read_back(path)):
        assert found.time[number] == row["t"]
        assert found.tracked_position[number].tolist() == row["p"]
        x, y, z, w = row["q"]
        assert found.tracked_quaternion[number].tolist() == [w, x, y, z]
        assert found.command[number, 0] == pytest.approx(row["T_sp"][0] / row["hover_throttle"][0], rel=1e-15)
        turns = (found.command[number, 1:] - angles(row["q_sp"])) / (2 * np.pi)
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)


def test_yaw_commands_continue_beyond_half_a_turn(experiment: ModuleType, tmp_path: Path):
    yaw = np.linspace(3, 3.5, 60)
    turned = Rotation.from_euler("z", yaw[:, None]).as_quat().tolist()
    rows = [{**row, "q_sp": each} for row, each in zip(random_rows(0), turned, strict=True)]
    found = experiment.convert(write(tmp_path / "flight.csv", rows, USED), "70wind-NF")
    np.testing.assert_allclose(found.command[:, 3], yaw, atol=1e-12)


def test_recordings_differ_from_the_files_by_rounding_alone(
    experiment: ModuleType, robot: RobotDescription, tmp_path: Path
):
    source = write(tmp_path / "flight.csv", fly(WIND_FORCES["70wind"], 1, 2.0))
    made = experiment.convert(source, "70wind-NF")
    write_recording(made, tmp_path / "70wind-NF.csv", robot, decimals=experiment.DECIMALS)
    found = read_recording(tmp_path / "70wind-NF.csv", robot)
    assert (found.held, found.interpolated, found.trimmed) == ({}, {}, (0, 0))
    assert found.tracked_position is not None
    np.testing.assert_allclose(found.time, made.time, atol=1e-9)
    np.testing.assert_allclose(found.tracked_position, made.tracked_position, atol=5.1e-8)
    np.testing.assert_allclose(found.command, made.command, atol=5.1e-5)
    turned = Rotation.from_quat(found.tracked_quaternion, scalar_first=True).inv() * Rotation.from_quat(
        made.tracked_quaternion, scalar_first=True
    )
    assert turned.magnitude().max() < 5e-6
    assert "personal and educational use only" in found.notes


@pytest.mark.parametrize("column", USED)
def test_a_file_without_a_column_is_refused(column: str, experiment: ModuleType, tmp_path: Path):
    path = write(tmp_path / "flight.csv", random_rows(0, 3), [name for name in USED if name != column])
    with pytest.raises(InputError, match=rf"flight\.csv: there is no column {column}; give a file of the public"):
        experiment.convert(path, "70wind-NF")


def test_all_missing_columns_are_named(experiment: ModuleType, tmp_path: Path):
    path = tmp_path / "flight.csv"
    path.write_text("time,x\n0,1\n")
    with pytest.raises(InputError, match=f"no columns {', '.join(USED)};"):
        experiment.convert(path, "70wind-NF")


@pytest.mark.parametrize(
    "column, value, problem",
    [
        ("p", [1.0, 2.0], "is not a list of 3 finite numbers"),
        ("p", [1.0, 2.0, float("nan")], "is not a list of 3 finite numbers"),
        ("p", "[1.0, 2.0,", "is not a list of 3 finite numbers"),
        ("t", "", "is not a finite number"),
        ("T_sp", [0.5, 0.5], "is not a finite number"),
        ("q", [0.0, 0.0, 0.0, 2.0], "has length 2 instead of 1"),
        ("q_sp", [0.0, 0.0, 0.0, 0.0], "has length 0 instead of 1"),
        ("hover_throttle", [0.0], "must be greater than 0"),
    ],
)
def test_a_damaged_cell_is_refused_with_its_place(
    column: str, value: object, problem: str, experiment: ModuleType, tmp_path: Path
):
    rows = random_rows(0, 5)
    rows[2] = {**rows[2], column: value}
    with pytest.raises(InputError, match=rf"flight\.csv, column {column}, row 4: .*{problem}"):
        experiment.convert(write(tmp_path / "flight.csv", rows, USED), "70wind-NF")


def test_a_file_that_ends_after_its_header_is_refused(experiment: ModuleType, tmp_path: Path):
    with pytest.raises(InputError, match="there is no row below the header"):
        experiment.convert(write(tmp_path / "flight.csv", [], USED), "70wind-NF")


def test_a_missing_flight_is_named(experiment: ModuleType, robot: RobotDescription, tmp_path: Path):
    with pytest.raises(InputError, match=r"neither nowind-baseline\.csv\.gz nor custom_figure8_baseline_nowind\.csv"):
        experiment.load(tmp_path, experiment.FLIGHTS["training"], robot, tmp_path / "made")


def test_every_flight_has_one_use(experiment: ModuleType):
    every = [flight for chosen in experiment.FLIGHTS.values() for flight in chosen]
    assert len(every) == len(set(every)) == 30
    for use in ("training", "validation", "near"):
        assert not {flight.wind for flight in experiment.FLIGHTS[use]} & {"100wind", "70p20sint"}


@pytest.fixture(scope="module")
def public(experiment: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a made file for each flight of the quick run."""
    folder = tmp_path_factory.mktemp("public")
    chosen = [flight for each in experiment.FLIGHTS.values() for flight in each[:2]]
    for seed, flight in enumerate(chosen):
        write(folder / flight.file, fly(WIND_FORCES[flight.wind], seed))
    return folder


@pytest.mark.slow
def test_a_known_wind_is_found_and_explains_the_flight(
    experiment: ModuleType, robot: RobotDescription, public: Path, tmp_path: Path
):
    motions = experiment.load(public, experiment.FLIGHTS["far"][:1], robot, tmp_path)
    simulator = Simulator(robot)
    evaluator = OpenLoopEvaluator(simulator, motions, experiment.ConstantWrench(anchored=True))
    found = experiment.fit_constant_force(evaluator)
    known = np.array(WIND_FORCES["100wind"])
    np.testing.assert_allclose(found[:3], known, atol=0.05)
    (without,) = experiment.end_errors(evaluator, evaluator.replay(np.zeros(6, np.float32))).values()
    (left,) = experiment.end_errors(evaluator, evaluator.replay(found)).values()
    for place, seconds in enumerate(experiment.HORIZONS):
        moved = np.linalg.norm(known) / MASS * seconds**2 / 2
        assert np.nanmedian(without[:, place]) == pytest.approx(moved, rel=0.05)
        assert np.nanmax(left[:, place]) < 0.05 * moved
    # The last start is between 1 and 2 s before the flight's end.
    assert np.isnan(without[-1]).tolist() == [False, True, True]


@pytest.mark.slow
def test_a_quick_run_compares_all_methods(
    experiment: ModuleType, public: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    experiment.main(["--data", str(public), "--output", str(tmp_path / "run"), "--quick"])
    assert "Best constant force for the training flights" in capsys.readouterr().out
    table = (tmp_path / "run" / "table.md").read_text()
    rows = re.findall(r"^\| (?!position|---)(.*?) \| (.*?) \| (.*?) \|", table.partition("### winds")[0], re.MULTILINE)
    names = ["vanilla", "constant force", *experiment.METHODS.values(), "constant force of each flight"]
    assert [name for name, *_ in rows] == names
    errors = {name: np.array([[float(x) for x in cell.split(", ")] for cell in cells]) for name, *cells in rows}
    assert all(values.shape == (2, 3) for values in errors.values())
    assert (errors["constant force of each flight"] < 0.1 * errors["vanilla"]).all()
    recordings = sorted(path.name for path in (tmp_path / "run" / "recordings" / "far").glob("*.csv.gz"))
    assert recordings == ["100wind-baseline.csv.gz", "70p20sint-baseline.csv.gz"]
