"""Live 3D view of a run or a recording: `python -m ballu_mjx view RUN`.

JAX, MuJoCo and modules that need them are imported inside functions: `runtime.prepare` has to come first.
"""

from __future__ import annotations

import dataclasses
import sys
import time
import warnings
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from ballu_mjx.cli._help import parse_options
from ballu_mjx.common import files, runtime
from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE, StoredRollout, read_rollouts

if TYPE_CHECKING:
    from ballu_mjx.viz.viser_scene import LocalServer


_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
_FRAME = 1.0 / 40.0
"""Time between two updates of the view (s)."""


@dataclasses.dataclass(frozen=True)
class Options(runtime.CommandOptions):
    """Show the replay of a run, or a reconstructed recording, in 3D in the browser. The server accepts only connections
    from this machine."""

    source: tyro.conf.Positional[Path]
    """Folder of a run or of `train all`, or a recording (.csv or .csv.gz)."""
    port: int = 8080
    """Port of the server on 127.0.0.1. If it is taken, the next free port is used."""
    open: bool = False
    """Open the view in the browser at once."""
    mujoco: bool = False
    """Open MuJoCo's own viewer instead. It needs a screen."""
    rerun: Path | None = None
    """Write the recording (or task) of --show to a file for Rerun's viewer instead, NAME.rrd. Needs the extra rerun."""
    robot: str = "ballu"
    """Robot of a recording: its name, or its description file. For a run, the run's own robot is used."""
    show: str | None = None
    """Recording (or task) to show first. Without this option: the first one."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command until it is interrupted; return the exit status (`runtime.exit_status`)."""

    def run() -> None:
        try:
            options = parse_options(Options, arguments, "python -m ballu_mjx view")
            if not 0 <= options.port <= 65535:
                raise InputError(f"--port is {options.port}: it must be between 0 and 65535.")
            if options.rerun is not None and options.mujoco:
                raise InputError("--rerun does not go with --mujoco; leave one out.")
            if options.mujoco:
                check_screen()
            runtime.prepare()
            if options.rerun is not None:
                files.check_folder(options.rerun.parent)
            takes = load(options.source, options.robot)
            first = choose(takes, options.show)
            if options.rerun is not None:
                from ballu_mjx.viz.rerun_file import write_rerun

                options.rerun.parent.mkdir(parents=True, exist_ok=True)
                write_rerun(options.rerun, takes[first])
                print(f"Written to {options.rerun}; `rerun {options.rerun}` shows it.")
            elif options.mujoco:
                _mujoco(takes[first])
            else:
                _serve(takes, first, options)
        except KeyboardInterrupt:  # the normal way to close the view
            print("Closed.", file=sys.stderr)

    return runtime.exit_status(run, arguments)


def load(source: Path, robot: str = "ballu") -> list[StoredRollout]:
    """Return the replays of a run's folder, or a reconstructed recording of a robot as one replay.

    **Raises** `InputError` if `source` is neither a run's folder nor a free recording, or if the run has no replay.
    """
    if source.is_dir():
        from ballu_mjx.viz.report_content import collect

        takes = collect(source).takes
        if not takes:
            _check_has_replay(source)
        return takes or read_rollouts(source / ROLLOUT_FILE)
    from ballu_mjx.recordings.csv_format import list_recordings, read_recording
    from ballu_mjx.recordings.reconstruct import reconstruct
    from ballu_mjx.robots.registry import load_robot

    description = load_robot(robot)
    recording = read_recording(list_recordings([source])[0], description)
    if recording.kind != "free":
        raise InputError(f"{source}: is a {recording.kind} recording; only free recordings can be shown.")
    print("Reconstructing the recorded states ...", flush=True)
    motion = reconstruct(recording, description)
    return [
        StoredRollout(
            name=motion.name,
            description=description,
            robot=motion.robot,
            time=motion.time,
            qpos={"recording": motion.qpos},
            command=motion.command,
        )
    ]


