"""Options of a network that gives residual forces: what it sees, and what its output means."""

from __future__ import annotations

import dataclasses

from ballu_mjx.sim.force_sets import ForceSet


@dataclasses.dataclass(frozen=True)
class ForceNetworkConfig:
    """What a force network sees, and what its output means."""

    forces: ForceSet = "force"
    """What the policy acts with: a force on the tracked body (the paper's), a force and a torque there (wrench), forces
    there and at all measured points (multi), forces and torques along joints (joints), or changes of the commands
    (commands)."""
    force_limit: float | None = None
    """Largest force along each axis, N (paper: 1). Other loads may be as many units. Without this option: the robot's
    own, or 20 units."""
    force_scale: float | None = None
    """Force, N, that one unit of the policy's output stands for. Without this option: the robot's own, or the size of
    what the model leaves unexplained in the training recordings. Joints and commands have `scales`: for limit and cost
    one of their units counts as this force."""
    torque_scale: float | None = None
    """Torque, N m, that one unit of the policy's output stands for, where it pushes with one. Without this option:
    likewise. Limit and cost are, unit for unit, those of a force."""
    scales: tuple[float, ...] = ()
    """What one unit of each output stands for, with `--forces joints` (N m, of slides N) and `commands` (their units),
    in their order. Without this option: from the training recordings."""
    observe_command: bool = True
    """Let the policy see the commands (now and the last two), which the paper's state leaves out."""
    relative_observation: bool = True
    """Horizontal positions that the policy sees are from the tracked body, so that forces do not depend on the place in
    the room. The paper's are the room's. Those of an anchored robot always are."""
    heading_frame: bool = True
    """Directions that the policy sees, yaw and forces are in the tracked body's heading frame. The paper's are the
    world's. Those of an anchored robot always are."""
