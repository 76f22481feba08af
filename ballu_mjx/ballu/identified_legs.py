"""Identification of BALLU's legs, from recordings to a report."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from ballu_mjx.ballu.leg_fit import identify_legs
from ballu_mjx.ballu.leg_parameters import IdentificationConfig
from ballu_mjx.ballu.leg_results import Identification
from ballu_mjx.ballu.sweep import LEVELS, Sweep, read_sweep
from ballu_mjx.ballu.sysid_report import identification_details, identification_table
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.adapter import IdentificationProgress, IdentifiedActuators


@dataclasses.dataclass(frozen=True, eq=False)
class IdentifiedLegs(IdentifiedActuators):
    """Both legs' actuators, with the sweep that they were identified from, and the whole fit."""

    sweep: Sweep
    identification: Identification


def identify_from_sweep(
    recordings: Mapping[Path, Recording],
    config: IdentificationConfig | None = None,
    levels: int | None = None,
    progress: IdentificationProgress | None = None,
) -> IdentifiedLegs:
    """Identify both legs from suspended recordings, by file; see `identification.identify_legs`.

    `levels`: fewest command levels of each leg; None: the paper's 20.

    **Raises** `InputError` from `sweep.read_sweep`, and for options out of range.
    """
    sweep = read_sweep(recordings, levels=LEVELS if levels is None else levels)
    found = identify_legs(sweep, config, progress)
    return IdentifiedLegs(
        robot=sweep.robot,
        parameters=found.parameters,
        report=identification_table(sweep, found),
        details=identification_details(found),
        sweep=sweep,
        identification=found,
    )
