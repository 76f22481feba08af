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
from ballu_mjx.recordings.groups import GROUPS

HORIZONS = (1.0, 2.0, 5.0, 10.0, 20.0)
"""Seconds over which errors are taken."""
SCORE_HORIZONS = (5.0, 10.0)
"""Horizons (s) that the validation score looks at."""
_LEAST = 1e-5
"""m or deg: an error below is that of single precision."""


@dataclasses.dataclass(frozen=True)
class Errors:
    """Errors of one simulator on one recording; spread is the standard deviation over starts."""

    recording: str
    group: str
    """`near` or `far` where the recording's name begins so, else `all`."""
    position: dict[float, tuple[float, float]]
    """Horizon (s) to mean and spread of the balloon position's RMSE (m)."""
    yaw: dict[float, tuple[float, float]]
    """Horizon (s) to mean and spread of the yaw's RMSE (deg)."""
    mean_com_error: float
    """Mean distance (m) of the centres of mass over the whole recording (paper, Table I, open loop)."""
    final_yaw_error: float
    """Simulated less recorded yaw (deg) at the end of the recording (paper, Table II, open loop)."""
    mean_force: float
    """Mean magnitude of the residual force (N)."""


def base_name(identified: bool) -> str:
    """What the simulator without residual forces is called, with identified or nominal actuators."""
    return "vanilla+sysid" if identified else "vanilla"


