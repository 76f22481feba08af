"""`train sysid` for a robot that declares parameters, and the use of the result by other commands."""

import contextlib
import dataclasses
import io
import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from servo_arm import IDENTIFY, TRUTH, identified, record_arm, write_arm, write_example

from ballu_mjx.cli import train
from ballu_mjx.cli._residual import prepare
from ballu_mjx.cli.train_policy import _verdict
from ballu_mjx.cli.train_sysid import _actuators_json
from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.actuator_choice import Choice, ReplayErrors, ReplayRow
from ballu_mjx.identification.actuators import ACTUATORS_FILE, read_actuators, read_validation
from ballu_mjx.identification.declared import IdentifiedByFit, check_recordings
from ballu_mjx.identification.measured_motion import SamplingConfig
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.identification.write_back import identified_to_json
from ballu_mjx.recordings.csv_format import list_recordings, read_recording
from ballu_mjx.residuals.dataset import RecordingsData
from ballu_mjx.residuals.run_config import describe_run, run_actuators
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.robots.model import same_parameters
from ballu_mjx.robots.registry import load_robot


def write_recorded_arm(folder: Path) -> RobotDescription:
    """Write the servo arm with a recording for training and one for validation. Return its description."""
    robot = write_arm(folder)
    for use, seed in (("training", 0), ("validation", 1)):
        (folder / use).mkdir()
        record_arm(folder / use, robot, f"motion-{seed}", seed)
    return robot


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    """Return the description of the servo arm, with recordings beside it."""
    folder = tmp_path_factory.mktemp("arm")
    robot = write_recorded_arm(folder)
    (folder / "sweep").mkdir()
    record_arm(folder / "sweep", robot, "sweep", 0, "suspended")
    return robot


@pytest.fixture(scope="module")
def run(robot: RobotDescription) -> tuple[Path, str]:
    """Return a run of sysid and its output."""
    folder, printed = robot.file.parent, io.StringIO()
    arguments = ["sysid", "--robot", robot.file, "--recordings", folder / "sweep", "--output", folder / "run"]
    arguments += ["--validation", folder / "validation", "--starts", "2", "--steps", "12"]
    with contextlib.redirect_stdout(printed):
        assert train.main(list(map(str, arguments))) == 0
    return folder / "run", printed.getvalue()


def test_guide_shows_the_files_that_the_example_writes(tmp_path: Path):
    write_example(tmp_path)
    guide = (Path(__file__).parents[2] / "docs" / "identify.md").read_text()
    description, sidecar, *_ = map(json.loads, re.findall(r"^```json\n(.*?)^```", guide, re.DOTALL | re.MULTILINE))
    assert json.loads((tmp_path / "arm.robot.json").read_text()) == description
    motion = tmp_path / "recordings" / "motion-0.csv"
    assert json.loads(motion.with_suffix(".json").read_text()) == sidecar
    assert "\n".join(motion.read_text().splitlines()[:3]) in guide
    assert (tmp_path / "validation" / "motion-2.csv").exists()


@pytest.mark.slow
def test_sysid_identifies_the_arm_and_writes_all_files(robot: RobotDescription, run: tuple[Path, str]):
    folder, printed = run
    name, found = read_actuators(robot, folder / ACTUATORS_FILE)
    assert name == "arm" and isinstance(found, IdentifiedParameters)
    validation = read_validation(folder / ACTUATORS_FILE)
    assert validation is not None and validation.improves and 0 < (validation.ratio or 0) < 0.2
    for parameter, value in zip(found.declared.names, np.asarray(found.values), strict=True):
        assert value == pytest.approx(TRUTH[parameter], rel=0.1), parameter
    assert "these recordings show all 5 parameters" in printed
    assert printed.count("better than nominal") == 2
    assert (folder / "identification.txt").read_text().strip() in printed
    details = json.loads((folder / "identification.json").read_text())
    for row in details["parameters"]:
        low, high = row["interval"]
        assert low <= row["value"] <= high and row["seen"] and not row["at_bound"]
    assert details["held_out"]["identified"]["score"] < 0.3 * details["held_out"]["nominal"]["score"]
    model = mujoco.MjModel.from_xml_path(str(folder / "identified.xml"))
    assert model.body("lower").mass[0] == pytest.approx(
        float(found.values[found.declared.names.index("mass")]), rel=1e-4
    )
    for figure in ("held_out.png", "residual_autocorrelation.png", "parameters.png"):
        assert (folder / figure).stat().st_size > 5000
    page = (folder / "report.html").read_text()
    assert "shoulder_backlash" in page and "95 % from" in page and "held_out.png" in page
    assert any("search" in json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines())


