"""Training from the command line: `python -m ballu_mjx.train sysid`, `... envmimic`, `... walk` and so on.

JAX, and all that needs it, is imported inside functions: `runtime.prepare` has to come first.
"""

# Not postponed here: tyro reads the annotations of functions whose names exist only inside `subcommands`.
import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import tyro

from ballu_mjx.common import runtime
from ballu_mjx.common.errors import InputError

if TYPE_CHECKING:
    from ballu_mjx.rl.ppo import PPOConfig


Config = TypeVar("Config")
Data = TypeVar("Data")
_KEPT = ("validate_every", "keep_every", "wandb")
"""Options of the training commands' data that a run keeps."""
_PROGRAM = "python -m ballu_mjx.train"
_SIGNALS = 128
"""Statuses from here on are of processes that were interrupted, all of them together."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status (`runtime.exit_status`)."""
    arguments = _by_method(sys.argv[1:] if arguments is None else arguments)

    def run() -> int:
        _check_robot(arguments)
        runtime.prepare()
        return tyro.extras.subcommand_cli_from_dict(
            subcommands(arguments),
            args=arguments,
            prog=_PROGRAM,
            description="Learn from recordings of the robot. Each subcommand explains its options with --help.",
            config=(tyro.conf.OmitArgPrefixes,),
        )

    status = runtime.exit_status(run, arguments)
    if 0 < status < _SIGNALS and "jax" in sys.modules:
        from ballu_mjx.rl import distributed

        distributed.leave(status)
    return status


def subcommands(arguments: Sequence[str] = ()) -> dict[str, Callable[..., int]]:
    """Subcommands by name. A function's parameters are its options, their defaults depend on --resume and --quick."""
    from ballu_mjx.ballu.leg_parameters import IdentificationConfig
    from ballu_mjx.cli import pipeline, train_aerodynamics, train_envmimic, train_forces, train_policy, train_sysid
    from ballu_mjx.policies.locomotion_env import LocomotionConfig
    from ballu_mjx.policies.tasks import TASKS, Task
    from ballu_mjx.residuals.aerodynamics_fit import AirConfig
    from ballu_mjx.residuals.analytic import AnalyticConfig
    from ballu_mjx.residuals.envmimic import EnvMimicConfig
    from ballu_mjx.residuals.supervised import SupervisedConfig
    from ballu_mjx.rl.ppo import PPOConfig

    data_defaults, env_defaults, ppo_defaults = _defaults(
        arguments, "envmimic", train_envmimic.Data, EnvMimicConfig, PPOConfig, train_envmimic.QUICK
    )
    fit_defaults = IdentificationConfig(**train_sysid.QUICK if "--quick" in arguments else {})

    def envmimic(
        data: train_envmimic.Data = data_defaults,
        env: EnvMimicConfig = env_defaults,
        ppo: PPOConfig = ppo_defaults,
    ) -> int:
        """Learn residual forces from recordings, and measure them on recordings that training never saw."""
        return train_envmimic.train(data, env, ppo)

    quick = "--quick" in arguments
    air_defaults = AirConfig(**train_aerodynamics.QUICK if quick else {})
    supervised_defaults = SupervisedConfig(**train_forces.QUICK["supervised"] if quick else {})
    analytic_defaults = AnalyticConfig(**train_forces.QUICK["analytic"] if quick else {})

    def residual(
        method: Literal["aerodynamic", "supervised", "analytic", "envmimic"] = "aerodynamic",
        data: train_aerodynamics.AirData = train_aerodynamics.AirData(),  # noqa: B008
        fit: AirConfig = air_defaults,
    ) -> int:
        """Learn a residual from recordings, and measure it on recordings that training never saw.

        --method aerodynamic identifies the air around the balloon (added mass, drag, lift, its centre) by least squares
        through the simulation. The others learn a network of forces on the balloon: supervised by regression on the
        forces that explain the recordings, analytic by gradients of the tracking error through the simulation, envmimic
        by reinforcement learning (it is `train envmimic`). Each has options of its own: see its --help.
        """
        del method  # the others were told apart by `_by_method`
        return train_aerodynamics.fit(data, fit)

    def residual_supervised(
        data: train_forces.ForcesData = train_forces.ForcesData(),  # noqa: B008
        fit: SupervisedConfig = supervised_defaults,
    ) -> int:
        """Learn residual forces by regression on the forces that explain the recordings."""
        return train_forces.fit_supervised(data, fit)

    def residual_analytic(
        data: train_forces.ForcesData = train_forces.ForcesData(),  # noqa: B008
        fit: AnalyticConfig = analytic_defaults,
    ) -> int:
        """Learn residual forces by gradients of the tracking error through the simulation."""
        return train_forces.fit_analytic(data, fit)

    def sysid(
        data: train_sysid.SweepData = train_sysid.SweepData(),  # noqa: B008
        fit: IdentificationConfig = fit_defaults,
    ) -> int:
        """Identify the actuators from a suspended sweep: what `--actuators` of the other commands takes."""
        return train_sysid.fit(data, fit)

    def task_command(task: Task) -> Callable[..., int]:
        data_defaults, env_defaults, ppo_defaults = _defaults(
            arguments,
            task.name,
            train_policy.Data,
            LocomotionConfig,
            train_policy.defaults,
            train_policy.QUICK,
        )

        def command(
            data: train_policy.Data = data_defaults,
            env: LocomotionConfig = env_defaults,
            ppo: PPOConfig = ppo_defaults,
        ) -> int:
            return train_policy.train(task, data, env, ppo)

        command.__doc__ = f"{task.summary} In the nominal simulator, or one improved by --actuators and --residual."
        return command

    def everything(story: pipeline.Options = pipeline.Options()) -> int:  # noqa: B008
        """The whole story on a virtual robot: data, actuators, residuals, policies in five simulators, trials."""
        return pipeline.run(story)

    tasks = {name: task_command(task) for name, task in TASKS.items()}
    by_method = {"supervised": residual_supervised, "analytic": residual_analytic}
    named = {name: by_method[name] for name in by_method if arguments[:1] == [name]}
    return {"sysid": sysid, "envmimic": envmimic, "residual": residual, **named, **tasks, "all": everything}