def _check_has_replay(run: Path) -> None:
    """Check that a run whose replay is missing is that of a residual, which `evaluate` writes.

    **Raises** `InputError` otherwise.
    """
    from ballu_mjx.policies.tasks import TASKS
    from ballu_mjx.residuals.registry import RESIDUAL_TASKS
    from ballu_mjx.runs.folder import read_config

    task = read_config(run, *RESIDUAL_TASKS, *TASKS, "sysid")["task"]
    if task == "sysid":
        raise InputError(f"{run}: an identification has no replay; give the run of a residual or a policy.")
    if task in TASKS:
        raise InputError(
            f"{run}: has no {ROLLOUT_FILE}; `python -m ballu_mjx.train {task} --resume {run}` writes it again."
        )


def choose(takes: Sequence[StoredRollout], name: str | None) -> int:
    """Return the index of the replay called `name`, or 0 if `name` is None.

    **Raises** `InputError` if there is no such replay.
    """
    names = [take.name for take in takes]
    if name is None:
        return 0
    if name not in names:
        raise InputError(f"--show {name}: there is no such replay; give one of {', '.join(names)}.")
    return names.index(name)


def check_screen() -> None:
    """Check that there is a screen for MuJoCo's viewer.

    **Raises** `InputError` if there is none.
    """
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        there = glfw.init()
    if not there:
        raise InputError("--mujoco: there is no screen for MuJoCo's viewer; leave the option out to use a browser.")


class Player:
    """Player of replays on a server, with controls. `advance` moves its clock."""

    def __init__(self, server: LocalServer, takes: Sequence[StoredRollout], first: int = 0) -> None:
        self._server, self._takes = server, takes
        names = _distinct([take.name for take in takes])
        gui = server.gui
        self.take = gui.add_dropdown("show", names, initial_value=names[first])
        self._robot = gui.add_text("robot", "", disabled=True)
        self.play = gui.add_checkbox("play", True)
        self.clock = gui.add_slider("time (s)", 0.0, 1.0, 0.01, 0.0)
        self.speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1")
        self.follow = gui.add_checkbox("follow", True)
        self._force = gui.add_text("residual force (N)", "", disabled=True)
        self._names = names
        self._scrubbed = False
        self._folder: Any = None
        self._boxes: list[Any] = []
        self._shown: tuple[str, int] | None = None
        self._load()

        @self.clock.on_update
        def _(event: Any) -> None:
            self._scrubbed = self._scrubbed or event.client is not None

    def advance(self, seconds: float) -> None:
        """Advance the clock by `seconds` times the chosen speed, if it plays, and show the state at that time.

        After the end, the replay begins again.
        """
        if self._shown is None or self._shown[0] != self.take.value:
            self._load()
        take, end = self._stage.take, self.clock.max
        now = float(self.clock.value)
        if self.play.value and not self._scrubbed:
            now = now + seconds * float(self.speed.value) if now < end else 0.0
            self.clock.value = min(now, end)
        self._scrubbed = False
        # Times of the states may differ from multiples of the time step in the last digits.
        state = int(np.argmin(np.abs(take.time - take.time[0] - now)))
        for name, box in zip(self._stage.robots, self._boxes, strict=True):
            self._stage.robots[name].visible = box.value
        centre = self._stage.centre(state) if self.follow.value else np.zeros(3)
        self._stage.world.position = (-centre[0], -centre[1], 0.0)
        if (self.take.value, state) != self._shown:
            self._show(state)

    @property
    def state(self) -> int:
        """Index of the state that is shown."""
        return 0 if self._shown is None else self._shown[1]

    def _load(self) -> None:
        from ballu_mjx.viz.style import label_of
        from ballu_mjx.viz.viser_scene import RobotScene

        take = self._takes[self._names.index(self.take.value)]
        self._server.scene.reset()
        self._server.scene.set_up_direction("+z")
        self._stage = RobotScene(self._server, take)
        for client in self._server.get_clients().values():
            client.camera.position, client.camera.look_at = self._close()
        self._server.initial_camera.position, self._server.initial_camera.look_at = self._close()
        self._robot.value = take.robot
        self.clock.value = 0.0
        self.clock.max = float(take.time[-1] - take.time[0])
        if self._folder is not None:
            self._folder.remove()
        self._folder = self._server.gui.add_folder("robots")
        with self._folder:
            self._boxes = [self._server.gui.add_checkbox(label_of(name), True) for name in take.qpos]
        self._show(0)

    def _close(self) -> tuple[np.ndarray, np.ndarray]:
        """Return position and target (m) of a camera beside the robots, which it follows."""
        shapes = self._stage.shapes
        target = np.array([0.0, 0.0, self._stage.centre(0)[2]])
        return target + shapes.extent * np.array([-0.6, -1.8, 0.35]), target

    def _show(self, state: int) -> None:
        from ballu_mjx.viz import robot_meshes

        self._stage.show(state)
        force = robot_meshes.force_at(self._stage.take, state)
        self._force.value = "" if force is None else "  ".join(f"{component:+.3f}" for component in force)
        self._shown = (self.take.value, state)


