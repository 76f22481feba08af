"""Errors of simulators over horizons: the table, its JSON, and the score that choices are made by."""

from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.recordings.groups import group_of

HORIZONS = (1.0, 2.0, 5.0, 10.0, 20.0)
"""Seconds over which errors are taken."""
SCORE_HORIZONS = (5.0, 10.0)
"""Horizons (s) that the validation score looks at."""
_LEAST = 1e-5
"""m or deg: an error below is that of single precision."""


_LARGEST = 1e6
"""m or deg: whoever is farther off has diverged."""


@dataclasses.dataclass(frozen=True)
class Errors:
    """Errors of one simulator on one recording; spread is the standard deviation over starts.

    Means are over the starts whose errors are finite. An error is infinite where no start's is.
    """

    recording: str
    group: str
    """Of the recording: see `groups.group_of`."""
    position: dict[float, tuple[float, float]]
    """Horizon (s) to mean and spread of the tracked body's position RMSE (m)."""
    yaw: dict[float, tuple[float, float]]
    """Horizon (s) to mean and spread of the yaw's RMSE (deg); each difference of yaw is wrapped to 180 deg."""
    mean_com_error: float
    """Mean distance (m) of the centres of mass over the whole recording (paper, Table I, open loop)."""
    final_yaw_error: float
    """Simulated less recorded yaw (deg, wrapped to 180) at the end of the recording (paper, Table II, open loop)."""
    mean_force: float
    """Mean magnitude of the residual force (N)."""
    diverged: dict[float, tuple[int, int]] = dataclasses.field(default_factory=dict)
    """Horizon (s) to how many starts diverged before it, and of how many; where it is missing, none did."""

    def num_diverged(self, horizon: float) -> int:
        """Return the number of starts that diverged before `horizon` (s)."""
        return self.diverged.get(horizon, (0, 0))[0]


