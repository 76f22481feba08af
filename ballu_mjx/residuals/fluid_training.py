"""Fit of fluid forces: from a simulator and recorded motions to a residual."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals.fluid import FLUID_FILE, FluidForces
from ballu_mjx.residuals.fluid_fit import FluidConfig, FluidFit, fit_fluid_forces
from ballu_mjx.residuals.network import ForceNetworkConfig, recorded_inputs
from ballu_mjx.residuals.trained import TrainedResidual, observed_range, write_observed
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.runs.record import MemoryRecord, TrainingRecord
from ballu_mjx.sim.simulator import Simulator


def fit_fluid(
    simulator: Simulator,
    motions: Sequence[Motion],
    validation: Sequence[Motion],
    config: FluidConfig | None = None,
    *,
    run: TrainingRecord | None = None,
    progress: PhaseProgress | None = None,
) -> TrainedResidual:
    """Fit fluid forces; the result's report has the coefficients with their standard errors.

    **Arguments**

    - `motions`: what the simulator is to follow.
    - `validation`: other motions, which choose the terms.
    - `config`: how to fit; None: the defaults.
    - `run`: takes measurements and files, for example in a folder; None: memory.
    - `progress`: is told of every iteration.

    **Raises** `InputError` for options out of range, and where no motion is as long as a window.
    """
    config = config or FluidConfig()
    record = MemoryRecord({"fit": dataclasses.asdict(config)}) if run is None else run
    began, done = time.perf_counter(), 0

    def report(stage: str, iteration: int, steps: int, loss: float) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress.update(stage, iteration, steps, loss)
        record.log(done, {"loss": loss, "seconds": time.perf_counter() - began})

    found = fit_fluid_forces(simulator, motions, validation, config, report)
    if progress is not None:
        progress.close()
    record.log(done, {"control_steps": found.control_steps})
    record.write(FLUID_FILE, found.coefficients.to_json())
    reference, _ = stack_motions(simulator, motions)
    inputs = np.asarray(recorded_inputs(reference, ForceNetworkConfig(), simulator.robot))
    write_observed(record, inputs)
    return TrainedResidual(
        FluidForces(simulator.robot, simulator.mj_model, found.coefficients.term_set),
        jnp.asarray(found.coefficients.values, jnp.float32),
        observed_range(inputs),
        0,
        simulator.actuators,
        fluid_table(found),
    )


def fluid_table(found: FluidFit) -> str:
    """Return coefficients and validation errors, as text."""
    scores = ", ".join(f"{name} {score:.3g}" for name, score in found.scores.items())
    symmetric = "symmetric about the xz plane" if found.symmetric else "without symmetry"
    return (
        f"{found.coefficients.table()}\n{found.windows} training windows; {symmetric}. "
        f"Validation error by set of terms, in expected errors: {scores}."
    )
