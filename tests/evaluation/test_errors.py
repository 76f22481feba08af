"""Errors over horizons, and the effect of diverged simulations on scores, bounds, tables and files."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.errors import (
    HORIZONS,
    Errors,
    Evaluation,
    choose_horizons,
    mean_by_group,
    orientation_errors,
    quotient,
    summarize_starts,
)
from ballu_mjx.evaluation.errors_file import evaluation_from_json, evaluation_to_json, read_evaluation
from ballu_mjx.recordings.recording_groups import group_of


def errors(name: str, starts: list[list[float]]) -> Errors:
    """Return the errors of a recording from `starts`: for each of `HORIZONS`, the error of each start.

    A value x is a position error of x m and a yaw error of 10 x deg.
    """
    given = dict(zip(HORIZONS, starts, strict=False))
    return Errors(
        name, group_of(name),
        {h: summarize_starts(values) for h, values in given.items()},
        {h: summarize_starts([10 * value for value in values]) for h, values in given.items()},
        0.1, 1.0, 0.0,
        {h: (sum(not math.isfinite(value) for value in values), len(values)) for h, values in given.items()},
    )  # fmt: skip


SOUND = errors("near-1", [[0.1, 0.3], [0.2, 0.4], [0.5, 0.7]])
PARTLY_DIVERGED = errors("near-1", [[0.1, 0.1], [0.1, 0.1], [0.1, math.nan]])
DIVERGED = errors("near-1", [[0.1, 0.1], [0.1, math.nan], [math.nan, math.inf]])


def test_means_are_over_the_starts_that_did_not_diverge() -> None:
    assert PARTLY_DIVERGED.position[5.0] == (0.1, 0.0) and PARTLY_DIVERGED.diverged[5.0] == (1, 2)
    assert DIVERGED.position[5.0] == (math.inf, 0.0)
    assert summarize_starts([1e7, 1.0, 3.0]) == (2.0, 1.0), "an error of 10,000 km must count as diverged"


@pytest.mark.parametrize("residual", [PARTLY_DIVERGED, DIVERGED])
def test_diverged_residual_exceeds_the_bound_and_has_an_infinite_score(residual: Errors) -> None:
    result = Evaluation((SOUND,), (residual,))
    worst, location = result.excess()
    assert worst == math.inf and "near-1" in location and "diverged in " in location
    assert result.score == math.inf
    assert Evaluation((SOUND,), (SOUND,)).score == 1.0


def test_nan_error_exceeds_the_bound_for_any_number_of_diverged_starts() -> None:
    broken = dataclasses.replace(SOUND, position=SOUND.position | {5.0: (math.nan, 0.0)})
    worst, location = Evaluation((SOUND,), (broken,)).excess()
    assert worst == math.inf and "at 5 s" in location


def test_ratio_is_infinite_if_a_start_diverges_with_the_residual_alone() -> None:
    """The means leave out the start that diverged, and would be smaller with the residual."""
    result = Evaluation((SOUND,), (PARTLY_DIVERGED,))
    assert result.ratio("near", "position", 5.0) == math.inf
    assert result.ratio("near", "position", 1.0) == pytest.approx(0.5)
    assert Evaluation((PARTLY_DIVERGED,), (SOUND,)).ratio("near", "position", 5.0) == pytest.approx(6.0)


def test_ratio_leaves_out_recordings_in_which_the_base_simulator_always_diverges() -> None:
    """Both means are over the same recordings."""
    large = errors("near-2", [[1.0], [1.0], [9.0]])
    result = Evaluation((SOUND, DIVERGED), (SOUND, large))
    assert result.ratio("near", "position", 5.0) == 1.0


def test_starts_that_diverge_in_both_simulators_do_not_affect_the_score() -> None:
    result = Evaluation((PARTLY_DIVERGED,), (PARTLY_DIVERGED,))
    assert result.score == 1.0 and result.excess()[0] < 0
    assert Evaluation((DIVERGED,), (DIVERGED,)).score == 1.0 and quotient(math.inf, math.inf) == 1.0
    assert Evaluation((DIVERGED,), (SOUND,)).excess()[0] < math.inf, "vanilla diverges, but the residual does not"


def test_table_and_file_count_diverged_starts_and_contain_no_nan(tmp_path: Path) -> None:
    result = Evaluation((SOUND,), (DIVERGED,), name="analytic")
    table = result.table()
    assert "near-1, 5 s: analytic diverged in 2 of 2 starts" in table
    assert "near-1, 2 s: analytic diverged in 1 of 2 starts" in table
    assert "vanilla diverged" not in table and "± is the standard deviation over starts" in table
    text = json.dumps(evaluation_to_json(result))
    for word in ("nan", "inf"):
        assert word not in table.lower() and word not in text.lower()
    (tmp_path / "evaluation.json").write_text(text)
    assert read_evaluation(tmp_path / "evaluation.json") == result


def test_group_means_keep_the_number_of_diverged_starts() -> None:
    other = errors("near-2", [[0.3], [0.3], [math.nan]])
    (mean,) = mean_by_group([PARTLY_DIVERGED, other])
    assert mean.diverged[5.0] == (2, 3) and mean.position[5.0][0] == pytest.approx(0.1)
    assert Evaluation(mean_by_group([SOUND, SOUND]), (mean,)).excess()[0] == math.inf


def without(row: str) -> dict[str, Any]:
    content = evaluation_to_json(Evaluation((SOUND,), (SOUND,)))
    for errors in content["vanilla"] + content["residual"]:
        errors.pop(row)
    return content


@pytest.mark.parametrize(
    "content",
    [
        without("diverged"),  # written before diverged starts were counted
        without("orientation"),
        evaluation_to_json(Evaluation((SOUND,), (SOUND,))) | {"vanilla": []},
        evaluation_to_json(Evaluation((SOUND,), (errors("near-2", [[0.1]]),))),
        evaluation_to_json(
            Evaluation((dataclasses.replace(SOUND, group="far"),), (dataclasses.replace(SOUND, group="far"),))
        ),
        evaluation_to_json(Evaluation((SOUND,), (dataclasses.replace(SOUND, diverged={1.0: (3, 2)}),))),
    ],
)
def test_invalid_evaluation_is_refused_with_the_command_that_writes_it(tmp_path: Path, content: dict[str, Any]) -> None:
    (tmp_path / "evaluation.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="is no evaluation .* evaluate"):
        read_evaluation(tmp_path / "evaluation.json")


NAMES = (("near-3", "near"), ("far-1", "far"), ("stairs-up-2", "stairs"), ("policy", "other"), ("-x", "other"))


@pytest.mark.parametrize(("name", "group"), NAMES)
def test_groups_are_prefixes_of_recording_names(name: str, group: str) -> None:
    assert group_of(name) == group


def test_table_shows_vanilla_beside_vanilla_with_identified_actuators() -> None:
    nominal = errors("near-1", [[0.9], [0.9], [0.9]])
    result = Evaluation((SOUND,), (PARTLY_DIVERGED,), "vanilla+sysid", "analytic", (nominal,))
    header = next(line for line in result.table().splitlines() if "(s)" in line)
    assert header.split("|")[1].split() == ["vanilla", "vanilla+sysid", "analytic", "ratio"]
    assert "0.900 ± 0.000" in result.table()
    assert evaluation_from_json(json.loads(json.dumps(evaluation_to_json(result)))) == result
    assert result.ratio("near", "position", 1.0) == pytest.approx(0.1 / 0.2), "ratios must be relative to the base"


def test_orientation_errors_are_continuous_through_the_vertical() -> None:
    """A pendulum swings about y. Its yaw jumps by 180 deg at a pitch of 90 deg, but the orientation error does not."""
    angles = np.deg2rad([80.0, 89.0, 91.0, 179.0, -170.0])
    simulated = Rotation.from_euler("y", angles[:, None]).as_euler("ZYX")[:, ::-1]
    recorded = Rotation.from_euler("y", angles[:, None] - np.deg2rad(4.0)).as_euler("ZYX")[:, ::-1]
    np.testing.assert_allclose(orientation_errors(simulated, recorded, upright=False), 4.0, atol=1e-6)
    assert np.abs(orientation_errors(simulated, recorded, upright=True)).max() > 179
    angles_of_both = np.zeros((2, 3)), np.array([[0.3, 0.0, 3.1], [0.0, 0.2, 0.1]])
    np.testing.assert_allclose(orientation_errors(*angles_of_both, upright=True), -np.rad2deg([3.1, 0.1]))


def test_horizons_are_those_of_the_robot_or_fit_the_recordings() -> None:
    assert choose_horizons((), 30.0) == HORIZONS and max(choose_horizons((), 0.8)) < 0.8
    assert choose_horizons((0.2, 0.4), 30.0) == (0.2, 0.4)
    short = Errors("near-1", "near", {0.4: (0.1, 0.0)}, {0.4: (1.0, 0.0)}, 0.1, 1.0, 0.0)
    assert Evaluation((short,), (short,)).score == 1.0 and f"{0.4:>8g} |" in Evaluation((short,), (short,)).table()


def test_table_shows_medians_and_the_percentage_of_finite_starts() -> None:
    medians = {"position": {1.0: 0.2}, "orientation": {1.0: 3.0}, "joints": {1.0: math.inf}}
    each = Errors(
        "near-1", "near", {1.0: (0.2, 0.0)}, {1.0: (3.0, 0.0)}, 0.1, 1.0, 0.0, {1.0: (1, 4)},
        joints={1.0: (math.inf, 0.0)}, medians=medians, first_diverged=(20, 7),
    )  # fmt: skip
    result = Evaluation((each,), (each,), angle="orientation")
    table = result.table()
    assert "near joints (deg)" in table and "75%" in table and "7 control steps after step 20" in table
    assert (
        "orientation RMSE (deg)" in table and "yaw" not in table and "nan" not in table and "inf" not in table.split()
    )
    assert evaluation_from_json(json.loads(json.dumps(evaluation_to_json(result)))) == result
