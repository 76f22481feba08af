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
from ballu_mjx.identification import NAMES, IdentificationConfig, Space, SuspendedLeg
from ballu_mjx.sweep import Sweep

COMMANDS = np.linspace(0, 1, 20)
TIMES = 60
HIGH, LOW = [1.3, 1.2, 0.05, 0.05, 0.9], [0.8, 0.8, -0.06, -0.03, 0.55]
"""Of the nominal parameters (angles: added): a leg that never saturates, and one that does from a command of 0.6 on."""


@pytest.fixture(scope="module", autouse=True)
def double() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def vector(change: list[float]) -> np.ndarray:
    nominal, change_ = identification.nominal_leg(), np.array(change)
    relative = ~np.char.startswith(np.array(NAMES), "default")
    return np.where(relative, nominal * change_, nominal + change_)


@pytest.fixture(scope="module")
def leg() -> SuspendedLeg:
    return SuspendedLeg()


class Programs:
    """Compiled once for all tests here."""

    def __init__(self, leg: SuspendedLeg) -> None:
        over = jax.vmap(leg.settled_qpos, (None, 0))
        self.settled = jax.jit(over)
        self.slope = jax.jit(jax.jacfwd(over))
        path = lambda v, q, c, d: jax.vmap(leg.transient, (None, 0, 0, None, None))(v, q, c, d, TIMES)  # noqa: E731
        self.transient = jax.jit(path)
        self.transient_slope = jax.jit(jax.jacfwd(path, argnums=(0, 3)))


@pytest.fixture(scope="module")
def programs(leg: SuspendedLeg) -> Programs:
    return Programs(leg)


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
def test_settled_angles_are_those_c_mujoco_comes_to_rest_at(programs: Programs, change: list[float], side: str) -> None:
    model = c_model(side, vector(change))
    model.dof_damping[:] = np.maximum(model.dof_damping, 0.05)  # rests sooner, at the same place
    data = mujoco.MjData(model)
    expected = []
    for command in COMMANDS[::4]:
        data.ctrl[:] = command
        mujoco.mj_step(model, data, 1500)
        expected.append([data.joint(f"{kind}_{side}").qpos[0] for kind in ("motor", "knee")])
    angles = SuspendedLeg().angles
    ours = np.asarray(programs.settled(jnp.asarray(vector(change)), jnp.asarray(COMMANDS)))[::4][:, angles]
    assert np.rad2deg(ours) == pytest.approx(np.rad2deg(expected), abs=0.02)


def test_transients_are_those_of_c_mujoco(leg: SuspendedLeg, programs: Programs) -> None:
    values = vector(HIGH)
    start = programs.settled(jnp.asarray(values), jnp.asarray(COMMANDS))
    command = jnp.asarray(np.roll(COMMANDS, 7))
    paths = np.asarray(programs.transient(jnp.asarray(values), start, command, jnp.asarray(0.03)))
    model = c_model("left", values)
    for hold in (0, 8, 15):
        data = mujoco.MjData(model)
        data.qpos[:] = np.tile(np.asarray(start[hold]), 2)
        data.ctrl[:] = float(command[hold])
        expected = [np.asarray(start[hold])[leg.angles]] * 4  # at rest for the delay of three samples
        for _ in range(TIMES - 4):
            mujoco.mj_step(model, data)
            expected.append([data.joint(f"{kind}_left").qpos[0] for kind in ("motor", "knee")])
        assert np.rad2deg(paths[hold]) == pytest.approx(np.rad2deg(expected), abs=0.2)


@pytest.mark.parametrize("change", [HIGH, LOW])
def test_derivatives_of_settled_angles_agree_with_differences(programs: Programs, change: list[float]) -> None:
    """Cable slack and knee at its stop at low commands, cable taut at high ones, servo saturated in the weak leg."""
    values = vector(change)
    rest = np.asarray(programs.settled(jnp.asarray(values), jnp.asarray(COMMANDS)))
    assert rest[0, 1] < values[3] and rest[-1, 1] > values[3] + 0.3, "from the stop to far off it"
    slope = np.asarray(programs.slope(jnp.asarray(values), jnp.asarray(COMMANDS)))
    saturates = np.abs(slope[-1, :, NAMES.index("torque_limit")]).max() > 0.1
    assert saturates == (change is LOW)
    for index in range(len(NAMES)):
        step = 1e-6 * max(abs(values[index]), 0.1)
        moved = [values + sign * step * (np.arange(len(NAMES)) == index) for sign in (1, -1)]
        up, down = (np.asarray(programs.settled(jnp.asarray(v), jnp.asarray(COMMANDS))) for v in moved)
        difference = (up - down) / (2 * step)
        assert slope[:, :, index] == pytest.approx(difference, rel=1e-3, abs=1e-4 * np.abs(difference).max() + 1e-7)


@pytest.mark.parametrize("change", [HIGH, LOW])
def test_derivatives_of_transients_agree_with_differences(programs: Programs, change: list[float]) -> None:
    values, delay = jnp.asarray(vector(change)), jnp.asarray(0.033)
    start, command = programs.settled(values, jnp.asarray(COMMANDS)), jnp.asarray(np.roll(COMMANDS, 7))
    by_vector, by_delay = programs.transient_slope(values, start, command, delay)
    slopes = np.concatenate([np.asarray(by_vector), np.asarray(by_delay)[..., None]], axis=-1)
    assert np.all(np.isfinite(slopes))
    for index in range(len(NAMES) + 1):
        step = 1e-6 * (max(abs(float(values[index])), 0.1) if index < len(NAMES) else 1.0)
        ends = []
        for sign in (1, -1):
            change_ = sign * step * (np.arange(len(NAMES) + 1) == index)
            moved = (values + change_[:-1], start, command, delay + change_[-1])
            ends.append(np.asarray(programs.transient(*moved)))
        difference = (ends[0] - ends[1]) / (2 * step)
        # Where a cable tightens or a stop lets go between two steps, the path has a kink: few samples may differ.
        off = np.abs(slopes[..., index] - difference) > 0.01 * np.abs(difference).max() + 1e-9
        assert off.mean() < 0.02, NAMES[index] if index < len(NAMES) else "delay"


