"""Tests of the package's root, which notebooks import. It imports its modules lazily."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import re
import subprocess
import sys
import typing
from pathlib import Path

import jax
import numpy as np
import pytest
import tethered

import ballu_mjx as bm
from ballu_mjx.ballu.leg_parameters import IdentificationConfig
from ballu_mjx.recordings.recording import cut
from ballu_mjx.robots.model import assets
from ballu_mjx.runs.layout import RUN_FORMAT
from ballu_mjx.runs.record import MemoryRecord

SIZES = bm.PPOConfig(
    num_timesteps=320, num_envs=16, batch_size=16, num_minibatches=2, unroll_length=5, num_updates_per_batch=1,
    policy_layers=(16,), value_layers=(16,),
)  # fmt: skip


def test_importing_the_package_imports_no_jax():
    code = "import sys, ballu_mjx; assert 'jax' not in sys.modules; ballu_mjx.load_robot; assert 'jax' in sys.modules"
    code += "; import os; assert '--xla_force_host_platform_device_count' in os.environ['XLA_FLAGS']"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == done.stderr == ""


def test_root_defines_every_public_name():
    for name in bm.__all__:
        assert getattr(bm, name).__name__ == name
    assert set(bm.__all__) <= set(dir(bm))
    assert set(bm._MODULES) == set(bm.__all__)
    with pytest.raises(AttributeError, match="fit_everything"):
        bm.fit_everything  # noqa: B018


class Example(typing.NamedTuple):
    """Variables and output of the README's example."""

    robot: bm.RobotDescription
    motions: list[bm.Motion]
    actuators: bm.IdentifiedActuators
    sim: bm.Simulator
    air: bm.TrainedResidual
    policy: bm.Policy
    printed: str


@pytest.fixture(scope="module")
def example() -> Example:
    """Run the README's example unchanged, on two short recordings and with small sizes."""
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(import ballu_mjx as bm\n.*?)```", readme, re.DOTALL)
    load = bm.load_recordings

    def load_short(use: str, robot: bm.RobotDescription) -> list[bm.Recording]:
        if use == "suspended":
            return load(use, robot)
        return [cut(each, slice(int(np.searchsorted(each.time, each.time[0] + 6.0)))) for each in load(use, robot)[1:3]]

    identification = IdentificationConfig(motion=False, starts=2, draws=6, steps=8)
    air = bm.AirConfig(window_seconds=0.5, evaluations=2)
    quick = {
        "load_recordings": load_short,
        "identify_actuators": functools.partial(bm.identify_actuators, config=identification),
        "fit_aerodynamics": functools.partial(bm.fit_aerodynamics, config=air, free=("added_mass", "lift")),
        "train_policy": functools.partial(bm.train_policy, ppo_config=SIZES),
    }
    printed, left = io.StringIO(), {}
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(printed),
    ):
        for name, function in quick.items():
            patch.setattr(bm, name, function)
        exec(code, left)
    return Example(printed=printed.getvalue(), **{name: left[name] for name in Example._fields if name != "printed"})


@pytest.mark.slow
def test_readme_example_prints_a_table_and_returns_a_policy(example: Example):
    _, *table = example.printed.splitlines()
    assert "vanilla+sysid" in example.printed and "aerodynamic" in example.printed and table
    assert "motor gain, left" in example.actuators.report and "std. error" in example.air.report
    policy = example.policy
    assert policy.variant.name == "aerodynamic" and policy.step % 160 == 0
    command = policy.act()(np.zeros(example.robot.features))
    assert command.shape == (2,) and np.all((command >= 0) & (command <= 1))


@pytest.mark.slow
def test_evaluation_is_deterministic(example: Example):
    one, other = (bm.evaluate(example.sim.with_residual(example.air), example.motions) for _ in range(2))
    assert one == other
    assert one.residual != one.vanilla


@pytest.fixture(scope="module")
def flights() -> list[bm.Motion]:
    """Return recordings of the tethered balloon, whose programs compile sooner than BALLU's."""
    return [tethered.flight(seed=seed, added_mass=0.03) for seed in range(2)]


@pytest.mark.slow
def test_envmimic_on_top_of_aerodynamic_is_evaluated_with_both(flights: list[bm.Motion]):
    """A residual learned in an improved simulator is evaluated together with that simulator's residual."""
    simulator = bm.Simulator(tethered.ROBOT)
    windows = bm.AirConfig(window_seconds=1.0, interval_seconds=1.0)
    air = bm.fit_aerodynamics(simulator, flights, config=windows, free=("added_mass",))
    start_at_zero = bm.EnvMimicConfig(expected_loads=(0.0,))
    learned = bm.train_envmimic(simulator.with_residual(air), flights, start_at_zero, SIZES)
    found = bm.evaluate(simulator.with_residual(learned), flights)
    assert found.name == "aerodynamic+envmimic"
    alone = bm.evaluate(simulator.with_residual(air), flights)
    assert found.vanilla == alone.vanilla
    if not learned.step:  # without learned forces only the aerodynamic residual acts
        np.testing.assert_allclose(found.score, alone.score, rtol=0.2)


@pytest.mark.slow
def test_training_in_memory_and_in_a_folder_are_equal(flights: list[bm.Motion], tmp_path: Path):
    simulator = bm.Simulator(tethered.ROBOT)
    content = {"format": RUN_FORMAT, "task": "envmimic", "starts": [], "ppo": dataclasses.asdict(SIZES)}
    memory = MemoryRecord(content)
    kept = bm.train_envmimic(simulator, flights, ppo_config=SIZES, run=memory, validate_every=160)
    with bm.Run(tmp_path / "run", content) as run:
        written = bm.train_envmimic(simulator, flights, ppo_config=SIZES, run=run, validate_every=160)
    assert kept.step == written.step
    jax.tree.map(np.testing.assert_array_equal, kept.params, written.params)
    assert [row["step"] for row in memory.metrics if "validation_error" in row] == [0, 160, 320]


def test_the_legs_of_another_model_are_not_identified_as_ballus(tmp_path: Path):
    for name in ("ballu.robot.json", "ballu.xml"):
        (tmp_path / name).write_text((assets() / name).read_text().replace('model="ballu"', 'model="other"'))
    other = bm.load_robot(str(tmp_path / "ballu.robot.json"))
    with pytest.raises(bm.InputError, match="needs the bundled model"):
        bm.identify_actuators(bm.load_recordings("suspended", bm.load_robot("ballu")), other)


def test_bundled_recordings_and_sweeps_are_refused_for_other_robots(tmp_path: Path):
    robot, other = bm.load_robot("ballu"), tethered.ROBOT
    with pytest.raises(bm.InputError, match="bundled recordings are of BALLU"):
        bm.load_recordings("training", other)
    with pytest.raises(bm.InputError, match="actuators of tethered balloon cannot be identified"):
        bm.identify_actuators(bm.load_recordings("suspended", robot), other)
    with pytest.raises(bm.InputError, match="no such file or folder"):
        bm.load_recordings(tmp_path / "nowhere", robot)
    with pytest.raises(bm.InputError, match="There are no recordings to identify"):
        bm.identify_actuators([], robot)
    assert typing.get_type_hints(bm.evaluate)["return"] is bm.Evaluation
