"""The drivetrain against a plain reference implementation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballu_mjx.sim.drivetrain import (
    DrivetrainParameters,
    count_slots,
    filter_commands,
    identity_drivetrain,
    init_drivetrain,
    step_drivetrain,
)

STEP = 0.004


def wandering(seed: int = 0, steps: int = 400, commands: int = 2) -> np.ndarray:
    rng = np.random.default_rng(seed)
    held = np.repeat(rng.uniform(-1, 1, (steps // 20, commands)), 20, axis=0)
    return held + 0.1 * np.sin(0.3 * np.arange(steps))[:, None]


def reference(values: dict[str, float], commands: np.ndarray) -> np.ndarray:
    """Filter one command step by step, by the documented equations."""
    found = []
    limited = lagged = after_backlash = values["scale"] * commands[0] + values["offset"]
    for step in range(len(commands)):
        late = step - values["delay"] / STEP
        arrived = values["scale"] * np.interp(late, np.arange(len(commands)), commands) + values["offset"]
        change = arrived - limited
        limited += np.sign(change) * min(abs(change), values["rate_limit"] * STEP)
        lagged += (limited - lagged) * STEP / (STEP + values["lag"])
        if after_backlash < lagged - values["backlash"] / 2:
            after_backlash = lagged - values["backlash"] / 2
        if after_backlash > lagged + values["backlash"] / 2:
            after_backlash = lagged + values["backlash"] / 2
        found.append(after_backlash)
    return np.array(found)


def test_the_identity_drivetrain_does_not_change_commands():
    commands = jnp.asarray(wandering(), jnp.float32)
    passed = filter_commands(identity_drivetrain(2), commands, STEP, count_slots(0.1, STEP))
    np.testing.assert_array_equal(passed, commands)


CASES = {
    "delay between two steps": {"delay": 3.3 * STEP},
    "longest delay": {"delay": 0.1},
    "rate limit": {"rate_limit": 4.0},
    "lag": {"lag": 0.03},
    "backlash": {"backlash": 0.3},
    "scale and offset": {"scale": 0.8, "offset": -0.1},
    "all": {"scale": 0.9, "offset": 0.1, "delay": 0.017, "backlash": 0.1, "rate_limit": 6.0, "lag": 0.02},
}


@pytest.mark.parametrize("case", CASES)
def test_each_effect_agrees_with_the_reference(case: str):
    values = {"scale": 1.0, "offset": 0.0, "delay": 0.0, "backlash": 0.0, "rate_limit": np.inf, "lag": 0.0}
    other = values | CASES[case]
    commands = wandering()
    with jax.enable_x64(True):
        each = [jnp.array([values[name], other[name]]) for name in DrivetrainParameters._fields]
        found = filter_commands(DrivetrainParameters(*each), jnp.asarray(commands), STEP, count_slots(0.1, STEP))
    np.testing.assert_allclose(found[:, 0], commands[:, 0], atol=1e-12)
    np.testing.assert_allclose(found[:, 1], reference(other, commands[:, 1]), atol=1e-12)


def test_derivatives_agree_with_finite_differences_and_exist_at_the_identity():
    commands = wandering()
    with jax.enable_x64(True):

        def passed(vector: jax.Array) -> jax.Array:
            each = vector.reshape(6, 2)
            return filter_commands(DrivetrainParameters(*each), jnp.asarray(commands), STEP, count_slots(0.1, STEP))

        values = np.repeat([0.9, 0.1, 0.0171, 0.1, 6.03, 0.02], 2)
        jacobian, passed_at = np.asarray(jax.jacfwd(passed)(jnp.asarray(values))), jax.jit(passed)
        for place in range(len(values)):
            step = np.zeros(len(values))
            step[place] = 1e-7
            change = (passed_at(values + step) - passed_at(values - step)) / 2e-7
            np.testing.assert_allclose(jacobian[..., place], change, atol=1e-4)
        identity = jnp.concatenate(list(identity_drivetrain(2)))
        at_identity = np.asarray(jax.jacfwd(passed)(identity))
    assert np.isfinite(at_identity).all()
    # At a delay of 0, the derivative with respect to delay is the decrease of the command per time.
    early = commands[:-1, 0] - commands[1:, 0]
    np.testing.assert_allclose(at_identity[1:, 0, 4], early / STEP, atol=1e-9)


@pytest.mark.parametrize("backlash", [0.0, 0.08])
@pytest.mark.parametrize("delay", [0.0, 0.008])
def test_derivatives_by_backlash_and_delay_are_those_of_larger_values_also_if_commands_are_held(
    backlash: float, delay: float
):
    """Delays of whole physics steps, and outputs that rest at an end of the backlash, are kinks of the filter."""
    commands = jnp.array(
        [0.0, 0.0, 0.1, 0.2, 0.3, 0.3, 0.3, 0.2, 0.2, -0.1, -0.1, -0.1, 0.4, 0.4, 0.35, 0.35, 0.35, 0.1]
    )

    def filtered(values: jax.Array) -> jax.Array:
        own = identity_drivetrain(1)._replace(backlash=values[:1], delay=values[1:])
        return filter_commands(own, jnp.asarray(commands[:, None], float), 0.004, 5)[:, 0]

    with jax.enable_x64(True):
        values = jnp.array([backlash, delay], float)
        jacobian = jax.jacfwd(filtered)(values)
        for place, step in enumerate(jnp.eye(2) * 1e-7):
            change = (filtered(values + step) - filtered(values)) / 1e-7
            np.testing.assert_allclose(jacobian[:, place], change, atol=1e-5)
            assert np.abs(change).max() > 0.4


def test_drivetrains_in_a_batch_agree_with_single_ones():
    commands = jnp.asarray(wandering(), jnp.float32)
    delays = jnp.array([0.0, 0.01, 0.05])
    slots = count_slots(0.05, STEP)

    def delayed(delay: jax.Array) -> jax.Array:
        parameters = identity_drivetrain(2)._replace(delay=jnp.full(2, delay))
        state = init_drivetrain(parameters, commands[0], slots)
        step = lambda state, command: step_drivetrain(parameters, state, command, STEP)  # noqa: E731
        return jax.lax.scan(step, state, commands[:30])[1][-1]

    together = jax.vmap(delayed)(delays)
    for delay, ctrl in zip(delays, together, strict=True):
        np.testing.assert_allclose(ctrl, delayed(delay), atol=1e-6)
    assert not np.allclose(together[0], together[2])
