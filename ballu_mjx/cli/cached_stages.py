"""Stages of a pipeline that are kept while what they were made from stays the same."""

from __future__ import annotations

import dataclasses
import gc
import hashlib
import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.checkpoints import list_checkpoints

_KEY = re.compile("[0-9a-f]{16}")


def cached_stage(
    folder: Path, options: Any, needs: Sequence[Path], make: Callable[[Path], None], *, goes_on: bool = True
) -> Path:
    """`folder` as `make` leaves it, made unless it is there with the key of `options` and `needs`.

    A folder with another key is set aside. One with the same key that was not finished is handed to `make` as it is, if
    that `goes_on` from checkpoints and there are any.
    """
    content = {
        "options": options if isinstance(options, dict) else plain(options),
        "needs": [read_mark(stage_mark(need))["key"] for need in needs],
    }
    key = hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]
    mark = stage_mark(folder)
    found = read_mark(mark) if mark.exists() else None
    if found is not None and found["key"] == key and found["done"]:
        return folder
    if found is not None and found["key"] != key:
        aside = folder.with_name(f"{folder.name}.{found['key']}")
        shutil.rmtree(aside, ignore_errors=True)
        if folder.exists():
            folder.rename(aside)
        print(f"{folder}: made with other options; set aside as {aside.name}.")
        found = None
    print(f"\n== {folder.name}" + (" (goes on)" if goes_on and found is not None else ""), flush=True)
    if folder.exists() and not (goes_on and found is not None and list_checkpoints(folder)):
        shutil.rmtree(folder)  # a beginning of nothing
    folder.mkdir(parents=True, exist_ok=True)
    write_mark(mark, key, content, done=False)
    make(folder)
    write_mark(mark, key, content, done=True)
    # Programs of a stage stay mapped otherwise, until the process has no map left.
    jax.clear_caches()
    gc.collect()
    return folder


def stage_mark(folder: Path) -> Path:
    """Where a stage's key stands: beside its folder, which is its maker's."""
    return folder.with_name(folder.name + ".stage.json")


def write_mark(path: Path, key: str, content: dict[str, Any], *, done: bool) -> None:
    files.write(path, json.dumps({"key": key, "done": done, **content}, indent=2, default=str) + "\n")


def read_mark(path: Path) -> dict[str, Any]:
    """The content of a stage's file.

    **Raises** `InputError` where it is damaged.
    """
    mend = "delete it, and its stage will be made anew"
    content = files.read_json(path, mend)
    key = content.get("key")
    if not (isinstance(key, str) and _KEY.fullmatch(key) and isinstance(content.get("done"), bool)):
        raise InputError(f'{path}: "key" and "done" are not as this program writes them; {mend}.')
    return content


def plain(options: Any) -> Any:
    if isinstance(options, tuple):
        return [plain(option) for option in options]
    return dataclasses.asdict(options) | {"kind": type(options).__name__}
