"""The robot as something to look at: see-through copies over each other, in MuJoCo's scenes and as meshes.

Shapes are the geoms of the model, poses those of C MuJoCo's kinematics; nothing is simulated here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, Int

from ballu_mjx.runs.rollout_file import StoredRollout
from ballu_mjx.viz.style import colour_of

OPACITY, BALLOON_OPACITY = 0.8, 0.12
"""Of frame and legs, and of balloons."""
ARROW_LENGTH = 8.0
"""Length (m) of the arrow of a force of 1 N."""
ARROW_COLOUR = (0.8, 0.0, 0.0)
SMALLEST_FORCE = 1e-3
"""N: no arrow below."""
_ROBOT_GROUP = 1
"""The robot's geoms; the floor is of group 0."""


class Part(NamedTuple):
    """Geoms of a body that look alike, as one triangle mesh in the body's frame (m)."""

    body: int
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    opacity: float


class Poses(NamedTuple):
    """Each body over time in its parent's frame, and the balloon in the world."""

    position: Float[np.ndarray, "states bodies 3"]
    """m."""
    quaternion: Float[np.ndarray, "states bodies 4"]
    """w, x, y, z."""
    balloon: Float[np.ndarray, "states 3"]
    """The site `balloon` (m), the balloon's centre of mass, at which the residual force acts."""
    yaw: Float[np.ndarray, " states"]
    """Of the balloon (rad), not unwrapped."""


def parts(model: mujoco.MjModel) -> list[Part]:
    """The robot's geoms, without the floor."""
    found: dict[tuple[int, float], list[trimesh.Trimesh]] = {}
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if body == 0:
            continue
        pose = np.eye(4)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
        mesh = _mesh(int(model.geom_type[geom]), model.geom_size[geom])
        mesh.apply_transform(pose)
        found.setdefault((body, _opacity(model, geom)), []).append(mesh)
    result = []
    for (body, opacity), meshes in found.items():
        starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
        vertices = np.concatenate([np.asarray(mesh.vertices, float) for mesh in meshes])
        faces = np.concatenate([np.asarray(m.faces, int) + n for m, n in zip(meshes, starts[:-1], strict=True)])
        result.append(Part(body, vertices, faces, opacity))
    return result


def poses(model: mujoco.MjModel, qpos: Float[np.ndarray, "states nq"]) -> Poses:
    """Where a robot's bodies are."""
    data = mujoco.MjData(model)
    site, balloon = model.site("balloon").id, model.body("balloon").id
    states = len(qpos)
    position, quaternion = np.zeros((states, model.nbody, 3)), np.zeros((states, model.nbody, 4))
    place, yaw = np.zeros((states, 3)), np.zeros(states)
    inverse, offset = np.zeros(4), np.zeros(3)
    for state, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for body in range(model.nbody):
            parent = model.body_parentid[body]
            mujoco.mju_negQuat(inverse, data.xquat[parent])
            mujoco.mju_rotVecQuat(offset, data.xpos[body] - data.xpos[parent], inverse)
            position[state, body] = offset
            mujoco.mju_mulQuat(quaternion[state, body], inverse, data.xquat[body])
        place[state] = data.site_xpos[site]
        forward = data.xmat[balloon].reshape(3, 3)[:, 0]
        yaw[state] = np.arctan2(forward[1], forward[0])
    return Poses(position, quaternion, place, yaw)


def draw(
    scene: mujoco.MjvScene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    robots: Mapping[str, Float[np.ndarray, " nq"]],
    force: Float[np.ndarray, " 3"] | None,
) -> None:
    """Add robots to a MuJoCo scene, each in its colour, and the arrow of a force (N, world) on the last one's balloon.

    `data` is left at the last one's state.
    """
    option, perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()
    option.sitegroup[:] = 0
    for name, qpos in robots.items():
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        first = scene.ngeom
        mujoco.mjv_addGeoms(model, data, option, perturbation, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)
        for geom in scene.geoms[first : scene.ngeom]:
            opacity = BALLOON_OPACITY if geom.rgba[3] < 1 else OPACITY
            geom.matid = -1
            geom.rgba[:] = (*colour_of(name), opacity)
    if force is not None and np.linalg.norm(force) > SMALLEST_FORCE and scene.ngeom < scene.maxgeom:
        start = data.site("balloon").xpos
        arrow = scene.geoms[scene.ngeom]
        rgba = np.array([*ARROW_COLOUR, 1.0], np.float32)
        mujoco.mjv_initGeom(arrow, mujoco.mjtGeom.mjGEOM_ARROW, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
        mujoco.mjv_connector(arrow, mujoco.mjtGeom.mjGEOM_ARROW, 0.015, start, start + ARROW_LENGTH * force)
        scene.ngeom += 1


def hide_robot(option: mujoco.MjvOption) -> None:
    """Let a view show the floor without the model's own robot, which `draw` then puts there in its place."""
    option.geomgroup[_ROBOT_GROUP] = 0
    option.sitegroup[:] = 0
    option.flags[mujoco.mjtVisFlag.mjVIS_TENDON] = 0


def force_at(take: StoredRollout, state: int) -> Float[np.ndarray, " 3"] | None:
    """The residual force (N, world) that acts from a state on; in the last state, the one that led there."""
    return None if take.force is None else take.force[min(state, len(take.force) - 1)]


def pushed(take: StoredRollout) -> str | None:
    """The robot of a take on which the residual force acts."""
    if take.force is None:
        return None
    return next((name for name in take.qpos if name != "recording" and not name.startswith("vanilla")), None)


def _mesh(kind: int, size: Float[np.ndarray, " 3"]) -> trimesh.Trimesh:
    types = mujoco.mjtGeom
    match kind:
        case types.mjGEOM_BOX:
            return trimesh.creation.box(extents=2 * size)
        case types.mjGEOM_CAPSULE:
            return trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=[8, 8])
        case types.mjGEOM_CYLINDER:
            return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=16)
        case types.mjGEOM_SPHERE:
            return trimesh.creation.icosphere(subdivisions=1, radius=size[0])
        case types.mjGEOM_ELLIPSOID:
            ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
            ball.apply_scale(size)
            return ball
        case _:
            raise ValueError(f"Geoms of type {types(kind).name} cannot be drawn.")


def _opacity(model: mujoco.MjModel, geom: int) -> float:
    material = model.geom_matid[geom]
    alpha = model.mat_rgba[material, 3] if material >= 0 else model.geom_rgba[geom, 3]
    return BALLOON_OPACITY if alpha < 1 else OPACITY
