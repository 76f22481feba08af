"""Views of a run: the report page and its numbers, the replay in a real browser, the live viewer and the video."""

from __future__ import annotations

import dataclasses
import html.parser
import io
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from PIL import Image

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.cli import train_envmimic, train_policy, view
from ballu_mjx.cli.report import main
from ballu_mjx.evaluation.errors import HORIZONS, Errors, Evaluation
from ballu_mjx.evaluation.errors_file import evaluation_to_json
from ballu_mjx.evaluation.transfer import Transfer, walking_table
from ballu_mjx.policies import pipeline_layout
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.training import locomotion_ppo
from ballu_mjx.recordings.csv_format import list_bundled
from ballu_mjx.recordings.recording_groups import group_of
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.run_config import describe_run
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs.folder import Run
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE, StoredRollout, read_rollouts, write_rollouts
from ballu_mjx.viz import artifacts, report, report_content, robot_meshes, video, viser_scene
from ballu_mjx.viz.style import colour_of

LARGEST_PAGE = 10e6
HOSTILE = "<script>window.hacked = 1</script>\"><img src=x onerror='window.hacked = 1'>"
SECONDS = 25.0
"""Length of the main recordings."""


def walk(states: int, speed: float, turn: float, seed: int) -> np.ndarray:
    """Return states of a robot that walks ahead, turns and moves its legs. Noise makes them hard to compress."""
    time = np.arange(states) * CONTROL_TIMESTEP
    qpos = np.tile(standing_qpos(load_model()), (states, 1))
    qpos[:, 0] += speed * time
    qpos[:, 1] += turn * time**2 / 400
    qpos[:, 3], qpos[:, 6] = np.cos(turn * time / 40), np.sin(turn * time / 40)
    rng = np.random.default_rng(seed)
    qpos[:, 7:] += 0.3 * np.sin(7 * time[:, None] + np.arange(7)) + rng.normal(0, 0.01, (states, 7))
    return qpos


def take(name: str, states: int, seed: int = 0, robot_name: str = "") -> StoredRollout:
    rng = np.random.default_rng(seed)
    return StoredRollout(
        name=name,
        description=load_robot(),
        robot=robot_name,
        time=0.1 + np.arange(states) * CONTROL_TIMESTEP,
        qpos={
            "recording": walk(states, 0.10, 1.0, seed),
            "vanilla": walk(states, 0.14, 0.0, seed + 1),
            "envmimic": walk(states, 0.08, -1.0, seed + 2),
        },
        command=rng.uniform(0, 1, (states - 1, 2)),
        force=0.05 * rng.normal(0, 1, (states - 1, 3)),
    )


def errors(name: str, seed: int) -> Errors:
    rng = np.random.default_rng(seed)

    def horizons() -> dict[float, tuple[float, float]]:
        return {horizon: tuple(rng.uniform(0.01, 1, 2)) for horizon in HORIZONS}  # pyright: ignore[reportReturnType]

    return Errors(name, group_of(name), horizons(), horizons(), *rng.uniform(0.1, 10, 3))


def write_run(folder: Path, takes: list[StoredRollout]) -> Path:
    """Write the folder of an EnvMimic run as training does, without checkpoints and figures."""
    sections = {"env": EnvMimicConfig(), "ppo": PPOConfig(), "data": train_envmimic.Data(output=Path(HOSTILE))}
    with Run(folder, describe_run("envmimic", sections, {}, [])) as run:
        for step in range(0, 500, 100):
            run.log(step, {"reward": 1.0 + step / 1000, "validation_error": 1.0 - step / 1000})
    without, mimic = (tuple(errors(t.name, 10 * i + k) for i, t in enumerate(takes)) for k in range(2))
    evaluation = Evaluation(without, mimic)
    (folder / "evaluation.json").write_text(json.dumps(evaluation_to_json(evaluation)))
    (folder / "evaluation.txt").write_text(evaluation.table())
    write_rollouts(folder / ROLLOUT_FILE, takes)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on four recordings as long as the bundled ones. The names of the second and of its robot are hostile."""
    names = ("near-1", HOSTILE, "far-1", "far-2")
    states = round(SECONDS / CONTROL_TIMESTEP)
    takes = [take(name, states, 10 * i, HOSTILE if i == 1 else "virtual") for i, name in enumerate(names)]
    return write_run(tmp_path_factory.mktemp("report") / "run", takes)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("short") / "run", [take("near-1", 21)])


@pytest.fixture(scope="module")
def page(run: Path) -> Path:
    assert main([str(run)]) == 0
    return run / report.REPORT_FILE


class Elements(html.parser.HTMLParser):
    """Parser of the elements of a page and their attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))


