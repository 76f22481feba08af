"""Mirror image of a network's input and output, for robots that are symmetric about the xz plane."""

from __future__ import annotations

from collections.abc import Sequence

from ballu_mjx.common.errors import InputError
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.rl.mirror import Mirror, SignedPermutation, join_permutations
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.observation import HISTORY

_VECTOR, _ROTATION = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)
"""Signs of the mirrored components of a position, velocity or force, and of a rotation or torque."""


def network_mirror(config: ForceNetworkConfig, robot: RobotDescription) -> Mirror | None:
    """Return the mirror images of a network's input and output, or None without `config.mirror`.

    **Raises** `InputError` for a robot whose description declares no mirror image, and for forces along joints, because
    the sign of a mirrored joint depends on its axis.
    """
    if not config.mirror:
        return None
    if config.forces == "joints":
        raise InputError("--mirror: the signs of mirrored joints are unknown; leave it out, or give other --forces.")
    if robot.mirror is None:
        raise InputError(f'--mirror: {robot.name} has no mirror image; add "mirror" to {robot.file}, or leave it out.')
    bodies = (robot.tracked, *robot.points)
    commands = _swap(tuple(robot.commands), robot)
    frame = join_permutations([_swap(bodies, robot, (*_VECTOR, *_VECTOR)), _swap(("angles",), robot, _ROTATION)])
    seen = [frame] * HISTORY + [commands] * HISTORY * config.observe_command
    loads = {
        "force": _swap(bodies[:1], robot, _VECTOR),
        "wrench": _swap(bodies[:1], robot, (*_VECTOR, *_ROTATION)),
        "multi": _swap(bodies, robot, _VECTOR),
        "commands": commands,
    }[config.forces]
    return Mirror(join_permutations(seen), loads)


def _swap(names: Sequence[str], robot: RobotDescription, signs: Sequence[float] = (1.0,)) -> SignedPermutation:
    """Return the mirror image of an array with entries of signs `signs` for each of `names`."""
    swapped = [names.index((robot.mirror or {}).get(name, name)) for name in names]
    order = [len(signs) * place + entry for place in swapped for entry in range(len(signs))]
    return SignedPermutation(tuple(order), tuple(signs) * len(names))
