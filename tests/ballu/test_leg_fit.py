"""Identification: physics against C MuJoCo, derivatives against differences, known parameters recovered."""

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
    LEG_PARAMETERS,
    NOMINAL_DYNAMICS,
    PAPER_PARAMETERS,
    RICHER_PARAMETERS,
    LegDynamics,
    ParameterTransform,
    dynamics_coordinates,
    nominal_leg,
)
from ballu_mjx.ballu.leg_residuals import CompiledLeg, leg_data
from ballu_mjx.ballu.model import SIDES, suspend
from ballu_mjx.ballu.sweep import Sweep
from ballu_mjx.robots.model import assets, set_fields

pytestmark = pytest.mark.optimized

COMMANDS = np.linspace(0, 1, 20)
HOLD = 60
"""Times a command."""
HIGH, LOW = [1.3, 1.2, 0.05, 0.05, 0.9, 4e-4, -0.1, 0.8, 0.03], [0.8, 0.8, -0.06, -0.03, 0.55, 1e-3, 0.05, 1.3, -0.03]
"""Times the nominal parameters (angles, slack and travel: added): a leg that never saturates, and one that does."""
TRAIN = LegDynamics(
    delay=0.043, motor_friction=3e-3, knee_friction=8e-4, backlash=np.deg2rad(2.0), lag=0.02, knee_damping=4e-3
)


@pytest.fixture(scope="module", autouse=True)
def double() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


BEYOND = ["torque_limit", "cable_slack", "motor_travel", "cable_stiffness", "knee_spring_reference"]
"""What is not among the paper's eight."""
SPACE = ParameterTransform(nominal_leg(), ALL_PARAMETERS)


def vector(change: list[float]) -> np.ndarray:
    return np.where(SPACE.relative, SPACE.nominal * np.array(change), SPACE.nominal + np.array(change))


