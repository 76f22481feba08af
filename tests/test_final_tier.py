"""Tests of the final tier's units and tables, on made-up numbers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from experiment_modules import EXPERIMENTS, ROOT, experiment_module

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Cell, read_results
from ballu_mjx.evaluation.transfer import Transfer

DRAWN = {"tag": "final-1", "commit": "c" * 40}


@pytest.fixture(scope="module")
def final_tier() -> Iterator[ModuleType]:
    pytest.importorskip("pybullet", reason="the extra `bench` is not installed")
    with experiment_module(EXPERIMENTS / "final_tier.py") as module:
        yield module


def trial(error: float, distance: float, yaw_error: float = 0.0) -> dict[str, float]:
    found = dict.fromkeys(Transfer.__dataclass_fields__, 0.0)
    return found | {"com_error": error, "x_distance": distance, "y_distance": distance, "yaw_error": yaw_error}


def policies(error: float, distance: float, predicted: float) -> dict[str, Any]:
    """Return made-up results of one robot and training: EnvMimic's with the given numbers, and a fixed baseline."""
    return {
        "vanilla+dr": {"predicted": 0.5, "trials": [trial(1.0, 4.0), trial(3.0, 6.0)]},
        "envmimic": {"predicted": predicted, "trials": [trial(error - 0.1, distance), trial(error + 0.1, distance)]},
    }


def numbers(cell: Cell | str) -> list[float]:
    assert isinstance(cell, Cell)
    return list(cell.values)


def test_units_cover_every_robot_task_and_training_once(final_tier: ModuleType) -> None:
    units = final_tier.all_units()
    assert len({unit.name for unit in units}) == len(units) == 5 + 2 * 5 * 3
    for robot in range(5):
        mine = [unit for unit in units if unit.robot == robot]
        assert [(unit.kind, unit.training) for unit in mine if unit.kind == "fidelity"] == [("fidelity", None)]
        assert {unit.training for unit in mine if unit.kind == "turn"} == {0, 1, 2}


def test_transfer_tables_average_over_trials_then_trainings_and_compare_by_robot(final_tier: ModuleType) -> None:
    # EnvMimic's error is 1, 2 or 3 m by training. It is 2 m larger on the last robot, where it goes less far.
    results = [
        [policies(1.0 + training + 2.0 * (robot == 4), 7.0 - 5.0 * (robot == 4), 0.1) for training in range(3)]
        for robot in range(5)
    ]
    tables = final_tier.transfer_tables("walk", results)
    summary = {row[0]: dict(zip(tables["summary"].columns, row, strict=True)) for row in tables["summary"].rows}
    ours, baseline = summary["EnvMimic"], summary["vanilla+DR"]
    assert numbers(ours["mean CoM error (m)"]) == pytest.approx([2.0, 2.0, 2.0, 2.0, 4.0])
    assert numbers(baseline["mean CoM error (m)"]) == pytest.approx([2.0] * 5)
    # Student's t with four degrees of freedom: 2.776 times the standard error sqrt(0.8 / 5).
    assert ours["mean CoM error (m)"].bounds == pytest.approx((2.4 - 1.1104, 2.4 + 1.1104), abs=1e-3)
    assert ours["furthest on"] == "4 of 5" and baseline["furthest on"] == "1 of 5"
    difference = baseline["EnvMimic minus this: mean CoM error (m)"]
    assert numbers(difference) == pytest.approx([0.0, 0.0, 0.0, 0.0, 2.0])
    assert ours["EnvMimic minus this: mean CoM error (m)"] == ""
    last = [row for row in tables["robots"].rows if row[:2] == ("PyBullet 2", "EnvMimic")]
    assert [numbers(row[2]) for row in last] == [pytest.approx([3.0, 4.0, 5.0])]


def test_policy_with_the_smallest_prediction_is_chosen_for_each_training(final_tier: ModuleType) -> None:
    results = [[policies(0.5, 7.0, predicted) for predicted in (0.1, 0.9, 0.2)] for _ in range(5)]
    table = final_tier.transfer_tables("turn", results)["robots"]
    chosen = [row for row in table.rows if row[1] == final_tier.PREDICTED]
    errors = table.columns.index("mean CoM error (m)")
    assert [numbers(row[errors]) for row in chosen] == [pytest.approx([0.5, 2.0, 0.5])] * 5


def test_yaw_errors_of_both_signs_do_not_cancel(final_tier: ModuleType) -> None:
    one = {"envmimic": {"predicted": 0.1, "trials": [trial(1.0, 1.0, yaw_error=yaw) for yaw in (-30.0, 50.0)]}}
    table = final_tier.transfer_tables("turn", [[one]] * 5)["summary"]
    assert numbers(table.rows[0][table.columns.index("abs. final yaw error (deg)")]) == [40.0] * 5


