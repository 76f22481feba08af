"""Reading of text and JSON files, with an error of one sentence, and writing of files, completely or not at all."""

from __future__ import annotations

import contextlib
import errno
import gzip
import json
import math
import os
import tempfile
import zlib
from pathlib import Path
from typing import Any, NoReturn

from ballu_mjx.common.errors import InputError

LARGEST = 128 * 2**20
"""Largest size of a text file (bytes, decompressed): close to two hours of recording at 100 Hz."""
_PROBE = 2**20
"""Number of bytes that are written to test a folder before a computation."""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def read_text(path: Path) -> str:
    """Return the text of a file. A file whose name ends in .gz is decompressed.

    **Raises** `InputError` if the file does not exist, cannot be read, has more than `LARGEST` bytes or is not UTF-8.
    """
    if not path.is_file():
        _refuse(path, "there is no such file", "put it there or check the path")
    try:
        with gzip.open(path, "rb") if path.name.endswith(".gz") else path.open("rb") as stream:
            content = stream.read(LARGEST + 1)
    except (gzip.BadGzipFile, EOFError, zlib.error):
        _refuse(path, "not a whole gzip file", "compress or copy it again, or give the uncompressed .csv")
    except OSError as error:
        _refuse(path, f"cannot be read ({error.strerror})", "check the file and its permissions")
    if len(content) > LARGEST:
        _refuse(path, f"has more than {LARGEST >> 20} MiB of text", "split it into shorter files")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        _refuse(path, f"line {line} is not UTF-8 text", "save the file as UTF-8 text")


def read_json(path: Path, fix: str) -> dict[str, Any]:
    """Return the JSON object in a file. Messages about its content end with `fix`, which says how to fix it.

    **Raises** `InputError` in the cases of `read_text` and `parse_object`.
    """
    return parse_object(read_text(path), str(path), fix)


def parse_object(text: str, where: str, fix: str) -> dict[str, Any]:
    """Return the JSON object in a text. The arguments are those of `parse_json`.

    **Raises** `InputError` in the cases of `parse_json`, and if the value is not an object.
    """
    content = parse_json(text, where, fix)
    if not isinstance(content, dict):
        raise InputError(f"{where}: not a JSON object; {fix}.")
    return content


def parse_json(text: str, where: str, fix: str) -> Any:
    """Return the JSON value in a text. Messages begin with `where` (file and place) and end with `fix` (the fix).

    **Raises** `InputError` if the text is not JSON, or has a string that UTF-8 cannot encode.
    """
    try:
        content = json.loads(text)
        json.dumps(content, ensure_ascii=False).encode()  # half a surrogate pair cannot be printed or written
    except (ValueError, RecursionError) as error:
        if isinstance(error, json.JSONDecodeError):
            raise InputError(f"{where}: not JSON (line {error.lineno}: {error.msg}); {fix}.") from error
        raise InputError(f"{where}: not JSON that this program can read ({type(error).__name__}); {fix}.") from error
    return content


def finite_or_none(value: float | int) -> float | int | None:
    """Return a number as JSON can express it: None if it is infinite or not a number."""
    return value if math.isfinite(value) else None


def write(path: Path, content: str | bytes) -> None:
    """Write a file completely or not at all, and flush it to the disk.

    Once this function has returned, the content survives a power failure. Each process uses its own temporary file
    beside the target. If two processes write the same file, it ends with the content of one of them.
    """
    draft = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with draft.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise
    sync(path.parent)


def sync(path: Path) -> None:
    """Flush a file, or a folder's list of names, to the disk, if the file system supports this."""
    if os.name == "nt" and path.is_dir():  # Windows cannot open folders
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)


def sync_all(folder: Path) -> None:
    """Flush a folder, everything in it, and its entry in the parent folder to the disk."""
    for path in [*folder.rglob("*"), folder, folder.parent]:
        sync(path)


def check_folder(folder: Path) -> None:
    """Check before a computation that results can be written to `folder`, which need not exist yet.

    **Raises** `InputError` if `folder`, or the nearest parent that exists, is not a folder, is read-only or is full.
    """
    place = folder.absolute()
    try:
        while not place.exists():
            place = place.parent
        reserve(place, _PROBE)
    except OSError as error:
        if is_full(error):
            raise InputError(f"{folder}: its disk is full; make room there, or give another folder.") from error
        raise InputError(
            f"{folder}: cannot be written to ({error.strerror}); fix its permissions, or give another folder."
        ) from error


def reserve(folder: Path, size: int) -> None:
    """Write `size` bytes into a temporary file in a folder, and delete it. Quotas can only be detected in this way.

    **Raises** `OSError` if the folder cannot hold them.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(size))
        file.flush()
        os.fsync(file.fileno())


def is_full(error: BaseException) -> bool:
    """Return whether a full disk caused an exception. Libraries in other languages say so only in its message."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in _FULL
    return any(os.strerror(number) in str(error) for number in _FULL)


def _refuse(path: Path, problem: str, fix: str) -> NoReturn:
    """Raise `InputError` with a file, its problem and the fix."""
    raise InputError(f"{path}: {problem}; {fix}.")