@pytest.mark.parametrize(
    ("diverged", "verdict"), [(0, "better than nominal ones, with 0.50"), (2, "WORSE than nominal")]
)
def test_later_commands_read_from_the_file_whether_identification_improves(tmp_path: Path, diverged: int, verdict: str):
    """If more replays diverge with identified actuators, their error is infinite, which JSON cannot express."""
    robot = write_arm(tmp_path)
    nominal, own = ReplayErrors(0.2, 0.2, 0), ReplayErrors(0.1, 0.1, diverged)
    parameters, errors = identified(robot, **TRUTH), np.ones(len(TRUTH))
    choice = Choice(parameters, (ReplayRow("motion", 1.0, 3, nominal, own),), "joints")
    fit: Any = SimpleNamespace(standard_errors=errors)
    found = IdentifiedByFit("arm", parameters, "", {}, fit=fit, held_out=(), choice=choice, suggestions=())
    file = tmp_path / ACTUATORS_FILE
    file.write_text(_actuators_json(robot, found, []))
    json.loads(file.read_text(), parse_constant=lambda constant: pytest.fail(f"{constant} is not JSON"))
    assert verdict in _verdict(file)


@pytest.mark.slow
def test_refinement_keeps_earlier_values_that_the_recordings_do_not_show(
    robot: RobotDescription, tmp_path: Path, capsys: pytest.CaptureFixture
):
    """The shoulder's command stays 0, so that its drivetrain is hidden. The elbow moves and is identified anew."""
    earlier = {"shoulder_delay": 0.05, "shoulder_backlash": 0.08, "shoulder_scale": 0.9, "mass": 0.25}
    file = tmp_path / ACTUATORS_FILE
    file.write_text(identified_to_json(robot, identified(robot, **earlier)))
    paths = [record_arm(tmp_path, robot, f"elbow-{seed}", seed, still=(0,)) for seed in (0, 1)]
    line = ["sysid", "--robot", robot.file, "--actuators", file, "--output", tmp_path / "run", "--quick"]
    line += ["--recordings", paths[0], "--validation", paths[1], "--steps", "12"]
    assert train.main(list(map(str, line))) == 0
    _, found = read_actuators(robot, tmp_path / "run" / ACTUATORS_FILE)
    assert isinstance(found, IdentifiedParameters)
    values = dict(zip(found.declared.names, np.asarray(found.values, float), strict=True))
    for name in ("shoulder_delay", "shoulder_backlash", "shoulder_scale"):
        assert values[name] == pytest.approx(earlier[name], rel=0.05), name
    for name in ("mass", "elbow_damping"):
        assert values[name] == pytest.approx(TRUTH[name], rel=0.1), name
    printed = capsys.readouterr().out
    assert "cannot show" in printed and "better than earlier ones" in printed
    assert "These values can be wrong: --quick" in printed
    details = json.loads((tmp_path / "run" / "identification.json").read_text())
    assert {row["name"]: row["expected"] for row in details["parameters"]}["mass"] == pytest.approx(0.25)
    assert details["held_out"]["identified"]["score"] < details["held_out"]["earlier"]["score"]


def dataset(robot: RobotDescription, **options: Path) -> RecordingsData:
    folder = robot.file.parent
    parts = {"recordings": (folder / "training",), "validation": (folder / "validation",), "robot": str(robot.file)}
    return RecordingsData(**parts, output=folder / "out", **options)  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_identified_actuators_are_used_by_default_if_they_replay_better(
    robot: RobotDescription, run: tuple[Path, str], capsys: pytest.CaptureFixture
):
    beside = robot.file.parent / ACTUATORS_FILE
    shutil.copy(run[0] / ACTUATORS_FILE, beside)
    try:
        prepared = prepare("supervised", dataset(robot))
        assert prepared.simulator.drivetrain is not None and "better than nominal" in capsys.readouterr().out
        stored = describe_run("supervised", {}, {}, [], prepared.dataset.identified, robot)
        again = run_actuators(json.loads(json.dumps(stored, default=str)), robot.file.parent, robot)
        assert same_parameters(again, prepared.dataset.identified)

        beside.write_text(identified_to_json(robot, identified(robot, shoulder_scale=1.4, mass=0.08)))
        prepared = prepare("supervised", dataset(robot))
        printed = capsys.readouterr().out
        assert prepared.dataset.identified is None and prepared.simulator.drivetrain is None
        assert "WORSE than nominal" in printed and "Nominal actuators are taken" in printed
        prepared = prepare("supervised", dataset(robot, actuators=beside))  # given explicitly
        assert prepared.dataset.identified is not None and "WORSE than nominal" in capsys.readouterr().out
        prepared = prepare("supervised", dataset(robot, actuators=Path("nominal")))
        assert prepared.dataset.identified is None and "than nominal" not in capsys.readouterr().out
    finally:
        beside.unlink()


