"""Robots of a rollout in a viser scene, live or recorded as a page that plays without a server.

It needs the extra `report`.
"""

from __future__ import annotations

import contextlib
import io
import re
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import viser
import websockets.asyncio.server
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.rollout_file import StoredRollout
from ballu_mjx.viz import robot_meshes
from ballu_mjx.viz.style import colour_of, label_of

HOST = "127.0.0.1"
"""Address of the servers. They serve nothing to other machines."""
_GRAIN = 2.0**-14
"""Resolution of positions (m) and quaternions. Rounding makes recorded pages smaller."""
_OWN_PAGES = re.compile(r"http://(127\.0\.0\.1|localhost)(:[0-9]+)?")
_PATCHING = threading.Lock()
_FIELD_OF_VIEW = np.deg2rad(40.0)


class RobotScene:
    """Scene with the robots of one rollout, their paths on the floor, and the residual force."""

    def __init__(self, server: viser.ViserServer, take: StoredRollout) -> None:
        scene = server.scene
        self.shapes = robot_meshes.RobotShapes(take.description)
        model = self.shapes.model
        self.take = take
        self.states = len(take.time)
        self.poses = {name: self.shapes.poses(qpos) for name, qpos in take.qpos.items()}
        self._handles: dict[str, list[Any]] = {}
        self.world = scene.add_frame("/world", show_axes=False)
        scene.add_grid(
            "/world/floor", width=40.0, height=40.0, cell_size=0.25, section_size=1.0, position=(0, 0, -1e-3)
        )
        self.robots: dict[str, viser.FrameHandle] = {}
        for name, poses in self.poses.items():
            colour = colour_of(name)
            # A slash would start another level of the scene's tree.
            top = f"/world/{label_of(name).replace('/', '_')}"
            self.robots[name] = scene.add_frame(top, show_axes=False)
            paths, self._handles[name] = [top], []
            for body in range(1, model.nbody):
                own = model.body(body).name.replace("/", "_") or f"body-{body}"
                paths.append(f"{paths[model.body_parentid[body]]}/{own}")
                self._handles[name].append(scene.add_frame(paths[body], show_axes=False))
            for index, part in enumerate(self.shapes.parts):
                scene.add_mesh_simple(
                    f"{paths[part.body]}/shape-{index}",
                    part.vertices,
                    part.faces,
                    color=colour,
                    opacity=part.opacity,
                    cast_shadow=False,
                    receive_shadow=False,
                )
            way = _rounded(np.column_stack([poses.tracked[:, :2], np.full(self.states, 2e-3)]))
            lines = np.stack([way[:-1], way[1:]], axis=1)
            scene.add_line_segments(f"{top}/way", lines, colour, thickness=2.0, thickness_units="screen")
        pushed = robot_meshes.pushed_robot(take)
        self._pushed = None if pushed is None else self.poses[pushed]
        self._arrow: viser.ArrowsHandle | None = None
        if pushed is not None:
            self._arrow = scene.add_arrows(
                f"/world/{label_of(pushed).replace('/', '_')}/force",
                np.zeros((1, 2, 3)),
                robot_meshes.ARROW_COLOUR,
                shaft_radius=0.0055 * self.shapes.extent,
                head_radius=0.015 * self.shapes.extent,
                head_length=0.035 * self.shapes.extent,
                visible=False,
            )
        position, target = self._camera()
        server.initial_camera.position, server.initial_camera.look_at = position, target
        server.initial_camera.fov = _FIELD_OF_VIEW
        self.show(0)

    def show(self, state: int) -> None:
        """Show all robots in a state of the rollout, given its index."""
        for name, poses in self.poses.items():
            for body, handle in enumerate(self._handles[name], start=1):
                handle.position = _rounded(poses.position[state, body])
                handle.wxyz = _rounded(poses.quaternion[state, body])
        if self._arrow is not None and self._pushed is not None:
            arrow = self.shapes.arrow(self.take, state)
            self._arrow.visible = arrow is not None
            if arrow is not None:
                start = self._pushed.pushed[state]
                self._arrow.points = _rounded(np.stack([start, start + arrow])[None])

    def centre(self, state: int) -> Float[np.ndarray, " 3"]:
        """Return the centre of all robots in a state (m, world frame)."""
        return np.mean([p.tracked[state] for p in self.poses.values()], axis=0) + [0.0, 0.0, self.shapes.above]

    def _camera(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Return position and target (m) of a camera that looks across the whole path."""
        ways = np.concatenate([poses.tracked for poses in self.poses.values()])
        low, high = ways.min(axis=0), ways.max(axis=0)
        target = np.array([*((low + high)[:2] / 2), self.centre(0)[2]])
        distance = 0.5 * float(np.linalg.norm((high - low)[:2])) + 1.4 * self.shapes.extent
        along_y = high[1] - low[1] > high[0] - low[0]
        direction = np.array([1.0, -0.2, 0.3]) if along_y else np.array([-0.2, -1.0, 0.3])
        return target + distance * direction / np.linalg.norm(direction), target


class LocalServer(viser.ViserServer):
    """Server for this machine alone: clients cannot request a public tunnel, and pages of other origins are refused."""

    def __init__(self, *, port: int) -> None:
        """Listen on `port` or the next free one, or on any free port if `port` is 0.

        **Raises** `OSError` if there is no free port.
        """
        with _own_origin_only():
            super().__init__(host=HOST, port=port, verbose=False)

    def request_share_url(self, verbose: bool = True) -> None:
        """Return None: the server is never shared."""

    def stop(self) -> None:
        """Stop without printing."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()


@contextlib.contextmanager
def _own_origin_only() -> Iterator[None]:
    """Let websocket servers opened in this context accept only pages of this machine, and clients that are no browsers.

    A web page of another origin may open a websocket to this machine, but browsers then send the page's origin (RFC
    6455, 10.2). Origins of this machine are accepted with any port, because a tunnel from another machine may change
    it. viser has no option for origins, so that this context replaces the function of websockets that viser calls.
    """

    def serve_own(handler: Any, host: str, port: int, **options: Any) -> Any:
        return opened(handler, host, port, origins=[None, _OWN_PAGES], **options)

    with _PATCHING:
        opened = websockets.asyncio.server.serve
        websockets.asyncio.server.serve = serve_own  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = opened


def serve(port: int) -> LocalServer:
    """Return a server for this machine alone, on `port` or the next free one, or on any free port if `port` is 0.

    **Raises** `InputError` if there is no free port.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            server = LocalServer(port=port)
    except OSError as error:
        raise InputError(f"--port {port}: cannot be used ({error}); give another one.") from error
    server.scene.set_up_direction("+z")
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    return server


def page(take: StoredRollout) -> str:
    """Return a self-contained page (HTML) that plays a rollout in the browser."""
    server = serve(0)
    try:
        stage = RobotScene(server, take)
        recording = server.get_scene_serializer()
        for state in range(1, stage.states):
            recording.insert_sleep(float(take.time[state] - take.time[state - 1]))
            stage.show(state)
        recording.insert_sleep(0.5)
        return recording.as_html()
    finally:
        server.stop()


def shared(pages: Sequence[str]) -> tuple[str, list[str], str]:
    """Split pages into their common beginning, the middle part of each, and their common end."""
    shortest = min(map(len, pages))
    head = _common(pages, shortest)
    tail = _common([page[::-1] for page in pages], shortest - head)
    return pages[0][:head], [page[head : len(page) - tail] for page in pages], pages[0][len(pages[0]) - tail :]


def _common(texts: Sequence[str], longest: int) -> int:
    """Return the length of the common beginning of all texts, at most `longest`."""
    low, high = 0, longest
    while low < high:
        middle = (low + high + 1) // 2
        if all(text[:middle] == texts[0][:middle] for text in texts):
            low = middle
        else:
            high = middle - 1
    return low


def _rounded(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    return np.round(np.asarray(values, float) / _GRAIN) * _GRAIN
