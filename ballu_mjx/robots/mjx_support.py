"""Check that MJX can simulate a model in reasonable time. Problems are given in words, with their place and a fix."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import collision_driver

LARGEST_HULL = 200
"""Largest number of vertices of a collision mesh's convex hull, as MJX's documentation advises. Compiling and stepping
take minutes and gigabytes beyond it."""
LARGEST_PAIR = 32
"""The same for a mesh that may collide with a box or with another mesh."""
_MESH, _BOX = int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_BOX)
_VISUAL_ONLY = 'contype="0" conaffinity="0"'


def find_unsupported(model: mujoco.MjModel) -> tuple[str, str] | None:
    """Return the first problem of a model in MJX, and its fix. None if there is no problem."""
    for check in _CHECKS:
        found = check(model)
        if found is not None:
            return found
    return None


def _options(model: mujoco.MjModel) -> tuple[str, str] | None:
    """Check integrator, solver, passive forces, fluid and friction cones."""
    option = model.opt
    for name, value, kind, known in (
        ("integrator", option.integrator, mujoco.mjtIntegrator, mjx.IntegratorType),
        ("solver", option.solver, mujoco.mjtSolver, mjx.SolverType),
    ):
        if value not in set(known):
            usual = "implicitfast or Euler" if name == "integrator" else "Newton or CG"
            return f'it has the {name} "{_word(kind(value))}"', f'write {name}="{usual.split()[0]}" ({usual})'
    if option.noslip_iterations > 0:
        return f'it has noslip_iterations="{option.noslip_iterations}", which MJX would ignore', "remove it"
    if (passive := _passive_flags(model)) is not None:
        return passive
    fluid = option.density > 0 or option.viscosity > 0 or np.any(option.wind)
    if fluid and option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        problem = 'it has a fluid (density, viscosity or wind) together with integrator="implicitfast"'
        return problem, 'write integrator="Euler", or remove the fluid and identify it with `train fluid`'
    if fluid and (shaped := np.flatnonzero(model.geom_fluid[:, 0])).size:
        problem = f'{_geom(model, int(shaped[0]))} has fluidshape="ellipsoid", which MJX would leave out'
        return problem, "remove it (the fluid then acts on the body's inertia box), or remove the fluid"
    if option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and np.any(model.geom_condim[_colliding(model)] == 1):
        return 'it has elliptic cones together with condim="1"', 'write cone="pyramidal", or condim="3"'
    return None


def _passive_flags(model: mujoco.MjModel) -> tuple[str, str] | None:
    """Check the flags that disable springs and damping.

    MJX leaves out all passive forces if one of the flags is set, MuJoCo only if both are. In its Euler integrator, MJX
    damps joints although damping is disabled, unless `eulerdamp` is disabled too.
    """
    bits, disabled = mujoco.mjtDisableBit, model.opt.disableflags
    spring, damper = bool(disabled & bits.mjDSBL_SPRING), bool(disabled & bits.mjDSBL_DAMPER)
    if spring != damper:
        flag, number = ("spring", "stiffness") if spring else ("damper", "damping")
        problem = f'it disables "{flag}" alone, for which MJX would leave out all passive forces'
        return problem, f"remove the flag, and the {number} of joints and tendons"
    euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER and not disabled & bits.mjDSBL_EULERDAMP
    if damper and euler and np.any(model.dof_damping):
        problem = 'it disables "damper" together with integrator="Euler", in which MJX would damp joints nevertheless'
        return problem, 'add eulerdamp="disable" to its flags'
    return None


def _parts(model: mujoco.MjModel) -> tuple[str, str] | None:
    """Check deformable parts, plugins, equalities, sensors and actuators."""
    if model.nflex:
        return "it has deformable parts (flex)", "replace them by rigid bodies"
    if model.nplugin:
        return f"it has the plugin {_name(model, mujoco.mjtObj.mjOBJ_PLUGIN, 0)}, which MJX would ignore", "remove it"
    own, actuator = mujoco.mjtObj, mujoco.mjtObj.mjOBJ_ACTUATOR
    for what, kinds, known, kind, named, fix in (
        ("an equality", model.eq_type, mjx.EqType, mujoco.mjtEq, own.mjOBJ_EQUALITY, "use connect, weld or joint"),
        ("a sensor", model.sensor_type, mjx.SensorType, mujoco.mjtSensor, own.mjOBJ_SENSOR, "leave it out"),
        ("an actuator on", model.actuator_trntype, mjx.TrnType, mujoco.mjtTrn, actuator, "put it on a joint or site"),
        ("the gain", model.actuator_gaintype, mjx.GainType, mujoco.mjtGain, actuator, "use fixed or affine gains"),
        ("the bias", model.actuator_biastype, mjx.BiasType, mujoco.mjtBias, actuator, "use no or affine bias"),
    ):
        for number, value in enumerate(kinds):
            if value not in set(known):
                return f'it has {what} "{_word(kind(value))}" ({_name(model, named, number)})', fix
    contact = model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT
    if contact.any() and np.isin(
        np.concatenate([model.sensor_objtype[contact], model.sensor_reftype[contact]]),
        [int(own.mjOBJ_SITE), int(own.mjOBJ_BODY), int(own.mjOBJ_XBODY)],
    ).any():  # fmt: skip
        return "it has a contact sensor of sites or bodies", "name geoms there, or remove the sensor"
    return None


def _ignored(model: mujoco.MjModel) -> tuple[str, str] | None:
    """Check for numbers that MJX leaves out without a message, although they change the motion."""
    joint, tendon, actuator = mujoco.mjtObj.mjOBJ_JOINT, mujoco.mjtObj.mjOBJ_TENDON, mujoco.mjtObj.mjOBJ_ACTUATOR
    one = 'give "{}" a single number'
    for field, what, kind, fix in (
        ("jnt_stiffnesspoly", "a nonlinear stiffness", joint, one.format("stiffness")),
        ("dof_dampingpoly", "a nonlinear damping", joint, one.format("damping")),
        ("tendon_stiffnesspoly", "a nonlinear stiffness", tendon, one.format("stiffness")),
        ("tendon_dampingpoly", "a nonlinear damping", tendon, one.format("damping")),
        ("actuator_damping", "a damping", actuator, "write the damping at the joint or tendon"),
        ("actuator_dampingpoly", "a damping", actuator, "write the damping at the joint or tendon"),
        ("actuator_armature", "an armature", actuator, "write the armature at the joint or tendon"),
        ("actuator_delay", "a delay", actuator, "declare the delay of its command (docs/identify.md)"),
        ("actuator_actearly", '"actearly"', actuator, "remove it"),
    ):
        values = np.asarray(getattr(model, field))
        for number in np.flatnonzero(values.any(axis=tuple(range(1, values.ndim)))):
            element = int(model.dof_jntid[number]) if field.startswith("dof_") else int(number)
            return f"the {_word(kind)} {_name(model, kind, element)} has {what}, which MJX would leave out", fix
    for group in sorted(set(model.actuator_group.tolist())):
        if 0 <= group < 31 and model.opt.disableactuator >> group & 1:
            return f"it disables the actuator group {group}, which MJX would leave on", "remove the group's actuators"
    return None


def _collisions(model: mujoco.MjModel) -> tuple[str, str] | None:
    """Check the kinds of colliding geoms, the margins of meshes, and the size of their convex hulls."""
    largest: tuple[float, str] | None = None
    for one, other, pair in collision_driver.geom_pairs(model):
        kinds = model.geom_type[[one, other]]
        names = f"{_geom(model, one)} and {_geom(model, other)}"
        if not collision_driver.has_collision_fn(*kinds):
            shapes = " and ".join(_word(mujoco.mjtGeom(kind)) for kind in kinds)
            fix = f"exclude the pair, give one of them {_VISUAL_ONLY}, or use spheres, capsules or boxes"
            return f"{names} collide, but MJX has no collisions of {shapes}", fix
        if not np.isin(kinds, [_MESH, int(mujoco.mjtGeom.mjGEOM_HFIELD)]).any():
            continue
        margin = model.pair_margin[pair] if pair >= 0 else model.geom_margin[one] + model.geom_margin[other]
        if np.any(margin):
            return f"{names} collide with a margin, which meshes cannot have", 'write margin="0" there'
        for geom, partner in ((one, other), (other, one)):
            if model.geom_type[geom] != _MESH:
                continue
            count = _hull_vertices(model, int(model.geom_dataid[geom]))
            against = bool(np.isin(model.geom_type[partner], [_MESH, _BOX]))
            limit = LARGEST_PAIR if against else LARGEST_HULL
            if count > limit and (largest is None or count / limit > largest[0]):
                mesh = model.mesh(int(model.geom_dataid[geom])).name
                what = f"it collides with {_geom(model, partner)}, a box or mesh" if against else "it collides"
                largest = (
                    count / limit,
                    (
                        f"the hull of the mesh {mesh} ({_geom(model, geom)}) has {count:,} vertices, and {what}; more "
                        f"than {limit} are too many"
                    ),
                )
    if largest is None:
        return None
    fix = f'give the mesh maxhullvert="{LARGEST_PAIR}", or give its geoms {_VISUAL_ONLY} and add primitive geoms'
    return largest[1], fix


_CHECKS: tuple[Callable[[mujoco.MjModel], tuple[str, str] | None], ...] = (_options, _parts, _ignored, _collisions)


def check_mjx(model: mujoco.MjModel) -> tuple[str, str] | None:
    """Return the reason why MJX cannot simulate a model, and a fix. None if MJX can simulate it."""
    found = find_unsupported(model)
    if found is not None:
        return found
    try:
        mjx.put_model(model)
    except (NotImplementedError, ValueError) as error:
        return f"MJX says: {' '.join(str(error).split())[:200]}", "remove from the model the feature that MJX names"
    return None


def _colliding(model: mujoco.MjModel) -> np.ndarray:
    return (model.geom_contype | model.geom_conaffinity) != 0


def _hull_vertices(model: mujoco.MjModel, mesh: int) -> int:
    """Return the number of vertices of a mesh's convex hull."""
    graph = int(model.mesh_graphadr[mesh])
    return int(model.mesh_graph[graph] if graph >= 0 else model.mesh_vertnum[mesh])


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, element: int) -> str:
    return mujoco.mj_id2name(model, kind, element) or f"number {element + 1}"


def _geom(model: mujoco.MjModel, geom: int) -> str:
    return model.geom(geom).name or f"a geom of {model.body(int(model.geom_bodyid[geom])).name or 'the world'}"


def _word(value: object) -> str:
    """Return the MJCF keyword of a value of MuJoCo's enumerations."""
    return str(getattr(value, "name", value)).rpartition("_")[2].lower()
