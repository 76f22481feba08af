"""Identification: physics against C MuJoCo, derivatives against differences, known parameters recovered."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.distance import directed_hausdorff

from ballu_mjx import identification, robot
from ballu_mjx.identification import NAMES, IdentificationConfig, Space
from ballu_mjx.sweep import Sweep

COMMANDS = np.linspace(0, 1, 20)
TIMES = 60
HIGH, LOW = [1.3, 1.2, 0.05, 0.05, 0.9], [0.8, 0.8, -0.06, -0.03, 0.55]
"""Times the nominal parameters (angles: added): a leg that never saturates, and one that does."""


@pytest.fixture(scope="module", autouse=True)
def double() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def vector(change: list[float]) -> np.ndarray:
    nominal, change_ = identification.nominal_leg(), np.array(change)
    relative = ~np.char.startswith(np.array(NAMES), "default")
    return np.where(relative, nominal * change_, nominal + change_)


SPACE = Space(identification.nominal_leg(), IdentificationConfig())
PREVIOUS = np.maximum(np.arange(20) - 1, 0)
DELAY = 0.04


def blank() -> Sweep:
    """A sweep of the sizes that all tests here share, and so two compiled programs."""
    command = np.stack([COMMANDS, COMMANDS], 1)
    return Sweep("model", command, PREVIOUS, np.zeros((20, 2, 2)), np.full(20, 50), np.zeros((20, TIMES, 2, 2)))


@pytest.fixture(scope="module")
def identifier() -> identification.Identifier:
    return identification.Identifier(IdentificationConfig(), blank(), lambda *_: None)


@pytest.fixture(scope="module")
def physics(identifier: identification.Identifier) -> identification.Physics:
    return identifier.physics


def coordinates(*vectors: np.ndarray) -> np.ndarray:
    return np.stack([SPACE.coordinates(vector) for vector in vectors])


def rest(physics: identification.Physics, *vectors: np.ndarray) -> np.ndarray:
    """Positions at rest under COMMANDS."""
    return physics.settled(coordinates(*vectors), np.tile(COMMANDS, (len(vectors), 1)))[0]


def moving(physics: identification.Physics, *vectors: np.ndarray) -> np.ndarray:
    """Transients of a left and a right leg from rest under each command's predecessor."""
    start, slope = physics.settled(coordinates(*vectors), np.tile(COMMANDS, (2, 1)))
    y = np.concatenate([coordinates(*vectors), np.full((2, 1), DELAY / identification.DELAY_UNIT)], axis=1)
    return physics.transient(y, start[:, PREVIOUS], slope[:, PREVIOUS], np.tile(COMMANDS, (2, 1)))[0]


def c_model(side: str, values: np.ndarray) -> mujoco.MjModel:
    """The whole robot in C, base held, feet in the air, with one leg's parameters on both sides."""
    spec = mujoco.MjSpec.from_file(str(robot.assets() / "ballu.xml"))
    robot.suspend(spec)
    model = spec.compile()
    pairs = robot.ActuatorParameters(*(jnp.array([value, value]) for value in values))
    robot.set_fields(model, robot.actuator_fields(model, pairs))
    model.opt.iterations, model.opt.tolerance = 50, 1e-12
    return model


@pytest.mark.parametrize("change", [HIGH, LOW])
@pytest.mark.parametrize("side", robot.SIDES)
def test_settled_angles_are_those_c_mujoco_comes_to_rest_at(
    physics: identification.Physics, change: list[float], side: str
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


def test_transients_are_those_of_c_mujoco(physics: identification.Physics) -> None:
    values, angles = vector(HIGH), physics.leg.angles
    start, paths = rest(physics, values)[0], moving(physics, values, values)[1]
    model = c_model("left", values)
    for hold in (3, 12, 18):
        data = mujoco.MjData(model)
        data.qpos[:] = np.tile(start[hold - 1], 2)
        data.ctrl[:] = COMMANDS[hold]
        delayed = round(DELAY / 0.01) + 1
        expected = [start[hold - 1][angles]] * delayed
        for _ in range(TIMES - delayed):
            mujoco.mj_step(model, data)
            expected.append([data.joint(f"{kind}_left").qpos[0] for kind in ("motor", "knee")])
        assert np.rad2deg(paths[hold]) == pytest.approx(np.rad2deg(expected), abs=0.05)


@pytest.mark.parametrize("change", [HIGH, LOW])
def test_derivatives_of_settled_angles_agree_with_differences(
    physics: identification.Physics, change: list[float]
) -> None:
    """Cable slack and knee at its stop at low commands, cable taut at high ones, servo saturated in the weak leg."""
    y, command, angles = coordinates(vector(change))[0], COMMANDS[None], physics.leg.angles
    value, slope = (x[0][:, angles] for x in physics.settled(y[None], command))
    assert value[0, 1] < vector(change)[3] and value[-1, 1] > vector(change)[3] + 0.2, "from the stop to far off it"
    saturates = np.abs(slope[-1, :, NAMES.index("torque_limit")]).max() > 0.1
    assert saturates == (change is LOW)
    step = 1e-6
    steps = step * np.eye(len(y))
    up, down = (physics.settled(y + sign * steps, np.tile(command, (len(y), 1)))[0][:, :, angles] for sign in (1, -1))
    difference = np.moveaxis((up - down) / (2 * step), 0, -1)
    for index, name in enumerate(NAMES):
        scale = np.abs(difference[..., index]).max()
        assert slope[..., index] == pytest.approx(difference[..., index], abs=1e-4 * scale + 1e-6), name


def test_derivatives_of_transients_agree_with_differences(physics: identification.Physics) -> None:
    """Both legs at once: one that never saturates, and one that does."""
    y = np.concatenate([coordinates(vector(HIGH), vector(LOW)), np.full((2, 1), 3.3)], axis=1)
    command = np.tile(COMMANDS, (2, 1))

    def paths(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        start, slope = physics.settled(y[:, :-1], command)
        return physics.transient(y, start[:, PREVIOUS], slope[:, PREVIOUS], command)

    slopes = paths(y)[1]
    assert np.all(np.isfinite(slopes))
    step = 1e-6
    for index in range(y.shape[1]):
        change = step * (np.arange(y.shape[1]) == index)
        difference = (paths(y + change)[0] - paths(y - change)[0]) / (2 * step)
        # Where a cable tightens or a stop lets go within a step, the path has a kink: few samples may differ.
        off = np.abs(slopes[..., index] - difference) > 0.01 * np.abs(difference).max() + 1e-9
        assert off.mean() < 0.02, index


def test_every_leg_within_the_bounds_comes_to_rest(physics: identification.Physics) -> None:
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
    distance, i, j = directed_hausdorff(a, b)
    assert float(identification.directed_hausdorff(jnp.asarray(a), jnp.asarray(b))) == pytest.approx(
        distance, abs=1e-12
    )
    gradient = np.asarray(jax.grad(lambda x: identification.directed_hausdorff(x, jnp.asarray(b)))(jnp.asarray(a)))
    expected = np.zeros_like(a)
    expected[i] = (a[i] - b[j]) / distance
    assert gradient == pytest.approx(expected, abs=1e-12)
    same = jax.value_and_grad(lambda x: identification.directed_hausdorff(x, jnp.asarray(a)))(jnp.asarray(a))
    assert float(same[0]) == 0 and np.all(np.asarray(same[1]) == 0)


def test_curves_are_numpys_polynomials() -> None:
    rng = np.random.default_rng(0)
    angles = rng.normal(size=20)
    expected = np.polynomial.Polynomial.fit(COMMANDS, angles, 5)(np.linspace(0, 1, 200)) / (np.pi / 2)
    curve = np.asarray(identification.polynomial_curve(COMMANDS, jnp.asarray(angles), 5))
    assert curve[:, 1] == pytest.approx(expected, abs=1e-9)
    assert curve[:, 0] == pytest.approx(np.linspace(0, 1, 200))


def test_curve_distances_go_both_ways() -> None:
    measured = jnp.asarray(np.stack([COMMANDS, COMMANDS], 1))
    simulated = measured.at[-1, 0].add(0.5)
    there, back = np.asarray(identification.curve_distances(COMMANDS, simulated, measured, 7))
    assert there[0] > back[0] > 0.01, "the point that juts out is far from the curve, not the curve from its neighbours"
    assert there[1] == back[1] == 0


def test_coordinates_map_onto_the_bounds_and_back() -> None:
    for draw in SPACE.draw(3, 5):
        values = np.asarray(SPACE.vector(jnp.asarray(draw)))
        assert np.all((SPACE.lower < values) & (values < SPACE.upper))
        assert SPACE.coordinates(values) == pytest.approx(draw, abs=1e-9)
    assert np.asarray(SPACE.vector(jnp.asarray(SPACE.draw(0, 1)[0]))) == pytest.approx(SPACE.nominal)
    paper = Space(identification.nominal_leg(), IdentificationConfig(torque_limit=False))
    held = paper.vector(jnp.asarray(paper.draw(0, 1)[1]))
    assert held[NAMES.index("torque_limit")] == paper.nominal[NAMES.index("torque_limit")]


TRUTH = (vector([1.3, 0.7, 0.05, 0.06, 0.75]), vector([0.8, 1.2, -0.08, -0.03, 0.6]))


@pytest.fixture(scope="module")
def noiseless(physics: identification.Physics) -> Sweep:
    """A sweep of the model itself, with the parameters TRUTH."""
    settled = np.moveaxis(rest(physics, *TRUTH)[:, :, physics.leg.angles], 0, -1)
    return dataclasses.replace(blank(), settled=settled, transient=np.moveaxis(moving(physics, *TRUTH), 0, -1))


def noisy(sweep: Sweep, seed: int, noise: float = np.deg2rad(0.5)) -> Sweep:
    """White noise (rad) on every one of the samples."""
    rng = np.random.default_rng(seed)
    return dataclasses.replace(
        sweep,
        settled=sweep.settled + rng.normal(size=sweep.settled.shape) * noise / np.sqrt(50),
        transient=sweep.transient + rng.normal(size=sweep.transient.shape) * noise,
    )


def test_known_parameters_are_recovered_whatever_the_draws(
    noiseless: Sweep, identifier: identification.Identifier
) -> None:
    for seed in range(3):
        identifier.config = IdentificationConfig(seed=seed)
        result = identifier.run(noiseless, lambda *_: None)
        for fit, truth in zip(result.fits, TRUTH, strict=True):
            for index, name in enumerate(NAMES):
                exact = np.deg2rad(0.1) if name.startswith("default") else 0.01 * truth[index]
                assert fit.vector[index] == pytest.approx(truth[index], abs=exact), name
            assert fit.delay == pytest.approx(DELAY, abs=1e-3)
            assert not fit.open_directions


def test_standard_errors_are_honest(noiseless: Sweep, identifier: identification.Identifier) -> None:
    """With 0.5 deg of noise, nine in ten estimates within two standard errors."""
    identifier.config = IdentificationConfig(draws=32, steps=12)
    within = []
    for seed in range(4):
        result = identifier.run(noisy(noiseless, seed), lambda *_: None)
        for fit, truth in zip(result.fits, TRUTH, strict=True):
            within += list(np.abs(fit.vector - truth) < 2 * fit.standard_errors)
    assert np.mean(within) > 0.85


def test_transients_make_more_known(noiseless: Sweep, identifier: identification.Identifier) -> None:
    fits = []
    for transients in (True, False):
        identifier.config = IdentificationConfig(transients=transients, draws=32, steps=12)
        fits.append(identifier.run(noisy(noiseless, 0), lambda *_: None).fits)
    for moving_fit, still_fit in zip(*fits, strict=True):
        assert np.all(moving_fit.standard_errors < still_fit.standard_errors)
        assert max(d.standard_error for d in moving_fit.directions) < max(
            d.standard_error for d in still_fit.directions
        )


def test_what_a_sweep_leaves_open_is_named_and_held_near_nominal(
    physics: identification.Physics, identifier: identification.Identifier
) -> None:
    """At rest, servos that never saturate say nothing about where they would (moving, they do)."""
    strong = [vector(HIGH), vector(HIGH)]
    settled = np.moveaxis(rest(physics, *strong)[:, :, physics.leg.angles], 0, -1)
    sweep = dataclasses.replace(blank(), settled=settled, transient=np.moveaxis(moving(physics, *strong), 0, -1))
    identifier.config = IdentificationConfig(transients=False, draws=16, steps=12)
    limit = NAMES.index("torque_limit")
    for fit in identifier.run(noisy(sweep, 0, np.deg2rad(0.1)), lambda *_: None).fits:
        assert len(fit.open_directions) == 1
        assert abs(fit.open_directions[0].weights[limit]) > 0.95
        nominal = identification.nominal_leg()[limit]
        assert fit.vector[limit] == pytest.approx(nominal, rel=0.2)
        # What is known is found all the same.
        for index in set(range(len(NAMES))) - {limit}:
            assert fit.vector[index] == pytest.approx(strong[0][index], rel=0.05, abs=np.deg2rad(0.5)), NAMES[index]


def test_the_papers_objective_is_lower_where_it_is_what_is_minimized(
    noiseless: Sweep, identifier: identification.Identifier
) -> None:
    sweep = dataclasses.replace(
        noiseless, settled=noiseless.settled + np.random.default_rng(0).normal(size=(20, 2, 2)) * np.deg2rad(1.0)
    )
    distances = {}
    for objective in ("pointwise", "hausdorff"):
        identifier.config = IdentificationConfig(objective=objective, transients=False, draws=16, steps=15)
        result = identifier.run(sweep, lambda *_: None)
        assert result.config.objective == objective
        distances[objective] = sum(
            float(
                np.sum(
                    identification.curve_distances(COMMANDS, result.settled[..., leg], sweep.settled[..., leg], 7)[0]
                )
            )
            for leg in range(2)
        )
    assert distances["hausdorff"] < 0.98 * distances["pointwise"]
