"""Identification of BALLU's legs: physics as in C MuJoCo, exact derivatives, and recovery of known parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.distance import directed_hausdorff as scipy_directed_hausdorff

from ballu_mjx.ballu.actuators import ActuatorParameters, actuator_fields
from ballu_mjx.ballu.curves import curve_distances, directed_hausdorff, polynomial_curve
from ballu_mjx.ballu.leg_fit import Identifier
from ballu_mjx.ballu.leg_parameters import (
    ALL_PARAMETERS,
    DYNAMICS_PRIOR,
    LEG_PARAMETERS,
    NOMINAL_DYNAMICS,
    PAPER_PARAMETERS,
    RICHER_PARAMETERS,
    LegDynamics,
    ParameterTransform,
    dynamics_coordinates,
    largest_motor_gain,
    nominal_leg,
)
from ballu_mjx.ballu.leg_residuals import CompiledLeg, LegData, leg_data
from ballu_mjx.ballu.leg_uncertainty import analyse_legs
from ballu_mjx.ballu.model import SIDES, load_suspended_leg, suspend
from ballu_mjx.ballu.sweep import Sweep
from ballu_mjx.common.errors import InputError
from ballu_mjx.robots.model import assets, set_fields

pytestmark = pytest.mark.optimized

COMMANDS = np.linspace(0, 1, 20)
HOLD = 20
"""Number of samples for which each command is held."""
LONG_HOLD = 40
"""The same, for a sweep that determines the parameters well."""
HIGH, LOW = [1.3, 1.2, 0.05, 0.05, 0.9, 4e-4, -0.1, 0.8, 0.03], [0.8, 0.8, -0.06, -0.03, 0.55, 1e-3, 0.05, 1.3, -0.03]
"""Changes of the nominal parameters: offsets for angles, slack and travel, and factors for the others.

The servo of HIGH never saturates. That of LOW does.
"""
DYNAMICS = LegDynamics(
    delay=0.043, motor_friction=3e-3, knee_friction=8e-4, backlash=np.deg2rad(2.0), lag=0.02, knee_damping=4e-3
)


@pytest.fixture(scope="module", autouse=True)
def double() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


NOT_IN_PAPER = ["torque_limit", "cable_slack", "motor_travel", "cable_stiffness", "knee_spring_reference"]
"""Parameters of a leg that are not among the paper's four."""
SPACE = ParameterTransform(nominal_leg(), ALL_PARAMETERS)
LARGEST_GAIN = largest_motor_gain(load_suspended_leg(SIDES[0]))


def vector(change: list[float]) -> np.ndarray:
    return np.where(SPACE.relative, SPACE.nominal * np.array(change), SPACE.nominal + np.array(change))


def blank(hold: int = HOLD) -> Sweep:
    """Return a sweep of zeros. Nearly all tests use sweeps of the same sizes, and so share two compiled programs."""
    times = len(COMMANDS) * hold
    return Sweep(
        robot="model",
        command=np.stack([COMMANDS, COMMANDS], 1),
        settled=np.zeros((20, 2, 2)),
        drift=np.zeros((20, 2, 2)),
        samples=np.full(20, 50),
        motion=np.zeros((times, 2, 2)),
        commanded=np.repeat(COMMANDS, hold)[:, None].repeat(2, axis=1),
        hold=np.repeat(np.arange(20), hold),
        begins=np.arange(times) == 0,
    )


DATA = leg_data(blank())


@pytest.fixture(scope="module")
def identifier() -> Identifier:
    return Identifier(ALL_PARAMETERS, blank(), lambda *_: None)


@pytest.fixture(scope="module")
def physics(identifier: Identifier) -> CompiledLeg:
    return identifier.physics


def coordinates(*vectors: np.ndarray) -> np.ndarray:
    return np.stack([SPACE.coordinates(vector) for vector in vectors])


