"""All commands: their list, help, options, presets, error messages and completion."""

import dataclasses
import importlib.util
import json
import pkgutil
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ballu_mjx import __main__ as package
from ballu_mjx import cli
from ballu_mjx.__main__ import COMMANDS, NAMES
from ballu_mjx.cli import completion, train, train_aerodynamics, train_envmimic, train_fluid, train_forces
from ballu_mjx.cli._command import TrainCommand, run_command
from ballu_mjx.common import runtime
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.importers.readers import READERS
from ballu_mjx.residuals.aerodynamics_fit import AirConfig
from ballu_mjx.residuals.dataset import RecordingsData
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.fluid_fit import FluidConfig
from ballu_mjx.residuals.force_gradients import AnalyticConfig
from ballu_mjx.residuals.force_regression import SupervisedConfig
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.presets import describe_preset, preset_configs
from ballu_mjx.residuals.run_config import describe_run
from ballu_mjx.rl import ppo as ppo_options
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.runs.folder import Run
from ballu_mjx.runs.layout import RUN_FORMAT

TRAININGS = (
    "sysid", "envmimic", "supervised", "analytic", "aerodynamic", "fluid",
    "walk", "turn", "turn-right", "walk-backward", "all",
)  # fmt: skip
SUBCOMMANDS = [
    "compare",
    "evaluate",
    "report",
    "view",
    *(f"record {name}" for name in ("import", "check", "simulate", "example-mapping")),
    *(f"export {name}" for name in ("policy", "simulator", "check")),
    *(f"train {name}" for name in TRAININGS),
]


def main(line: str) -> int:
    """Run a command line in this process."""
    command, *arguments = line.split()
    return importlib.import_module(f"ballu_mjx.cli.{command}").main(arguments)


def test_list_of_commands_is_complete_and_correct():
    listed = {command.split()[0] for _, command, _ in COMMANDS}
    found = set()
    for module in pkgutil.iter_modules(cli.__path__):
        spec = importlib.util.find_spec(f"ballu_mjx.cli.{module.name}")
        assert spec is not None and spec.origin is not None
        if "\ndef main(" in Path(spec.origin).read_text():
            found.add(module.name)
    assert found == listed