def _serve(takes: Sequence[StoredRollout], first: int, options: Options) -> None:
    try:
        from ballu_mjx.viz import viser_scene
    except ImportError as error:
        raise InputError(
            f"The viewer needs {error.name}, which comes with the extra report: pip install -c constraints.txt -e "
            '".[report]".'
        ) from None
    server = viser_scene.serve(options.port)
    try:
        player = Player(server, takes, first)
        address = f"http://{viser_scene.HOST}:{server.get_port()}"
        print(f"{address}, on this machine alone; Ctrl-C closes it.", flush=True)
        if options.open:
            webbrowser.open(address)
        before = time.perf_counter()
        while True:
            time.sleep(_FRAME)
            now = time.perf_counter()
            player.advance(now - before)
            before = now
    finally:
        server.stop()


def _mujoco(take: StoredRollout) -> None:
    """Show a replay in MuJoCo's viewer in a loop, until its window is closed. The space bar pauses."""
    import mujoco
    import mujoco.viewer

    from ballu_mjx.viz import robot_meshes

    shapes = robot_meshes.RobotShapes(take.description)
    model = robot_meshes.load_scenery(shapes.robot)
    data, drawn = mujoco.MjData(model), mujoco.MjData(shapes.model)
    playing = True

    def key(code: int) -> None:
        nonlocal playing
        playing = playing != (code == ord(" "))

    try:
        window = mujoco.viewer.launch_passive(model, data, key_callback=key, show_left_ui=False, show_right_ui=False)
    except RuntimeError as error:
        raise InputError(f"--mujoco: {str(error).strip()}") from None
    with window:
        robot_meshes.option_for_scenery(window.opt)
        now, before = 0.0, time.perf_counter()
        while window.is_running():
            time.sleep(_FRAME)
            elapsed, before = time.perf_counter() - before, time.perf_counter()
            now = (now + elapsed * playing) % float(take.time[-1] - take.time[0])
            state = int(np.argmin(np.abs(take.time - take.time[0] - now)))
            robots = {name: qpos[state] for name, qpos in take.qpos.items()}
            with window.lock():
                scene = window.user_scn
                if scene is not None:
                    scene.ngeom = 0
                    arrow = shapes.arrow(take, state)
                    robot_meshes.draw(scene, shapes.model, drawn, shapes.robot, robots, arrow)
            window.sync()


def _distinct(names: Sequence[str]) -> list[str]:
    """Return names made unique by a number, for a list to choose from."""
    return [name if names.count(name) == 1 else f"{name} ({index + 1})" for index, name in enumerate(names)]