def rest(physics: CompiledLeg, *vectors: np.ndarray) -> np.ndarray:
    """Return the positions at which the leg rests under COMMANDS."""
    return physics.settled(coordinates(*vectors), np.tile(COMMANDS, (len(vectors), 1)))[0]


def with_dynamics(*vectors: np.ndarray) -> np.ndarray:
    """Return coordinates of a left and a right leg, both with the dynamics DYNAMICS."""
    return np.concatenate([coordinates(*vectors), np.tile(dynamics_coordinates(DYNAMICS), (2, 1))], 1)


def moving(physics: CompiledLeg, *vectors: np.ndarray, data: LegData = DATA) -> np.ndarray:
    """Return the motion of a left and a right leg."""
    return physics.motion(with_dynamics(*vectors), data.commanded)[0][:, data.counts]


def c_model(side: str, values: np.ndarray) -> mujoco.MjModel:
    """Return the suspended robot's model for C MuJoCo, with one leg's parameters on both sides."""
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    suspend(spec)
    model = spec.compile()
    pairs = {name: jnp.array([value, value]) for name, value in zip(LEG_PARAMETERS, values, strict=True)}
    set_fields(model, actuator_fields(model, ActuatorParameters(**pairs)))
    model.opt.iterations, model.opt.tolerance = 50, 1e-12
    return model


@pytest.mark.slow
@pytest.mark.parametrize("change", [HIGH, LOW])
@pytest.mark.parametrize("side", SIDES)
def test_settled_angles_are_the_angles_at_rest_in_c_mujoco(
    physics: CompiledLeg, change: list[float], side: str
) -> None:
    model = c_model(side, vector(change))
    model.dof_damping[:] = np.maximum(model.dof_damping, 0.05)  # comes to rest earlier, at the same angles
    data = mujoco.MjData(model)
    expected = []
    for command in COMMANDS[::4]:
        data.ctrl[:] = command
        mujoco.mj_step(model, data, 1500)
        expected.append([data.joint(f"{kind}_{side}").qpos[0] for kind in ("motor", "knee")])
    ours = rest(physics, vector(change))[0, ::4][:, physics.leg.angles]
    assert np.rad2deg(ours) == pytest.approx(np.rad2deg(expected), abs=0.02)


@pytest.mark.slow
def test_motion_matches_c_mujoco_with_friction_backlash_lag_and_delay(physics: CompiledLeg) -> None:
    values = vector(LOW)
    paths = moving(physics, vector(HIGH), values)[1]
    model = c_model("left", values)
    for joint, friction in (("motor_left", DYNAMICS.motor_friction), ("knee_left", DYNAMICS.knee_friction)):
        model.dof_frictionloss[model.joint(joint).dofadr] = friction
    data = mujoco.MjData(model)
    for name, angle in (("motor_left", values[2]), ("knee_left", values[3])):
        data.joint(name).qpos[:] = angle
    model.dof_damping[model.joint("knee_left").dofadr] = DYNAMICS.knee_damping
    half, lagged, target, expected = DYNAMICS.backlash / np.pi / values[6], 0.0, 0.0, []
    gain = model.opt.timestep / (DYNAMICS.lag + model.opt.timestep)
    mujoco.mj_step(model, data, 200)
    for command in np.repeat(COMMANDS, HOLD):
        lagged += gain * (command - lagged)
        target = np.clip(target, lagged - half, lagged + half)
        expected.append([data.joint(f"{kind}_left").qpos[0] for kind in ("motor", "knee")])
        data.ctrl[:] = target
        mujoco.mj_step(model, data)
    times = model.opt.timestep * np.arange(len(paths))
    delayed = np.stack([np.interp(times - DYNAMICS.delay, times, column) for column in np.array(expected).T], axis=1)
    difference = np.rad2deg(np.abs(paths - delayed))
    # MJX's solver stops earlier. This is visible for a short time after a joint sticks or slips.
    assert np.sqrt(np.mean(difference**2)) < 0.05 and difference.max() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("change", [HIGH, LOW])
