"""Errors of simulators over horizons, and the score by which checkpoints are chosen."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from ballu_mjx.common.rotations import quaternion_conjugate, quaternion_product

HORIZONS = (1.0, 2.0, 5.0, 10.0, 20.0)
"""Default horizons (s) of errors. A robot may declare others, and short recordings have `_SHORT_HORIZONS`."""
_SHORT_HORIZONS = (0.1, 0.2, 0.5)
"""Horizons (s) for recordings that last no longer than the first of `HORIZONS`."""
SCORE_HORIZONS = (5.0, 10.0)
"""Horizons (s) in the validation score. If recordings are too short for both, the score uses their longest horizon."""
Angle = Literal["yaw", "orientation"]
"""Angle of the orientation errors: yaw for upright robots, or the angle of the whole rotation."""
_LEAST = 1e-5
"""Smallest error (m or deg) in ratios. Smaller errors are within single precision."""
LARGEST = 1e6
"""Error (m or deg) from which a simulation counts as diverged."""
WHOLE = ("mean_com_error", "final_orientation_error", "mean_force")
"""Quantities with one value for a whole recording."""


@dataclasses.dataclass(frozen=True)
class Errors:
    """Errors of one simulator on one recording.

    Means and spreads (standard deviations) are over the starts that did not diverge. If all starts diverged, the mean
    is infinite. Medians are over all starts, so that a median is infinite if half of them diverged.
    """

    recording: str
    group: str
    """Group of the recording; see `recording_groups.group_of`."""
    position: dict[float, tuple[float, float]]
    """Mean and spread of the RMSE of the tracked body's position (m), by horizon (s)."""
    orientation: dict[float, tuple[float, float]]
    """Mean and spread of the RMSE of the tracked body's orientation (deg), by horizon (s). For an upright robot, it is
    the RMSE of yaw, with each difference wrapped to 180 deg. For other robots, it is the RMSE of the angle of the
    rotation between simulated and recorded orientation."""
    mean_com_error: float
    """Mean distance (m) between the simulated and recorded centres of mass over the whole recording (paper, Table I,
    open loop)."""
    final_orientation_error: float
    """Orientation error (deg) at the end of the recording. For an upright robot, it is simulated minus recorded yaw,
    wrapped to 180 deg (paper, Table II, open loop)."""
    mean_force: float
    """Mean magnitude of the residual force (N)."""
    diverged: dict[float, tuple[int, int]] = dataclasses.field(default_factory=dict)
    """Number of starts that diverged before a horizon, and number of all starts, by horizon (s). No start diverged if a
    horizon is missing."""
    points: dict[float, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Mean and spread of the position RMSE over all points (m), by horizon (s). Empty without points."""
    joints: dict[float, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Mean and spread of the RMSE of the recorded hinge angles (deg), by horizon (s). Each difference is wrapped to 180
    deg. Held joints are left out, because they are commands. Empty if no hinge angle is recorded."""
    medians: dict[str, dict[float, float]] = dataclasses.field(default_factory=dict)
    """Median over starts (m or deg), by quantity and horizon (s)."""
    first_diverged: tuple[int, int] | None = None
    """Control step (in the recording) of the start that diverged soonest, and the number of control steps until it
    diverged. None if no start diverged."""

    def num_diverged(self, horizon: float) -> int:
        """Return the number of starts that diverged before `horizon` (s)."""
        return self.diverged.get(horizon, (0, 0))[0]


def summarize_starts(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and standard deviation of the errors (m or deg) that did not diverge (`has_diverged`).

    Return infinity and 0 if all diverged.
    """
    kept = [value for value in values if not has_diverged(value)]
    return (float(np.mean(kept)), float(np.std(kept))) if kept else (np.inf, 0.0)


def median_of_starts(values: Sequence[float]) -> float:
    """Return the median of errors (m or deg) over all starts. It is infinite if half of them diverged."""
    return float(np.median([np.inf if has_diverged(value) else value for value in values]))


def choose_horizons(declared: Sequence[float], longest: float) -> tuple[float, ...]:
    """Return the horizons (s) of errors: those `declared` by the robot, or the default ones.

    Without declared horizons, recordings of at most 1 s have shorter ones. `longest` is the length (s) of the longest
    recording.
    """
    if declared:
        return tuple(declared)
    return HORIZONS if longest > HORIZONS[0] else _SHORT_HORIZONS


def has_diverged(error: float) -> bool:
    """Return whether an error (m or deg) is not finite, or `LARGEST` or more."""
    return not abs(error) < LARGEST


def base_name(identified: bool) -> str:
    """Return the name of the simulator without residual, with identified or nominal actuators."""
    return "vanilla+sysid" if identified else "vanilla"


def quotient(with_it: float, without: float) -> float:
    """Return the error with a residual divided by the error without it.

    The result is 1 if both errors are zero, as for the yaw of a robot that cannot turn, or if both are infinite.
    """
    if np.isinf(with_it) and np.isinf(without):
        return 1.0
    return max(with_it, _LEAST) / max(without, _LEAST)


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Errors of a simulator with and without its residual, on the same recordings and starts."""

    vanilla: tuple[Errors, ...]
    """Errors without the residual, by recording."""
    residual: tuple[Errors, ...]
    """Errors with the residual, by recording."""
    base: str = "vanilla"
    """Name of the simulator without the residual."""
    name: str = "envmimic"
    """Name of the simulator with the residual."""
    nominal: tuple[Errors, ...] = ()
    """Errors of the simulator with nominal actuators and without the residual, by recording. Empty if the actuators of
    the other two are nominal."""
    angle: Angle = "yaw"
    """Angle of the orientation errors."""

    @property
    def groups(self) -> tuple[str, ...]:
        """Groups of the recordings, in their order."""
        return tuple(dict.fromkeys(errors.group for errors in self.vanilla))

    @property
    def simulators(self) -> dict[str, tuple[Errors, ...]]:
        """Errors by the name of the simulator: nominal, then without the residual, then with it."""
        nominal = {base_name(False): self.nominal} if self.nominal else {}
        return nominal | {self.base: self.vanilla, self.name: self.residual}

    def ratio(self, group: str, quantity: str, horizon: float) -> float:
        """Return the ratio (`error_ratio`) of the errors with and without the residual."""
        return error_ratio(self.residual, self.vanilla, group, quantity, horizon)

    def score_horizons(self, group: str) -> list[float]:
        """Return the horizons (s) of a group that enter the score."""
        reached = reached_horizons(self.vanilla, group)
        return [horizon for horizon in reached if horizon in SCORE_HORIZONS] or [max(reached)]

    @property
    def score(self) -> float:
        """Score by which checkpoints are chosen on validation recordings.

        It is the mean ratio of the errors with the residual to those of the same simulator without it.

        The mean is over position, orientation and, if recorded, joint angles, with equal weights, over groups and over
        `SCORE_HORIZONS`. A group without these horizons enters with its longest one. The score is infinite if more
        starts diverge with the residual than without. It ignores worst cases: at 20 s they are a matter of chance, and
        choosing by them chose untrained policies.
        """
        ratios = []
        for group in self.groups:
            members = [errors for errors in self.vanilla if errors.group == group]
            for horizon in self.score_horizons(group):
                with_joints = all(horizon in each.joints for each in members if horizon in each.position)
                quantities = ("position", "orientation", *(["joints"] if with_joints else []))
                ratios += [self.ratio(group, quantity, horizon) for quantity in quantities]
        return float(np.mean(ratios))

    def excess(self) -> tuple[float, str]:
        """Return the largest error with the residual relative to a bound, over recordings and horizons, and its place.

        The bound is 1.2 times vanilla's error plus 2 cm or 3 deg. The value is the error divided by the bound, minus 1:
        0.1 is ten per cent beyond the bound, and a negative value is within it. It is infinite if more starts diverge
        with the residual than without, or if only the residual's error diverged.
        """
        worst, place = -np.inf, ""
        for base, mimic in zip(self.vanilla, self.residual, strict=True):
            for quantity, allowance, unit in (("position", 0.02, "m"), ("orientation", 3.0, "deg")):
                for horizon, (value, _) in getattr(mimic, quantity).items():
                    bound = 1.2 * getattr(base, quantity)[horizon][0] + allowance
                    where = f"{self.called(quantity)} of {mimic.recording} at {horizon:g} s: "
                    if mimic.num_diverged(horizon) > base.num_diverged(horizon):
                        return np.inf, f"{where}{share_diverged(mimic, horizon)}, {self.base} in fewer"
                    if has_diverged(value) and not has_diverged(bound):
                        return np.inf, f"{where}diverged, bound {bound:.3f}"
                    beyond = quotient(value, bound) - 1
                    if beyond > worst:
                        worst, place = beyond, f"{where}{value:.3f} {unit}, bound {bound:.3f}"
        return float(worst), place

    def table(self) -> str:
        """Return the table of errors by group and horizon, as text (`errors_table.errors_table`)."""
        from ballu_mjx.evaluation.errors_table import errors_table  # here, because it imports this module

        return errors_table(self)

    def called(self, quantity: str) -> str:
        """Return the name of a quantity in tables. For orientation, it is the angle of the errors."""
        return self.angle if quantity == "orientation" else quantity


def share_diverged(errors: Errors, horizon: float) -> str:
    """Return the number of starts that diverged before a horizon (s), as text. The horizon must be in `diverged`."""
    some, starts = errors.diverged[horizon]
    return f"diverged in {some} of {starts} starts"


def reached_horizons(errors: Sequence[Errors], group: str) -> list[float]:
    """Return the horizons (s) for which the recordings of a group are long enough, in increasing order."""
    return sorted({horizon for e in errors if e.group == group for horizon in e.position})


def mean_com_error(errors: Sequence[Errors]) -> float:
    """Return the mean CoM error (m) over whole recordings."""
    return float(np.mean([each.mean_com_error for each in errors]))


def mean_by_group(errors: Sequence[Errors]) -> tuple[Errors, ...]:
    """Return the mean over each group's recordings, as the errors of one recording that has the group's name."""
    groups = dict.fromkeys(e.group for e in errors)
    return tuple(_mean([e for e in errors if e.group == group]) for group in groups)


def _mean(errors: Sequence[Errors]) -> Errors:
    """Return the mean over recordings of one group, which gives the result its name."""
    group = errors[0].group

    def over(quantity: str) -> dict[float, tuple[float, float]]:
        reached = sorted({horizon for e in errors for horizon in getattr(e, quantity)})
        return {h: (group_mean(errors, group, quantity, h), group_mean(errors, group, quantity, h, 1)) for h in reached}

    position = over("position")
    counts = {h: [e.diverged[h] for e in errors if h in e.diverged] for h in position}
    diverged = {h: (sum(some for some, _ in each), sum(of for _, of in each)) for h, each in counts.items() if each}
    com, turn, force = (_mean_of_finite([getattr(e, name) for e in errors]) for name in WHOLE)
    medians = {
        name: {h: group_median(errors, group, name, h) for h in position if any(h in e.medians[name] for e in errors)}
        for name in errors[0].medians
    }
    soonest = min((e.first_diverged for e in errors if e.first_diverged), key=lambda each: each[1], default=None)
    return Errors(
        group,
        group,
        position,
        over("orientation"),
        com,
        turn,
        force,
        diverged,
        over("points"),
        over("joints"),
        medians,
        soonest,
    )


def error_ratio(errors: Sequence[Errors], base: Sequence[Errors], group: str, quantity: str, horizon: float) -> float:
    """Return the ratio (`quotient`) of a simulator's errors to those of a base simulator on the same recordings.

    Both are first averaged over the group's recordings, without those in which all starts of the base simulator
    diverged. Means of a recording leave out starts that diverged. The ratio is therefore infinite if more starts of a
    recording diverge than in the base simulator. If fewer diverge, it is usually too large: the starts that only the
    base simulator loses are difficult ones.
    """
    pairs = [pair for pair in zip(errors, base, strict=True) if pair[1].group == group]
    if any(ours.num_diverged(horizon) > theirs.num_diverged(horizon) for ours, theirs in pairs):
        return np.inf
    means = np.array([[getattr(each, quantity).get(horizon, (np.inf,))[0] for each in pair] for pair in pairs])
    finite = np.isfinite(means[:, 1])
    return quotient(*(means[finite] if finite.any() else means).mean(axis=0))


def group_mean(errors: Sequence[Errors], group: str, quantity: str, horizon: float, place: int = 0) -> float:
    """Return the mean over a group's recordings of their means (`place` 0) or of their spreads (1), in m or deg."""
    values = [
        getattr(e, quantity)[horizon][place] for e in errors if e.group == group and horizon in getattr(e, quantity)
    ]
    return _mean_of_finite(values)


def group_median(errors: Sequence[Errors], group: str, quantity: str, horizon: float) -> float:
    """Return the median over a group's recordings of the medians over their starts (m or deg)."""
    values = [e.medians[quantity][horizon] for e in errors if e.group == group and horizon in e.medians[quantity]]
    return float(np.median(values))


def _mean_of_finite(values: Sequence[float]) -> float:
    """Return the mean of the finite values, or infinity if there is none."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else np.inf


def orientation_errors(
    simulated: Float[np.ndarray, "*states 3"], recorded: Float[np.ndarray, "*states 3"], upright: bool
) -> Float[np.ndarray, "*states"]:
    """Return orientation errors (deg) between orientations given as roll, pitch and yaw (rad; intrinsic z-y-x).

    For an upright robot, the error is simulated minus recorded yaw, wrapped to 180 deg. For other robots, it is the
    angle of the rotation between both orientations.
    """
    if upright:
        turn = simulated[..., 2] - recorded[..., 2]
        return np.rad2deg(np.arctan2(np.sin(turn), np.cos(turn)))
    turn = quaternion_product(quaternion_conjugate(_quaternion(simulated)), _quaternion(recorded))
    scalar, vector = turn[..., 0], np.linalg.norm(turn[..., 1:], axis=-1)
    return np.rad2deg(2 * np.arctan2(vector, np.abs(scalar)))


def _quaternion(euler: Float[np.ndarray, "*states 3"]) -> Float[np.ndarray, "*states 4"]:
    # SciPy's rotations raise for angles that are not finite, which diverged simulations have.
    halves = np.moveaxis(np.asarray(euler, np.float64), -1, 0) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(halves), np.sin(halves)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )
