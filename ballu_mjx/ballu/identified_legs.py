"""Identification of BALLU's legs, from recordings to report."""

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
    """Identified actuators of both legs, with the sweep and the full result of the fit."""

    sweep: Sweep
    identification: Identification


def identify_from_sweep(
    recordings: Mapping[Path, Recording],
    config: IdentificationConfig | None = None,
    levels: int | None = None,
    progress: IdentificationProgress | None = None,
) -> IdentifiedLegs:
    """Identify both legs from suspended recordings; see `leg_fit.identify_legs`.

    **Arguments**

    - `recordings`: the recordings, by file.
    - `levels`: smallest number of command levels of each leg. None for the paper's 20.

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
