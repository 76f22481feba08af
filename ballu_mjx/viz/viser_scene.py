"""Robots of a rollout in a viser scene: live, or recorded into a page that plays without a server.

Needs the extra `report`.
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
"""Servers listen here alone: nothing is served to other machines."""
_GRAIN = 2.0**-14
"""Positions (m) and quaternions are rounded to multiples of this, so that recordings pack well."""
_OWN_PAGES = re.compile(r"http://(127\.0\.0\.1|localhost)(:[0-9]+)?")
_PATCHING = threading.Lock()
_FIELD_OF_VIEW = np.deg2rad(40.0)


class RobotScene:
    """The robots of one rollout, their ways over the floor, and the residual force."""

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
        """Put all robots into a state of the rollout."""
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
        """Return the middle (m, world) of all robots."""
        return np.mean([p.tracked[state] for p in self.poses.values()], axis=0) + [0.0, 0.0, self.shapes.above]

    def _camera(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Place of a camera that sees the whole way, across it, and what it looks at."""
        ways = np.concatenate([poses.tracked for poses in self.poses.values()])
        low, high = ways.min(axis=0), ways.max(axis=0)
        target = np.array([*((low + high)[:2] / 2), self.centre(0)[2]])
        distance = 0.5 * float(np.linalg.norm((high - low)[:2])) + 1.4 * self.shapes.extent
        along_y = high[1] - low[1] > high[0] - low[0]
        direction = np.array([1.0, -0.2, 0.3]) if along_y else np.array([-0.2, -1.0, 0.3])
        return target + distance * direction / np.linalg.norm(direction), target


class LocalServer(viser.ViserServer):
    """A server that no client can ask for a tunnel to the outside, and that pages of other origins cannot talk to."""

    def __init__(self, *, port: int) -> None:
        """Listen at `port` or the next that is free; at any free one for 0.

        **Raises** `OSError` where there is none.
        """
        with _own_origin_only():
            super().__init__(host=HOST, port=port, verbose=False)

    def request_share_url(self, verbose: bool = True) -> None:
        """None: nothing is shared."""

    def stop(self) -> None:
        """Stop without a word."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()


@contextlib.contextmanager
def _own_origin_only() -> Iterator[None]:
    """Let websockets that are opened meanwhile accept this machine's own pages alone, and clients that are no browser.

    Any port will do: a tunnel to another machine may change it.

    A web page elsewhere may open a websocket to this machine; browsers then say which page it was (RFC 6455, 10.2).
    viser has no option for it, and calls this function of websockets'.
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
    """A server for this machine alone, on `port` or the next that is free; on any free one for 0.

    **Raises** `InputError` where there is none.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            server = LocalServer(port=port)
    except OSError as error:
        raise InputError(f"--port {port}: cannot be listened on ({error}); give another one.") from error
    server.scene.set_up_direction("+z")
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    return server


def page(take: StoredRollout) -> str:
    """Return a page (HTML) that plays a rollout in the browser by itself, from its own text alone."""
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
    """Pages as what they all begin with, what is each one's own, and what they all end with."""
    shortest = min(map(len, pages))
    head = _common(pages, shortest)
    tail = _common([page[::-1] for page in pages], shortest - head)
    return pages[0][:head], [page[head : len(page) - tail] for page in pages], pages[0][len(pages[0]) - tail :]


def _common(texts: Sequence[str], longest: int) -> int:
    """Length of what all texts begin with, `longest` at most."""
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
