"""Named sets of options of `train envmimic`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.rl.ppo import PPOConfig

PresetName = Literal["paper"]


class Setting(NamedTuple):
    """Value of an option in a preset, with its source."""

    value: Any
    source: str
    """Source of the value, as text for the user."""


_PAPER = "paper"
_SB3 = "Stable-Baselines3's default"
_NONE = "the paper has none"
_OPEN = "not in the paper"
_TO_THE_END = 1000.0
"""Length of an episode that always lasts to the end of the recording (s)."""

PRESETS: Mapping[PresetName, Mapping[str, Mapping[str, Setting]]] = {
    "paper": {
        "env": {
            "forces": Setting("force", _PAPER),
            "force_limit": Setting(1.0, _PAPER),
            "force_scale": Setting(1.0, "the paper's actions are newtons"),
            "expected_loads": Setting((0.0,), "the paper's forces start at 0"),
            "observe_command": Setting(False, _PAPER),
            "relative_observation": Setting(False, _PAPER),
            "heading_frame": Setting(False, _PAPER),
            "position_weight": Setting(0.7, _PAPER),
            "orientation_weight": Setting(0.3, _PAPER),
            "position_scale": Setting(10.0, _PAPER),
            "orientation_scale": Setting(2.0, _PAPER),
            "orientation_axes": Setting((0.2, 0.4, 0.4), "paper; the order of the axes is ours"),
            "fine_position_weight": Setting(0.0, _NONE),
            "fine_orientation_weight": Setting(0.0, _NONE),
            "force_cost": Setting(0.0, _NONE),
            "critic_sees_error": Setting(False, f"{_SB3}: one observation for both networks"),
            "observation_noise": Setting(0.0, _NONE),
            "start_noise": Setting(0.0, "paper: starts are recorded states"),
            "episode_seconds": Setting(_TO_THE_END, f"{_OPEN}: to the recording's end"),
            "episode_spread": Setting(0.0, f"{_OPEN}: to the recording's end"),
        },
        "ppo": {
            "num_envs": Setting(64, f"{_SB3}: with unroll_length, 2048 steps for an update"),
            "unroll_length": Setting(32, f"{_SB3}: with num_envs, 2048 steps for an update"),
            "batch_size": Setting(2, f"{_SB3}: with unroll_length, 64 steps in a minibatch"),
            "num_minibatches": Setting(32, f"{_SB3}: 32 minibatches of 64 steps for an update"),
            "num_updates_per_batch": Setting(10, _SB3),
            "learning_rate": Setting(3e-4, _SB3),
            "desired_kl": Setting(0.0, f"{_SB3}: the learning rate is constant"),
            "entropy_cost": Setting(0.0, _SB3),
            "value_cost": Setting(0.5, _SB3),
            "discounting": Setting(0.99, _SB3),
            "gae_lambda": Setting(0.95, _SB3),
            "clipping_epsilon": Setting(0.2, _SB3),
            "reward_scaling": Setting(1.0, _SB3),
            "max_grad_norm": Setting(0.5, _SB3),
            "adam_epsilon": Setting(1e-5, _SB3),
            "normalize_observations": Setting(False, _SB3),
            "policy_layers": Setting((64, 64), _PAPER),
            "value_layers": Setting((64, 64), _SB3),
            "activation": Setting("tanh", _SB3),
            "orthogonal_init": Setting(True, _SB3),
            "initial_std": Setting(1.0, _SB3),
            "averaging": Setting(1, f"{_SB3}: the last iterate"),
        },
    },
}
"""Presets by name, section of the configuration, and option.

`paper` has the values of Sontakke et al. (2023, section "Residual Dynamics Learning via Reinforcement Learning"). The
paper uses the PPO of Stable-Baselines3, so values that it does not state are that library's defaults. Options without a
value here (num_timesteps, seed) are stated by neither.
"""


def preset_values(name: PresetName) -> dict[str, dict[str, Any]]:
    """Return the values of a preset by section and option."""
    return {section: {option: s.value for option, s in each.items()} for section, each in PRESETS[name].items()}


def preset_configs(name: PresetName, **changes: Any) -> tuple[EnvMimicConfig, PPOConfig]:
    """Return the configurations of a preset. `changes` replace options of the PPO configuration."""
    values = preset_values(name)
    return EnvMimicConfig(**values["env"]), PPOConfig(**{**values["ppo"], **changes})


def describe_preset(name: PresetName, env: EnvMimicConfig, ppo: PPOConfig) -> str:
    """Return a table of a preset's options, their values and their sources, as text.

    The table also shows the values in `env` and `ppo` that differ from the preset.
    """
    rows = []
    for section, config in (("env", env), ("ppo", ppo)):
        assert dataclasses.is_dataclass(config)
        for option, setting in PRESETS[name][section].items():
            value = getattr(config, option)
            changed = "" if value == setting.value else f", but given as {value}"
            rows.append((f"--{option.replace('_', '-')}", f"{setting.value}{changed}", setting.source))
    widths = [max(len(row[column]) for row in rows) for column in range(2)]
    return "\n".join(f"  {row[0]:{widths[0]}}  {row[1]:{widths[1]}}  {row[2]}" for row in rows)