def test_fidelity_tables_name_diverged_simulations(final_tier: ModuleType) -> None:
    def robot(*ratios: float | None) -> dict[str, Any]:
        return {"5": {"vanilla": {"near position": [0.2]}, "EnvMimic": {"near position": list(ratios)}}}

    found = final_tier.fidelity_tables([robot(0.2, 0.4)] * 5)
    vanilla, ours = found["5"].rows
    assert vanilla[1].to_text() == "0.200 m [0.200, 0.200]" and numbers(ours[1]) == pytest.approx([0.3] * 5)
    assert found["5"].columns == ("5 s", "near: position")
    assert found["pairs-5"].rows == ()
    broken = final_tier.fidelity_tables([robot(0.2, 0.4)] * 4 + [robot(0.2, None)])
    assert broken["5"].rows[1][1].to_text() == "diverged in 1 of 5"
    assert broken["robots"].rows[-1][2].to_text() == "diverged in 1 of 2"


def test_fidelity_is_compared_in_pairs_over_robots(final_tier: ModuleType) -> None:
    # Both simulators vary over robots by more than they differ. The white box has one fit for each robot.
    results = [
        {
            "5": {
                "vanilla": {"far position": [0.2]},
                "EnvMimic": {"far position": [x, x + 0.2]},
                "air": {"far position": [y]},
            }
        }
        for x, y in ((0.2, 0.1), (0.5, 0.3), (0.8, 0.8), (1.1, 1.0), (1.4, 1.3))
    ]
    ((label, cell),) = final_tier.fidelity_tables(results)["pairs-5"].rows
    assert label == "air" and numbers(cell) == pytest.approx([0.2, 0.3, 0.1, 0.2, 0.2])
    # Student's t with four degrees of freedom: 2.776 times the standard error sqrt(0.005 / 5).
    assert cell.bounds == pytest.approx((0.2 - 0.0878, 0.2 + 0.0878), abs=1e-3)
    broken = [*results[:4], {"5": {**results[4]["5"], "air": {"far position": [None]}}}]
    assert final_tier.fidelity_tables(broken)["pairs-5"].rows == (("air", "diverged"),)


def test_unit_of_another_commit_or_name_is_refused(final_tier: ModuleType, tmp_path: Path) -> None:
    unit = final_tier.Unit("walk", 3, 1)
    path = tmp_path / f"{unit.name}.json"
    final_tier.write_unit(path, unit, DRAWN, 12.3, policies(1.0, 2.0, 0.1))
    assert final_tier.read_unit(path, DRAWN)["result"] == policies(1.0, 2.0, 0.1)
    with pytest.raises(InputError, match=r'walk-3-1.json: "commit" is not'):
        final_tier.read_unit(path, {**DRAWN, "commit": "d" * 40})
    with pytest.raises(InputError, match='"unit" is not'):
        final_tier.read_unit(path.rename(tmp_path / "walk-3-2.json"), DRAWN)


def test_only_the_tagged_commit_may_measure(final_tier: ModuleType) -> None:
    with pytest.raises(InputError, match="run the script in a checkout of that commit"):
        final_tier.check_code(DRAWN)


def test_seeds_that_do_not_follow_from_the_commit_are_refused(final_tier: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "final.json"
    content = {"format": final_tier.FORMAT, **DRAWN, "seeds": final_tier.draw_seeds(DRAWN["commit"])}
    path.write_text(json.dumps(content))
    assert final_tier.read_seeds(path) == content
    content["seeds"]["robots"][0] += 1
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="has no seeds of a commit"):
        final_tier.read_seeds(path)


def test_tables_are_of_the_first_training_seeds_that_all_robots_have(
    final_tier: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = {**DRAWN, "seeds": final_tier.draw_seeds(DRAWN["commit"])}
    for unit in final_tier.all_units():
        measured = {"fidelity": unit.robot < 4, "walk": True, "turn": unit.training == 0 or unit.robot < 4}
        if measured[unit.kind]:
            result = policies(9.0 if unit.training else 1.0, 2.0, 0.1)
            final_tier.write_unit(tmp_path / f"{unit.name}.json", unit, drawn, 1.0, result)
    files = [tmp_path / "final_walk.json", tmp_path / "final_turn.json"]
    assert final_tier.write_tables(drawn, tmp_path, tmp_path) == files
    said = capsys.readouterr().out
    assert "fidelity: 1 of 5 units are missing" in said and "turn: 2 of 15 units are missing" in said
    walk, turn = map(read_results, files)
    assert walk.commit == DRAWN["commit"] and walk.seeds["training"] == drawn["seeds"]["trainings"][:3]
    assert walk.data.startswith("Final tier, tag final-1") and "first" not in walk.data
    assert turn.seeds["training"] == drawn["seeds"]["trainings"][:1]
    assert turn.data.endswith("the first 1 of 3 training seeds")
    for row in turn.tables["robots"].rows:
        assert numbers(row[-1]) in ([pytest.approx(1.0)], [pytest.approx(2.0)])  # the first training's alone


@pytest.mark.parametrize("path", sorted((ROOT / "results" / "final").glob("*.json")), ids=lambda path: path.name)
def test_published_units_are_of_the_drawn_commit(final_tier: ModuleType, path: Path) -> None:
    drawn = final_tier.read_seeds(ROOT / "results" / "final.json")
    assert final_tier.read_unit(path, drawn)["result"]
    assert path.stem in {unit.name for unit in final_tier.all_units()}