def test_derivatives_of_settled_angles_match_finite_differences(physics: CompiledLeg, change: list[float]) -> None:
    """At low commands, the cable is slack and the knee at its stop. At high ones, it is taut. LOW's servo saturates."""
    y, command, angles = coordinates(vector(change))[0], COMMANDS[None], physics.leg.angles
    value, derivative = (x[0][:, angles] for x in physics.settled(y[None], command))
    assert value[0, 1] < vector(change)[3] and value[-1, 1] > vector(change)[3] + 0.2, (
        "the knee must go from its stop to far away from it"
    )
    saturates = np.abs(derivative[-1, :, LEG_PARAMETERS.index("torque_limit")]).max() > 0.1
    assert saturates == (change is LOW)
    step = 1e-6
    steps = step * np.eye(len(y))
    up, down = (physics.settled(y + sign * steps, np.tile(command, (len(y), 1)))[0][:, :, angles] for sign in (1, -1))
    difference = np.moveaxis((up - down) / (2 * step), 0, -1)
    for index, name in enumerate(LEG_PARAMETERS):
        scale = np.abs(difference[..., index]).max()
        assert derivative[..., index] == pytest.approx(difference[..., index], abs=1e-4 * scale + 1e-6), name


@pytest.mark.slow
def test_derivatives_of_the_motion_match_finite_differences(physics: CompiledLeg) -> None:
    """The left leg's servo never saturates. The right leg's servo does."""
    y = with_dynamics(vector(HIGH), vector(LOW))
    derivatives = physics.motion(y, DATA.commanded)[1]
    assert np.all(np.isfinite(derivatives))
    step = 1e-6
    for index in range(y.shape[1]):
        change = step * (np.arange(y.shape[1]) == index)
        up, down = (physics.motion(y + sign * change, DATA.commanded)[0] for sign in (1, -1))
        difference = (up - down) / (2 * step)
        # The motion has a kink where a cable tightens or a knee leaves its stop. A few samples may therefore differ.
        differs = np.abs(derivatives[..., index] - difference) > 0.01 * np.abs(difference).max() + 1e-9
        assert differs.mean() < 0.02, index


@pytest.mark.parametrize(("factor", "stays"), [(1.9, True), (2.1, False)])
def test_a_free_servo_is_stable_up_to_twice_the_largest_gain(factor: float, stays: bool) -> None:
    values = nominal_leg()
    values[LEG_PARAMETERS.index("motor_gain")] = factor * LARGEST_GAIN
    values[LEG_PARAMETERS.index("torque_limit")] = 1e6
    model = c_model(SIDES[0], values)
    model.tendon_stiffness[:] = 0
    model.jnt_limited[:] = 0
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.5
    mujoco.mj_step(model, data, 300)
    reached = data.joint(f"motor_{SIDES[0]}").qpos[0]
    assert (abs(reached - np.pi / 4) < 0.01) == stays


@pytest.mark.slow
def test_motions_of_the_stiffest_servos_have_usable_derivatives(physics: CompiledLeg) -> None:
    """The servo of the right leg saturates. Derivatives grow to 1e20 and more at twice the largest gain."""
    gain, limit, cable = (LEG_PARAMETERS.index(name) for name in ("motor_gain", "torque_limit", "cable_stiffness"))
    strong = SPACE.nominal.copy()
    strong[gain], strong[cable] = 0.98 * LARGEST_GAIN, 2 * strong[cable]
    weak = strong.copy()
    weak[limit] *= 0.5
    derivatives = physics.motion(with_dynamics(strong, weak), DATA.commanded)[1]
    assert np.abs(derivatives).max() < 100.0


