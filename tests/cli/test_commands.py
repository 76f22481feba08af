"""The commands as a whole: `python -m ballu_mjx` lists them, and all tell of errors in the same way."""

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
from ballu_mjx.cli import completion, train
from ballu_mjx.cli._command import TrainCommand, run_command
from ballu_mjx.common import runtime
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.importers.readers import READERS
from ballu_mjx.residuals.dataset import RecordingsData
from ballu_mjx.rl.ppo import PPOConfig
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


def test_every_command_is_listed_and_every_listed_one_is_there():
    listed = {command.split()[0] for _, command, _ in COMMANDS}
    found = set()
    for module in pkgutil.iter_modules(cli.__path__):
        spec = importlib.util.find_spec(f"ballu_mjx.cli.{module.name}")
        assert spec is not None and spec.origin is not None
        if "\ndef main(" in Path(spec.origin).read_text():
            found.add(module.name)
    assert found == listed


def test_the_package_alone_lists_them():
    done = subprocess.run([sys.executable, "-m", "ballu_mjx"], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert all(command in done.stdout for _, command, _ in COMMANDS)


@pytest.mark.parametrize("line", SUBCOMMANDS)
def test_every_help_tells_of_debug(line: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as left:
        main(f"{line} --help")
    assert left.value.code == 0
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
def test_the_traceback_of_bad_input_is_shown_on_demand(line: str, capsys: pytest.CaptureFixture[str]):
    assert main(line) == 2
    sentence = capsys.readouterr().err
    assert sentence.startswith("nowhere: ") and sentence.count("\n") == 1
    assert main(f"{line} --debug") == 2
    shown = capsys.readouterr().err
    assert shown.startswith("Traceback") and shown.endswith(f"InputError: {sentence}")


@pytest.mark.parametrize(
    ("line", "options"),
    [
        ("train supervised", ("--force-scales", "--forces", "--robot", "--actuators")),
        ("train analytic", ("--relinearizations", "--forces", "--robot")),
        ("train aerodynamic", ("--fixed-from", "--free", "--robot")),
        ("train walk", ("--keep-every", "--robot", "--residual", "--domain-randomization")),
        ("train sysid", ("--levels", "--robot", "--objective")),
    ],
)
def test_every_option_of_a_training_is_in_its_help(line: str, options: tuple, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(f"{line} --help")
    told = capsys.readouterr().out
    assert all(option in told for option in options)


@pytest.mark.parametrize(
    ("line", "sizes"),
    [
        ("train envmimic", "--num-timesteps 120000 --num-envs 256 --batch-size 128"),
        ("train walk", "--num-timesteps 60000"),
        ("train sysid", "--no-motion --starts 4"),
    ],
)
def test_help_tells_the_defaults_without_and_with_quick(line: str, sizes: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(f"{line} --help")
    told = " ".join(capsys.readouterr().out.split())
    assert f"Defaults under --quick: {sizes}" in told
    assert "(default: 3000000)" in told or "sysid" in line


@pytest.mark.parametrize("line", [line for line in SUBCOMMANDS if line.startswith("train ")])
def test_help_shows_every_option_once_in_a_newcomers_order(line: str, capsys: pytest.CaptureFixture[str]):
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
    """What a training's options come to."""
    found = []

    def keep(data: Data, ppo: PPOConfig) -> int:
        found.append((data, ppo))
        return 3

    quick = {"ppo": {"num_envs": 256, "normalize_observations": False}}
    commands = {"learn": TrainCommand("Learns.", {"data": Data(), "ppo": PPOConfig()}, keep, quick)}
    assert run_command(commands, arguments.split(), "") == 3
    return found[0]


def test_quick_changes_defaults_wherever_it_stands_and_no_option_that_is_given():
    assert given("learn") == (Data(), PPOConfig())
    small = PPOConfig(num_envs=256, normalize_observations=False)
    assert given("learn --quick") == (Data(quick=True), small)
    _, ppo = given("learn --num-envs 1024 --quick --normalize-observations --seed 3")
    assert ppo == dataclasses.replace(PPOConfig(), seed=3)  # given, though equal to the defaults without --quick


def test_a_run_that_goes_on_keeps_its_options_but_for_those_given(tmp_path: Path):
    stored = {"data": {"validate_every": 7, "output": "elsewhere"}, "ppo": {"num_envs": 64, "seed": 5}}
    content = {"format": RUN_FORMAT, "task": "learn", **stored}
    (tmp_path / "config.json").write_text(json.dumps(content))
    data, ppo = given(f"learn --seed 6 --resume={tmp_path}")
    assert (data.validate_every, data.output, data.resume) == (7, None, tmp_path)
    assert (ppo.num_envs, ppo.seed) == (64, 6)
    with pytest.raises(InputError, match="there is no run"):
        given(f"learn --resume {tmp_path / 'other'}")


@pytest.mark.parametrize("line", ["train residual", "train envmimic --method envmimic", "train sysid --num-envs 3"])
def test_what_is_no_option_is_refused(line: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as left:
        main(line)
    assert left.value.code == 2
    capsys.readouterr()


def test_an_unexpected_error_is_called_a_fault_of_the_package(capsys: pytest.CaptureFixture[str]):
    def fail() -> None:
        raise ValueError("shapes (3,)\nand (4,) do not match " + "x" * 5000)

    assert runtime.exit_status(fail, []) == 1
    told = capsys.readouterr().err
    assert "fault of ballu_mjx" in told and "ValueError: shapes (3,) and (4,)" in told and "--debug" in told
    assert told.count("\n") == 1 and len(told) < 600
    assert runtime.exit_status(fail, ["--debug"]) == 1
    assert "Traceback" in (shown := capsys.readouterr().err) and "in fail" in shown


def test_what_the_system_refuses_is_no_fault_of_the_package(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def open_nothing() -> None:
        (tmp_path / "nothing").open()

    assert runtime.exit_status(open_nothing, []) == 1
    told = capsys.readouterr().err
    assert f"{tmp_path}/nothing" in told and "fault" not in told and told.count("\n") == 1


def test_a_folder_that_is_none_is_refused_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").touch()
    assert main(f"record simulate --gait walking --seconds 1 --output {tmp_path}/file/walk.csv") == 2
    assert f"{tmp_path}/file: cannot be written to" in capsys.readouterr().err


def test_a_reader_that_has_seen_enough_is_no_error():
    line = [sys.executable, "-m", "ballu_mjx", "record", "example-mapping"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


def test_the_script_runs_commands_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
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
def test_bash_completes(bash_script: Path, typed: str, offered: set[str], tmp_path: Path):
    (tmp_path / "recordings").mkdir()
    words = ["ballu_mjx", *typed.split(" ")]
    # What readline does: the function first; where it offers nothing, files, if the script asks for these by default.
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


def test_the_script_for_zsh_names_the_subcommands():
    text = completion.completion_script("zsh", NAMES)
    assert text.startswith("#compdef ballu_mjx")
    assert all(line.split()[-1] in text for line in SUBCOMMANDS)