def quotient(with_it: float, without: float) -> float:
    """Error with a residual over error without; 1 where there is none either way, as of the yaw of a robot that cannot
    turn."""
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

    @property
    def groups(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(errors.group for errors in self.vanilla))

    def ratio(self, group: str, quantity: str, horizon: float) -> float:
        """`quotient` of the errors with the residual and without, each averaged over the group's recordings."""
        with_it, without = (_group_mean(e, group, quantity, horizon) for e in (self.residual, self.vanilla))
        return quotient(with_it, without)

    @property
    def score(self) -> float:
        """What choices are made by, on validation recordings: the mean ratio to vanilla, position and yaw alike.

        Averaged over groups and over `SCORE_HORIZONS`, or over the longest horizon where recordings are shorter. Worst
        cases stay out of it: at 20 s they are a matter of luck, and choosing by them chose untrained policies.
        """
        ratios = []
        for group in self.groups:
            reached = {horizon for e in self.vanilla if e.group == group for horizon in e.position}
            for horizon in reached.intersection(SCORE_HORIZONS) or {max(reached)}:
                ratios += [self.ratio(group, quantity, horizon) for quantity in ("position", "yaw")]
        return float(np.mean(ratios))

    def excess(self) -> tuple[float, str]:
        """Worst case over recordings and horizons of the residual's error beyond 1.2 vanilla + (2 cm or 3 deg).

        Given in units of that bound (0.1: ten per cent beyond it; negative: within), with where it is.
        """
        worst, place = -np.inf, ""
        for base, mimic in zip(self.vanilla, self.residual, strict=True):
            for quantity, allowance, unit in (("position", 0.02, "m"), ("yaw", 3.0, "deg")):
                for horizon, (value, _) in getattr(mimic, quantity).items():
                    bound = 1.2 * getattr(base, quantity)[horizon][0] + allowance
                    if value / bound - 1 > worst:
                        worst = value / bound - 1
                        place = (
                            f"{quantity} of {mimic.recording} at {horizon:g} s: {value:.3f} {unit}, bound {bound:.3f}"
                        )
        return float(worst), place

    def table(self) -> str:
        """Errors by group and horizon, without and with the residual, with the spread over starts; then the whole
        recordings."""
        base, name = self.base, self.name
        wide, narrow = max(16, len(name) + 2), max(13, len(name) + 2)
        lines = [
            f"{'':7}{'horizon':>8} |{'position RMSE (m)':^{wide + 23}}| {'yaw RMSE (deg)':^{wide + 22}}",
            f"{'':7}{'(s)':>8} |{base:>14}{name:>{wide}}{'ratio':>8} | {base:>13}{name:>{wide}}{'ratio':>8}",
        ]
        for group in self.groups:
            for horizon in HORIZONS:
                if not any(horizon in e.position for e in self.vanilla if e.group == group):
                    continue
                cells = []
                for quantity, digits in (("position", 3), ("yaw", 1)):
                    for errors in (self.vanilla, self.residual):
                        mean = _group_mean(errors, group, quantity, horizon)
                        spread = _group_mean(errors, group, quantity, horizon, place=1)
                        cells.append(f"{mean:.{digits}f} ± {spread:.{digits}f}")
                    cells.append(f"{self.ratio(group, quantity, horizon):.2f}")
                lines.append(
                    f"{group:7}{horizon:>8g} |{cells[0]:>14}{cells[1]:>{wide}}{cells[2]:>8} | "
                    f"{cells[3]:>13}{cells[4]:>{wide}}{cells[5]:>8}"
                )
        lines += [
            "",
            f"{'whole recording':24}{'mean CoM error (m)':>{15 + narrow}}{'final yaw error (deg)':>{15 + narrow}}",
        ]
        lines.append(f"{'':24}{base:>15}{name:>{narrow}}{base:>15}{name:>{narrow}}")
        for without, mimic in zip(self.vanilla, self.residual, strict=True):
            lines.append(
                f"{without.recording:24}{without.mean_com_error:>15.3f}{mimic.mean_com_error:>{narrow}.3f}"
                f"{without.final_yaw_error:>15.1f}{mimic.final_yaw_error:>{narrow}.1f}"
            )
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """All figures, as plain lists and numbers."""
        worst, place = self.excess()
        return {
            "base": self.base,
            "name": self.name,
            "score": self.score,
            "worst_beyond_bound": {"relative": worst, "where": place},
            "vanilla": [dataclasses.asdict(errors) for errors in self.vanilla],
            "residual": [dataclasses.asdict(errors) for errors in self.residual],
        }

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> Evaluation:
        """The inverse of `to_json`.

        **Raises** `ValueError`, `TypeError`, `KeyError` or `AttributeError` for what is none.
        """

        def number(value: Any) -> float:
            if not is_number(value):
                raise ValueError(f"{reprlib.repr(value)} is no number")
            return float(value)

        def text(value: Any) -> str:
            if not isinstance(value, str):
                raise ValueError(f"{reprlib.repr(value)} is no text")
            return value

        def table(values: Any) -> dict[float, tuple[float, float]]:
            found = {float(horizon[:8]): (number(mean), number(spread)) for horizon, (mean, spread) in values.items()}
            if not all(horizon in HORIZONS for horizon in found):
                raise ValueError(f"errors are taken over {HORIZONS} s, not {reprlib.repr(list(found))}")
            if not all(0 <= error < 1e9 and spread >= 0 for error, spread in found.values()):
                raise ValueError("errors and their spreads are 0 or more")
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
            )
            if found.group not in GROUPS or not found.position or found.position.keys() != found.yaw.keys():
                raise ValueError(f"{reprlib.repr(found.recording)} has no group or not the same horizons for both")
            return found

        without, mimic = (tuple(map(errors, content[which])) for which in ("vanilla", "residual"))
        if not without or [_compared(e) for e in without] != [_compared(e) for e in mimic]:
            raise ValueError("there are not the same recordings and horizons without the residual and with it")
        return Evaluation(without, mimic, text(content["base"]), text(content["name"]))


def _compared(errors: Errors) -> tuple[str, str, set[float]]:
    return errors.recording, errors.group, set(errors.position)


def read_evaluation(path: Path) -> Evaluation:
    """The evaluation in a file, `evaluation.json` of a run, say.

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
    """The means of each group's recordings, as one recording named after it."""
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

    whole = (float(np.mean([getattr(e, name) for e in errors])) for name in _WHOLE)
    return Errors(group, group, over("position"), over("yaw"), *whole)


_WHOLE = ("mean_com_error", "final_yaw_error", "mean_force")


def _group_mean(errors: Sequence[Errors], group: str, quantity: str, horizon: float, place: int = 0) -> float:
    values = [getattr(e, quantity)[horizon][place] for e in errors if e.group == group and horizon in e.position]
    return float(np.mean(values))
