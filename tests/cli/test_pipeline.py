"""Stages of the pipeline: they are cached, and made again if an option or an earlier stage has changed."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ballu_mjx.ballu.virtual.hardware import VirtualHardware
from ballu_mjx.cli import pipeline, train_policy
from ballu_mjx.cli.cached_stages import cached_stage
from ballu_mjx.cli.pipeline import Options
from ballu_mjx.common.errors import InputError
from ballu_mjx.residuals.presets import preset_configs
from ballu_mjx.runs.checkpoints import restore_checkpoint
from ballu_mjx.runs.folder import Run
from ballu_mjx.runs.layout import RUN_FORMAT
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE


class Interrupted(Exception):
    pass


def run_stages(root: Path, options: dict[str, int], stop_at: str | None = None) -> list[str]:
    """Run three stages, each of which needs the previous one. Return the names of the stages that were made."""
    made: list[str] = []

    def make(name: str) -> Path:
        def write(folder: Path) -> None:
            (folder / "begun").touch()
            if name == stop_at:
                raise Interrupted
            made.append(name)
            (folder / "result").write_text(str(options[name]))

        needs = [] if name == "a" else [make(chr(ord(name) - 1))]
        return cached_stage(root / name, {"value": options[name]}, needs, write)

    make("c")
    return made


def test_finished_stages_are_not_made_again(tmp_path):
    assert run_stages(tmp_path, {"a": 1, "b": 2, "c": 3}) == ["a", "b", "c"]
    assert run_stages(tmp_path, {"a": 1, "b": 2, "c": 3}) == []


def test_interrupted_pipeline_continues_with_the_unfinished_stage(tmp_path):
    with pytest.raises(Interrupted):
        run_stages(tmp_path, {"a": 1, "b": 2, "c": 3}, stop_at="b")
    assert (tmp_path / "b" / "begun").exists()
    assert run_stages(tmp_path, {"a": 1, "b": 2, "c": 3}) == ["b", "c"]


def test_changed_option_remakes_dependent_stages_and_keeps_the_old_ones(tmp_path):
    run_stages(tmp_path, {"a": 1, "b": 2, "c": 3})
    assert run_stages(tmp_path, {"a": 1, "b": 20, "c": 3}) == ["b", "c"]
    assert (tmp_path / "b" / "result").read_text() == "20"
    renamed = [path for path in tmp_path.glob("b.*") if path.is_dir()]
    assert [(path / "result").read_text() for path in renamed] == ["2"]


def test_a_stage_that_was_renamed_is_used_again_when_its_options_return(tmp_path):
    first, second = {"a": 1, "b": 2, "c": 3}, {"a": 1, "b": 20, "c": 3}
    run_stages(tmp_path, first)
    assert run_stages(tmp_path, second) == ["b", "c"]
    for options in (first, second, first):
        assert run_stages(tmp_path, options) == []
        assert (tmp_path / "b" / "result").read_text() == str(options["b"])
    with pytest.raises(Interrupted):
        run_stages(tmp_path, {"a": 1, "b": 30, "c": 3}, stop_at="b")
    assert run_stages(tmp_path, first) == []
    assert run_stages(tmp_path, {"a": 1, "b": 30, "c": 3}) == ["b", "c"]  # an unfinished one is made anew


@pytest.mark.parametrize(
    "options", [{"seeds": (0, 1, 0)}, {"tasks": ("walk", "walk")}, {"also": ("supervised", "supervised")}]
)
def test_repeated_entries_are_refused(tmp_path, options: dict):
    """A copy is no other sample: intervals over seeds would be too narrow."""
    with pytest.raises(InputError, match="twice; a repetition is no other sample"):
        pipeline.run(Options(output=tmp_path / "out", **options))


def test_folders_of_the_user_are_neither_used_nor_removed(tmp_path):
    own = tmp_path / "out" / "seed-0" / "walk-vanilla+dr" / "notes.txt"
    own.parent.mkdir(parents=True)
    own.write_text("mine")
    with pytest.raises(InputError, match="was not made by `train all`"):
        pipeline.run(Options(output=tmp_path / "out"))
    with pytest.raises(InputError, match="was not made by `train all`"):
        cached_stage(own.parent, {}, [], lambda folder: None)
    assert own.read_text() == "mine"


def test_unfinished_stages_are_made_again(tmp_path):
    run_stages(tmp_path, {"a": 1, "b": 2, "c": 3})
    mark = tmp_path / "b.stage.json"
    content = json.loads(mark.read_text())
    mark.write_text(json.dumps(content | {"done": False}))
    assert run_stages(tmp_path, {"a": 1, "b": 2, "c": 3}) == ["b"]


def test_a_deleted_folder_is_made_again(tmp_path):
    """Messages about damaged results advise to delete a stage's folder."""
    run_stages(tmp_path, {"a": 1, "b": 2, "c": 3})
    shutil.rmtree(tmp_path / "b")
    assert run_stages(tmp_path, {"a": 1, "b": 2, "c": 3}) == ["b"]


def test_the_advice_on_a_damaged_mark_works(tmp_path):
    run_stages(tmp_path, {"a": 1, "b": 2, "c": 3})
    mark = tmp_path / "b.stage.json"
    mark.write_text("{}")
    with pytest.raises(InputError, match=r"b\.stage\.json: .*; delete it and the folder b, and the stage will be made"):
        run_stages(tmp_path, {"a": 1, "b": 2, "c": 3})
    mark.unlink()
    shutil.rmtree(tmp_path / "b")
    assert run_stages(tmp_path, {"a": 1, "b": 2, "c": 3}) == ["b"]