def _by_method(arguments: Sequence[str]) -> list[str]:
    """`residual --method envmimic` is `envmimic` and so on: each method has options of its own."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--method")
    first, rest = parser.parse_known_args(arguments)
    if rest[:1] == ["residual"] and first.method in ("envmimic", "supervised", "analytic"):
        return [first.method, *rest[1:]]
    return list(arguments)


def _check_robot(arguments: Sequence[str]) -> None:
    """**Raises** `InputError` where another robot is given to a command that is tied to BALLU's legs or balloon."""
    named = [argument.split("=")[0].replace("_", "-") for argument in arguments]
    if "--robot-description" in named and named[0] != "envmimic":
        raise InputError(
            f"--robot-description: `train {arguments[0]}` is for BALLU alone; leave it out, or train envmimic."
        )


def _defaults(
    arguments: Sequence[str],
    task: str,
    data_class: type[Data],
    env_class: type[Config],
    ppo: "Callable[..., PPOConfig]",
    quick: Mapping[str, Any],
) -> "tuple[Data, Config, PPOConfig]":
    """Where the options of a task's training stand that are not given: in the run that goes on, or in the classes and
    `ppo`, with `quick` under --quick."""
    from ballu_mjx.rl.ppo import PPOConfig
    from ballu_mjx.runs.folder import read_config, typed_config

    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", type=Path)
    parser.add_argument("--quick", action="store_true")
    first, _ = parser.parse_known_args([a for a in arguments if a != "--help"])
    if first.resume is not None and arguments[0] == task:
        config = read_config(first.resume, task)
        kept = {name: config["data"][name] for name in _KEPT if name in config.get("data", {})}
        return (
            data_class(**kept),
            typed_config(env_class, config, "env", first.resume),
            typed_config(PPOConfig, config, "ppo", first.resume),
        )
    return data_class(), env_class(), ppo(**quick if first.quick else {})
