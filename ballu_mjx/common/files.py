"""Files: text and JSON read with one sentence for what is wrong with them, and written to the end or not at all."""

from __future__ import annotations

import contextlib
import errno
import gzip
import json
import os
import tempfile
import zlib
from pathlib import Path
from typing import Any, NoReturn

from ballu_mjx.common.errors import InputError

LARGEST = 128 * 2**20
"""Bytes of text that are read; close to two hours of recording at 100 Hz."""
_PROBE = 2**20
"""Bytes that a folder must take before it is worked for."""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def read_text(path: Path) -> str:
    """The text of a file, unpacked where its name ends in .gz.

    **Raises** `InputError` where there is no such file, or none of at most `LARGEST` bytes of UTF-8 text.
    """
    if not path.is_file():
        _refuse(path, "there is no such file", "put it there or check the path")
    try:
        with gzip.open(path, "rb") if path.name.endswith(".gz") else path.open("rb") as stream:
            content = stream.read(LARGEST + 1)
    except (gzip.BadGzipFile, EOFError, zlib.error):
        _refuse(path, "not a whole gzip file", "compress or copy it again, or give the plain .csv")
    except OSError as error:
        _refuse(path, f"cannot be read ({error.strerror})", "check the file and its permissions")
    if len(content) > LARGEST:
        _refuse(path, f"holds more than {LARGEST >> 20} MiB of text", "cut it into shorter ones")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        _refuse(path, f"line {line} is not UTF-8 text", "save the file as UTF-8 text")


def read_json(path: Path, mend: str) -> dict[str, Any]:
    """The JSON object in a file; `mend` ends the sentence where there is none.

    **Raises** `InputError` as `read_text`, and for text that is no JSON object or holds what is no text.
    """
    return parse_object(read_text(path), str(path), mend)


def parse_object(text: str, where: str, mend: str) -> dict[str, Any]:
    """The JSON object in a text, that of the file and place `where`.

    **Raises** `InputError` as `parse_json`, and for what is no object.
    """
    content = parse_json(text, where, mend)
    if not isinstance(content, dict):
        raise InputError(f"{where}: not a JSON object; {mend}.")
    return content


def parse_json(text: str, where: str, mend: str) -> Any:
    """What a text, that of the file and place `where`, says in JSON.

    **Raises** `InputError` for what is no JSON, and for text in it that could not be written again.
    """
    try:
        content = json.loads(text)
        json.dumps(content, ensure_ascii=False).encode()  # half a surrogate pair could be neither printed nor written
    except (ValueError, RecursionError) as error:
        if isinstance(error, json.JSONDecodeError):
            raise InputError(f"{where}: not JSON (line {error.lineno}: {error.msg}); {mend}.") from error
        raise InputError(f"{where}: not JSON that can be read ({type(error).__name__}); {mend}.") from error
    return content


def write(path: Path, content: str | bytes) -> None:
    """Write all of a file or nothing, to the disk: what is there when this returns outlives a power failure.

    The temporary file beside it is this process's own: two processes that write one file end with one of both.
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
    """Have a file, or a folder's list of names, on the disk, where its file system can tell."""
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
    """Have everything in a folder on the disk."""
    for path in [*folder.rglob("*"), folder, folder.parent]:
        sync(path)


def check_folder(folder: Path) -> None:
    """Find out before the work whether results can be written to `folder`, which need not be there yet.

    **Raises** `InputError` where it, or what it would be made in, is no folder, is read-only or is full.
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
            f"{folder}: cannot be written to ({error.strerror}); mend its permissions, or give another folder."
        ) from error


def reserve(folder: Path, size: int) -> None:
    """Write so many bytes into a folder, and take them away again.

    **Raises** `OSError` where it does not take them: quotas are not seen in any other way.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(size))
        file.flush()
        os.fsync(file.fileno())


def is_full(error: BaseException) -> bool:
    """Whether an exception comes of a full disk; libraries in other languages tell of it in words alone."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in _FULL
    return any(os.strerror(number) in str(error) for number in _FULL)


def _refuse(path: Path, problem: str, mend: str) -> NoReturn:
    raise InputError(f"{path}: {problem}; {mend}.")