@pytest.mark.slow
def test_an_unstable_motion_turns_searches_back_and_is_no_result(
    noiseless: Sweep, identifier: Identifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    residuals = identifier.residuals(noiseless)
    motion = residuals.physics.motion

    def amplified(coordinates: np.ndarray, commanded: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        paths, jacobians = motion(coordinates, commanded)
        return paths, jacobians * np.array([1.0, 1e12])[:, None, None, None]

    y = with_dynamics(*TRUTH)
    kept = np.ones(y.shape[1], bool)
    plain = residuals(y, kept)
    monkeypatch.setattr(residuals.physics, "motion", amplified)
    values, jacobians = residuals(y, kept)
    np.testing.assert_array_equal(values[0], plain[0][0])
    assert np.sum(values[1] ** 2) > 1e3 * np.sum(values[0] ** 2)
    assert not jacobians[1].any() and jacobians[0].any()
    with pytest.raises(InputError, match="right leg.*--no-motion"):
        analyse_legs(residuals, y, kept, residuals.spread(y))


@pytest.mark.slow
def test_a_parameter_at_its_bound_has_the_standard_error_of_its_prior(noiseless: Sweep, identifier: Identifier) -> None:
    residuals, gain = identifier.residuals(noiseless), LEG_PARAMETERS.index("motor_gain")
    y = with_dynamics(*TRUTH)
    y[0, gain] = 50.0  # the logistic function is flat there
    spread = np.full(residuals(y, np.ones(y.shape[1], bool))[0].shape, 0.005)
    analyses = analyse_legs(residuals, y, np.ones(y.shape[1], bool), spread)
    for analysis in analyses:
        assert np.isfinite(analysis.standard_errors).all() and np.isfinite(analysis.correlations).all()
    assert analyses[0].standard_errors[gain] == pytest.approx(SPACE.prior[gain] * LARGEST_GAIN, rel=0.01)


@pytest.mark.slow
def test_all_legs_within_the_bounds_come_to_rest(physics: CompiledLeg) -> None:
    draws = SPACE.draw(1, 40)
    qpos, _ = physics.settled(draws, np.tile(COMMANDS, (len(draws), 1)))
    torque = jax.jit(jax.vmap(lambda q, y, c: physics.leg.residual_torque(q, SPACE.vector(y), c), (0, None, 0)))
    torques = np.array([torque(q, jnp.asarray(y), COMMANDS) for q, y in zip(qpos, draws, strict=True)])
    residual = np.abs(torques).max(axis=-1)
    # Some solutions jump back and forth across a kink in the last iterations.
    assert np.mean(residual > 1e-6) < 0.05
    assert np.max(residual) < 5e-3, "unbalanced torque (N m)"


def test_directed_hausdorff_distance_and_gradient_match_scipy() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(30, 2)), rng.normal(size=(20, 2))
    distance, i, j = scipy_directed_hausdorff(a, b)
    assert float(directed_hausdorff(jnp.asarray(a), jnp.asarray(b))) == pytest.approx(distance, abs=1e-12)
    gradient = np.asarray(jax.grad(lambda x: directed_hausdorff(x, jnp.asarray(b)))(jnp.asarray(a)))
    expected = np.zeros_like(a)
    expected[i] = (a[i] - b[j]) / distance
    assert gradient == pytest.approx(expected, abs=1e-12)
    same = jax.value_and_grad(lambda x: directed_hausdorff(x, jnp.asarray(a)))(jnp.asarray(a))
    assert float(same[0]) == 0 and np.all(np.asarray(same[1]) == 0)


def test_curves_match_numpys_polynomial_fit() -> None:
    rng = np.random.default_rng(0)
    angles = rng.normal(size=20)
    expected = np.polynomial.Polynomial.fit(COMMANDS, angles, 5)(np.linspace(0, 1, 200)) / (np.pi / 2)
    curve = np.asarray(polynomial_curve(COMMANDS, jnp.asarray(angles), 5))
    assert curve[:, 1] == pytest.approx(expected, abs=1e-9)
    assert curve[:, 0] == pytest.approx(np.linspace(0, 1, 200))


def test_curve_distances_are_directed() -> None:
    measured = jnp.asarray(np.stack([COMMANDS, COMMANDS], 1))
    simulated = measured.at[-1, 0].add(0.5)
    to_measured, to_simulated = np.asarray(curve_distances(COMMANDS, simulated, measured, 7))
    assert to_measured[0] > to_simulated[0] > 0.01, (
        "the outlier is far from the measured curve, which is near the outlier's neighbours"
    )
    assert to_measured[1] == to_simulated[1] == 0


def test_coordinates_map_to_values_within_the_bounds_and_back() -> None:
    for draw in SPACE.draw(3, 5):
        values = np.asarray(SPACE.vector(jnp.asarray(draw)))
        assert np.all((SPACE.lower < values) & (values < SPACE.upper))
        assert SPACE.coordinates(values) == pytest.approx(draw, abs=1e-9)
    assert np.asarray(SPACE.vector(jnp.asarray(SPACE.draw(0, 1)[0]))) == pytest.approx(SPACE.nominal)
    paper = ParameterTransform(nominal_leg(), PAPER_PARAMETERS)
    held = np.asarray(paper.vector(jnp.asarray(paper.draw(0, 1)[1]))) == paper.nominal
    assert [name for name, same in zip(LEG_PARAMETERS, held, strict=True) if same] == NOT_IN_PAPER


TRUTH = (
    vector([1.3, 0.7, 0.05, 0.06, 0.75, 1.2e-3, -0.15, 0.8, 0.03]),
    vector([0.8, 1.2, -0.08, -0.03, 0.6, 2e-4, 0.0, 1.3, 0.0]),
)


def sweep_of(physics: CompiledLeg, *vectors: np.ndarray, hold: int = HOLD) -> Sweep:
    """Return a sweep simulated by the model itself. Its motion includes dry friction, its settled angles do not."""
    settled = np.moveaxis(rest(physics, *vectors)[:, :, physics.leg.angles], 0, -1)
    motion = np.moveaxis(moving(physics, *vectors, data=leg_data(blank(hold))), 0, -1)
    return dataclasses.replace(blank(hold), settled=settled, motion=motion)


@pytest.fixture(scope="module")
def noiseless(physics: CompiledLeg) -> Sweep:
    return sweep_of(physics, *TRUTH)


def noisy(sweep: Sweep, seed: int, noise: float = np.deg2rad(0.5)) -> Sweep:
    """Return the sweep with white noise (standard deviation in rad) on every sample."""
    rng = np.random.default_rng(seed)
    return dataclasses.replace(
        sweep,
        settled=sweep.settled + rng.normal(size=sweep.settled.shape) * noise / np.sqrt(50),
        motion=sweep.motion + rng.normal(size=sweep.motion.shape) * noise,
    )


@pytest.mark.slow
def test_known_parameters_are_recovered(noiseless: Sweep, identifier: Identifier) -> None:
    identifier.config = dataclasses.replace(ALL_PARAMETERS, steps=20)
    for fit, truth in zip(identifier.run(noiseless, lambda *_: None).fits, TRUTH, strict=True):
        assert fit.residual < np.deg2rad(0.05)
        for index, name in enumerate(LEG_PARAMETERS):
            exact = 0.01 * truth[index] if SPACE.relative[index] else SPACE.prior[index] / 30
            assert fit.vector[index] == pytest.approx(truth[index], abs=exact), name
        assert fit.dynamics is not None
        assert list(fit.dynamics) == pytest.approx(list(DYNAMICS), rel=0.02)
        assert not fit.open_directions


@pytest.mark.slow
def test_richer_model_is_selected_for_a_robot_that_requires_it(physics: CompiledLeg, identifier: Identifier) -> None:
    """The springs then stay at their nominal stiffness. The other parameters are identified with this stiffness."""
    spring, travel = (LEG_PARAMETERS.index(name) for name in ("knee_spring_stiffness", "motor_travel"))
    truths = [np.where(np.arange(len(truth)) == spring, SPACE.nominal, truth) for truth in TRUTH]
    identifier.config = dataclasses.replace(ALL_PARAMETERS, nominal_springs=True, draws=32, steps=15)
    found = identifier.run(noisy(sweep_of(physics, *truths), 0), lambda *_: None)
    assert found.selection is not None and found.selection.richer
    for fit, truth in zip(found.fits, truths, strict=True):
        assert fit.vector[spring] == pytest.approx(SPACE.nominal[spring], rel=1e-9)
        assert abs(fit.vector[travel] - truth[travel]) < 3 * fit.standard_errors[travel]
        assert fit.residual < np.deg2rad(0.55)


@pytest.mark.slow
def test_simpler_model_is_kept_for_a_robot_that_it_describes(physics: CompiledLeg, identifier: Identifier) -> None:
    """The springs are then as accurate as in the simpler model alone. Standard errors are those of the richer model."""
    plain = [np.where(np.isin(LEG_PARAMETERS, RICHER_PARAMETERS), SPACE.nominal, truth) for truth in TRUTH]
    dynamics = dynamics_coordinates(DYNAMICS._replace(lag=1e-4, knee_damping=NOMINAL_DYNAMICS["knee_damping"]))
    y = np.concatenate([coordinates(*plain), np.tile(dynamics, (2, 1))], 1)
    motion = physics.motion(y, DATA.commanded)[0][:, DATA.counts]
    settled = rest(physics, *plain)[:, :, physics.leg.angles]
    sweep = dataclasses.replace(blank(), settled=np.moveaxis(settled, 0, -1), motion=np.moveaxis(motion, 0, -1))
    identifier.config = dataclasses.replace(ALL_PARAMETERS, draws=32, steps=15)
    found = identifier.run(noisy(sweep, 0), lambda *_: None)
    assert found.selection is not None and not found.selection.richer
    assert found.selection.statistic > 0 and found.selection.effect > 0, (
        "the richer search starts from the simpler solution, among others"
    )
    parameters = found.parameters
    assert all(getattr(parameters, name) is None for name in RICHER_PARAMETERS) and parameters.backlash is not None
    spring, travel = (LEG_PARAMETERS.index(name) for name in ("knee_spring_stiffness", "motor_travel"))
    derivatives = physics.motion(y, DATA.commanded)[1][:, DATA.counts].reshape(2, -1, y.shape[1])
    simpler = ~np.isin([*LEG_PARAMETERS, *LegDynamics._fields], RICHER_PARAMETERS)
    for fit, truth, leg_coordinates, derivative in zip(
        found.fits, plain, y, derivatives[..., simpler] / np.deg2rad(0.5), strict=True
    ):
        moved = np.diag(np.asarray(jax.jacfwd(SPACE.vector)(jnp.asarray(leg_coordinates[: len(truth)]))))
        priors = np.concatenate([SPACE.units(truth) / moved, DYNAMICS_PRIOR])[simpler]
        covariance = np.linalg.inv(derivative.T @ derivative + np.diag(priors**-2))
        error = float(np.sqrt(covariance[spring, spring]) * moved[spring])
        assert abs(fit.vector[spring] - truth[spring]) < 3 * error
        assert error < fit.standard_errors[spring], "the standard error must be that of the richer model"
        assert np.all(np.abs(fit.vector - truth) < 3 * fit.standard_errors + 1e-9)
        assert fit.standard_errors[travel] > 0, "the travel is held, but it has a standard error"


@pytest.mark.slow
def test_standard_errors_cover_the_true_parameters() -> None:
    """With noise of 0.5 deg and spring tolerances as makers quote, 90 % of estimates are within two standard errors."""
    spring = np.arange(len(SPACE.nominal)) == LEG_PARAMETERS.index("knee_spring_stiffness")
    truths = [np.where(spring, SPACE.nominal * factor, truth) for factor, truth in zip((1.1, 0.92), TRUTH, strict=True)]
    config = dataclasses.replace(ALL_PARAMETERS, draws=32, steps=12)
    identifier = Identifier(config, blank(LONG_HOLD), lambda *_: None)
    clean = sweep_of(identifier.physics, *truths, hold=LONG_HOLD)
    within = []
    for seed in range(2):
        result = identifier.run(noisy(clean, seed), lambda *_: None)
        for fit, truth in zip(result.fits, truths, strict=True):
            within += list(np.abs(fit.vector - truth) < 2 * fit.standard_errors)
    assert np.mean(within) > 0.85


@pytest.mark.slow
def test_only_the_motion_separates_friction_and_backlash_from_motor_zero(
    noiseless: Sweep, identifier: Identifier
) -> None:
    """Backlash and friction stop a motor early, as another angle at command 0 would. Its motion shows the cause."""
    ends = noiseless.motion.reshape(len(COMMANDS), HOLD, 2, 2)[:, -20:].mean(axis=1)
    sweep = noisy(dataclasses.replace(noiseless, settled=ends), 0)
    zero_error = {}
    for motion in (True, False):
        identifier.config = dataclasses.replace(ALL_PARAMETERS, motion=motion, draws=32, steps=15)
        fits = identifier.run(sweep, lambda *_: None).fits
        zero = LEG_PARAMETERS.index("default_motor_angle")
        zero_error[motion] = [abs(fit.vector[zero] - truth[zero]) for fit, truth in zip(fits, TRUTH, strict=True)]
    assert max(zero_error[True]) < np.deg2rad(0.3) < min(zero_error[False])


@pytest.mark.slow
def test_open_directions_are_reported_and_held_near_nominal(physics: CompiledLeg, identifier: Identifier) -> None:
    """Settled angles show no torque limit of servos that never saturate, although the motion does.

    They do not separate the knee spring's reference angle from its stiffness either.
    """
    strong = [vector(HIGH), vector(HIGH)]
    settled = np.moveaxis(rest(physics, *strong)[:, :, physics.leg.angles], 0, -1)
    sweep = dataclasses.replace(blank(), settled=settled)
    identifier.config = dataclasses.replace(ALL_PARAMETERS, motion=False, draws=16, steps=12)
    limit, spring, reference = (
        LEG_PARAMETERS.index(name) for name in ("torque_limit", "knee_spring_stiffness", "knee_spring_reference")
    )
    for fit in identifier.run(noisy(sweep, 0, np.deg2rad(0.1)), lambda *_: None).fits:
        trade, alone = fit.open_directions
        assert np.hypot(trade.weights[spring], trade.weights[reference]) > 0.95
        assert min(abs(trade.weights[spring]), abs(trade.weights[reference])) > 0.3
        assert alone.weights[limit] > 0.95
        nominal = nominal_leg()[limit]
        assert fit.vector[limit] == pytest.approx(nominal, rel=0.2)
        # The other parameters are identified nevertheless.
        for index in set(range(len(LEG_PARAMETERS))) - {limit, spring, reference}:
            assert fit.vector[index] == pytest.approx(strong[0][index], rel=0.05, abs=np.deg2rad(0.5)), LEG_PARAMETERS[
                index
            ]


@pytest.mark.slow
def test_hausdorff_fit_has_a_lower_paper_objective_than_pointwise_fit(noiseless: Sweep, identifier: Identifier) -> None:
    sweep = dataclasses.replace(
        noiseless, settled=noiseless.settled + np.random.default_rng(0).normal(size=(20, 2, 2)) * np.deg2rad(1.0)
    )
    distances = {}
    for objective in ("pointwise", "hausdorff"):
        identifier.config = dataclasses.replace(ALL_PARAMETERS, objective=objective, motion=False, draws=16, steps=15)
        result = identifier.run(sweep, lambda *_: None)
        assert result.config.objective == objective
        distances[objective] = sum(
            float(np.sum(curve_distances(COMMANDS, result.settled[..., leg], sweep.settled[..., leg], 7)[0]))
            for leg in range(2)
        )
    assert distances["hausdorff"] < 0.98 * distances["pointwise"]
