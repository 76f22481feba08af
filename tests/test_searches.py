"""Tests that the identification benchmarks compare searches, times and simulators fairly."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sysid_pendulum  # pyright: ignore[reportMissingImports]
from searches import Search, compare, lbfgsb  # pyright: ignore[reportMissingImports]

from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.measured_motion import MeasuredMotion
from ballu_mjx.identification.parameters import Shares
from ballu_mjx.identification.window_simulator import WindowSimulator, cut_windows

SHARES = Shares(np.array([1e-3, -1.0]), np.array([1e1, 3.0]), np.array([True, False]))


def test_search_over_shares_finds_values_of_different_magnitudes():
    def function(place: np.ndarray) -> tuple[float, np.ndarray]:
        goal = SHARES.of(np.array([0.02, 2.5]))
        return float(np.sum((place - goal) ** 2)), 2 * (place - goal)

    place, seconds, trace = lbfgsb(function, np.array([0.9, 0.1]), 50)
    np.testing.assert_allclose(SHARES.values(place), [0.02, 2.5], rtol=1e-4)
    values = [value for _, value in trace]
    assert values == sorted(values, reverse=True)
    assert trace[-1][0] <= seconds


def test_time_to_an_error_is_that_of_the_first_point_that_reaches_it():
    ours = Search("ours", 2, 3.0, 40.0, 1.0, [(1.0, 5.0), (2.0, 1.05), (3.0, 1.0)])
    other = Search("other", 2, 9.0, None, 1.1, [(1.0, 5.0), (8.0, 1.1), (9.0, 1.1)])
    assert ours.reached(1.1) == 2.0
    assert other.reached(1.0) == np.inf
    text = compare([ours], other)
    assert "the lower of the two" in text and "ours 4 times sooner" in text


def test_compile_clock_counts_compilation_once():
    clock = sysid_pendulum.CompileClock()
    function = jax.jit(lambda x: jax.jit(jnp.sin)(x) ** 2)
    begin = time.perf_counter()
    function(jnp.ones(3)).block_until_ready()
    compiled = time.perf_counter()
    function(jnp.ones(3)).block_until_ready()
    end = time.perf_counter()
    assert 0 < clock.between(begin, compiled) <= compiled - begin
    assert clock.between(compiled, end) == 0


@pytest.mark.slow
def test_windows_in_c_mujoco_match_those_of_the_fit():
    robot = sysid_pendulum.read_pendulum()
    model = robot.load_model()
    parameters = declared_parameters(robot, model)
    rng = np.random.default_rng(0)
    samples, every = 21, 5
    motion = MeasuredMotion(
        name="random",
        model=model,
        every=every,
        commands=0.5 + 0.1 * np.cumsum(rng.normal(size=((samples - 1) * every + 1, 2)), axis=0) / 10,
        qpos=rng.normal(size=(samples, 2)),
        start_qpos=rng.normal(size=(samples, 2)),
        qvel=rng.normal(size=(samples, 2)),
        position_noise=np.ones(2),
        velocity_noise=np.ones(2),
    )
    values = 1.05 * np.array([parameter.nominal for parameter in parameters.parameters]) + 0.003
    vectors = np.stack([values, 1.1 * values])
    with jax.enable_x64(True):
        windows = cut_windows([motion], 0.2)
        simulator = WindowSimulator(parameters, [motion], windows)
        differences = sysid_pendulum.WindowRollouts(parameters, [motion], windows).differences(vectors)
        for vector, found in zip(vectors, differences, strict=True):
            np.testing.assert_allclose(found, simulator.differences(vector), atol=1e-5)
    assert np.abs(differences[0] - differences[1]).max() > 1e-3
