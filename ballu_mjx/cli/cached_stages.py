"""Cached stages of a pipeline: a stage is made again only if its options or its inputs have changed."""

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
_MARK = ".stage.json"
SET_ASIDE = re.compile(r"\.[0-9a-f]{16}$")
"""End of the names of folders that were made with other options and renamed."""


def cached_stage(
    folder: Path, options: Any, needs: Sequence[Path], make: Callable[[Path], None], *, goes_on: bool = True
) -> Path:
    """Return the `folder` of a stage. Call `make` to fill it unless it is already there with the same key.

    The key is a hash of `options` and of the keys of the stages `needs`. A folder with another key is renamed and kept,
    and used again when its key returns. A folder that was deleted is made again.
    If a folder with the same key is unfinished, `make` continues in it if `goes_on` is true and it has checkpoints.
    Otherwise the folder is emptied first.

    **Raises** `InputError` from `check_is_stage`.
    """
    check_is_stage(folder)
    content = {
        "options": options if isinstance(options, dict) else plain(options),
        "needs": [read_mark(stage_mark(need))["key"] for need in needs],
    }
    key = hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]
    mark = stage_mark(folder)
    found = read_mark(mark) if mark.exists() and folder.is_dir() else None
    if found is not None and found["key"] == key and found["done"]:
        return folder
    if found is not None and found["key"] != key:
        aside = _move(folder, folder.with_name(f"{folder.name}.{found['key']}"))
        print(f"{folder}: made with other options or inputs; renamed to {aside.name}.")
        found = None
        earlier = folder.with_name(f"{folder.name}.{key}")
        if earlier.is_dir() and stage_mark(earlier).exists() and read_mark(stage_mark(earlier))["done"]:
            _move(earlier, folder)
            print(f"{folder}: made with these options before; {earlier.name} renamed back.")
            return folder
    print(f"\n== {folder.name}" + (" (resumed)" if goes_on and found is not None else ""), flush=True)
    if folder.exists() and not (goes_on and found is not None and list_checkpoints(folder)):
        shutil.rmtree(folder)  # unfinished (or empty), and `make` cannot continue in it
    folder.mkdir(parents=True, exist_ok=True)
    write_mark(mark, key, content, done=False)
    make(folder)
    write_mark(mark, key, content, done=True)
    # Otherwise the compiled programs of all stages stay mapped, until the process reaches its limit of memory maps.
    jax.clear_caches()
    gc.collect()
    return folder


def _move(folder: Path, place: Path) -> Path:
    """Move a stage's folder and its key to another place, and return the place."""
    shutil.rmtree(place, ignore_errors=True)  # left by versions that did not keep its key
    folder.rename(place)
    stage_mark(folder).rename(stage_mark(place))
    return place


def check_is_stage(folder: Path) -> None:
    """Check that a stage's folder is missing, is empty, or was made by this module.

    **Raises** `InputError` otherwise. The content of such a folder is the user's.
    """
    if folder.exists() and not stage_mark(folder).exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder}: was not made by `train all`; move it, or give another --output.")


def stage_mark(folder: Path) -> Path:
    """Return the path of the file with a stage's key. It is beside the folder, which only `make` fills."""
    return folder.with_name(folder.name + _MARK)


def write_mark(path: Path, key: str, content: dict[str, Any], *, done: bool) -> None:
    """Write a stage's key, whether the stage is `done`, and the `content` from which the key was made."""
    files.write(path, json.dumps({"key": key, "done": done, **content}, indent=2, default=str) + "\n")


def read_mark(path: Path) -> dict[str, Any]:
    """Return the content of a stage's file.

    **Raises** `InputError` if the file is damaged.
    """
    fix = f"delete it and the folder {path.name.removesuffix(_MARK)}, and the stage will be made again"
    content = files.read_json(path, fix)
    key = content.get("key")
    if not (isinstance(key, str) and _KEY.fullmatch(key) and isinstance(content.get("done"), bool)):
        raise InputError(f'{path}: the values of "key" and "done" are not valid; {fix}.')
    return content


def plain(options: Any) -> Any:
    """Return options as JSON-compatible values: a dataclass as a dict with its class name under "kind"."""
    if isinstance(options, tuple):
        return [plain(option) for option in options]
    return dataclasses.asdict(options) | {"kind": type(options).__name__}
