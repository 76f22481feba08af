"""JSON file of simulators' errors, which is checked when it is read."""

from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.common.files import finite_or_none
from ballu_mjx.evaluation.errors import LARGEST, WHOLE, Angle, Errors, Evaluation
from ballu_mjx.recordings.recording_groups import group_of
from ballu_mjx.robots.description_fields import HORIZON_RANGE


def evaluation_to_json(evaluation: Evaluation) -> dict[str, Any]:
    """Return all figures as JSON-compatible values, with None for infinity."""
    worst, place = evaluation.excess()
    return {
        "base": evaluation.base,
        "name": evaluation.name,
        "angle": evaluation.angle,
        "score": finite_or_none(evaluation.score),
        "worst_beyond_bound": {"relative": finite_or_none(worst), "where": place},
        "nominal": [_errors_to_json(errors) for errors in evaluation.nominal],
        "vanilla": [_errors_to_json(errors) for errors in evaluation.vanilla],
        "residual": [_errors_to_json(errors) for errors in evaluation.residual],
    }


def _errors_to_json(errors: Errors) -> dict[str, Any]:
    found = dataclasses.asdict(errors)
    for quantity in ("position", "orientation", "points", "joints"):
        found[quantity] = {horizon: [finite_or_none(x) for x in pair] for horizon, pair in found[quantity].items()}
    found["medians"] = {name: {h: finite_or_none(x) for h, x in each.items()} for name, each in errors.medians.items()}
    return found | {name: finite_or_none(found[name]) for name in WHOLE}


def evaluation_from_json(content: Mapping[str, Any]) -> Evaluation:
    """Return the evaluation from the values that `evaluation_to_json` returned.

    **Raises** `ValueError`, `TypeError`, `KeyError` or `AttributeError` for values that are no evaluation.
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
        check(found)
        return found

    def check(horizons: Mapping[float, Any]) -> None:
        low, high = HORIZON_RANGE
        if not all(low <= horizon <= high for horizon in horizons):
            raise ValueError(f"errors are taken over {low:g} to {high:g} s, not {reprlib.repr(list(horizons))}")

    def medians(values: Any) -> dict[str, dict[float, float]]:
        found = {text(name): {float(h[:8]): number(x) for h, x in each.items()} for name, each in values.items()}
        for each in found.values():
            check(each)
            if not all(0 <= x for x in each.values()):
                raise ValueError("medians of errors are 0 or more")
        return found

    def steps(value: Any) -> tuple[int, int] | None:
        if value is None:
            return None
        start, later = value
        if not type(start) is type(later) is int:
            raise ValueError("a start that diverged is given by two numbers of control steps")
        return start, later

    def table(values: Any) -> dict[float, tuple[float, float]]:
        found = {horizon: (number(mean), number(spread)) for horizon, (mean, spread) in by_horizon(values).items()}
        if not all(0 <= error < LARGEST or error == np.inf for error, _ in found.values()) or not all(
            0 <= spread < np.inf for _, spread in found.values()
        ):
            raise ValueError("errors and their spreads are 0 or more")
        return found

    def counts(values: Any) -> dict[float, tuple[int, int]]:
        found = by_horizon(values)
        if not all(type(some) is type(starts) is int and 0 <= some <= starts for some, starts in found.values()):
            raise ValueError("counts of diverged starts need two numbers: diverged starts, and all starts")
        return found

    def errors(row: Any) -> Errors:
        found = Errors(
            recording=text(row["recording"]),
            group=text(row["group"]),
            position=table(row["position"]),
            orientation=table(row["orientation"]),
            mean_com_error=number(row["mean_com_error"]),
            final_orientation_error=number(row["final_orientation_error"]),
            mean_force=number(row["mean_force"]),
            diverged=counts(row["diverged"]),
            points=table(row["points"]),
            joints=table(row["joints"]),
            medians=medians(row["medians"]),
            first_diverged=steps(row["first_diverged"]),
        )
        if found.group != group_of(found.recording):
            raise ValueError(f"{reprlib.repr(found.recording)} is not of the group {reprlib.repr(found.group)}")
        if not found.position or found.position.keys() != found.orientation.keys():
            raise ValueError(f"{reprlib.repr(found.recording)} needs the same horizons for position and orientation")
        for horizon in found.position:
            some, starts = found.diverged.get(horizon, (0, 0))
            all_diverged = some == starts > 0
            if any(np.isinf(quantity[horizon][0]) != all_diverged for quantity in (found.position, found.orientation)):
                raise ValueError(
                    f"the errors of {reprlib.repr(found.recording)} at {horizon:g} s do not agree with its count of "
                    "diverged starts"
                )
        return found

    nominal, without, mimic = (tuple(map(errors, content[which])) for which in ("nominal", "vanilla", "residual"))
    compared = [[_compared(e) for e in side] for side in (without, mimic, *([nominal] if nominal else []))]
    if not without or any(side != compared[0] for side in compared):
        raise ValueError("recordings or horizons differ between the simulators without and with the residual")
    angle = content["angle"]
    if angle not in get_args(Angle):
        raise ValueError(f"{reprlib.repr(angle)} is none of {', '.join(get_args(Angle))}")
    return Evaluation(without, mimic, text(content["base"]), text(content["name"]), nominal, angle)


def _compared(errors: Errors) -> tuple[str, str, set[float]]:
    return errors.recording, errors.group, set(errors.position)


def read_evaluation(path: Path) -> Evaluation:
    """Return the evaluation in a file, for example a run's `evaluation.json`.

    **Raises** `InputError` if the file holds no valid evaluation.
    """
    fix = f"`python -m ballu_mjx evaluate {path.parent} --output {path.parent}` writes it again"
    content = files.read_json(path, fix)
    try:
        return evaluation_from_json(content)
    except KeyError as error:
        raise InputError(f"{path}: is no evaluation ({error} is missing); {fix}.") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is no evaluation ({error}); {fix}.") from error
