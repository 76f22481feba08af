"""Errors of simulators over horizons, and the score that choices are made by."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from ballu_mjx.common.rotations import quaternion_conjugate, quaternion_product

HORIZONS = (1.0, 2.0, 5.0, 10.0, 20.0)
"""Seconds over which errors are taken, where neither robot nor recordings ask for others."""
_SHORT_HORIZONS = (0.1, 0.2, 0.5)
"""Those of recordings that last no longer than the first of `HORIZONS`."""
SCORE_HORIZONS = (5.0, 10.0)
"""Horizons (s) that the validation score looks at; where recordings are shorter, it looks at the longest."""
Angle = Literal["yaw", "orientation"]
"""What errors of orientation are of: yaw, of upright robots, or the whole rotation."""
_LEAST = 1e-5
"""m or deg: an error below is that of single precision."""
LARGEST = 1e6
"""m or deg: whoever is farther off has diverged."""
WHOLE = ("mean_com_error", "final_orientation_error", "mean_force")
"""Errors of which a recording has one, over its whole length."""


@dataclasses.dataclass(frozen=True)
class Errors:
    """Errors of one simulator on one recording; spread is the standard deviation over starts.

    Means are over the starts whose errors are finite. An error is infinite where no start's is. Medians are over all
    starts: infinite where half of them diverged.
    """

    recording: str
    group: str
    """Of the recording: see `groups.group_of`."""
    position: dict[float, tuple[float, float]]
    """Horizon (s) to mean and spread of the tracked body's position RMSE (m)."""
    orientation: dict[float, tuple[float, float]]
    """Horizon (s) to mean and spread of the RMSE (deg) of the tracked body's orientation: of its yaw, each difference
    wrapped to 180 deg, where the robot is upright; else the angle of the rotation between simulated and recorded."""
    mean_com_error: float
    """Mean distance (m) of the centres of mass over the whole recording (paper, Table I, open loop)."""
    final_orientation_error: float
    """Error of orientation (deg) at the end of the recording; of an upright robot simulated less recorded yaw, wrapped
    to 180 deg (paper, Table II, open loop)."""
    mean_force: float
    """Mean magnitude of the residual force (N)."""
    diverged: dict[float, tuple[int, int]] = dataclasses.field(default_factory=dict)
    """Horizon (s) to how many starts diverged before it, and of how many; where it is missing, none did."""
    points: dict[float, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Horizon (s) to mean and spread of the points' position RMSE (m), over all points; empty: there are none."""
    joints: dict[float, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Horizon (s) to mean and spread of the RMSE (deg) of the hinges' angles that the recording holds, each difference
    wrapped to 180 deg; held joints count as commands, not as motion. Empty: there are none."""
    medians: dict[str, dict[float, float]] = dataclasses.field(default_factory=dict)
    """Quantity to horizon (s) to the median over starts (m, deg)."""
    first_diverged: tuple[int, int] | None = None
    """Of the start that diverged soonest: its control step in the recording, and how many steps later; None: none."""

    def num_diverged(self, horizon: float) -> int:
        """Return the number of starts that diverged before `horizon` (s)."""
        return self.diverged.get(horizon, (0, 0))[0]


def summarize_starts(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and standard deviation of the errors (m or deg) that `has_diverged` is false of; infinity and 0 where
    it is true of all."""
    kept = [value for value in values if not has_diverged(value)]
    return (float(np.mean(kept)), float(np.std(kept))) if kept else (np.inf, 0.0)


def median_of_starts(values: Sequence[float]) -> float:
    """Return the median of errors (m or deg) over all starts: infinity where half of them diverged."""
    return float(np.median([np.inf if has_diverged(value) else value for value in values]))


def choose_horizons(declared: Sequence[float], longest: float) -> tuple[float, ...]:
    """Return the horizons (s) to take errors over: those that the robot declares, or the usual ones.

    Recordings of at most `longest` seconds, 1 s or less, get shorter ones, unless the robot declares some.
    """
    if declared:
        return tuple(declared)
    return HORIZONS if longest > HORIZONS[0] else _SHORT_HORIZONS


def shortest_recording(declared: Sequence[float]) -> float:
    """Return how long (s) a recording for validation or test has to be, with the horizons that the robot declares."""
    return (max(declared) if declared else min(SCORE_HORIZONS)) + 0.5


def has_diverged(error: float) -> bool:
    """Return whether an error (m or deg) is that of a simulation that broke down."""
    return not abs(error) < LARGEST


def base_name(identified: bool) -> str:
    """Return what the simulator without residual forces is called, with identified or nominal actuators."""
    return "vanilla+sysid" if identified else "vanilla"


def quotient(with_it: float, without: float) -> float:
    """Return error with a residual over error without; 1 where there is none either way, as of the yaw of a robot that
    cannot turn, or both are infinite."""
    if np.isinf(with_it) and np.isinf(without):
        return 1.0
    return max(with_it, _LEAST) / max(without, _LEAST)


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """A simulator's errors beside vanilla's, on the same recordings and starts."""

    vanilla: tuple[Errors, ...]
    residual: tuple[Errors, ...]
    base: str = "vanilla"
    """What the simulator without the residual is called."""
    name: str = "envmimic"
    """What the simulator with it is called."""
    nominal: tuple[Errors, ...] = ()
    """Errors of the nominal robot without the residual, where the actuators of both others are identified."""
    angle: Angle = "yaw"
    """What errors of orientation are of."""

    @property
    def groups(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(errors.group for errors in self.vanilla))

    @property
    def simulators(self) -> dict[str, tuple[Errors, ...]]:
        """Errors by simulator: without residual first."""
        nominal = {base_name(False): self.nominal} if self.nominal else {}
        return nominal | {self.base: self.vanilla, self.name: self.residual}

    def ratio(self, group: str, quantity: str, horizon: float) -> float:
        """Return `quotient` of the errors with the residual and without, each averaged over the group's recordings."""
        with_it, without = (group_mean(e, group, quantity, horizon) for e in (self.residual, self.vanilla))
        return quotient(with_it, without)

    def score_horizons(self, group: str) -> list[float]:
        """Return the horizons (s) of a group that the score looks at."""
        reached = reached_horizons(self.vanilla, group)
        return [horizon for horizon in reached if horizon in SCORE_HORIZONS] or [max(reached)]

    @property
    def score(self) -> float:
        """What choices are made by, on validation recordings: the mean ratio to vanilla, of position, orientation and,
        where recordings hold them, joint angles alike.

        Averaged over groups and over `SCORE_HORIZONS`, or over the longest horizon where there is none of these.
        Infinite where more starts diverge with the residual than without. Worst cases stay out of it: at 20 s they are
        a matter of luck, and choosing by them chose untrained policies.
        """
        ratios = []
        for group in self.groups:
            pairs = [pair for pair in zip(self.vanilla, self.residual, strict=True) if pair[0].group == group]
            for horizon in self.score_horizons(group):
                if any(mimic.num_diverged(horizon) > without.num_diverged(horizon) for without, mimic in pairs):
                    return np.inf
                with_joints = all(horizon in without.joints for without, _ in pairs if horizon in without.position)
                quantities = ("position", "orientation", *(["joints"] if with_joints else []))
                ratios += [self.ratio(group, quantity, horizon) for quantity in quantities]
        return float(np.mean(ratios))

    def excess(self) -> tuple[float, str]:
        """Worst case over recordings and horizons of the residual's error beyond 1.2 vanilla + (2 cm or 3 deg).

        Given in units of that bound (0.1: ten per cent beyond it; negative: within), with where it is. Infinite where
        more starts diverge with the residual than without.
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
        """Return `errors_table.errors_table` of it: errors by group and horizon, in lines."""
        from ballu_mjx.evaluation.errors_table import errors_table  # which imports this module

        return errors_table(self)

    def called(self, quantity: str) -> str:
        """Return what a quantity is called: errors of orientation by what they are of."""
        return self.angle if quantity == "orientation" else quantity


def share_diverged(errors: Errors, horizon: float) -> str:
    """Return in words how many starts diverged before a horizon (s) that some did."""
    some, starts = errors.diverged[horizon]
    return f"diverged in {some} of {starts} starts"


def reached_horizons(errors: Sequence[Errors], group: str) -> list[float]:
    """Return the horizons (s) that recordings of a group are long enough for, in order."""
    return sorted({horizon for e in errors if e.group == group for horizon in e.position})


def mean_by_group(errors: Sequence[Errors]) -> tuple[Errors, ...]:
    """Return the means of each group's recordings, as one recording named after it."""
    groups = dict.fromkeys(e.group for e in errors)
    return tuple(_mean([e for e in errors if e.group == group]) for group in groups)


def _mean(errors: Sequence[Errors]) -> Errors:
    """Of recordings of one group; named after it."""
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


def group_mean(errors: Sequence[Errors], group: str, quantity: str, horizon: float, place: int = 0) -> float:
    """Return the mean over a group's recordings of their means, or with `place` 1 of their spreads (m or deg)."""
    values = [
        getattr(e, quantity)[horizon][place] for e in errors if e.group == group and horizon in getattr(e, quantity)
    ]
    return _mean_of_finite(values)


def group_median(errors: Sequence[Errors], group: str, quantity: str, horizon: float) -> float:
    """Return the median over recordings of the medians over their starts."""
    values = [e.medians[quantity][horizon] for e in errors if e.group == group and horizon in e.medians[quantity]]
    return float(np.median(values))


def _mean_of_finite(values: Sequence[float]) -> float:
    """Return the mean over those that are finite; infinity where none is."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else np.inf


def orientation_errors(
    simulated: Float[np.ndarray, "*states 3"], recorded: Float[np.ndarray, "*states 3"], upright: bool
) -> Float[np.ndarray, "*states"]:
    """Return errors of orientation (deg) of roll, pitch and yaw (rad; intrinsic z-y-x).

    Of an upright robot simulated less recorded yaw, wrapped to 180 deg. Else the angle of the rotation between both.
    """
    if upright:
        turn = simulated[..., 2] - recorded[..., 2]
        return np.rad2deg(np.arctan2(np.sin(turn), np.cos(turn)))
    turn = quaternion_product(quaternion_conjugate(_quaternion(simulated)), _quaternion(recorded))
    scalar, vector = turn[..., 0], np.linalg.norm(turn[..., 1:], axis=-1)
    return np.rad2deg(2 * np.arctan2(vector, np.abs(scalar)))


def _quaternion(euler: Float[np.ndarray, "*states 3"]) -> Float[np.ndarray, "*states 4"]:
    # SciPy's rotations raise where an angle is not finite; simulations that diverged have such states.
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
