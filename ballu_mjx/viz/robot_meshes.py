"""Drawing of robots: translucent copies of a robot over each other, in MuJoCo's scenes and as meshes.

Shapes are the model's geoms, and poses are from C MuJoCo's kinematics. This module does not simulate.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, Int

from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.runs.rollout_file import StoredRollout
from ballu_mjx.viz.style import colour_of

OPACITY, TRANSLUCENT_OPACITY = 0.8, 0.12
"""Opacity of geoms that are opaque in the model, and of translucent ones (alpha below 1), such as big hulls."""
ARROW_COLOUR = (0.8, 0.0, 0.0)
_SMALLEST_SHARE = 3.5e-4
"""Force below which no arrow is drawn, as a fraction of the robot's weight."""
_WEIGHT_SHARE = 0.065
"""Force whose arrow is as long as the robot, as a fraction of the robot's weight."""
_SKY = (0.93, 0.94, 0.96)
_GRAVITY = 9.81
_SHOWN_GROUPS = 3
"""Number of geom groups that are drawn, from group 0, as in MuJoCo's viewer. Others often have collision shapes."""
_HIDDEN_GROUP = mujoco.mjNGROUP - 1
_MOST_FACES = 5_000
"""Largest number of faces of a mesh. A larger mesh is drawn as its convex hull, because a page has a copy for each
robot."""


class Part(NamedTuple):
    """Geoms of a body with the same opacity, as one triangle mesh in the body frame (m)."""

    body: int
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    opacity: float


class Poses(NamedTuple):
    """Poses of all bodies over time in the frames of their parents, and of the tracked body in the world frame."""

    position: Float[np.ndarray, "states bodies 3"]
    """Positions of the bodies (m, parent's frame)."""
    quaternion: Float[np.ndarray, "states bodies 4"]
    """Orientations of the bodies (w, x, y, z; parent's frame)."""
    tracked: Float[np.ndarray, "states 3"]
    """Position of the tracked site (m, world frame)."""
    pushed: Float[np.ndarray, "states 3"]
    """Centre of mass of the tracked body, at which the residual force acts (m, world frame)."""
    yaw: Float[np.ndarray, " states"]
    """Yaw of the tracked body (rad, world frame), not unwrapped."""


class RobotShapes:
    """Shapes and size of a robot.

    **Fields**

    - `robot`, `model`: description and nominal model of the robot.
    - `parts`: meshes of its bodies; see `parts`.
    - `extent`: longest side (m) of its bounding box in the initial pose.
    - `above`: height (m) of the centre of this box above the tracked site. It is negative if the centre is lower.
    - `arrow_scale`: length of an arrow for a force of 1 N (m/N).
    """

    def __init__(self, robot: RobotDescription) -> None:
        self.robot, self.model = robot, robot.load_model()
        self.parts = parts(self.model)
        data = mujoco.MjData(self.model)
        data.qpos[:] = robot.adapter.initial_qpos(robot, self.model)
        mujoco.mj_kinematics(self.model, data)
        corners = [data.xpos[p.body] + p.vertices @ data.xmat[p.body].reshape(3, 3).T for p in self.parts]
        # The size of a robot without shapes is the extent of its bodies' positions.
        points = np.concatenate(corners) if corners else data.xpos[1:]
        low, high = points.min(axis=0), points.max(axis=0)
        site = self.model.site(robot.tracked).id
        self.extent = max(float((high - low).max()), 1e-2)
        self.above = float(low[2] + high[2]) / 2 - float(data.site_xpos[site, 2])
        root = self.model.body_rootid[self.model.site_bodyid[site]]
        self._weight = float(self.model.body_subtreemass[root]) * _GRAVITY
        # One digit, because the report shows this number.
        self.arrow_scale = float(f"{self.extent / (_WEIGHT_SHARE * self._weight):.1g}")

    def poses(self, qpos: Float[np.ndarray, "states nq"]) -> Poses:
        """Return the poses of this robot's bodies for generalized positions; see `poses`."""
        return poses(self.model, self.robot, qpos)

    def arrow(self, rollout: StoredRollout, state: int) -> Float[np.ndarray, " 3"] | None:
        """Return the arrow (m, world frame) of the residual force in a state.

        None if there is no force, or if it is less than a small fraction of the robot's weight.
        """
        force = force_at(rollout, state)
        if force is None or np.linalg.norm(force) <= _SMALLEST_SHARE * self._weight:
            return None
        return self.arrow_scale * force


def parts(model: mujoco.MjModel) -> list[Part]:
    """Return the meshes of all moving bodies. Geoms that are fixed to the world are left out."""
    found: dict[tuple[int, float], list[trimesh.Trimesh]] = {}
    for geom in _shown_geoms(model):
        mesh = _mesh(model, geom)
        if mesh is None:
            continue
        pose = np.eye(4)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
        mesh.apply_transform(pose)
        found.setdefault((int(model.geom_bodyid[geom]), _opacity(model, geom)), []).append(mesh)
    result = []
    for (body, opacity), meshes in found.items():
        starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
        vertices = np.concatenate([np.asarray(mesh.vertices, float) for mesh in meshes])
        faces = np.concatenate([np.asarray(m.faces, int) + n for m, n in zip(meshes, starts[:-1], strict=True)])
        result.append(Part(body, vertices, faces, opacity))
    return result


