"""Training in two processes: it agrees with training in one, and only the first process writes the run."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ballu_mjx.cli._command import open_run
from ballu_mjx.common.errors import InputError
from ballu_mjx.rl import distributed
from ballu_mjx.rl.distributed import DistributedOptions
from ballu_mjx.runs.checkpoints import last_checkpoint
from ballu_mjx.runs.folder import Run
from ballu_mjx.runs.layout import RUN_FORMAT
from ballu_mjx.runs.metrics import read_metrics

TRAINING = """
import json, sys
from ballu_mjx.common import runtime
runtime.prepare()
from pathlib import Path
from ballu_mjx.rl import distributed, ppo
from ballu_mjx.rl.resume_point import ResumePoint
from ballu_mjx.rl.training_loop import TrainingLoop, Validation
from ballu_mjx.runs.folder import Run
from follower import Follower, weight

options, folder = json.loads(sys.argv[1]), Path(sys.argv[2])
distributed.join(distributed.DistributedOptions(**options))
config = ppo.PPOConfig(num_envs=32, batch_size=16, num_minibatches=2, unroll_length=5, num_timesteps=160 * 6,
                       policy_layers=(8,), value_layers=(8,))
sections = {"env": Follower.limit, "ppo": config}
content = {"task": "follow", "starts": [], "recordings": {}, "ppo": {"learning_rate": 1e-4, "seed": 0}}
if distributed.is_first():
    with Run(folder, content) as run:
        TrainingLoop(run, None, 320, Validation(weight)).train(Follower(), config, ResumePoint(), content)
else:
    TrainingLoop(None, None, 320, Validation(weight)).train(Follower(), config, ResumePoint(), content)
"""


PHYSICS = """
import json, sys
from ballu_mjx.common import runtime
runtime.prepare()
from ballu_mjx.ballu.model import load_model
from ballu_mjx.rl import distributed
from ballu_mjx.sim.step import make_data, put_model
import jax

distributed.join(distributed.DistributedOptions(**json.loads(sys.argv[1])))
model = load_model()
for leaf in jax.tree.leaves((put_model(model), make_data(model))):
    assert not isinstance(leaf, jax.Array) or leaf.is_fully_addressable, leaf.sharding
distributed.meet()
"""

FAILURE = """
import json, sys
from ballu_mjx.rl import distributed

options = json.loads(sys.argv[1])
distributed.join(distributed.DistributedOptions(**options))
if options["process_id"] == 1:
    distributed.leave(2)
distributed.meet()
"""


def start(code: str, folder: Path, devices: int, **options: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", code, json.dumps(options), str(folder)]
    path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": path}
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def finish(*processes: subprocess.Popen[str]) -> None:
    try:
        for process in processes:
            _, errors = process.communicate(timeout=300)
            assert process.returncode == 0, errors
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def together() -> dict[str, Any]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return {"coordinator": f"127.0.0.1:{port}", "num_processes": 2}


@pytest.mark.slow
def test_two_processes_agree_with_one_process_with_two_devices(tmp_path: Path) -> None:
    options = together()
    both = [start(TRAINING, tmp_path / f"process-{i}", 1, **options, process_id=i) for i in range(2)]
    finish(*both, start(TRAINING, tmp_path / "alone", 2))

    def curve(folder: str) -> list[list[float]]:
        rows = read_metrics(tmp_path / folder)
        return [[row["reward"], row["total_loss"], row["distance"]] for row in rows if "reward" in row]

    assert len(curve("process-0")) == 6
    np.testing.assert_allclose(curve("process-0"), curve("alone"), rtol=1e-6)
    assert not (tmp_path / "process-1").exists()
    kept, expected = (last_checkpoint(tmp_path / name, training=True) for name in ("process-0", "alone"))
    assert kept.step == expected.step
    assert kept.training is not None and expected.training is not None
    for name, values in expected.training.items():  # including the environments of both processes
        np.testing.assert_allclose(kept.training[name], values, rtol=1e-5, atol=1e-6, err_msg=name)


@pytest.mark.slow
def test_every_process_holds_the_model_on_its_own_devices(tmp_path: Path) -> None:
    options = together()
    finish(*(start(PHYSICS, tmp_path, 1, **options, process_id=i) for i in range(2)))


def test_a_failing_process_exits_while_others_wait_for_it(tmp_path: Path) -> None:
    options = together()
    waiting, failing = (start(FAILURE, tmp_path, 1, **options, process_id=i) for i in range(2))
    try:
        assert failing.wait(60) == 2
        assert waiting.poll() is None
    finally:
        for process in (waiting, failing):
            process.kill()
            process.communicate()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"process_id": 1}, "--process-id needs --coordinator"),
        ({"coordinator": "here:1"}, "needs --num-processes and --process-id"),
        ({"coordinator": "here:1", "num_processes": 2, "process_id": 2}, "must be 0 to 1"),
        ({"coordinator": "here", "num_processes": 2, "process_id": 1}, "give host:port"),
    ],
)
def test_inconsistent_options_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        distributed.join(DistributedOptions(**given))


def test_a_process_beside_the_first_has_a_result_if_nothing_is_left_to_train(tmp_path: Path):
    content = {"format": RUN_FORMAT, "task": "walk", "starts": []}
    with Run(tmp_path / "run", content) as run:
        run.save(10, {"weight": np.ones(1)}, 0.5)
    with open_run(tmp_path / "run", content, 10, None, first=False) as record:
        assert record.best()[0] == 10
        record.save(20, {"weight": np.zeros(1)}, 0.9)
        assert record.best()[0] == 20