def test_every_leg_within_the_bounds_comes_to_rest(leg: SuspendedLeg, programs: Programs) -> None:
    space = Space(identification.nominal_leg(), IdentificationConfig())
    torque = jax.jit(jax.vmap(leg.residual_torque, (0, None, 0)))
    unbalanced = []
    for draw in space.draw(1, 40):
        values = space.vector(jnp.asarray(draw))
        rest = programs.settled(values, jnp.asarray(COMMANDS))
        unbalanced.append(np.abs(torque(rest, values, jnp.asarray(COMMANDS))).max(axis=1))
    assert np.mean(np.array(unbalanced) > 1e-6) < 0.05
    assert np.max(unbalanced) < 5e-3  # N m: where the very last iterations jump to and fro over a kink


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
    space = Space(identification.nominal_leg(), IdentificationConfig())
    for draw in space.draw(3, 5):
        values = np.asarray(space.vector(jnp.asarray(draw)))
        assert np.all((space.lower < values) & (values < space.upper))
        assert space.coordinates(values) == pytest.approx(draw, abs=1e-9)
    assert np.asarray(space.vector(jnp.asarray(space.draw(0, 1)[0]))) == pytest.approx(space.nominal)
    paper = Space(identification.nominal_leg(), IdentificationConfig(torque_limit=False))
    held = paper.vector(jnp.asarray(paper.draw(0, 1)[1]))
    assert held[NAMES.index("torque_limit")] == paper.nominal[NAMES.index("torque_limit")]


TRUTH = (vector([1.3, 0.7, 0.05, 0.06, 0.75]), vector([0.8, 1.2, -0.08, -0.03, 0.6]))
DELAY = 0.04


def simulated_sweep(programs: Programs, angles: np.ndarray, noise: float, seed: int) -> Sweep:
    """A sweep of the model itself, with white noise (rad) on every one of 50 settled and 60 moving samples a hold."""
    rng = np.random.default_rng(seed)
    settled, moving = [], []
    for values in TRUTH:
        rest = programs.settled(jnp.asarray(values), jnp.asarray(COMMANDS))
        start = rest[np.maximum(np.arange(20) - 1, 0)]
        moving.append(np.asarray(programs.transient(jnp.asarray(values), start, jnp.asarray(COMMANDS), DELAY)))
        settled.append(np.asarray(rest)[:, angles])
    still, path = np.stack(settled, -1), np.stack(moving, -1)
    return Sweep(
        robot="model",
        command=np.stack([COMMANDS, COMMANDS], 1),
        previous=np.maximum(np.arange(20) - 1, 0),
        settled=still + rng.normal(size=still.shape) * noise / np.sqrt(50),
        samples=np.full(20, 50),
        transient=path + rng.normal(size=path.shape) * noise,
    )


@pytest.fixture(scope="module")
def identifier(programs: Programs, leg: SuspendedLeg) -> identification._Identifier:
    sweep = simulated_sweep(programs, leg.angles, 0.0, 0)
    return identification._Identifier(IdentificationConfig(), sweep, lambda *_: None)


def test_known_parameters_are_recovered_from_any_seed_of_the_starts(
    programs: Programs, leg: SuspendedLeg, identifier: identification._Identifier
) -> None:
    sweep = simulated_sweep(programs, leg.angles, 0.0, 0)
    for seed in range(3):
        identifier.config = dataclasses.replace(identifier.config, seed=seed)
        result = identifier.run(sweep, lambda *_: None)
        for fit, truth in zip(result.fits, TRUTH, strict=True):
            for index, name in enumerate(NAMES):
                exact = np.deg2rad(0.1) if name.startswith("default") else 0.01 * truth[index]
                assert fit.vector[index] == pytest.approx(truth[index], abs=exact), name
            assert fit.delay == pytest.approx(DELAY, abs=1e-3)
            assert not fit.open_directions


def test_standard_errors_are_honest(
    programs: Programs, leg: SuspendedLeg, identifier: identification._Identifier
) -> None:
    """With 0.5 deg of noise, nine in ten estimates within two standard errors; from one search each, to save time."""
    within = []
    for seed in range(8):
        result = identifier.run(simulated_sweep(programs, leg.angles, np.deg2rad(0.5), seed), lambda *_: None)
        for fit, truth in zip(result.fits, TRUTH, strict=True):
            within += list(np.abs(fit.vector - truth) < 2 * fit.standard_errors)
    assert np.mean(within) > 0.9


def test_transients_make_more_known(
    programs: Programs, leg: SuspendedLeg, identifier: identification._Identifier
) -> None:
    sweep = simulated_sweep(programs, leg.angles, np.deg2rad(0.5), 0)
    moving = identifier.run(sweep, lambda *_: None)
    try:
        identifier.config = dataclasses.replace(identifier.config, transients=False)
        still = identifier.run(sweep, lambda *_: None)
    finally:
        identifier.config = dataclasses.replace(identifier.config, transients=True)
    for with_them, without in zip(moving.fits, still.fits, strict=True):
        assert np.all(with_them.standard_errors < without.standard_errors)
