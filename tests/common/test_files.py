"""Files that are written completely or not at all."""

import subprocess
import sys
from pathlib import Path

import pytest

from ballu_mjx.common import files

WRITER = """
import sys
from pathlib import Path
from ballu_mjx.common import files
for _ in range(200):
    files.write(Path(sys.argv[1]), sys.argv[2] * 4096)
"""


def test_concurrent_writers_leave_one_complete_file(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    writers = [subprocess.Popen([sys.executable, "-c", WRITER, str(path), letter]) for letter in "ab"]
    assert [writer.wait() for writer in writers] == [0, 0]
    assert path.read_text() in ("a" * 4096, "b" * 4096)
    assert [each.name for each in tmp_path.iterdir()] == ["result.json"]


def test_failed_write_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space"):
        files.write(tmp_path / "result.json", "text")
    assert not list(tmp_path.iterdir())