@pytest.mark.parametrize("diverges", ["nominal", "identified"])
def test_stability_is_checked_for_the_actuators_in_use(tmp_path: Path, diverges: str):
    robot = write_recorded_arm(tmp_path)
    stiffness = {"nominal": 0.0, "identified": 0.0, diverges: 1e4}  # N m/rad; 1e4 is too stiff for the time step
    model = tmp_path / "arm.xml"
    model.write_text(model.read_text().replace('name="elbow"', f'name="elbow" stiffness="{stiffness["nominal"]}"'))
    content = json.loads(robot.file.read_text())
    content["identify"] = [{"joint": "elbow", "field": "stiffness", "bounds": [0, 2e4]}]
    robot.file.write_text(json.dumps(content))
    robot = read_description(robot.file)
    file = tmp_path / "identified.json"
    file.write_text(identified_to_json(robot, identified(robot, elbow_stiffness=stiffness["identified"])))

    actuators = {"nominal": Path("nominal"), "identified": file}
    with pytest.raises(InputError, match=r"arm\.xml: the model diverges from its recorded states"):
        prepare("supervised", dataset(robot, actuators=actuators.pop(diverges)))
    (stable,) = actuators.values()
    prepare("supervised", dataset(robot, actuators=stable))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--objective", "hausdorff"], "--objective is for BALLU's legs"),
        (["--levels", "5"], "--levels is for BALLU's legs"),
        (["--window-seconds", "0"], "--window-seconds is 0.0: it must be above 0"),
        (["--angle-noise", "-1"], "--angle-noise is -1.0: it must be above 0"),
        (["--actuators", "{training}"], "this is a folder; give the file actuators.json"),
        (["--actuators", "missing.json"], "missing.json: there is no such file; `python -m ballu_mjx.train sysid`"),
        (["--validation", "{training}"], "is among --recordings and --validation"),
        (["--window-seconds", "60"], "none of --recordings lasts 60 s"),
    ],
)
def test_unsuitable_options_and_recordings_are_refused(
    robot: RobotDescription, capsys: pytest.CaptureFixture, arguments: list[str], message: str
):
    folder = robot.file.parent
    line = ["sysid", "--robot", str(robot.file), "--recordings", str(folder / "training")]
    line += ["--output", str(folder / "refused")]
    assert train.main([*line, *(a.format(training=folder / "training") for a in arguments)]) == 2
    assert message in capsys.readouterr().err
    assert not (folder / "refused").exists()


def test_recordings_of_one_identification_have_the_same_kind_of_states(robot: RobotDescription):
    training, held = (
        {path: read_recording(path, robot) for path in list_recordings([robot.file.parent / use])}
        for use in ("training", "validation")
    )
    bare = {path: dataclasses.replace(recording, joint_angles={}) for path, recording in held.items()}
    check_recordings(robot, training, held, 1.0, SamplingConfig(angle_noise=0.01))
    check_recordings(robot, bare, {}, 1.0, SamplingConfig())
    with pytest.raises(InputError, match="motion-1.*no columns for elbow, shoulder, but .*motion-0.* has all joints"):
        check_recordings(robot, training, bare, 1.0, SamplingConfig())
    with pytest.raises(InputError, match="leave out the options of sampling"):
        check_recordings(robot, bare, {}, 1.0, SamplingConfig(angle_noise=0.01))


@pytest.mark.parametrize("option", [("--window-seconds", "2"), ("--actuators", "swept.json")])
def test_options_of_declared_parameters_are_refused_for_ballu(option: tuple[str, str], capsys: pytest.CaptureFixture):
    assert train.main(["sysid", *option]) == 2
    message = f"{option[0]} is for declared parameters, but ballu has its own method"
    assert message in capsys.readouterr().err.lower()


def test_declared_parameters_beside_an_own_method_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture):
    ballu = load_robot()
    content = json.loads(ballu.file.read_text()) | {"model": str(ballu.model)}
    content["identify"] = [{"joint": "knee_left", "field": "damping", "bounds": [0.0, 0.1], "prior": 0.01}]
    (tmp_path / "mine.robot.json").write_text(json.dumps(content))
    assert train.main(["sysid", "--robot", str(tmp_path / "mine.robot.json")]) == 2
    assert 'mine.robot.json: "identify" has no effect' in capsys.readouterr().err


def test_actuators_file_of_another_declaration_is_refused(robot: RobotDescription, tmp_path: Path):
    path = tmp_path / "actuators.json"
    path.write_text(identified_to_json(robot, identified(robot, **TRUTH)))
    content = json.loads(robot.file.read_text()) | {"identify": IDENTIFY[:2], "model": str(robot.model)}
    other = tmp_path / "other.robot.json"
    other.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"actuators.json: other.robot.json identifies no shoulder_delay"):
        read_actuators(read_description(other), path)
    del content["identify"]
    other.write_text(json.dumps(content))
    with pytest.raises(InputError, match="the actuators of arm cannot be identified yet"):
        read_actuators(read_description(other), path)
