"""A body for virtual robots that the training simulator cannot have: soft neck, wobbling balloons, other cables.

The parts are added to `assets/ballu.xml` before it is compiled.
"""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.model import SIDES
from ballu_mjx.ballu.virtual.air import add_air

_BALLOON_SHARE = 0.75
"""Share of the balloon cluster's mass that is in the balloons. The rest is in their frame. An assumption."""


@dataclasses.dataclass(frozen=True)
class FlexibleBody:
    """Masses, lengths, neck, balloons and cables of one robot. Pairs are (left, right). Units are SI units."""

    mass_ratio: tuple[float, ...]
    """Ratio of the mass and inertia of each body to the nominal one, in the order of the bodies of the model."""
    thigh_ratio: tuple[float, ...]
    """Ratio of the distance from hip to knee to the nominal one."""
    shank_ratio: tuple[float, ...]
    """Ratio of the distance from knee to foot to the nominal one."""
    neck_stiffness: tuple[float, float]
    """Stiffness of the neck (N m/rad) about the roll axis and about the yaw axis. The nominal neck has neither axis."""
    neck_damping: float
    """Damping of the neck (N m s/rad) about both axes."""
    balloon_frequency: float
    """Natural frequency (Hz) of each balloon on a fixed frame, along each axis."""
    balloon_damping: float
    """Damping ratio of this oscillation."""
    cable_stiffness: tuple[float, float]
    """Stiffness of the cables (N/m) where they begin to pull."""
    cable_toe: tuple[float, float]
    """Stretch (m) from which the cables are stiffer."""
    cable_hardening: tuple[float, float]
    """Stiffness (N/m) that is added from this stretch on."""


def make_flexible(
    spec: mujoco.MjSpec,
    flexible: FlexibleBody,
    offset: tuple[float, float, float],
    lift: float,
    added_mass: float,
) -> None:
    """Give the model of the nominal robot a flexible body, in place. `harden_cables` completes it once it is compiled.

    **Arguments**

    - `offset`: offset of all balloons from their nominal places (m, balloon frame).
    - `lift`: lift of all balloons (N).
    - `added_mass`: added mass of all balloons (kg), whose weight the lift carries in addition.
    """
    for body, ratio in zip(spec.bodies[1:], flexible.mass_ratio, strict=True):
        body.mass *= ratio
        body.inertia *= ratio
    for index, side in enumerate(SIDES):
        _scale_leg(spec, side, flexible.thigh_ratio[index], flexible.shank_ratio[index])
        cable = spec.tendon(f"cable_{side}")
        cable.stiffness[0] = flexible.cable_stiffness[index]
        second = spec.add_tendon(name=f"stiff_cable_{side}")
        second.stiffness[0] = flexible.cable_hardening[index]
        for part in ("femur", "arm"):
            second.wrap_site(f"cable_{part}_{side}")
    balloon = spec.body("balloon")
    for (name, axis), stiffness in zip((("roll", (1, 0, 0)), ("yaw", (0, 0, 1))), flexible.neck_stiffness, strict=True):
        joint = balloon.add_joint(name=f"neck_{name}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        joint.stiffness[0], joint.damping[0] = stiffness, flexible.neck_damping
    _split_balloons(spec, flexible, offset, lift, added_mass)


def _scale_leg(spec: mujoco.MjSpec, side: str, thigh: float, shank: float) -> None:
    """Scale the lengths of a leg. Knee, cable and motor keep their places relative to each other."""
    femur, tibia = spec.body(f"femur_{side}"), spec.body(f"tibia_{side}")
    spec.site(f"cable_femur_{side}").pos[2] += (thigh - 1) * tibia.pos[2]
    tibia.pos[2] *= thigh
    femur.ipos[2] *= thigh
    tibia.ipos[2] *= shank
    spec.geom(f"foot_{side}").pos[2] *= shank
    spec.site(f"foot_{side}").pos[2] *= shank


def harden_cables(model: mujoco.MjModel, flexible: FlexibleBody) -> None:
    """Let the second strand of each cable pull from a longer rest length than the first, in place."""
    for index, side in enumerate(SIDES):
        first, second = (model.tendon(f"{name}_{side}").id for name in ("cable", "stiff_cable"))
        model.tendon_lengthspring[second] = 0.0, model.tendon_lengthspring[first, 1] + flexible.cable_toe[index]


def _split_balloons(
    spec: mujoco.MjSpec,
    flexible: FlexibleBody,
    offset: tuple[float, float, float],
    lift: float,
    added_mass: float,
) -> None:
    """Replace the rigid balloon cluster by a frame and balloons on springs, each with air of its own, in place.

    When the robot is upright and at rest, the balloons stand at the places of the nominal model's ellipsoids. They are
    moved by less than a millimetre, so that their mean is the cluster's centre of mass. Together with their frame, they
    have the mass and the inertia of the rigid cluster. The arguments are those of `make_flexible`.
    """
    frame = spec.body("balloon")
    shapes = [geom for geom in frame.geoms if geom.type == mujoco.mjtGeom.mjGEOM_ELLIPSOID]
    places = np.array([shape.pos for shape in shapes])
    places += frame.ipos - places.mean(axis=0)
    mass = _BALLOON_SHARE * frame.mass / len(shapes)
    moving = mass + added_mass / len(shapes)
    gravity = float(np.linalg.norm(spec.option.gravity))
    rate = 2 * np.pi * flexible.balloon_frequency
    stiffness = moving * rate**2
    at_rest = (0.0, 0.0, -(lift / len(shapes) - mass * gravity) / stiffness)
    taken = np.zeros(3)
    for index, (shape, place) in enumerate(zip(shapes, places, strict=True)):
        inertia = np.full(3, 2 / 3 * mass * np.mean(shape.size) ** 2)  # of a thin shell
        taken += inertia + mass * _point_inertia(place - frame.ipos)
        body = frame.add_body(name=f"balloon_{index}", pos=place + offset)
        body.explicitinertial = True
        body.mass, body.inertia, body.ipos = mass, inertia, np.zeros(3)
        add_air(spec, body, f"air_{index}", lift / len(shapes), added_mass / len(shapes), shape.size)
        for axis, direction in enumerate(np.eye(3)):
            joint = body.add_joint(
                name=f"balloon_{index}_{'xyz'[axis]}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction
            )
            joint.stiffness[0], joint.springref = stiffness, at_rest[axis]
            joint.damping[0] = 2 * flexible.balloon_damping * moving * rate
    frame.mass -= mass * len(shapes)
    frame.inertia -= taken
    frame.gravcomp = 0.0


def _point_inertia(place: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Return the moments of inertia of a mass of 1 at a place, about the axes through the origin."""
    return float(place @ place) - place**2
