"""Video (MP4) of a rollout by MuJoCo's renderer. It needs OpenGL, and the extra `video` for the encoder."""

from __future__ import annotations

import ctypes.util
import os
import sys
from pathlib import Path

import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.rollout_file import StoredRollout

WIDTH, HEIGHT = 960, 544
_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
_NO_OPENGL = (
    "No video: there is no OpenGL to draw with ({}). Install one by `apt-get install libegl1 libgl1-mesa-dri` and use "
    "MUJOCO_GL=egl, or by `apt-get install libosmesa6` and use MUJOCO_GL=osmesa."
)


def choose_renderer() -> None:
    """Choose MuJoCo's OpenGL library if there is no screen and MUJOCO_GL is not set. MuJoCo must be imported later."""
    if sys.platform != "linux" or "MUJOCO_GL" in os.environ:
        return
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    found = [name for name, library in _LIBRARIES.items() if ctypes.util.find_library(library)]
    os.environ["MUJOCO_GL"] = found[0] if found else "disable"


def write(path: Path, take: StoredRollout) -> None:
    """Write a video of a rollout at the control rate, with the camera beside the robots.

    **Raises** `InputError` if there is no OpenGL or no encoder.
    """
    try:
        import imageio_ffmpeg
    except ImportError:
        raise InputError(
            'No video: the encoder is missing; install the extra video: pip install -c constraints.txt -e ".[video]".'
        ) from None
    import mujoco

    from ballu_mjx.viz import robot_meshes

    shapes = robot_meshes.RobotShapes(take.description)
    model = robot_meshes.load_scenery(shapes.robot)
    model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
    try:
        most = (200 + 2 * model.ngeom) * (1 + len(take.qpos))
        renderer = mujoco.Renderer(model, HEIGHT, WIDTH, max_geom=most)
    except Exception as error:  # each OpenGL library raises other errors
        raise InputError(_NO_OPENGL.format(str(error).strip().split("\n")[0] or type(error).__name__)) from None
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    option, camera = mujoco.MjvOption(), mujoco.MjvCamera()
    robot_meshes.option_for_scenery(option)
    camera.azimuth, camera.elevation = 75.0, -12.0
    ways = np.stack([shapes.poses(qpos).tracked for qpos in take.qpos.values()])
    middle = ways.mean(axis=0)
    height = float(middle[:, 2].mean()) + shapes.above
    apart = np.linalg.norm(ways - middle, axis=-1).max(axis=0)
    rate = 1.0 / float(np.median(np.diff(take.time)))
    frames = imageio_ffmpeg.write_frames(
        str(path),
        (WIDTH, HEIGHT),
        fps=rate,  # pyright: ignore[reportArgumentType]  # it takes fractions, too
        codec="libx264",
        quality=7,
        macro_block_size=16,
    )
    try:
        frames.send(None)
        for state in range(len(take.time)):
            camera.lookat[:] = (*middle[state, :2], height)
            camera.distance = 1.65 * shapes.extent + 1.2 * apart[state]
            renderer.update_scene(data, camera, option)
            robots = {name: qpos[state] for name, qpos in take.qpos.items()}
            arrow = shapes.arrow(take, state)
            robot_meshes.draw(renderer.scene, shapes.model, data, shapes.robot, robots, arrow)
            # Without a GPU, shadows and reflections would take two thirds of the time.
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
            frames.send(renderer.render())
    finally:
        frames.close()
        renderer.close()