# ---- the page ----


def test_page_is_small_and_has_no_external_references(page: Path):
    text = page.read_text(encoding="utf-8")
    assert len(text.encode()) < LARGEST_PAGE
    elements = Elements(text).elements
    assert {"iframe", "script", "style", "table"} <= {tag for tag, _ in elements}
    for tag, attributes in elements:
        assert tag not in ("link", "object", "embed", "base"), tag
        for name in ("src", "href", "srcset", "data", "action", "poster"):
            assert re.match(r"#|data:|$", attributes.get(name) or ""), (tag, attributes)
    (policy,) = [a["content"] for tag, a in elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert "default-src 'none'" in (policy or "") and "http" not in (policy or "")


def test_numbers_agree_with_the_evaluation(run: Path, page: Path):
    stored = json.loads((run / "evaluation.json").read_text())
    shown = [a["title"] for tag, a in Elements(page.read_text()).elements if tag == "td" and "title" in a]
    expected: list[float] = []
    for without, mimic in zip(stored["vanilla"], stored["residual"], strict=True):
        for horizon in map(str, HORIZONS):
            for quantity in ("position", "orientation"):
                pair = [e[quantity][horizon][0] for e in (without, mimic)]
                expected += [*pair, pair[1] / pair[0]]
    for without, mimic in zip(stored["vanilla"], stored["residual"], strict=True):
        expected += [e[key] for key in ("mean_com_error", "final_orientation_error") for e in (without, mimic)]
        expected.append(mimic["mean_force"])
    assert [float(value or "nan") for value in shown] == expected


def test_curves_and_plots_agree_with_the_run(run: Path):
    content = report_content.collect(run)
    assert [(curve.title, *curve.values) for curve in content.curves] == [
        ("reward per control step", "envmimic"),
        ("validation error (ratio to no residual)", "envmimic"),
    ]
    np.testing.assert_allclose(content.curves[1].values["envmimic"][1], [1.0, 0.9, 0.8, 0.7, 0.6])
    rows = dict(report._take_rows(content.takes[0]))
    assert [line.name for line in rows["x (m)"]] == ["recording", "vanilla", "EnvMimic"]
    assert [line.colour for line in rows["x (m)"]] == ["#000000", "#d55e00", "#009e73"]
    # 25 s at 0.10 m/s. The quaternion has half the angle, so the robot turns by 2 x 25 / 40 rad.
    path = rows["x (m)"][0].y
    assert path[-1] - path[0] == pytest.approx(2.5, abs=0.15)
    yaw = rows["yaw (deg)"][0].y
    assert yaw[-1] - yaw[0] == pytest.approx(np.rad2deg(2 * 25 / 40), abs=3.0)
    assert len(rows["residual force (N)"]) == 3 and len(rows["command"]) == 2


def test_options_and_names_are_escaped(run: Path, page: Path):
    elements = Elements(page.read_text()).elements
    assert not [a for tag, a in elements if tag == "img" or "onerror" in a]
    content = report_content.collect(run)
    assert HOSTILE in dict(content.facts)["robot"]
    assert dict(dict(content.options)["env"])["episode_spread"] == "0.5"


class Bomb:
    """Object that creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda arrays, path: arrays | {"0/qpos/vanilla": np.array([Bomb(path)], object)},
            "not an archive of plain arrays",
        ),
        (lambda arrays, path: arrays | {"names": np.array([Bomb(path)], object)}, "not an archive of plain arrays"),
        (lambda arrays, path: arrays | {"0/force": arrays["0/force"][:-1]}, "0/force is not an array of (20, 3)"),
        (lambda arrays, path: arrays | {"0/qpos/vanilla": np.full((21, 14), np.nan)}, "0/qpos/vanilla is not"),
        (lambda arrays, path: arrays | {"0/time": np.array(["x"] * 21)}, "0/time is not an array"),
        (lambda arrays, path: {k: v for k, v in arrays.items() if "qpos" not in k}, "has no robot"),
        (lambda arrays, path: arrays | {"format": np.array("other/1")}, "the format is not ballu-replay/2"),
    ],
)
def test_damaged_replay_is_refused(short: Path, tmp_path: Path, capsys, damage: Callable, message: str):
    folder = shutil.copytree(short, tmp_path / "run")
    with np.load(folder / ROLLOUT_FILE) as file:
        arrays: dict[str, np.ndarray] = {name: file[name] for name in file.files}
    np.savez(folder / ROLLOUT_FILE, **damage(arrays, tmp_path / "exploded"))  # pyright: ignore[reportArgumentType]
    for command in (main, view.main):
        assert command([str(folder)]) == 2
        error = capsys.readouterr().err
        assert message in error and ROLLOUT_FILE in error and error.count("\n") == 1
    assert not (tmp_path / "exploded").exists()
    assert not (folder / report.REPORT_FILE).exists()


def test_a_replay_file_that_is_not_an_archive_is_refused(tmp_path: Path):
    single = io.BytesIO()
    np.save(single, np.zeros(3))
    for content in (b"", b"PK\x03\x04 cut off", b"\x80\x04\x95 pickle", single.getvalue()):
        (tmp_path / ROLLOUT_FILE).write_bytes(content)
        with pytest.raises(report.InputError, match="not an archive of plain arrays"):
            read_rollouts(tmp_path / ROLLOUT_FILE)


def test_replay_is_stored_in_single_precision(tmp_path: Path):
    takes = [take("a", 30), dataclasses.replace(take("b", 12, 5), command=None, force=None)]
    write_rollouts(tmp_path / ROLLOUT_FILE, takes)
    for found, expected in zip(read_rollouts(tmp_path / ROLLOUT_FILE), takes, strict=True):
        assert (found.name, found.robot, list(found.qpos)) == (expected.name, expected.robot, list(expected.qpos))
        assert found.qpos["vanilla"].dtype == np.float32
        for name in expected.qpos:
            np.testing.assert_allclose(found.qpos[name], expected.qpos[name], atol=1e-6)
        assert (found.force is None) == (expected.force is None)
    with zipfile.ZipFile(tmp_path / ROLLOUT_FILE) as archive:
        assert all(entry.compress_type == zipfile.ZIP_DEFLATED for entry in archive.infolist())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{}/nowhere"], "there is no run"),
        (["{}", "--output", "{}"], "is a folder; give a file"),
        (["{}", "--video", "--show", "far-9"], "there is no such replay; give one of near-1"),
    ],
)
def test_report_refuses_unsuitable_arguments(short: Path, capsys, arguments: list[str], message: str):
    assert main([argument.format(short) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_damaged_evaluation_is_refused(short: Path, tmp_path: Path, capsys):
    folder = shutil.copytree(short, tmp_path / "run")
    for content in ("", "[]", '{"vanilla": [{}], "residual": [{}], "score": 1.0}', '{"score": "<b>"}'):
        (folder / "evaluation.json").write_text(content)
        assert main([str(folder)]) == 2
        error = capsys.readouterr().err
        assert "evaluation.json: " in error and "writes it again" in error and error.count("\n") == 1


def test_learning_curves_have_the_steps_of_their_method(tmp_path: Path):
    units = {"envmimic": "control steps (millions)", "analytic": "gradient steps"}
    for task in units:
        with Run(tmp_path / task, describe_run(task, {"env": EnvMimicConfig(), "ppo": PPOConfig()}, {}, [])) as run:
            for step in (0, 300):
                run.log(step, {"validation_error": 1.0})
        text = report.render(report_content.collect(tmp_path / task))
        shown = [unit for unit in units.values() if re.search(rf'"text":\s*"{re.escape(unit)}"', text)]
        assert shown == [units[task]]


def test_report_of_the_pipeline_shows_tables_and_overlaid_policies(tmp_path: Path):
    transfer = Transfer(*np.arange(1.0, 12.0))
    results = {"vanilla+dr": [[transfer]], "envmimic": [[transfer]], HOSTILE: [[transfer]]}
    pipeline_layout.table_file(tmp_path, "walk").write_text(walking_table(results))
    for setting, states in (("vanilla+dr", 30), ("envmimic", 25), ("envmimic-2", 28)):
        folder = tmp_path / "seed-0" / f"walk-{setting}"
        sections = {"env": LocomotionConfig(), "ppo": locomotion_ppo(), "data": train_policy.Data()}
        with Run(folder, describe_run("walk", sections, {}, [])) as run:
            run.log(100, {"reward": 0.1})
        episode = StoredRollout(
            name="walk",
            description=load_robot(),
            time=np.arange(states) * 0.05,
            qpos={setting.removesuffix("-2"): walk(states, 0.2, 0.0, 1)},
        )
        write_rollouts(folder / ROLLOUT_FILE, [episode])
    write_run(tmp_path / "seed-0" / "envmimic-walk", [take("actions-1", 21)])
    write_run(tmp_path / "seed-0" / "envmimic-walk-2", [take("actions-1", 22)])
    write_run(tmp_path / "seed-0" / "aerodynamic-walk", [take("actions-1", 23)])

    content = report_content.collect(tmp_path)
    assert [(t.name, list(t.qpos), len(t.time)) for t in content.takes] == [
        ("policies: walk, seed-0", ["vanilla+dr", "envmimic", "envmimic-2"], 25),
        ("EnvMimic: walk, seed-0: actions-1", ["recording", "vanilla", "envmimic"], 21),
        ("aerodynamic: walk, seed-0: actions-1", ["recording", "vanilla", "envmimic"], 23),
        ("EnvMimic, round 2: walk, seed-0: actions-1", ["recording", "vanilla", "envmimic"], 22),
    ]
    assert [list(curve.values) for curve in content.curves] == [["vanilla+dr", "envmimic", "envmimic-2"]]
    text = report.render(content)
    assert "EnvMimic, round 2" in text
    # Our value and the paper's are in neighbouring cells.
    assert re.search(r"<td>vanilla\+dr</td>\s*<td[^>]*>1\.00</td>\s*<td[^>]*>1\.24</td>", text)
    assert "hacked" not in " ".join(str(a) for tag, a in Elements(text).elements if tag == "img")
    assert "<img src=x" not in text


# ---- geometry ----


def test_shape_has_the_height_of_the_model_and_stands_on_the_floor():
    model = load_model()
    qpos = standing_qpos(model)
    poses = robot_meshes.poses(model, load_robot(), qpos[None])
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    world = {0: (np.zeros(3), np.eye(3))}
    for body in range(1, model.nbody):
        origin, rotation = world[model.body_parentid[body]]
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, poses.quaternion[0, body])
        world[body] = origin + rotation @ poses.position[0, body], rotation @ turned.reshape(3, 3)
        np.testing.assert_allclose(world[body][0], data.xpos[body], atol=1e-9)
        np.testing.assert_allclose(world[body][1].ravel(), data.xmat[body], atol=1e-9)
    points = np.concatenate(
        [part.vertices @ world[part.body][1].T + world[part.body][0] for part in robot_meshes.parts(model)]
    )
    assert points[:, 2].min() == pytest.approx(0.0, abs=1e-3)
    balloon, rotation = world[model.body("balloon").id]
    assert points[:, 2].max() == pytest.approx(balloon[2] + 0.54 + 0.17, abs=5e-3)  # the upper balloons' tops
    assert {part.body for part in robot_meshes.parts(model)} == set(range(1, model.nbody))


def test_mujoco_scene_shows_robots_in_their_colours_and_the_force():
    model = load_model()
    data = mujoco.MjData(model)
    scene = mujoco.MjvScene(model, 500)
    shown = take("near-1", 3)
    robots = {name: qpos[1] for name, qpos in shown.qpos.items()}
    robot_meshes.draw(scene, model, data, load_robot(), robots, np.array([0.0, 0.8, 0.0]))
    geoms = scene.geoms[: scene.ngeom]
    for name in robots:
        own = [geom for geom in geoms if np.allclose(geom.rgba[:3], colour_of(name), atol=1e-3)]
        balloons = [geom for geom in own if geom.type == mujoco.mjtGeom.mjGEOM_ELLIPSOID]
        assert len(balloons) == 6 and all(geom.rgba[3] < 0.3 for geom in balloons)
        base = min(balloons, key=lambda geom: geom.pos[2]).pos[0]
        assert base == pytest.approx(robots[name][0], abs=0.4)
    (arrow,) = [geom for geom in geoms if geom.type == mujoco.mjtGeom.mjGEOM_ARROW]
    np.testing.assert_allclose(arrow.pos, data.site("balloon").xpos, atol=1e-6)
    np.testing.assert_allclose(arrow.mat[:, 2], [0, 1, 0], atol=1e-6)


# ---- in the browser ----

_PATIENCE = 120.0
"""Longest time to wait for the browser (s)."""


@pytest.fixture
def browser() -> Iterator[Any]:
    """Headless Chromium with logs of its console and network."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no Chromium here: apt-get install chromium chromium-driver")
    if "PYTEST_XDIST_WORKER" in os.environ:  # rendering without a GPU fails while other tests use the processors
        pytest.skip("needs the machine to itself: pytest --numprocesses=0 tests/viz/test_report.py -k browser")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--window-size=700,560",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    chrome = webdriver.Chrome(options=options, service=Service(driver))
    chrome.implicitly_wait(_PATIENCE)  # a busy machine draws slowly
    try:
        yield chrome
    finally:
        chrome.quit()