def test_package_without_a_command_lists_the_commands():
    done = subprocess.run([sys.executable, "-m", "ballu_mjx"], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert all(command in done.stdout for _, command, _ in COMMANDS)


@pytest.mark.parametrize("line", SUBCOMMANDS)
def test_every_help_shows_the_debug_option(line: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as exit_info:
        main(f"{line} --help")
    assert exit_info.value.code == 0
    assert "--debug" in capsys.readouterr().out


@pytest.mark.parametrize(
    "line",
    [
        "compare nowhere",
        "evaluate nowhere",
        *(f"export {name} nowhere" for name in ("policy", "simulator", "check")),
        "report nowhere",
        "view nowhere",
        "record check nowhere",
        "train sysid --recordings nowhere",
        "train envmimic --resume nowhere",
        "train walk --resume=nowhere",
    ],
)
def test_traceback_of_an_input_error_is_shown_with_debug(line: str, capsys: pytest.CaptureFixture[str]):
    assert main(line) == 2
    sentence = capsys.readouterr().err
    assert sentence.startswith("nowhere: ") and sentence.count("\n") == 1
    assert main(f"{line} --debug") == 2
    shown = capsys.readouterr().err
    assert shown.startswith("Traceback") and shown.endswith(f"InputError: {sentence}")


@pytest.mark.parametrize(
    ("line", "options"),
    [
        ("train supervised", ("--force-shares", "--forces", "--robot", "--actuators")),
        ("train analytic", ("--relinearizations", "--forces", "--robot")),
        ("train aerodynamic", ("--fixed-from", "--free", "--contact-friction", "--robot")),
        ("train fluid", ("--fixed-from", "--terms", "--robot")),
        ("train walk", ("--keep-every", "--robot", "--residual", "--domain-randomization")),
        ("train sysid", ("--levels", "--robot", "--objective")),
    ],
)
def test_help_of_each_training_lists_its_options(line: str, options: tuple, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(f"{line} --help")
    output = capsys.readouterr().out
    assert all(option in output for option in options)


@pytest.mark.parametrize(
    ("line", "friction"),
    [("", 0), ("--contact-friction", 1), ("--free lift friction --contact-friction", 1), ("--free lift", 0)],
)
def test_the_friction_of_contacts_is_identified_on_request(line: str, friction: int):
    asked = []

    def keep(data: train_aerodynamics.AirData, fit: AirConfig) -> int:
        asked.append(data.identified())
        return 0

    command = dataclasses.replace(train_aerodynamics.COMMAND, run=keep)
    run_command({"aerodynamic": command}, ["aerodynamic", *line.split()], "")
    assert asked[0].count("friction") == friction
    assert asked[0].count("lift") == 1


@pytest.mark.parametrize(
    ("line", "sizes"),
    [
        ("train envmimic", "--num-timesteps 120000 --num-envs 256 --batch-size 128"),
        ("train walk", "--num-timesteps 60000"),
        ("train sysid", "--no-motion --starts 4"),
    ],
)
def test_help_shows_the_defaults_with_and_without_quick(line: str, sizes: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(f"{line} --help")
    output = " ".join(capsys.readouterr().out.split())
    assert f"Defaults under --quick: {sizes}" in output
    assert "(default: 3000000)" in output or "sysid" in line


@pytest.mark.parametrize("line", [line for line in SUBCOMMANDS if line.startswith("train ")])
def test_help_shows_every_option_once_and_common_options_first(line: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(f"{line} --help")
    shown = re.findall(r"^\W{1,3}--([a-z][\w-]*)", capsys.readouterr().out, re.MULTILINE)
    sections = train._commands()[line.split()[1]].sections.values()
    options = [field.name.replace("_", "-") for section in sections for field in dataclasses.fields(section)]
    assert sorted(shown) == sorted(options)
    order = ("recordings", "output", "num-timesteps", "forces", "learning-rate", "coordinator", "debug")
    found = [shown.index(name) for name in order if name in shown]
    assert found == sorted(found) and shown[-1] == "debug"


@dataclasses.dataclass(frozen=True)
class Data(RecordingsData):
    resume: Path | None = None
    validate_every: int = 400


def given(arguments: str) -> tuple[Data, PPOConfig]:
    """Return the options that a training receives from a command line."""
    found = []

    def keep(data: Data, ppo: PPOConfig) -> int:
        found.append((data, ppo))
        return 3

    quick = {"ppo": {"num_envs": 256, "normalize_observations": False}}
    commands = {"learn": TrainCommand("Learns.", {"data": Data(), "ppo": PPOConfig()}, keep, quick)}
    assert run_command(commands, arguments.split(), "") == 3
    return found[0]


def test_quick_changes_defaults_but_not_given_options():
    assert given("learn") == (Data(), PPOConfig())
    small = PPOConfig(num_envs=256, normalize_observations=False)
    assert given("learn --quick") == (Data(quick=True), small)
    _, ppo = given("learn --num-envs 1024 --quick --normalize-observations --seed 3")
    assert ppo == dataclasses.replace(PPOConfig(), seed=3)  # two given options equal the defaults without --quick


@pytest.mark.parametrize(
    ("arguments", "brief"),
    [
        (["walk", "--quick"], True),
        (["walk", "--resume", "quick"], True),
        (["all", "--resume=quick"], True),
        (["walk", "--resume", "full"], False),
        (["walk", "--resume", "damaged"], False),
        (["walk", "--resume", "missing"], False),
        (["walk", "--resume"], False),
        (["walk", "--quick=yes"], False),  # the command's own parser refuses it
        (["walk", "--output", "quick"], False),
    ],
)
def test_a_resumed_quick_run_compiles_as_when_it_began(
    arguments: list[str], brief: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name, starts in (
        ("quick", [{"command": ["train", "walk", "--quick"]}, {"command": ["train", "walk", "--resume", "quick"]}]),
        ("full", [{"command": ["train", "walk"]}]),
        ("damaged", [None]),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(json.dumps({"starts": starts}))
    monkeypatch.chdir(tmp_path)
    assert train._is_brief(arguments) == brief


def test_preset_changes_defaults_but_not_given_options(tmp_path: Path):
    found = []

    def keep(data: train_envmimic.Data, env: EnvMimicConfig, ppo: PPOConfig) -> int:
        found.append((data.preset, env, ppo))
        return 0

    commands = {"envmimic": dataclasses.replace(train_envmimic.COMMAND, run=keep)}
    run_command(commands, ["envmimic", "--preset", "paper"], "")
    run_command(
        commands, ["envmimic", "--learning-rate", "1e-3", "--preset", "paper", "--heading-frame", "--quick"], ""
    )
    (name, env, ppo), (_, other_env, quick) = found
    assert name == "paper" and (env, ppo) == preset_configs("paper")
    assert env.force_scale == 1.0 and not env.relative_observation and ppo.activation == "tanh"
    assert other_env == dataclasses.replace(env, heading_frame=True)
    assert quick == dataclasses.replace(ppo, learning_rate=1e-3, num_timesteps=train_envmimic.QUICK["num_timesteps"])
    description = describe_preset("paper", other_env, quick)
    assert "False, but given as True" in description and "0.0003, but given as 0.001" in description
    with pytest.raises(InputError, match="--preset does not go with --resume"):
        train_envmimic.train(train_envmimic.Data(preset="paper", resume=tmp_path), env, ppo)


@pytest.mark.parametrize("command", [train_forces.SUPERVISED, train_forces.ANALYTIC], ids=["supervised", "analytic"])
def test_regression_and_gradients_take_all_options_of_the_network(command: TrainCommand):
    found = []

    def keep(data: train_forces.ForcesData, env: ForceNetworkConfig, fit: SupervisedConfig | AnalyticConfig) -> int:
        found.append(env)
        return 0

    line = "--forces wrench --torque-scale 0.1 --fade-width 1 --mirror --no-observe-command"
    run_command({"learn": dataclasses.replace(command, run=keep)}, ["learn", *line.split()], "")
    options = {"torque_scale": 0.1, "fade_width": 1.0, "mirror": True, "observe_command": False}
    assert found == [ForceNetworkConfig("wrench", **options)]
    for line, message in (
        ("--fade-width 0", "--fade-width is 0.0: it must be greater than 0"),
        ("--forces joints --mirror", "--mirror"),
        ("--torque-scale 1", "--torque-scale is for --forces wrench"),
        ("--expected-loads 1 2", "--expected-loads has 2 values: give 3"),
    ):
        with pytest.raises(InputError, match=message):
            run_command({"learn": command}, ["learn", *line.split()], "")


def test_a_quick_trim_keeps_the_terms_of_the_earlier_run(tmp_path: Path):
    found = []

    def keep(data: train_fluid.FluidData, fit: FluidConfig) -> int:
        found.append(fit)
        return 0

    command = {"fluid": dataclasses.replace(train_fluid.COMMAND, run=keep)}
    run_command(command, ["fluid", "--quick", "--fixed-from", str(tmp_path)], "")
    run_command(command, ["fluid", "--quick"], "")
    assert [fit.terms for fit in found] == ["auto", "linear"]
    assert found[0] == dataclasses.replace(found[1], terms="auto")


def test_a_network_to_start_with_sets_its_own_options(tmp_path: Path):
    network = EnvMimicConfig(forces="force", force_scale=0.05, force_limit=1.0, force_cost=20.0, start_noise=0.0)
    sections = {"env": network, "ppo": PPOConfig(policy_layers=(8,), num_envs=16)}
    with Run(tmp_path / "run", describe_run("supervised", sections, {}, [])):
        pass
    found = []

    def keep(data: train_envmimic.Data, env: EnvMimicConfig, ppo: PPOConfig) -> int:
        found.append((data, env, ppo))
        return 0

    commands = {"envmimic": dataclasses.replace(train_envmimic.COMMAND, run=keep)}
    run_command(commands, ["envmimic", "--start-from", str(tmp_path / "run"), "--force-scale", "1"], "")
    data, env, ppo = found[0]
    assert env == EnvMimicConfig(forces="force", force_scale=1.0, force_limit=1.0)
    assert ppo == PPOConfig(policy_layers=(8,))
    for other in ({"resume": tmp_path / "run"}, {"preset": "paper"}):
        with pytest.raises(InputError, match="does not go with"):
            train_envmimic.train(dataclasses.replace(data, **other), env, ppo)


def test_paper_preset_has_the_batch_sizes_of_stable_baselines():
    """An update has 2048 control steps, and a minibatch 64. The sizes are also valid on two devices."""
    _, config = preset_configs("paper")
    ppo_options.check(config, 2)
    assert config.batch_size * config.unroll_length == 64
    assert config.batch_size * config.unroll_length * config.num_minibatches == 2048
    assert config.num_envs * config.unroll_length == 2048


def test_resumed_run_keeps_its_options_except_given_ones(tmp_path: Path):
    stored = {"data": {"validate_every": 7, "output": "elsewhere"}, "ppo": {"num_envs": 64, "seed": 5}}
    content = {"format": RUN_FORMAT, "task": "learn", **stored}
    (tmp_path / "config.json").write_text(json.dumps(content))
    data, ppo = given(f"learn --seed 6 --resume={tmp_path}")
    assert (data.validate_every, data.output, data.resume) == (7, None, tmp_path)
    assert (ppo.num_envs, ppo.seed) == (64, 6)
    (tmp_path / "config.json").write_text(json.dumps(content | {"data": {"validate_every": "abc"}}))
    with pytest.raises(InputError, match=r"config\.json: validate_every of data has an invalid value, 'abc'"):
        given(f"learn --resume={tmp_path}")
    with pytest.raises(InputError, match="there is no run"):
        given(f"learn --resume {tmp_path / 'other'}")


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("train walk --push-force 0.1", "--push-force has no effect without --domain-randomization"),
        ("train walk --friction 0.4 0.5", "--friction has no effect without --domain-randomization"),
        ("train all --outside-cost 1", "--outside-cost has no effect without --also envmimic-near"),
        ("evaluate run --capture-noise 1 1", "--capture-noise has no effect without --noise-floor"),
        ("report run --show near-1", "--show has no effect without --video"),
    ],
)
def test_options_without_effect_are_refused(line: str, sentence: str, capsys: pytest.CaptureFixture[str]):
    assert main(line) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize("line", ["train residual", "train envmimic --method envmimic", "train sysid --num-envs 3"])
def test_unknown_options_and_subcommands_are_refused(line: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as exit_info:
        main(line)
    assert exit_info.value.code == 2
    capsys.readouterr()


def test_unexpected_errors_are_reported_as_faults_of_the_package(capsys: pytest.CaptureFixture[str]):
    def fail() -> None:
        raise ValueError("shapes (3,)\nand (4,) do not match " + "x" * 5000)

    assert runtime.exit_status(fail, []) == 1
    error = capsys.readouterr().err
    assert "fault of ballu_mjx" in error and "ValueError: shapes (3,) and (4,)" in error and "--debug" in error
    assert error.count("\n") == 1 and len(error) < 600
    assert runtime.exit_status(fail, ["--debug"]) == 1
    assert "Traceback" in (shown := capsys.readouterr().err) and "in fail" in shown


def test_system_errors_are_not_reported_as_faults_of_the_package(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def open_nothing() -> None:
        (tmp_path / "nothing").open()

    assert runtime.exit_status(open_nothing, []) == 1
    error = capsys.readouterr().err
    assert f"{tmp_path}/nothing" in error and "fault" not in error and error.count("\n") == 1


def test_invalid_output_folder_is_refused_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").touch()
    assert main(f"record simulate --gait walking --seconds 1 --output {tmp_path}/file/walk.csv") == 2
    assert f"{tmp_path}/file: cannot be written to" in capsys.readouterr().err


def test_closed_output_pipe_is_not_an_error():
    line = [sys.executable, "-m", "ballu_mjx", "record", "example-mapping"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


def test_entry_point_runs_commands_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert package.main(["record", "example-mapping"]) == 0
    assert "[commands]" in capsys.readouterr().out
    assert package.main(["record", "check", str(tmp_path / "nowhere")]) == 2
    assert capsys.readouterr().err.startswith(f"{tmp_path}/nowhere: ")
    assert package.main(["import", "walk.csv"]) == 2
    assert "import: there is no such command" in capsys.readouterr().err
    assert package.main(["completion"]) == 2
    assert "bash or zsh" in capsys.readouterr().err


@pytest.fixture(scope="module")
def bash_script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "ballu_mjx"
    path.write_text(completion.completion_script("bash", NAMES))
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("", {"record", "train", "evaluate", "report", "view", "compare", "export"}),
        ("tr", {"train"}),
        ("record ", {"import", "map", "check", "simulate", "example-mapping"}),
        ("train ", set(TRAININGS)),
        ("train envmimic --num-t", {"--num-timesteps"}),
        ("record import --format ", {"auto", *READERS}),
        ("view --po", {"--port"}),
        ("report rec", {"recordings"}),  # a path
    ],
)
def test_bash_completion_offers_commands_options_values_and_paths(
    bash_script: Path, typed: str, offered: set[str], tmp_path: Path
):
    (tmp_path / "recordings").mkdir()
    words = ["ballu_mjx", *typed.split(" ")]
    # As readline: call the function. If it offers nothing, offer files if the script has `-o default`.
    ask = """source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); set -- $(complete -p ballu_mjx)
        [[ " $* " =~ " -F "([^ ]+)" " ]]; "${BASH_REMATCH[1]}"
        if [[ -z "${COMPREPLY[*]}" && " $* " == *" -o default "* ]]; then
            COMPREPLY=($(compgen -f -- "${COMP_WORDS[COMP_CWORD]}"))
        fi
        printf '%s\\n' "${COMPREPLY[@]}" """
    line = ["bash", "-c", ask, "bash", str(bash_script), *words]
    done = subprocess.run(line, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stderr == ""
    assert set(done.stdout.split()) - {"-h", "--help"} == offered


def test_zsh_completion_contains_all_subcommands():
    text = completion.completion_script("zsh", NAMES)
    assert text.startswith("#compdef ballu_mjx")
    assert all(line.split()[-1] in text for line in SUBCOMMANDS)
