"""Identification of the actuators from a suspended sweep (paper, section "System Identification", Algorithm 1).

The legs are suspended from a fixed base. Each leg is therefore identified independently of the other, and both are
fitted at once. The search begins with settled angles. The whole motion then decides. Its simulation includes delay,
backlash and dry friction (`LegDynamics`), under which a leg is never quite at rest. Both kinds of residuals are
computed in `ballu.leg_residuals`.

All functions compute in double precision and must be called inside `jax.enable_x64(True)`. Only `identify_legs` does
this itself. A leg's parameters are a vector in the order of `LEG_PARAMETERS`. A pair of angles is (motor, knee).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ballu_mjx.ballu.curves import curve_distances
from ballu_mjx.ballu.leg_model_selection import select_model
from ballu_mjx.ballu.leg_parameters import (
    DEGREE,
    LEG_PARAMETERS,
    RICHER_PARAMETERS,
    SIMPLE_DYNAMICS,
    IdentificationConfig,
    LegDynamics,
    ParameterTransform,
    check_identification_config,
    dynamics_coordinates,
    leg_dynamics,
    nominal_leg,
)
from ballu_mjx.ballu.leg_residuals import CompiledLeg, LegResiduals, leg_data
from ballu_mjx.ballu.leg_results import Fit, Identification
from ballu_mjx.ballu.leg_uncertainty import analyse_legs
from ballu_mjx.ballu.model import SIDES
from ballu_mjx.ballu.sweep import Sweep
from ballu_mjx.identification.batched_solver import BatchedSolver, Evaluate

_PATIENCE = 4
"""Number of successive iterations without enough gain after which a search ends."""
_LEAST_GAIN = 1e-5
"""Smallest gain of an iteration, as a fraction of the loss. With thousands of samples, 1e-4 is 0.4 in chi-squared."""
_FIRST_DAMPING = 5 * DEGREE
"""Unit of angles (rad) in a search, whose first Levenberg damping is 1 in this unit. In radians, weak directions would
stay damped for dozens of iterations."""
_INSIDE = 4.0
"""Largest magnitude of a coordinate at the start of a search by the motion. The parameter is then 2 % of the interval
away from a bound. If settled angles put the slack at its bound, the derivative is almost 0, and it would stay there."""
_SHORT = 6
"""Number of iterations of two short searches, of which the better one is continued."""
Report = Callable[[str, int, int, float], None]
"""Progress function, called with (stage, iteration, largest number of iterations, lowest loss of all searches)."""


def identify_legs(
    sweep: Sweep, config: IdentificationConfig | None = None, report: Report | None = None
) -> Identification:
    """Fit both legs' parameters to a sweep.

    1. Settled angles alone are fitted from several starts in parallel, the best of many draws. From a single start, the
       search may end in a local minimum, for example with a servo that never saturates.
    2. The whole motion is fitted, starting from the solution whose motion is nearest to the measured one.
       Steps 1 and 2 are done twice: with the `RICHER_PARAMETERS` held at their nominal values, and with all
       parameters. The second search has the first one's solution among its starts. The richer model is kept if it
       explains enough of what the simpler one leaves (`Selection`).
    3. In the richer model, the springs are held at their nominal stiffness, which sets the scale of all forces
       (`nominal_springs`).
    4. With the richer model, or if the data leave directions open, the fit continues with the priors. Parameters that a
       sweep hardly shows then stay near their nominal values, and the dynamics near `INITIAL_DYNAMICS`.
    5. With `objective="hausdorff"`, the paper's distance between curves is minimized from there.

    **Raises** `InputError` from `check_identification_config`.
    """
    config = config or IdentificationConfig()
    check_identification_config(config)
    report = report or (lambda stage, iteration, steps, value: None)
    with jax.enable_x64(True):
        return Identifier(config, sweep, report).run(sweep, report)


def _levenberg_marquardt() -> optx.LevenbergMarquardt:
    """Return a Levenberg-Marquardt solver that divides its damping by 10 after a step with 90 % of the predicted gain.

    The default is a division by 3.5 after 99 %, which steps along a curved valley hardly ever reach.
    """
    solver = optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5)
    region = optx.ClassicalTrustRegion(high_cutoff=0.9, high_constant=10.0)
    return eqx.tree_at(lambda solver: solver.search, solver, region)


class Identifier:
    """The stages of `identify_legs`, compiled once for sweeps of the same sizes."""

    def __init__(self, config: IdentificationConfig, sweep: Sweep, report: Report) -> None:
        self.config = config
        data = leg_data(sweep)
        starts = min(config.starts, config.draws + 1)
        report("compiling", 0, 1, float("nan"))
        self.space = ParameterTransform(nominal_leg(), config)
        self.physics = CompiledLeg(self.space, starts * len(SIDES), data, motion=config.motion)
        report("compiling", 1, 1, float("nan"))
        self._starts, self._size = starts, int(self.space.free.sum())
        self._squares = BatchedSolver(_levenberg_marquardt(), _LEAST_GAIN)
        self._shape = BatchedSolver(optx.LBFGS(rtol=1e-5, atol=1e-5))

        def objective(angles: Array, command: Array, measured: Array) -> Array:
            return jnp.sum(curve_distances(command, angles, measured, config.degree)[0])

        gradient = jax.value_and_grad(objective)
        self._curve_gradients = jax.jit(jax.vmap(lambda command, angles, measured: gradient(angles, command, measured)))

    def run(self, sweep: Sweep, report: Report) -> Identification:
        """Return the identification of both legs from a sweep of the compiled sizes."""
        config, size, residuals = self.config, self._size, self.residuals(sweep)
        data = residuals.data
        legs = np.arange(len(SIDES))
        free = np.array(LEG_PARAMETERS)[self.space.free]
        further = np.isin([*free, *(LegDynamics._fields if config.motion else ())], RICHER_PARAMETERS)
        every = np.ones_like(further)
        kept, selection = every, None
        if further.any():
            simpler, ends = self._search(residuals, ~further, report)
            rich = every.copy()
            rich[list(free).index("knee_spring_stiffness")] = not config.nominal_springs
            coordinates, richer_ends = self._search(residuals, rich, report, simpler)
            spread = residuals.spread(coordinates)
            sizes = coordinates.size, int(rich.sum()) - int((~further).sum())
            after = residuals(coordinates, every)[0]
            selection = select_model(residuals(simpler, every)[0], after, spread, *sizes)
            if selection.richer:
                # The simpler search may have ended in a local minimum that the richer one left.
                again = np.where(further, simpler, coordinates)
                again = self._follow(again, residuals, ~further, report, config.steps)
                simpler = self._nearest([simpler, again], residuals, ~further)
                selection = select_model(residuals(simpler, every)[0], after, spread, *sizes)
            if selection.richer:
                kept, ends = rich, richer_ends
            else:
                kept, coordinates = ~further, simpler
        else:
            coordinates, ends = self._search(residuals, every, report)
            spread = residuals.spread(coordinates)
        leg = np.repeat(legs, self._starts)
        ended = np.sum(residuals.settled(ends, leg, kept)[0] ** 2, axis=1).reshape(len(legs), -1)
        analyses = analyse_legs(residuals, coordinates, kept, spread)
        if kept[further].any() or any(d.standard_error > 1 for each in analyses for d in each.directions):
            coordinates, _ = self._squares(
                lambda y: residuals.with_priors(y, kept, spread),
                coordinates,
                2 * config.steps,  # more, for the weakest directions, which the data alone left open
                partial(report, "priors"),
                _PATIENCE,
            )
            analyses = analyse_legs(residuals, coordinates, kept, spread)
        if config.objective == "hausdorff":
            # Start from the end of every search: a maximum over points, summed over joints, has even more local minima.
            starts = np.concatenate([coordinates[:, None, :size], ends.reshape(len(legs), -1, size)[:, 1:]], axis=1)
            shaped, distances = self._shape(
                lambda y: residuals.curve_distances(y, leg, kept),
                starts.reshape(-1, size),
                config.steps,
                partial(report, "curves"),
            )
            best = np.argmin(distances.reshape(len(legs), -1), axis=1)
            shaped = shaped.reshape(len(legs), -1, size)[legs, best]
            coordinates = np.concatenate([shaped, coordinates[:, size:]], axis=1)
            analyses = analyse_legs(residuals, coordinates, kept, spread)

        before = np.tile(self.space.coordinates(self.space.nominal), (len(legs), 1))
        settled = [residuals.angles(y, data.command)[0] for y in (coordinates[:, :size], before)]
        fits = [
            Fit(
                vector=np.asarray(self.space.vector(jnp.asarray(coordinates[leg, :size]))),
                standard_errors=analysis.standard_errors,
                correlations=analysis.correlations,
                directions=analysis.directions,
                dynamics=LegDynamics(*map(float, leg_dynamics(jnp.asarray(coordinates[leg, size:]))))
                if config.motion
                else None,
                dynamics_errors=analysis.dynamics_errors,
                residual=analysis.scatter,
                losses=np.sort(ended[leg]),
            )
            for leg, analysis in enumerate(analyses)
        ]
        after, nominal = (np.moveaxis(angles, 0, -1) for angles in settled)
        moving = None
        if config.motion:
            paths, _ = self.physics.motion(coordinates, data.commanded)
            moving = sweep.means(np.moveaxis(paths[:, data.counts], 0, -1))
        return Identification(
            fits=(fits[0], fits[1]),
            settled=after,
            simulated=moving,
            nominal_settled=nominal,
            free=tuple(map(str, free)),
            fitted=tuple(map(str, free[kept[:size]])),
            selection=selection,
            config=config,
        )

    def residuals(self, sweep: Sweep) -> LegResiduals:
        """Return the residuals of both legs on a sweep of the compiled sizes."""
        data = leg_data(sweep)
        return LegResiduals(self.space, self.physics, data, self._curve_gradients, motion=self.config.motion)

    def _search(
        self,
        residuals: LegResiduals,
        kept: Bool[np.ndarray, " size"],
        report: Report,
        simpler: np.ndarray | None = None,
    ) -> tuple[Float[np.ndarray, "legs size"], Float[np.ndarray, "searches settled_size"]]:
        """Return the coordinates of both legs, and the ends of the searches by settled angles.

        Only the parameters in `kept` are fitted. The result is never worse than `simpler`, the solution of a model with
        fewer parameters.
        """
        config, size, legs = self.config, self._size, np.arange(len(SIDES))
        draws = self.space.draw(config.seed, config.draws)
        held = ~kept[:size]
        draws[:, held] = draws[0, held]
        coordinates, leg = np.tile(draws, (len(legs), 1)), np.repeat(legs, len(draws))
        report("draws", 0, 1, float("nan"))
        values, _ = residuals.settled(coordinates, leg, kept)
        losses = np.sum(values**2, axis=1).reshape(len(legs), -1)
        report("draws", 1, 1, float(losses.min()))
        starts = draws[np.argsort(losses, axis=1)[:, : self._starts]]
        if simpler is not None:
            simpler = np.where(kept, simpler, np.concatenate([draws[0], np.zeros(simpler.shape[1] - size)]))
            starts[:, -1] = simpler[:, :size]
        leg = np.repeat(legs, self._starts)
        ends, ended = self._least_squares(
            lambda y: residuals.settled(y, leg, kept),
            starts.reshape(-1, size),
            config.steps,
            partial(report, "settled angles"),
        )
        nearest = np.argmin(ended.reshape(len(legs), -1), axis=1)
        by_leg = ends.reshape(len(legs), -1, size)
        if not config.motion:
            return by_leg[legs, nearest], ends
        by_leg = np.clip(by_leg, -_INSIDE, _INSIDE)
        # Settled angles leave much open, and a servo far from its torque limit has no gradient with respect to it. The
        # motion therefore decides where to continue: at the end with the lowest loss now, or after a short search.
        first = np.where(kept[size:], 0.0, dynamics_coordinates(SIMPLE_DYNAMICS))
        candidates = [np.concatenate([y, np.tile(first, (len(legs), 1))], axis=1) for y in np.moveaxis(by_leg, 1, 0)]
        candidates += [] if simpler is None else [simpler]
        coordinates, by_settled = self._nearest(candidates, residuals, kept), np.stack(candidates)[nearest, legs]
        if not np.array_equal(coordinates, by_settled):
            both = [self._follow(y, residuals, kept, report, _SHORT) for y in (coordinates, by_settled)]
            coordinates = self._nearest(both, residuals, kept)
        ended = self._follow(coordinates, residuals, kept, report, config.steps)
        # Dry friction, lag and backlash can imitate one another, and a slack at its bound has no gradient. The search
        # is therefore repeated, with the dynamics back at their start and parameters at a bound back at nominal.
        inside = np.where(np.abs(ended[:, :size]) > _INSIDE, draws[0], ended[:, :size])
        again = np.concatenate([inside, np.tile(first, (len(legs), 1))], axis=1)
        return self._nearest([ended, self._follow(again, residuals, kept, report, config.steps)], residuals, kept), ends

    def _follow(
        self,
        start: Float[np.ndarray, "legs size"],
        residuals: LegResiduals,
        kept: Bool[np.ndarray, " size"],
        report: Report,
        steps: int,
    ) -> Float[np.ndarray, "legs size"]:
        """Return the end of a search by all residuals that begins at `start`."""
        stage = "motion" if self.config.motion else "settled angles"
        return self._least_squares(lambda y: residuals(y, kept), start, steps, partial(report, stage))[0]

    def _least_squares(
        self,
        evaluate: Evaluate,
        start: Float[np.ndarray, "n size"],
        steps: int,
        report: Callable[[int, int, float], None],
    ) -> tuple[Float[np.ndarray, "n size"], Float[np.ndarray, " n"]]:
        """Return the ends of searches that minimize sums of squared angles, and their losses (rad^2)."""

        def scaled(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            values, jacobians = evaluate(y)
            return values / _FIRST_DAMPING, jacobians / _FIRST_DAMPING

        ends, losses = self._squares(
            scaled,
            start,
            steps,
            lambda iteration, most, loss: report(iteration, most, loss * _FIRST_DAMPING**2),
            _PATIENCE,
        )
        return ends, losses * _FIRST_DAMPING**2

    def _nearest(
        self,
        candidates: Sequence[Float[np.ndarray, "legs size"]],
        residuals: LegResiduals,
        kept: Bool[np.ndarray, " size"],
    ) -> Float[np.ndarray, "legs size"]:
        """Return for each leg the candidate with the lowest sum of squares."""
        losses = [np.sum(residuals(y, kept)[0] ** 2, axis=1) for y in candidates]
        return np.stack(candidates)[np.argmin(losses, axis=0), np.arange(len(SIDES))]
