"""`python -m ballu_mjx`: the list of commands is that of the package."""

import importlib.util
import pkgutil
import subprocess
import sys
from pathlib import Path

import ballu_mjx
from ballu_mjx.__main__ import COMMANDS


def test_every_command_is_listed_and_every_listed_one_is_there():
    listed = {command.split()[0] for _, command, _ in COMMANDS}
    found = set()
    for module in pkgutil.iter_modules(ballu_mjx.__path__):
        spec = importlib.util.find_spec(f"ballu_mjx.{module.name}")
        assert spec is not None
        if spec.origin and not module.ispkg and 'if __name__ == "__main__"' in Path(spec.origin).read_text():
            found.add(module.name)
    # What runs on the robot's computer is started there, from the exported folder.
    assert found - {"__main__", "controller"} == listed


def test_the_package_alone_lists_them():
    done = subprocess.run([sys.executable, "-m", "ballu_mjx"], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert all(command in done.stdout for _, command, _ in COMMANDS)
