"""What a sweep can tell: `python benchmarks/identifiability.py`.

On sweeps simulated with known parameters: are they found from ten different draws of starts, without noise; and with
0.5 deg of noise, how often does the truth lie within two standard errors, and what do the motions between commands add
to the settled angles? Takes about five minutes on two cores; `--quick` a tenth of it after compiling.
"""

from __future__ import annotations

import argparse
import dataclasses

from ballu_mjx import runtime

runtime.prepare()

import jax  # noqa: E402
import numpy as np  # noqa: E402

from ballu_mjx import identification  # noqa: E402
from ballu_mjx.identification import NAMES, IdentificationConfig  # noqa: E402
from ballu_mjx.robot import SIDES  # noqa: E402
from ballu_mjx.sweep import Sweep  # noqa: E402

NOISE = float(np.deg2rad(0.5))
SAMPLES, TIMES, LEVELS, DELAY = 50, 80, 20, 0.04
CHANGES = ([1.3, 0.7, 0.05, 0.06, 0.75], [0.8, 1.2, -0.08, -0.03, 0.6])
"""Left and right: times the nominal parameters; angles (rad) added."""


def truth() -> np.ndarray:
    """Parameters of both legs."""
    nominal = identification.nominal_leg()
    relative = np.array([not name.startswith("default") for name in NAMES])
    return np.stack([np.where(relative, nominal * change, nominal + change) for change in np.array(CHANGES)])


def simulate(identifier: identification.Identifier, vectors: np.ndarray) -> Sweep:
    """A sweep of the model itself, without noise."""
    physics = identifier.physics
    command, previous = np.linspace(0, 1, LEVELS), np.maximum(np.arange(LEVELS) - 1, 0)
    y = np.stack([identifier.space.coordinates(vector) for vector in vectors])
    qpos, slope = physics.settled(y, np.tile(command, (2, 1)))
    delayed = np.concatenate([y, np.full((2, 1), DELAY / identification.DELAY_UNIT)], axis=1)
    paths, _ = physics.transient(delayed, qpos[:, previous], slope[:, previous], np.tile(command, (2, 1)))
    return dataclasses.replace(
        blank(), settled=np.moveaxis(qpos[:, :, physics.leg.angles], 0, -1), transient=np.moveaxis(paths, 0, -1)
    )


def blank() -> Sweep:
    """Of the right sizes."""
    command = np.repeat(np.linspace(0, 1, LEVELS)[:, None], len(SIDES), axis=1)
    previous = np.maximum(np.arange(LEVELS) - 1, 0)
    sizes = (np.zeros((LEVELS, 2, 2)), np.full(LEVELS, SAMPLES), np.zeros((LEVELS, TIMES, 2, 2)))
    return Sweep("model", command, previous, *sizes)


def with_noise(sweep: Sweep, seed: int) -> Sweep:
    """White noise on every sample."""
    rng = np.random.default_rng(seed)
    return dataclasses.replace(
        sweep,
        settled=sweep.settled + rng.normal(size=sweep.settled.shape) * NOISE / np.sqrt(SAMPLES),
        transient=sweep.transient + rng.normal(size=sweep.transient.shape) * NOISE,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the draws")
    seeds, draws = (1, 5) if parser.parse_args().quick else (10, 50)
    vectors, silent = truth(), lambda *_: None
    with jax.enable_x64(True):
        identifier = identification.Identifier(IdentificationConfig(), blank(), silent)
        clean = simulate(identifier, vectors)

        worst = np.zeros(len(NAMES))
        for seed in range(seeds):
            identifier.config = IdentificationConfig(seed=seed)
            found = np.stack([fit.vector for fit in identifier.run(clean, silent).fits])
            worst = np.maximum(worst, np.abs(found - vectors).max(axis=0))
        print(f"Without noise, worst of {seeds} draws of starts:")
        for name, error, value in zip(NAMES, worst, vectors.min(axis=0), strict=True):
            shown = f"{np.rad2deg(error):.1e} deg" if name.startswith("default") else f"{error / value:.1e} relative"
            print(f"  {name:24}{shown}")

        within, singular = [], {}
        for transients in (True, False):
            inside = []
            for seed in range(draws):
                identifier.config = IdentificationConfig(draws=32, steps=15, transients=transients)
                result = identifier.run(with_noise(clean, seed), silent)
                for fit, vector in zip(result.fits, vectors, strict=True):
                    inside += list(np.abs(fit.vector - vector) < 2 * fit.standard_errors)
                singular[transients] = [[1 / d.standard_error for d in fit.directions] for fit in result.fits]
            within.append(np.mean(inside))
        print(f"With 0.5 deg of noise, {draws} draws: within two standard errors {within[0]:.1%} of the parameters")
        print(f"  (from settled angles alone: {within[1]:.1%})")
        for side, still, moving in zip(SIDES, singular[False], singular[True], strict=True):
            print(
                f"Singular values, {side} (1 is what is known of robots beforehand; each above 1 is a dimension known):"
            )
            print(f"  settled angles  {', '.join(f'{value:.3g}' for value in still)}")
            print(f"  and transients  {', '.join(f'{value:.3g}' for value in moving)}")


if __name__ == "__main__":
    main()