def blank() -> Sweep:
    """A sweep of the sizes that all tests here share, and so two compiled programs."""
    times = len(COMMANDS) * HOLD
    return Sweep(
        robot="model",
        command=np.stack([COMMANDS, COMMANDS], 1),
        settled=np.zeros((20, 2, 2)),
        drift=np.zeros((20, 2, 2)),
        samples=np.full(20, 50),
        motion=np.zeros((times, 2, 2)),
        hold=np.repeat(np.arange(20), HOLD),
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
    """Positions at rest under COMMANDS."""
    return physics.settled(coordinates(*vectors), np.tile(COMMANDS, (len(vectors), 1)))[0]


def with_dynamics(*vectors: np.ndarray) -> np.ndarray:
    """Coordinates of a left and a right leg and their dynamics, those of TRAIN."""
    return np.concatenate([coordinates(*vectors), np.tile(dynamics_coordinates(TRAIN), (2, 1))], 1)


def moving(physics: CompiledLeg, *vectors: np.ndarray) -> np.ndarray:
    """The motion of a left and a right leg."""
    return physics.motion(with_dynamics(*vectors), DATA.commanded)[0][:, DATA.counts]


def c_model(side: str, values: np.ndarray) -> mujoco.MjModel:
    """The whole robot in C, base held, feet in the air, with one leg's parameters on both sides."""
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    suspend(spec)
    model = spec.compile()
    pairs = {name: jnp.array([value, value]) for name, value in zip(LEG_PARAMETERS, values, strict=True)}
    set_fields(model, actuator_fields(model, ActuatorParameters(**pairs)))
    model.opt.iterations, model.opt.tolerance = 50, 1e-12
    return model


@pytest.mark.parametrize("change", [HIGH, LOW])
@pytest.mark.parametrize("side", SIDES)
def test_settled_angles_are_those_c_mujoco_comes_to_rest_at(
    physics: CompiledLeg, change: list[float], side: str
) -> None:
    model = c_model(side, vector(change))
    model.dof_damping[:] = np.maximum(model.dof_damping, 0.05)  # rests sooner, at the same place
    data = mujoco.MjData(model)
    expected = []
    for command in COMMANDS[::4]:
        data.ctrl[:] = command
        mujoco.mj_step(model, data, 1500)
        expected.append([data.joint(f"{kind}_{side}").qpos[0] for kind in ("motor", "knee")])
    ours = rest(physics, vector(change))[0, ::4][:, physics.leg.angles]
    assert np.rad2deg(ours) == pytest.approx(np.rad2deg(expected), abs=0.02)


def test_motion_is_that_of_c_mujoco_with_friction_play_and_delay(physics: CompiledLeg) -> None:
    values = vector(LOW)
    paths = moving(physics, vector(HIGH), values)[1]
    model = c_model("left", values)
    for joint, friction in (("motor_left", TRAIN.motor_friction), ("knee_left", TRAIN.knee_friction)):
        model.dof_frictionloss[model.joint(joint).dofadr] = friction
    data = mujoco.MjData(model)
    for name, angle in (("motor_left", values[2]), ("knee_left", values[3])):
        data.joint(name).qpos[:] = angle
    model.dof_damping[model.joint("knee_left").dofadr] = TRAIN.knee_damping
    half, lagged, target, expected = TRAIN.backlash / np.pi / values[6], 0.0, 0.0, []
    share = model.opt.timestep / (TRAIN.lag + model.opt.timestep)
    mujoco.mj_step(model, data, 200)
    for command in np.repeat(COMMANDS, HOLD):
        lagged += share * (command - lagged)
        target = np.clip(target, lagged - half, lagged + half)
        expected.append([data.joint(f"{kind}_left").qpos[0] for kind in ("motor", "knee")])
        data.ctrl[:] = target
        mujoco.mj_step(model, data)
    times = model.opt.timestep * np.arange(len(paths))
    late = np.stack([np.interp(times - TRAIN.delay, times, column) for column in np.array(expected).T], axis=1)
    difference = np.rad2deg(np.abs(paths - late))
    # MJX stops its solver sooner, and at a stick or slip that shows for a while.
    assert np.sqrt(np.mean(difference**2)) < 0.05 and difference.max() < 0.5


@pytest.mark.parametrize("change", [HIGH, LOW])
def test_derivatives_of_settled_angles_agree_with_differences(physics: CompiledLeg, change: list[float]) -> None:
    """Cable slack and knee at its stop at low commands, cable taut at high ones, servo saturated in the weak leg."""
    y, command, angles = coordinates(vector(change))[0], COMMANDS[None], physics.leg.angles
    value, slope = (x[0][:, angles] for x in physics.settled(y[None], command))
    assert value[0, 1] < vector(change)[3] and value[-1, 1] > vector(change)[3] + 0.2, "from the stop to far off it"
    saturates = np.abs(slope[-1, :, LEG_PARAMETERS.index("torque_limit")]).max() > 0.1
    assert saturates == (change is LOW)
    step = 1e-6
    steps = step * np.eye(len(y))
    up, down = (physics.settled(y + sign * steps, np.tile(command, (len(y), 1)))[0][:, :, angles] for sign in (1, -1))
    difference = np.moveaxis((up - down) / (2 * step), 0, -1)
    for index, name in enumerate(LEG_PARAMETERS):
        scale = np.abs(difference[..., index]).max()
        assert slope[..., index] == pytest.approx(difference[..., index], abs=1e-4 * scale + 1e-6), name


def test_derivatives_of_the_motion_agree_with_differences(physics: CompiledLeg) -> None:
    """Both legs at once: one that never saturates, and one that does."""
    y = with_dynamics(vector(HIGH), vector(LOW))
    slopes = physics.motion(y, DATA.commanded)[1]
    assert np.all(np.isfinite(slopes))
    step = 1e-6
    for index in range(y.shape[1]):
        change = step * (np.arange(y.shape[1]) == index)
        up, down = (physics.motion(y + sign * change, DATA.commanded)[0] for sign in (1, -1))
        difference = (up - down) / (2 * step)
        # Where a cable tightens or a stop lets go within a step, the path has a kink: few samples may differ.
        off = np.abs(slopes[..., index] - difference) > 0.01 * np.abs(difference).max() + 1e-9
        assert off.mean() < 0.02, index


def test_every_leg_within_the_bounds_comes_to_rest(physics: CompiledLeg) -> None:
    draws = SPACE.draw(1, 40)
    qpos, _ = physics.settled(draws, np.tile(COMMANDS, (len(draws), 1)))
    torque = jax.jit(jax.vmap(lambda q, y, c: physics.leg.residual_torque(q, SPACE.vector(y), c), (0, None, 0)))
    left = np.array([torque(q, jnp.asarray(y), COMMANDS) for q, y in zip(qpos, draws, strict=True)])
    unbalanced = np.abs(left).max(axis=-1)
    # Some jump to and fro over a kink in their last iterations.
    assert np.mean(unbalanced > 1e-6) < 0.05
    assert np.max(unbalanced) < 5e-3, "N m"


def test_hausdorff_distance_is_scipys_and_its_gradient_that_of_the_decisive_pair() -> None:
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


def test_curves_are_numpys_polynomials() -> None:
    rng = np.random.default_rng(0)
    angles = rng.normal(size=20)
    expected = np.polynomial.Polynomial.fit(COMMANDS, angles, 5)(np.linspace(0, 1, 200)) / (np.pi / 2)
    curve = np.asarray(polynomial_curve(COMMANDS, jnp.asarray(angles), 5))
    assert curve[:, 1] == pytest.approx(expected, abs=1e-9)
    assert curve[:, 0] == pytest.approx(np.linspace(0, 1, 200))


def test_curve_distances_go_both_ways() -> None:
    measured = jnp.asarray(np.stack([COMMANDS, COMMANDS], 1))
    simulated = measured.at[-1, 0].add(0.5)
    there, back = np.asarray(curve_distances(COMMANDS, simulated, measured, 7))
    assert there[0] > back[0] > 0.01, "the point that juts out is far from the curve, not the curve from its neighbours"
    assert there[1] == back[1] == 0


def test_coordinates_map_onto_the_bounds_and_back() -> None:
    for draw in SPACE.draw(3, 5):
        values = np.asarray(SPACE.vector(jnp.asarray(draw)))
        assert np.all((SPACE.lower < values) & (values < SPACE.upper))
        assert SPACE.coordinates(values) == pytest.approx(draw, abs=1e-9)
    assert np.asarray(SPACE.vector(jnp.asarray(SPACE.draw(0, 1)[0]))) == pytest.approx(SPACE.nominal)
    paper = ParameterTransform(nominal_leg(), PAPER_PARAMETERS)
    held = np.asarray(paper.vector(jnp.asarray(paper.draw(0, 1)[1]))) == paper.nominal
    assert [name for name, same in zip(LEG_PARAMETERS, held, strict=True) if same] == BEYOND


TRUTH = (
    vector([1.3, 0.7, 0.05, 0.06, 0.75, 1.2e-3, -0.15, 0.8, 0.03]),
    vector([0.8, 1.2, -0.08, -0.03, 0.6, 2e-4, 0.0, 1.3, 0.0]),
)


def sweep_of(physics: CompiledLeg, *vectors: np.ndarray) -> Sweep:
    """A sweep of the model itself, with these parameters. Its settled angles know no friction, its motion does."""
    settled = np.moveaxis(rest(physics, *vectors)[:, :, physics.leg.angles], 0, -1)
    return dataclasses.replace(blank(), settled=settled, motion=np.moveaxis(moving(physics, *vectors), 0, -1))


@pytest.fixture(scope="module")
def noiseless(physics: CompiledLeg) -> Sweep:
    return sweep_of(physics, *TRUTH)


def noisy(sweep: Sweep, seed: int, noise: float = np.deg2rad(0.5)) -> Sweep:
    """White noise (rad) on every one of the samples."""
    rng = np.random.default_rng(seed)
    return dataclasses.replace(
        sweep,
        settled=sweep.settled + rng.normal(size=sweep.settled.shape) * noise / np.sqrt(50),
        motion=sweep.motion + rng.normal(size=sweep.motion.shape) * noise,
    )


@pytest.mark.slow
def test_known_parameters_are_recovered(noiseless: Sweep, identifier: Identifier) -> None:
    """Some draws end in a long curved valley, where the motion is right to a tenth of a capture's noise."""
    every = []
    for seed in range(2):
        identifier.config = dataclasses.replace(ALL_PARAMETERS, seed=seed, draws=32, steps=20)
        every.append(identifier.run(noiseless, lambda *_: None).fits)
        assert all(fit.residual < np.deg2rad(0.05) for fit in every[-1])
    for leg, truth in enumerate(TRUTH):
        fit = min((fits[leg] for fits in every), key=lambda fit: fit.residual)
        for index, name in enumerate(LEG_PARAMETERS):
            exact = 0.01 * truth[index] if SPACE.relative[index] else SPACE.prior[index] / 30
            assert fit.vector[index] == pytest.approx(truth[index], abs=exact), name
        assert fit.dynamics is not None
        assert list(fit.dynamics) == pytest.approx(list(TRAIN), rel=0.02)
        assert not fit.open_directions


@pytest.mark.slow
def test_the_richer_model_is_taken_where_a_robot_asks_for_it(physics: CompiledLeg, identifier: Identifier) -> None:
    """Springs then stay at their nominal stiffness, and all else is found about it."""
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
def test_the_simpler_model_stays_where_a_robot_has_no_more(physics: CompiledLeg, identifier: Identifier) -> None:
    """Springs are then as well known as if nothing else could differ; their errors say what that rests on."""
    plain = [np.where(np.isin(LEG_PARAMETERS, RICHER_PARAMETERS), SPACE.nominal, truth) for truth in TRUTH]
    dynamics = dynamics_coordinates(TRAIN._replace(lag=1e-4, knee_damping=NOMINAL_DYNAMICS["knee_damping"]))
    y = np.concatenate([coordinates(*plain), np.tile(dynamics, (2, 1))], 1)
    motion = physics.motion(y, DATA.commanded)[0][:, DATA.counts]
    settled = rest(physics, *plain)[:, :, physics.leg.angles]
    sweep = dataclasses.replace(blank(), settled=np.moveaxis(settled, 0, -1), motion=np.moveaxis(motion, 0, -1))
    identifier.config = dataclasses.replace(ALL_PARAMETERS, draws=32, steps=15)
    found = identifier.run(noisy(sweep, 0), lambda *_: None)
    assert found.selection is not None and not found.selection.richer
    assert found.selection.statistic > 0 and found.selection.effect > 0, "it has the simpler solution among its starts"
    parameters = found.parameters
    assert all(getattr(parameters, name) is None for name in RICHER_PARAMETERS) and parameters.backlash is not None
    spring, travel = (LEG_PARAMETERS.index(name) for name in ("knee_spring_stiffness", "motor_travel"))
    slopes = physics.motion(y, DATA.commanded)[1][:, DATA.counts].reshape(2, -1, y.shape[1])
    simpler = ~np.isin([*LEG_PARAMETERS, *LegDynamics._fields], RICHER_PARAMETERS)
    for fit, truth, own, slope in zip(found.fits, plain, y, slopes[..., simpler] / np.deg2rad(0.5), strict=True):
        per_coordinate = jax.jacfwd(SPACE.vector)(jnp.asarray(own[: len(truth)]))[spring, spring]
        error = float(np.sqrt(np.linalg.inv(slope.T @ slope)[spring, spring]) * per_coordinate)
        assert abs(fit.vector[spring] - truth[spring]) < 3 * error
        assert error < fit.standard_errors[spring], "that of the richer model"
        assert np.all(np.abs(fit.vector - truth) < 3 * fit.standard_errors + 1e-9)
        assert fit.standard_errors[travel] > 0, "it may differ all the same"


@pytest.mark.slow
def test_standard_errors_are_honest(physics: CompiledLeg, identifier: Identifier) -> None:
    """With 0.5 deg of noise, nine in ten estimates within two standard errors, where springs are what makers quote."""
    spring = np.arange(len(SPACE.nominal)) == LEG_PARAMETERS.index("knee_spring_stiffness")
    truths = [np.where(spring, SPACE.nominal * factor, truth) for factor, truth in zip((1.1, 0.92), TRUTH, strict=True)]
    clean = sweep_of(physics, *truths)
    identifier.config = dataclasses.replace(ALL_PARAMETERS, draws=32, steps=12)
    within = []
    for seed in range(2):
        result = identifier.run(noisy(clean, seed), lambda *_: None)
        for fit, truth in zip(result.fits, truths, strict=True):
            within += list(np.abs(fit.vector - truth) < 2 * fit.standard_errors)
    assert np.mean(within) > 0.85


@pytest.mark.slow
def test_friction_and_play_pass_for_actuators_only_where_settled_angles_are_all(
    noiseless: Sweep, identifier: Identifier
) -> None:
    """At rest, a motor that play and friction stop short has another zero. Its motion tells them apart."""
    ends = noiseless.motion.reshape(len(COMMANDS), HOLD, 2, 2)[:, -20:].mean(axis=1)
    sweep = noisy(dataclasses.replace(noiseless, settled=ends), 0)
    off = {}
    for motion in (True, False):
        identifier.config = dataclasses.replace(ALL_PARAMETERS, motion=motion, draws=32, steps=15)
        fits = identifier.run(sweep, lambda *_: None).fits
        zero = LEG_PARAMETERS.index("default_motor_angle")
        off[motion] = [abs(fit.vector[zero] - truth[zero]) for fit, truth in zip(fits, TRUTH, strict=True)]
    assert max(off[True]) < np.deg2rad(0.3) < min(off[False])


def test_what_a_sweep_leaves_open_is_named_and_held_near_nominal(physics: CompiledLeg, identifier: Identifier) -> None:
    """At rest, servos that never saturate say nothing about where they would (moving, they do), and the knee spring's
    reference angle trades with its stiffness."""
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
        # What is known is found all the same.
        for index in set(range(len(LEG_PARAMETERS))) - {limit, spring, reference}:
            assert fit.vector[index] == pytest.approx(strong[0][index], rel=0.05, abs=np.deg2rad(0.5)), LEG_PARAMETERS[
                index
            ]


def test_the_papers_objective_is_lower_where_it_is_what_is_minimized(noiseless: Sweep, identifier: Identifier) -> None:
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