def wait(found: Callable[[], Any]) -> Any:
    """Wait until `found` returns a true value, and return it."""
    end = time.monotonic() + _PATIENCE
    while not (value := found()):
        assert time.monotonic() < end, "the browser did not respond in time"
        time.sleep(0.2)
    return value


_CANVAS = """
const frame = window.frameElement.getBoundingClientRect();
const canvas = document.querySelector("canvas").getBoundingClientRect();
return [frame.left + canvas.left, frame.top + canvas.top, frame.left + canvas.right, frame.top + canvas.bottom];
"""


def picture(chrome: Any) -> np.ndarray:
    """Return the pixels of the player, from within its frame. They are cut out of a screenshot of the window, because
    the driver sometimes fails to capture an element of a frame on a busy machine."""
    window = Image.open(io.BytesIO(chrome.get_screenshot_as_png())).convert("RGB")
    left, top, right, bottom = map(round, chrome.execute_script(_CANVAS))
    shown = window.crop((max(left, 0), max(top, 0), min(right, window.width), min(bottom, window.height)))
    return np.asarray(shown).astype(int)


def clock(chrome: Any) -> float:
    """Return the time (s) that the player shows, from within its frame."""
    return float(wait(lambda: chrome.execute_script("return document.querySelector('input')?.value")))


