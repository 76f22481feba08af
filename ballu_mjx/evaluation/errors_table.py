"""Table of errors as text: means, spreads and medians of simulators side by side, by group and horizon."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ballu_mjx.evaluation.errors import (
    Errors,
    Evaluation,
    group_mean,
    group_median,
    has_diverged,
    reached_horizons,
    share_diverged,
)

_MEDIANS = (("position", "m", 3), ("orientation", "deg", 1), ("points", "m", 3), ("joints", "deg", 1))
"""Quantities, their units and digits."""


def errors_table(evaluation: Evaluation) -> str:
    """Return the table of an evaluation as text.

    Its parts are: mean errors and their spread over starts, by group and horizon; errors over whole recordings;
    medians over starts; and the starts that diverged.
    """
    sides = evaluation.simulators
    wide = [max(16, len(name) + 2) for name in sides]
    final = f"final {evaluation.angle} error (deg)"
    narrow = [max(13, len(name) + 2, -(-(len(final) + 2) // len(sides))) for name in sides]
    margin = max(7, 2 + max(map(len, evaluation.groups)))
    titles = "".join(f"{name:>{width}}" for name, width in zip(sides, wide, strict=True)) + f"{'ratio':>8}"
    lines = [
        f"{'':{margin}}{'horizon':>8} |{'position RMSE (m)':^{len(titles)}} |"
        f"{f'{evaluation.angle} RMSE (deg)':^{len(titles)}}",
        f"{'':{margin}}{'(s)':>8} |{titles} |{titles}",
    ]
    for group in evaluation.groups:
        for horizon in reached_horizons(evaluation.vanilla, group):
            cells = ""
            for quantity, digits in (("position", 3), ("orientation", 1)):
                cells += " |"
                for errors, width in zip(sides.values(), wide, strict=True):
                    mean = group_mean(errors, group, quantity, horizon)
                    spread = group_mean(errors, group, quantity, horizon, place=1)
                    cells += f"{_cell(mean, digits, spread):>{width}}"
                ratio = evaluation.ratio(group, quantity, horizon)
                cells += f"{ratio:>8.2f}" if np.isfinite(ratio) else f"{'-':>8}"
            lines.append(f"{group:{margin}}{horizon:>8g}{cells}")
    lines += [
        f"± is the standard deviation over starts; ratio: {evaluation.name} over {evaluation.base}.",
        "",
        f"{'whole recording':24}{'mean CoM error (m)':>{sum(narrow)}}{final:>{sum(narrow)}}",
        f"{'':24}" + 2 * "".join(f"{name:>{width}}" for name, width in zip(sides, narrow, strict=True)),
    ]
    for each in zip(*sides.values(), strict=True):
        line = f"{each[0].recording:24}"
        for key, digits in (("mean_com_error", 3), ("final_orientation_error", 1)):
            for errors, width in zip(each, narrow, strict=True):
                value = getattr(errors, key)
                line += f"{_cell(value, digits):>{width}}"
        lines.append(line)
    lines += _median_lines(evaluation)
    broken = [
        f"{errors.recording}, {horizon:g} s: {name} {share_diverged(errors, horizon)}{_soonest(errors)}"
        for name, side in sides.items()
        for errors in side
        for horizon in errors.position
        if errors.num_diverged(horizon)
    ]
    if broken:
        lines += ["", "Simulations that diverged, which the means leave out:", *broken]
    return "\n".join(lines)


def _median_lines(evaluation: Evaluation) -> list[str]:
    """Return the lines with the medians over starts of every quantity, and the share of starts that stayed finite."""
    sides = evaluation.simulators
    if not any(errors.medians for errors in evaluation.vanilla):
        return []
    wide = [max(13, len(name) + 2) for name in sides]
    heads = "".join(f"{name:>{width}}" for name, width in zip(sides, wide, strict=True))
    lines = ["", f"{'medians over starts':26}{'horizon':>8}{heads}"]
    for group in evaluation.groups:
        for quantity, unit, digits in _MEDIANS:
            for horizon in reached_horizons(evaluation.vanilla, group):
                if not any(horizon in e.medians.get(quantity, {}) for e in evaluation.vanilla if e.group == group):
                    continue
                cells = [_cell(group_median(side, group, quantity, horizon), digits) for side in sides.values()]
                label = f"{group} {evaluation.called(quantity)} ({unit})"
                line = "".join(f"{cell:>{width}}" for cell, width in zip(cells, wide, strict=True))
                lines.append(f"{label:26}{horizon:>8g}{line}")
        for horizon in reached_horizons(evaluation.vanilla, group):
            shares = [_finite_share(side, group, horizon) for side in sides.values()]
            if min(shares) < 1:
                line = "".join(f"{share:>{width}.0%}" for share, width in zip(shares, wide, strict=True))
                lines.append(f"{f'{group} starts finite':26}{horizon:>8g}{line}")
    return lines


def _cell(value: float, digits: int, spread: float | None = None) -> str:
    if has_diverged(value):
        return "diverged"
    return f"{value:.{digits}f}" if spread is None else f"{value:.{digits}f} ± {spread:.{digits}f}"


def _soonest(errors: Errors) -> str:
    if errors.first_diverged is None:
        return ""
    start, later = errors.first_diverged
    return f", the soonest {later} control steps after step {start}"


def _finite_share(errors: Sequence[Errors], group: str, horizon: float) -> float:
    """Return the share of a group's starts that reach a horizon (s) without diverging."""
    counts = [e.diverged[horizon] for e in errors if e.group == group and horizon in e.diverged]
    starts = sum(each for _, each in counts)
    return 1 - sum(some for some, _ in counts) / starts if starts else 1.0