def summarize_starts(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and standard deviation of the errors (m or deg) that `has_diverged` is false of; infinity and 0 where
    it is true of all."""
    kept = [value for value in values if not has_diverged(value)]
    return (float(np.mean(kept)), float(np.std(kept))) if kept else (np.inf, 0.0)


def has_diverged(error: float) -> bool:
    """Return whether an error (m or deg) is that of a simulation that broke down."""
    return not abs(error) < _LARGEST


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
        with_it, without = (_group_mean(e, group, quantity, horizon) for e in (self.residual, self.vanilla))
        return quotient(with_it, without)

    @property
    def score(self) -> float:
        """What choices are made by, on validation recordings: the mean ratio to vanilla, position and yaw alike.

        Averaged over groups and over `SCORE_HORIZONS`, or over the longest horizon where recordings are shorter.
        Infinite where more starts diverge with the residual than without. Worst cases stay out of it: at 20 s they are
        a matter of luck, and choosing by them chose untrained policies.
        """
        ratios = []
        for group in self.groups:
            pairs = [pair for pair in zip(self.vanilla, self.residual, strict=True) if pair[0].group == group]
            reached = {horizon for without, _ in pairs for horizon in without.position}
            for horizon in reached.intersection(SCORE_HORIZONS) or {max(reached)}:
                if any(mimic.num_diverged(horizon) > without.num_diverged(horizon) for without, mimic in pairs):
                    return np.inf
                ratios += [self.ratio(group, quantity, horizon) for quantity in ("position", "yaw")]
        return float(np.mean(ratios))

    def excess(self) -> tuple[float, str]:
        """Worst case over recordings and horizons of the residual's error beyond 1.2 vanilla + (2 cm or 3 deg).

        Given in units of that bound (0.1: ten per cent beyond it; negative: within), with where it is. Infinite where
        more starts diverge with the residual than without.
        """
        worst, place = -np.inf, ""
        for base, mimic in zip(self.vanilla, self.residual, strict=True):
            for quantity, allowance, unit in (("position", 0.02, "m"), ("yaw", 3.0, "deg")):
                for horizon, (value, _) in getattr(mimic, quantity).items():
                    bound = 1.2 * getattr(base, quantity)[horizon][0] + allowance
                    where = f"{quantity} of {mimic.recording} at {horizon:g} s: "
                    if mimic.num_diverged(horizon) > base.num_diverged(horizon):
                        return np.inf, f"{where}{_share_diverged(mimic, horizon)}, {self.base} in fewer"
                    if has_diverged(value) and not has_diverged(bound):
                        return np.inf, f"{where}diverged, bound {bound:.3f}"
                    beyond = quotient(value, bound) - 1
                    if beyond > worst:
                        worst, place = beyond, f"{where}{value:.3f} {unit}, bound {bound:.3f}"
        return float(worst), place

    def table(self) -> str:
        """Return errors by group and horizon, without and with the residual, with the spread over starts; then the
        whole recordings, and where starts diverged."""
        sides = self.simulators
        wide = [max(16, len(name) + 2) for name in sides]
        narrow = [max(13, len(name) + 2) for name in sides]
        margin = max(7, 2 + max(map(len, self.groups)))
        titles = "".join(f"{name:>{width}}" for name, width in zip(sides, wide, strict=True)) + f"{'ratio':>8}"
        lines = [
            f"{'':{margin}}{'horizon':>8} |{'position RMSE (m)':^{len(titles)}} |{'yaw RMSE (deg)':^{len(titles)}}",
            f"{'':{margin}}{'(s)':>8} |{titles} |{titles}",
        ]
        for group in self.groups:
            for horizon in HORIZONS:
                if not any(horizon in e.position for e in self.vanilla if e.group == group):
                    continue
                cells = ""
                for quantity, digits in (("position", 3), ("yaw", 1)):
                    cells += " |"
                    for errors, width in zip(sides.values(), wide, strict=True):
                        mean = _group_mean(errors, group, quantity, horizon)
                        spread = _group_mean(errors, group, quantity, horizon, place=1)
                        cells += f"{_cell(mean, digits, spread):>{width}}"
                    ratio = self.ratio(group, quantity, horizon)
                    cells += f"{ratio:>8.2f}" if np.isfinite(ratio) else f"{'-':>8}"
                lines.append(f"{group:{margin}}{horizon:>8g}{cells}")
        lines += [
            f"± is the standard deviation over starts; ratio: {self.name} over {self.base}.",
            "",
            f"{'whole recording':24}{'mean CoM error (m)':>{sum(narrow)}}{'final yaw error (deg)':>{sum(narrow)}}",
            f"{'':24}" + 2 * "".join(f"{name:>{width}}" for name, width in zip(sides, narrow, strict=True)),
        ]
        for each in zip(*sides.values(), strict=True):
            line = f"{each[0].recording:24}"
            for key, digits in (("mean_com_error", 3), ("final_yaw_error", 1)):
                for errors, width in zip(each, narrow, strict=True):
                    value = getattr(errors, key)
                    line += f"{_cell(value, digits):>{width}}"
            lines.append(line)
        broken = [
            f"{errors.recording}, {horizon:g} s: {name} {_share_diverged(errors, horizon)}"
            for name, side in sides.items()
            for errors in side
            for horizon in errors.position
            if errors.num_diverged(horizon)
        ]
        if broken:
            lines += ["", "Simulations that broke down, which the means leave out:", *broken]
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Return all figures, as plain lists and numbers; null for what is infinite."""
        worst, place = self.excess()
        return {
            "base": self.base,
            "name": self.name,
            "score": _finite(self.score),
            "worst_beyond_bound": {"relative": _finite(worst), "where": place},
            "nominal": [_errors_to_json(errors) for errors in self.nominal],
            "vanilla": [_errors_to_json(errors) for errors in self.vanilla],
            "residual": [_errors_to_json(errors) for errors in self.residual],
        }

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> Evaluation:
        """Return the inverse of `to_json`.

        **Raises** `ValueError`, `TypeError`, `KeyError` or `AttributeError` for what is none.
        """

        def number(value: Any) -> float:
            if value is None:
                return np.inf
            if not is_number(value):
                raise ValueError(f"{reprlib.repr(value)} is no number")
            return float(value)

        def text(value: Any) -> str:
            if not isinstance(value, str):
                raise ValueError(f"{reprlib.repr(value)} is no text")
            return value

        def by_horizon(values: Any) -> dict[float, tuple[Any, Any]]:
            found = {float(horizon[:8]): (first, second) for horizon, (first, second) in values.items()}
            if not all(horizon in HORIZONS for horizon in found):
                raise ValueError(f"errors are taken over {HORIZONS} s, not {reprlib.repr(list(found))}")
            return found

        def table(values: Any) -> dict[float, tuple[float, float]]:
            found = {horizon: (number(mean), number(spread)) for horizon, (mean, spread) in by_horizon(values).items()}
            if not all(0 <= error < _LARGEST or error == np.inf for error, _ in found.values()) or not all(
                0 <= spread < np.inf for _, spread in found.values()
            ):
                raise ValueError("errors and their spreads are 0 or more")
            return found

        def counts(values: Any) -> dict[float, tuple[int, int]]:
            found = by_horizon(values)
            if not all(type(some) is type(starts) is int and 0 <= some <= starts for some, starts in found.values()):
                raise ValueError("starts that diverged are a number of them, of how many")
            return found

        def errors(row: Any) -> Errors:
            found = Errors(
                recording=text(row["recording"]),
                group=text(row["group"]),
                position=table(row["position"]),
                yaw=table(row["yaw"]),
                mean_com_error=number(row["mean_com_error"]),
                final_yaw_error=number(row["final_yaw_error"]),
                mean_force=number(row["mean_force"]),
                diverged=counts(row["diverged"]),
            )
            if found.group != group_of(found.recording):
                raise ValueError(f"{reprlib.repr(found.recording)} is not of the group {reprlib.repr(found.group)}")
            if not found.position or found.position.keys() != found.yaw.keys():
                raise ValueError(f"{reprlib.repr(found.recording)} has not the same horizons for both")
            for horizon in found.position:
                some, starts = found.diverged.get(horizon, (0, 0))
                lost = some == starts > 0
                if any(np.isinf(quantity[horizon][0]) != lost for quantity in (found.position, found.yaw)):
                    raise ValueError(f"{reprlib.repr(found.recording)} has no error at {horizon:g} s, or one too many")
            return found

        nominal, without, mimic = (tuple(map(errors, content[which])) for which in ("nominal", "vanilla", "residual"))
        compared = [[_compared(e) for e in side] for side in (without, mimic, *([nominal] if nominal else []))]
        if not without or any(side != compared[0] for side in compared):
            raise ValueError("there are not the same recordings and horizons without the residual and with it")
        return Evaluation(without, mimic, text(content["base"]), text(content["name"]), nominal)


def _cell(value: float, digits: int, spread: float | None = None) -> str:
    if has_diverged(value):
        return "diverged"
    return f"{value:.{digits}f}" if spread is None else f"{value:.{digits}f} ± {spread:.{digits}f}"


def _share_diverged(errors: Errors, horizon: float) -> str:
    some, starts = errors.diverged[horizon]
    return f"diverged in {some} of {starts} starts"


def _errors_to_json(errors: Errors) -> dict[str, Any]:
    found = dataclasses.asdict(errors)
    for quantity in ("position", "yaw"):
        found[quantity] = {horizon: [_finite(x) for x in pair] for horizon, pair in found[quantity].items()}
    return found | {name: _finite(found[name]) for name in _WHOLE}


def _finite(value: float | int) -> float | int | None:
    return value if np.isfinite(value) else None


def _compared(errors: Errors) -> tuple[str, str, set[float]]:
    return errors.recording, errors.group, set(errors.position)


def read_evaluation(path: Path) -> Evaluation:
    """Return the evaluation in a file, `evaluation.json` of a run, say.

    **Raises** `InputError` where it is none.
    """
    mend = f"`python -m ballu_mjx evaluate {path.parent} --output {path.parent}` writes it again"
    content = files.read_json(path, mend)
    try:
        return Evaluation.from_json(content)
    except KeyError as error:
        raise InputError(f"{path}: is no evaluation ({error} is missing); {mend}.") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is no evaluation ({error}); {mend}.") from error


def mean_by_group(errors: Sequence[Errors]) -> tuple[Errors, ...]:
    """Return the means of each group's recordings, as one recording named after it."""
    groups = dict.fromkeys(e.group for e in errors)
    return tuple(_mean([e for e in errors if e.group == group]) for group in groups)


def _mean(errors: Sequence[Errors]) -> Errors:
    """Of recordings of one group; named after it."""
    group = errors[0].group

    def over(quantity: str) -> dict[float, tuple[float, float]]:
        reached = [horizon for horizon in HORIZONS if any(horizon in e.position for e in errors)]
        return {
            h: (_group_mean(errors, group, quantity, h), _group_mean(errors, group, quantity, h, 1)) for h in reached
        }

    position = over("position")
    counts = {h: [e.diverged[h] for e in errors if h in e.diverged] for h in position}
    diverged = {h: (sum(some for some, _ in each), sum(of for _, of in each)) for h, each in counts.items() if each}
    com, yaw, force = (_mean_of_finite([getattr(e, name) for e in errors]) for name in _WHOLE)
    return Errors(group, group, position, over("yaw"), com, yaw, force, diverged)


_WHOLE = ("mean_com_error", "final_yaw_error", "mean_force")


def _group_mean(errors: Sequence[Errors], group: str, quantity: str, horizon: float, place: int = 0) -> float:
    values = [getattr(e, quantity)[horizon][place] for e in errors if e.group == group and horizon in e.position]
    return _mean_of_finite(values)


def _mean_of_finite(values: Sequence[float]) -> float:
    """Return the mean over those that are finite; infinity where none is."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else np.inf