def test_page_plays_in_a_browser(page: Path, browser: Any, tmp_path: Path):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    browser.get(page.as_uri())
    assert browser.execute_script("return document.querySelectorAll('#plots .main-svg').length") > 0
    frame = browser.find_element(By.ID, "stage")
    browser.execute_script("arguments[0].scrollIntoView()", frame)
    browser.switch_to.frame(frame)
    wait(lambda: browser.find_elements(By.TAG_NAME, "canvas"))
    wait(lambda: clock(browser) > 0.5)

    def colours(pixels: np.ndarray) -> dict[str, int]:
        """Return the number of pixels in each robot's colour, with a tolerance for transparency."""
        red, green, blue = pixels.reshape(-1, 3).T
        return {
            "recording": int(np.sum((red < 70) & (green < 70) & (blue < 70))),
            "vanilla": int(np.sum((red > green + 60) & (green > blue + 20))),
            "envmimic": int(np.sum((green > red + 60) & (green > blue + 10))),
        }

    wait(lambda: min(colours(picture(browser)).values()) > 10)
    play = browser.find_element(By.XPATH, "//button[@aria-label='Show scene tree']/preceding::button[1]")
    play.click()

    def changed(since: np.ndarray) -> float:
        """Return the fraction of pixels that changed."""
        return float(np.mean(np.abs(picture(browser) - since).max(axis=-1) > 30))

    def settled() -> bool:
        before = picture(browser)
        time.sleep(0.5)
        return changed(before) < 1e-4

    wait(settled)  # the last frame may still be drawn
    stopped, still = clock(browser), picture(browser)
    time.sleep(1.0)
    assert clock(browser) == stopped
    assert changed(still) < 1e-4

    play.click()
    wait(lambda: abs(clock(browser) - stopped) > 0.5)
    wait(lambda: changed(still) > 0.002)
    slider = browser.find_element(By.CSS_SELECTOR, ".mantine-Slider-root")
    side = -1 if stopped > SECONDS / 2 else 1  # the other half of the replay, which a busy machine may have reached
    ActionChains(browser).move_to_element_with_offset(slider, side * slider.size["width"] // 4, 0).click().perform()
    scrubbed = SECONDS / 2 + side * SECONDS / 4
    wait(lambda: abs(clock(browser) - scrubbed) < 1.0)
    wait(lambda: changed(still) > 0.01)

    browser.switch_to.default_content()
    browser.save_screenshot(str(tmp_path / "page.png"))
    assert (tmp_path / "page.png").stat().st_size > 10_000
    before = browser.execute_script("return JSON.stringify(document.getElementById('plots').data[0].y)")
    browser.find_elements(By.CSS_SELECTOR, "[data-take]")[1].click()
    assert browser.execute_script("return JSON.stringify(document.getElementById('plots').data[0].y)") != before
    browser.switch_to.frame(browser.find_element(By.ID, "stage"))
    wait(lambda: abs(clock(browser) - scrubbed) > 1.5)  # the other replay starts at its beginning
    assert browser.execute_script("return window.hacked") is None
    browser.switch_to.default_content()
    assert browser.execute_script("return window.hacked") is None
    assert HOSTILE in browser.find_element(By.TAG_NAME, "body").text

    assert [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    sent = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    loaded = [m["params"]["request"]["url"] for m in sent if m["method"] == "Network.requestWillBeSent"]
    assert page.as_uri() in loaded
    assert [url for url in loaded if not url.startswith(("data:", "blob:", "about:", page.as_uri()))] == []


# ---- live ----


def listening(host: str, port: int) -> bool:
    with socket.socket() as client:
        client.settimeout(2.0)
        return client.connect_ex((host, port)) == 0


def test_live_viewer_plays_and_accepts_only_local_connections():
    server = viser_scene.serve(0)
    try:
        assert listening("127.0.0.1", server.get_port())
        # A server on all addresses of the machine would also answer here.
        assert not listening("127.0.0.2", server.get_port())
        assert server.request_share_url() is None
        player = view.Player(server, [take("near-1", 41), take(HOSTILE, 21, 7)], 0)
        start = server.scene.get_handle_by_name("/world/EnvMimic/base")
        assert start is not None
        place = np.array(start.position)
        player.advance(0.5)
        assert player.state == 10
        assert np.linalg.norm(start.position - place) > 0.02
        player.speed.value = "2"
        player.advance(0.5)
        assert player.state == 30
        player.play.value = False
        player.advance(0.5)
        assert player.state == 30
        player.play.value = True
        for _ in range(2):
            player.advance(5.0)
        assert player.state == 0  # restarted
        player.take.value = HOSTILE
        player.advance(0.0)
        assert player.clock.max == pytest.approx(1.0) and player.state == 0
    finally:
        server.stop()


def test_view_refuses_a_suspended_recording(capsys):
    assert view.main([str(list_bundled("suspended")[0])]) == 2
    assert "is a suspended recording" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux runs without a screen")
def test_mujoco_viewer_without_a_screen_gives_a_one_line_error(short: Path):
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    line = [sys.executable, "-m", "ballu_mjx", "view", str(short), "--mujoco"]
    done = subprocess.run(line, capture_output=True, text=True, env=environment, timeout=300)
    assert done.returncode == 2
    assert done.stderr.startswith("--mujoco: there is no screen") and done.stderr.count("\n") == 1


# ---- video ----


def command(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")}
    line = [sys.executable, "-m", "ballu_mjx", "report", str(folder), "--video"]
    return subprocess.run(line, capture_output=True, text=True, env=kept | environment, timeout=300)


@pytest.mark.slow
def test_video_shows_the_robots(short: Path):
    import imageio_ffmpeg

    done = command(short)
    assert done.returncode == 0, done.stderr
    if done.stderr.startswith("No video"):
        pytest.skip(done.stderr)
    line = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(short / "report.mp4")]
    raw = subprocess.run([*line, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True).stdout
    pictures = np.frombuffer(raw, np.uint8).reshape(-1, video.HEIGHT, video.WIDTH, 3).astype(int)
    assert len(pictures) == 21
    red, green, blue = pictures[10].reshape(-1, 3).T
    assert np.sum((red > green + 60) & (green > blue + 20)) > 20  # vanilla
    assert np.sum((green > red + 60) & (green > blue + 10)) > 20  # EnvMimic
    assert np.mean(np.abs(pictures[0] - pictures[-1]).max(axis=-1) > 40) > 0.002


@pytest.mark.slow
def test_without_opengl_the_page_is_written_with_a_one_line_warning(short: Path):
    (short / report.REPORT_FILE).unlink(missing_ok=True)
    done = command(short, MUJOCO_GL="disable")
    assert done.returncode == 0
    assert "libosmesa6" in done.stderr and done.stderr.count("\n") == 1
    assert (short / report.REPORT_FILE).stat().st_size > 1e6


def test_a_simulation_that_diverged_keeps_its_last_state(tmp_path: Path):
    whole = walk(20, 0.1, 0.0, 0)
    broken = whole.copy()
    broken[12, 7], broken[13:] = 3e7, np.nan
    kept = artifacts._while_finite(broken)
    np.testing.assert_array_equal(kept[:12], whole[:12])
    np.testing.assert_array_equal(kept[12:], np.tile(whole[11], (8, 1)))
    rollout = dataclasses.replace(take("near-1", 20), qpos={"recording": whole, "vanilla": kept})
    write_rollouts(tmp_path / ROLLOUT_FILE, [rollout])
    assert set(read_rollouts(tmp_path / ROLLOUT_FILE)[0].qpos) == {"recording", "vanilla"}
    with pytest.raises(ValueError, match="not finite"):
        write_rollouts(tmp_path / ROLLOUT_FILE, [dataclasses.replace(rollout, qpos={"vanilla": broken})])