def test_a_policy_that_the_user_has_resumed_to_its_end_is_kept(tmp_path, monkeypatch):
    """An interrupted training prints how to resume it without the pipeline."""
    options = Options(output=tmp_path, policy_steps=1000)
    stages = pipeline.PipelineStages(options, 0, VirtualHardware.draw(0))

    def interrupted(task: Any, data: train_policy.Data, config: Any, ppo: Any) -> None:
        assert data.output is not None
        content = {"format": RUN_FORMAT, "task": "walk", "starts": []}
        with Run(data.output, content) as run:
            run.save(500, {"weight": np.zeros(1)}, None)
        raise KeyboardInterrupt

    monkeypatch.setattr(train_policy, "train", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stages.policy("walk", "vanilla+dr")
    folder = tmp_path / "seed-0" / "walk-vanilla+dr"
    with Run(folder, {"format": RUN_FORMAT, "task": "walk", "starts": []}, resumed_at=500) as run:
        run.save(1000, {"weight": np.ones(1)}, 0.5)
    (folder / ROLLOUT_FILE).touch()
    monkeypatch.setattr(train_policy, "train", lambda *_: pytest.fail("trained again"))
    assert stages.policy("walk", "vanilla+dr") == folder
    assert restore_checkpoint(folder, "best")[0] == 1000


def test_trial_draws_are_unique_and_reproducible():
    draws = [
        pipeline._draw(seed, task, use, number)
        for seed in (0, 1)
        for task in ("walk", "turn")
        for use in ("recordings", "trials", "round 2")
        for number in range(10)
    ]
    assert len(set(draws)) == len(draws)
    assert pipeline._draw(0, "walk", "trials", 3) == pipeline._draw(0, "walk", "trials", 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"trials": 0}, "--trials is 0"),
        ({"policy_steps": -5}, "--policy-steps is -5"),
        ({"seeds": ()}, "at least one seed"),
        ({"tasks": ()}, "--tasks is empty"),
        ({"outside_cost": -1.0}, "--outside-cost is -1"),
        ({"push_force": -0.1}, "--push-force is -0.1"),
    ],
)
def test_options_out_of_range_are_refused_before_anything_is_written(options, message, tmp_path):
    with pytest.raises(InputError, match=message):
        pipeline.run(Options(output=tmp_path / "out", **options))
    assert not (tmp_path / "out").exists()


def test_each_round_learns_from_all_recordings_so_far(tmp_path, monkeypatch):
    """The test records the needs of each stage, and makes none. A stage is identified by its folder."""
    needs: dict[str, list[str]] = {}
    costs: dict[str, float] = {}
    learned: dict[str, Any] = {}
    pushes: dict[str, tuple[float, float]] = {}

    def stage(folder, options, sources, make, goes_on=True):
        needs[folder.name] = [source.name for source in sources]
        if folder.name.startswith("walk-"):
            costs[folder.name] = options[0].outside_cost
            pushes[folder.name] = options[0].push_force, options[0].push_torque
        if folder.name.startswith("envmimic-"):
            learned[folder.name] = options
        return folder

    monkeypatch.setattr(pipeline, "cached_stage", stage)
    also = "envmimic-near", "envmimic-shared", "envmimic-wrench", "envmimic-paper", "supervised"
    options = Options(output=tmp_path, rounds=3, also=also, outside_cost=2.0, push_force=0.3, push_torque=0.04)
    stages = pipeline.PipelineStages(options, 0, VirtualHardware.draw(0))
    for setting in pipeline.settings_of(options):
        stages.policy("walk", setting)
    stages.prediction("walk")
    policies = [f"walk-{setting}" for setting in pipeline.settings_of(options)]
    assert needs["prediction-walk"] == ["sysid", "envmimic-walk", "aerodynamic-walk", *policies]
    assert pipeline.settings_of(options) == (*pipeline.PAPER_SIMULATORS, "envmimic-2", "envmimic-3", *options.also)
    recordings = ["recordings-walk", "recordings-walk-2", "recordings-walk-3"]
    for number, name in enumerate(("envmimic-walk", "envmimic-walk-2", "envmimic-walk-3"), 1):
        assert needs[name] == [*recordings[:number], "sysid"]
    assert needs["recordings-walk-3"] == ["walk-envmimic-2"]
    assert needs["walk-envmimic-3"] == ["envmimic-walk-3"]
    assert needs["walk-envmimic"] == needs["walk-envmimic-near"] == ["envmimic-walk"]
    assert {name: cost for name, cost in costs.items() if cost} == {"walk-envmimic-near": 2.0}
    assert {name for name, push in pushes.items() if push == (0.0, 0.0)} == {
        "walk-vanilla",
        "walk-vanilla+dr",
        "walk-vanilla+sysid",
        "walk-vanilla+sysid+dr",
    }
    assert pushes["walk-envmimic-2"] == pushes["walk-aerodynamic"] == (0.3, 0.04)
    assert needs["aerodynamic-walk"] == needs["supervised-walk"] == ["recordings-walk", "sysid"]
    assert {name for name, (env, _) in learned.items() if env.forces != "force"} == {"envmimic-wrench-walk"}
    assert learned["envmimic-wrench-walk"][0].forces == "wrench"
    paper = preset_configs("paper", num_timesteps=options.residual_steps)
    assert {name for name, configs in learned.items() if configs == paper} == {"envmimic-paper-walk"}
    assert needs["envmimic-shared"] == ["recordings-walk", "recordings-turn", "sysid"]
    assert needs["walk-envmimic-shared"] == ["envmimic-shared"]
