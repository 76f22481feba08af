"""Errors over horizons: what simulations that break down do to scores, bounds, table and file."""

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
    """Of a recording, by horizon of `HORIZONS`: the error of each start, in m and in 10 deg."""
    given = dict(zip(HORIZONS, starts, strict=False))
    return Errors(
        name, group_of(name),
        {h: summarize_starts(values) for h, values in given.items()},
        {h: summarize_starts([10 * value for value in values]) for h, values in given.items()},
        0.1, 1.0, 0.0,
        {h: (sum(not math.isfinite(value) for value in values), len(values)) for h, values in given.items()},
    )  # fmt: skip


SOUND = errors("near-1", [[0.1, 0.3], [0.2, 0.4], [0.5, 0.7]])
PARTLY = errors("near-1", [[0.1, 0.1], [0.1, 0.1], [0.1, math.nan]])
LOST = errors("near-1", [[0.1, 0.1], [0.1, math.nan], [math.nan, math.inf]])


def test_means_are_over_the_starts_that_did_not_diverge() -> None:
    assert PARTLY.position[5.0] == (0.1, 0.0) and PARTLY.diverged[5.0] == (1, 2)
    assert LOST.position[5.0] == (math.inf, 0.0)
    assert summarize_starts([1e7, 1.0, 3.0]) == (2.0, 1.0), "a robot ten thousand kilometres off has diverged"


@pytest.mark.parametrize("residual", [PARTLY, LOST])
def test_what_diverges_is_never_within_the_bound_nor_chosen(residual: Errors) -> None:
    result = Evaluation((SOUND,), (residual,))
    worst, place = result.excess()
    assert worst == math.inf and "near-1" in place and "diverged in " in place
    assert result.score == math.inf
    assert Evaluation((SOUND,), (SOUND,)).score == 1.0


def test_an_error_that_is_no_number_counts_whatever_the_starts_say() -> None:
    broken = dataclasses.replace(SOUND, position=SOUND.position | {5.0: (math.nan, 0.0)})
    worst, place = Evaluation((SOUND,), (broken,)).excess()
    assert worst == math.inf and "at 5 s" in place


def test_where_both_diverge_alike_the_rest_decides() -> None:
    result = Evaluation((PARTLY,), (PARTLY,))
    assert result.score == 1.0 and result.excess()[0] < 0
    assert Evaluation((LOST,), (LOST,)).score == 1.0 and quotient(math.inf, math.inf) == 1.0
    assert Evaluation((LOST,), (SOUND,)).excess()[0] < math.inf, "vanilla diverges, the residual does not"


def test_table_and_file_count_what_diverged_and_hold_no_nan(tmp_path: Path) -> None:
    result = Evaluation((SOUND,), (LOST,), name="analytic")
    table = result.table()
    assert "near-1, 5 s: analytic diverged in 2 of 2 starts" in table
    assert "near-1, 2 s: analytic diverged in 1 of 2 starts" in table
    assert "vanilla diverged" not in table and "± is the standard deviation over starts" in table
    text = json.dumps(evaluation_to_json(result))
    for word in ("nan", "inf"):
        assert word not in table.lower() and word not in text.lower()
    (tmp_path / "evaluation.json").write_text(text)
    assert read_evaluation(tmp_path / "evaluation.json") == result


def test_a_group_s_means_keep_the_count() -> None:
    other = errors("near-2", [[0.3], [0.3], [math.nan]])
    (mean,) = mean_by_group([PARTLY, other])
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
        without("diverged"),  # as before divergence was counted
        without("orientation"),
        evaluation_to_json(Evaluation((SOUND,), (SOUND,))) | {"vanilla": []},
        evaluation_to_json(Evaluation((SOUND,), (errors("near-2", [[0.1]]),))),
        evaluation_to_json(
            Evaluation((dataclasses.replace(SOUND, group="far"),), (dataclasses.replace(SOUND, group="far"),))
        ),
        evaluation_to_json(Evaluation((SOUND,), (dataclasses.replace(SOUND, diverged={1.0: (3, 2)}),))),
    ],
)
def test_what_is_no_evaluation_is_refused_with_the_command_that_makes_it(
    tmp_path: Path, content: dict[str, Any]
) -> None:
    (tmp_path / "evaluation.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="is no evaluation .* evaluate"):
        read_evaluation(tmp_path / "evaluation.json")


NAMES = (("near-3", "near"), ("far-1", "far"), ("stairs-up-2", "stairs"), ("policy", "other"), ("-x", "other"))


@pytest.mark.parametrize(("name", "group"), NAMES)
def test_groups_are_the_names_prefixes(name: str, group: str) -> None:
    assert group_of(name) == group


def test_nominal_vanilla_stands_beside_vanilla_with_identified_actuators() -> None:
    nominal = errors("near-1", [[0.9], [0.9], [0.9]])
    result = Evaluation((SOUND,), (PARTLY,), "vanilla+sysid", "analytic", (nominal,))
    header = next(line for line in result.table().splitlines() if "(s)" in line)
    assert header.split("|")[1].split() == ["vanilla", "vanilla+sysid", "analytic", "ratio"]
    assert "0.900 ± 0.000" in result.table()
    assert evaluation_from_json(json.loads(json.dumps(evaluation_to_json(result)))) == result
    assert result.ratio("near", "position", 1.0) == pytest.approx(0.1 / 0.2), "ratios are to the base"


def test_angles_between_orientations_pass_the_vertical() -> None:
    """A pendulum swings about y: its yaw flips by 180 deg where it passes 90 deg of pitch, its angle does not."""
    angles = np.deg2rad([80.0, 89.0, 91.0, 179.0, -170.0])
    turned = Rotation.from_euler("y", angles[:, None]).as_euler("ZYX")[:, ::-1]
    recorded = Rotation.from_euler("y", angles[:, None] - np.deg2rad(4.0)).as_euler("ZYX")[:, ::-1]
    np.testing.assert_allclose(orientation_errors(turned, recorded, upright=False), 4.0, atol=1e-6)
    assert np.abs(orientation_errors(turned, recorded, upright=True)).max() > 179
    way = np.zeros((2, 3)), np.array([[0.3, 0.0, 3.1], [0.0, 0.2, 0.1]])
    np.testing.assert_allclose(orientation_errors(*way, upright=True), -np.rad2deg([3.1, 0.1]))


def test_horizons_are_the_robot_s_or_fit_the_recordings() -> None:
    assert choose_horizons((), 30.0) == HORIZONS and max(choose_horizons((), 0.8)) < 0.8
    assert choose_horizons((0.2, 0.4), 30.0) == (0.2, 0.4)
    short = Errors("near-1", "near", {0.4: (0.1, 0.0)}, {0.4: (1.0, 0.0)}, 0.1, 1.0, 0.0)
    assert Evaluation((short,), (short,)).score == 1.0 and f"{0.4:>8g} |" in Evaluation((short,), (short,)).table()


def test_medians_and_the_share_of_finite_starts_are_told() -> None:
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