def poses(model: mujoco.MjModel, robot: RobotDescription, qpos: Float[np.ndarray, "states nq"]) -> Poses:
    """Return the poses of a robot's bodies for generalized positions."""
    data = mujoco.MjData(model)
    site = model.site(robot.tracked).id
    tracked = int(model.site_bodyid[site])
    states = len(qpos)
    position, quaternion = np.zeros((states, model.nbody, 3)), np.zeros((states, model.nbody, 4))
    place, pushed, yaw = np.zeros((states, 3)), np.zeros((states, 3)), np.zeros(states)
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
        place[state], pushed[state] = data.site_xpos[site], data.xipos[tracked]
        forward = data.xmat[tracked].reshape(3, 3)[:, 0]
        yaw[state] = np.arctan2(forward[1], forward[0])
    return Poses(position, quaternion, place, pushed, yaw)


def draw(
    scene: mujoco.MjvScene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    robot: RobotDescription,
    states: Mapping[str, Float[np.ndarray, " nq"]],
    arrow: Float[np.ndarray, " 3"] | None,
) -> None:
    """Add robots to a MuJoCo scene, each in its colour, and an arrow at the tracked body of the last robot.

    `states` holds the generalized positions by the name of a robot, `arrow` is in m in the world frame. Afterwards,
    `data` has the state of the last robot.
    """
    option, perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()
    option.sitegroup[:] = 0
    for name, qpos in states.items():
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        first = scene.ngeom
        mujoco.mjv_addGeoms(model, data, option, perturbation, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)
        for geom in scene.geoms[first : scene.ngeom]:
            opacity = TRANSLUCENT_OPACITY if geom.rgba[3] < 1 else OPACITY
            geom.matid = -1
            geom.rgba[:] = (*colour_of(name), opacity)
    if arrow is not None and scene.ngeom < scene.maxgeom:
        start = data.xipos[model.site_bodyid[model.site(robot.tracked).id]]
        geom = scene.geoms[scene.ngeom]
        rgba = np.array([*ARROW_COLOUR, 1.0], np.float32)
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_ARROW, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
        width = 0.01 * float(model.stat.extent)
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, width, start, start + arrow)
        scene.ngeom += 1


def load_scenery(robot: RobotDescription) -> mujoco.MjModel:
    """Return the robot's model with light and sky. With `option_for_scenery`, a view shows the world without robot."""
    spec = mujoco.MjSpec.from_file(str(robot.model))
    if all(texture.type != mujoco.mjtTexture.mjTEXTURE_SKYBOX for texture in spec.textures):
        spec.add_texture(
            name="_sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
            rgb1=_SKY,
            rgb2=_SKY,
            width=64,
            height=64,
        )
    model = spec.compile()
    if not model.nlight:
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.5, 0.5
    model.geom_group[_moving(model)] = _HIDDEN_GROUP
    return model


def option_for_scenery(option: mujoco.MjvOption) -> None:
    """Set the options of a view of `load_scenery`, so that it does not show the robot."""
    option.geomgroup[_HIDDEN_GROUP] = 0
    option.sitegroup[:] = 0
    option.flags[mujoco.mjtVisFlag.mjVIS_TENDON] = 0


def force_at(rollout: StoredRollout, state: int) -> Float[np.ndarray, " 3"] | None:
    """Return the residual force (N, world frame) in the control step after a state.

    For the last state, it is the force in the control step before it. None if the rollout has no force.
    """
    return None if rollout.force is None else rollout.force[min(state, len(rollout.force) - 1)]


def pushed_robot(rollout: StoredRollout) -> str | None:
    """Return the name of the robot in a rollout on which the residual force acts. None if the rollout has no force."""
    return None if rollout.force is None else list(rollout.qpos)[-1]


def _moving(model: mujoco.MjModel) -> np.ndarray:
    """Return a mask of the geoms whose bodies move."""
    return model.body_weldid[model.geom_bodyid] != 0


def _shown_geoms(model: mujoco.MjModel) -> list[int]:
    moving = _moving(model) & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
    moving &= np.array([_alpha(model, geom) > 0 for geom in range(model.ngeom)], bool)
    visible = moving & (model.geom_group < _SHOWN_GROUPS)
    return np.flatnonzero(visible if visible.any() else moving).tolist()


def _mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """Return a geom's surface in the geom's frame. None for types that are not drawn, such as height fields."""
    kind, size, types = int(model.geom_type[geom]), model.geom_size[geom], mujoco.mjtGeom
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
        case types.mjGEOM_MESH | types.mjGEOM_SDF:
            number = model.geom_dataid[geom]
            vertices, faces = model.mesh_vertadr[number], model.mesh_faceadr[number]
            mesh = trimesh.Trimesh(
                model.mesh_vert[vertices : vertices + model.mesh_vertnum[number]].astype(float),
                model.mesh_face[faces : faces + model.mesh_facenum[number]],
                process=False,
            )
            return mesh if len(mesh.faces) <= _MOST_FACES else mesh.convex_hull
        case _:
            return None


def _opacity(model: mujoco.MjModel, geom: int) -> float:
    return TRANSLUCENT_OPACITY if _alpha(model, geom) < 1 else OPACITY


def _alpha(model: mujoco.MjModel, geom: int) -> float:
    material = model.geom_matid[geom]
    return float(model.mat_rgba[material, 3] if material >= 0 else model.geom_rgba[geom, 3])
