"""Reader of arrays with one sample per row: NumPy's `.npz`, and LeRobot datasets on disk.

A one-dimensional array is a column with the array's name. Column i of a two-dimensional array is named `name[i]`.

A LeRobot dataset (https://github.com/huggingface/lerobot) is a folder with `meta/info.json` and parquet files under
`data/`. Versions 2 (one episode per file) and 3 (several episodes per file) are read. The times are the feature
`timestamp` (s). Parquet files are read with pyarrow, which the extra `lerobot` installs.
"""

from __future__ import annotations

import dataclasses
import functools
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.files import read_json
from ballu_mjx.recordings.importers.capture import Capture, Lazy, Series
from ballu_mjx.recordings.importers.mapping import RoomMapping
from ballu_mjx.recordings.importers.trajectories import TIMES, refuse, shorten

_LARGEST = 2**31
"""Largest total size of the arrays in an archive (bytes)."""
_WIDEST = 4096
"""Largest number of columns of an array."""
_INFO = Path("meta", "info.json")
_TIME = "timestamp"


def recognise_npz(path: Path, start: str) -> bool:
    """Return whether the file's name ends in .npz."""
    del start
    return path.suffix.lower() == ".npz"


def open_npz(path: Path, mapping: RoomMapping | None) -> Capture:
    """Return the arrays of the archive at `path`. Pickled objects in it are not loaded, so no code is executed.

    **Raises** `InputError` if the file is damaged or holds no arrays of numbers.
    """
    del mapping
    arrays: dict[str, np.ndarray] = {}
    notes: list[str] = []
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(each.file_size for each in archive.infolist()) > _LARGEST:
                refuse(path, "", f"holds more than {_LARGEST >> 20} MiB", "save only the needed arrays")
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                try:
                    array = archive[name]
                except ValueError as error:
                    if "pickle" not in str(error).lower():
                        raise
                    notes.append(f"{shorten(name)!r} holds Python objects and is not read.")
                    continue
                if (
                    array.dtype.kind in "fiub"
                    and array.ndim in (1, 2)
                    and array.shape[-1] <= _WIDEST * (1 if array.ndim == 2 else _LARGEST)
                ):
                    arrays[name] = array
                else:
                    shape = " x ".join(map(str, array.shape)) or "a single value"
                    notes.append(f"{shorten(name)!r} ({array.dtype}, {shape}) is no column of numbers; not read.")
    except InputError:
        raise
    except FileNotFoundError:
        refuse(path, "", "there is no such file", "check the path")
    except Exception as error:  # zipfile, zlib and NumPy raise many types for damaged files.
        refuse(path, "", f"not a complete .npz file ({shorten(str(error) or type(error).__name__)})", "save it again")
    return _capture(path, "an .npz archive", arrays, None, notes)


def _capture(
    path: Path,
    program: str,
    arrays: Mapping[str, np.ndarray],
    time_column: str | None,
    notes: list[str],
    labels: Mapping[str, str] | None = None,
) -> Capture:
    lengths = {name: len(array) for name, array in arrays.items()}
    rows = max(lengths.values(), key=lambda n: (list(lengths.values()).count(n), n), default=0)
    if rows == 0:
        refuse(path, "", "holds no array with one number per sample", "save arrays of shape (samples,) or (samples, n)")
    for name, length in lengths.items():
        if length != rows:
            notes.append(f"{shorten(name)!r} has {length} rows instead of {rows} and is not read.")

    def column(name: str, array: np.ndarray, index: int | None) -> Series:
        values = np.asarray(array if index is None else array[:, index], float)
        bad = np.isinf(values)
        if bad.any():
            refuse(path, f"{shorten(name)}, sample {int(bad.argmax()) + 1}", "it is infinite", "write NaN if missing")
        return Series(values, label=(labels or {}).get(name))

    makers = {}
    for name, array in arrays.items():
        if len(array) != rows:
            continue
        for index in (None,) if array.ndim == 1 else range(array.shape[1]):
            full = name if index is None else f"{name}[{index}]"
            makers[full] = functools.partial(column, full, array, index)
    columns = Lazy(makers)

    def clock(name: str, unit: str) -> np.ndarray:
        time = columns[name].values * TIMES[unit]
        if np.isnan(time).any():
            refuse(
                path, f"{shorten(name)}, sample {int(np.isnan(time).argmax()) + 1}", "the time is missing", "fill it in"
            )
        back = np.diff(time) <= 0
        if back.any():
            row = int(back.argmax())
            problem = f"time runs back or stands still, from {time[row]:.6f} to {time[row + 1]:.6f} s"
            refuse(path, f"{shorten(name)}, sample {row + 2}", problem, "sort the samples, and save one trial per file")
        return time

    return Capture(path, program, columns=columns, clock=clock, rows=rows, time_column=time_column, notes=notes)


# ---- LeRobot ----


def recognise_lerobot(path: Path, start: str) -> bool:
    """Return whether the folder holds meta/info.json."""
    del start
    return path.is_dir() and (path / _INFO).is_file()


def open_lerobot(path: Path, mapping: RoomMapping | None) -> Capture:
    """Return one episode of the dataset in the folder `path`: the one that the mapping selects, or the only one.

    **Raises** `InputError` if pyarrow is not installed, if the dataset is damaged or incomplete, or if it holds several
    episodes and the mapping selects none.
    """
    try:
        import pyarrow  # pyright: ignore[reportMissingImports]
        from pyarrow import parquet  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        fix = 'install it by `pip install -c constraints.txt -e ".[lerobot]"`'
        raise InputError(f"{path}: LeRobot datasets are read with pyarrow, which is not installed; {fix}.") from error
    again = "copy the dataset again"
    info = read_json(path / _INFO, again)
    features = info.get("features")
    if not isinstance(features, dict):
        refuse(path / _INFO, "", '"features" is missing', again)
    tables = sorted((path / "data").rglob("*.parquet"))
    if not tables:
        refuse(path, "", "there is no parquet file under data/", again)
    episode = None if mapping is None else mapping.clock.episode
    arrays: dict[str, list[np.ndarray]] = {}
    present: set[int] = set()
    notes: list[str] = []
    for file in tables:
        try:
            table = parquet.ParquetFile(file).read()
            numbers = table.column("episode_index").to_numpy()
        except KeyError:
            refuse(file, "", "there is no column 'episode_index'", again)
        except (pyarrow.ArrowException, OSError, ValueError) as error:
            refuse(file, "", f"not a complete parquet file ({shorten(str(error))})", again)
        present |= {int(number) for number in np.unique(numbers)}
        chosen = numbers == (min(present) if episode is None else episode)
        if not chosen.any():
            continue
        for name in table.column_names:
            array = _numbers(table.column(name), chosen)
            if array is not None:
                arrays.setdefault(name, []).append(array)
    if episode is None and len(present) > 1:
        problem = f"holds {len(present)} episodes, {min(present)} to {max(present)}"
        if mapping is not None:
            own = f"select one by episode = ... under [clock] in {mapping.path}"
            refuse(path, "", problem, "give the commands of one episode as a table" if mapping.clock.log else own)
        notes.append(f"It {problem}; this list is of episode {min(present)}.")
    elif episode is not None and episode not in present:
        problem = f"there is no episode {episode}"
        refuse(path, "", problem, f"its episodes are {min(present)} to {max(present)}, {len(present)} in all")
    joined = {}
    for name, parts in arrays.items():
        if len({part.shape[1:] for part in parts}) == 1:
            joined[name] = np.concatenate(parts)
    labels = {f"{name}[{i}]": label for name, feature in features.items() for i, label in enumerate(_labels(feature))}
    notes.append("LeRobot states no units of angles. They may be degrees, radians or fractions of a range.")
    capture = _capture(path, "a LeRobot dataset", joined, _TIME if _TIME in joined else None, notes, labels)
    several = len(present) > 1 and episode is None
    return dataclasses.replace(capture, episodes=sorted(present)) if several else capture


def _numbers(column: Any, chosen: np.ndarray) -> np.ndarray | None:
    """Return a column as numbers (T,) or (T, n). None for images, text and lists of different lengths."""
    values = column.filter(chosen.tolist()) if not chosen.all() else column
    plain = values.to_pylist()
    try:
        array = np.array([[np.nan if x is None else x for x in v] if isinstance(v, list) else v for v in plain])
    except (ValueError, TypeError):
        return None
    return array if array.dtype.kind in "fiub" and array.ndim in (1, 2) else None


def _labels(feature: Any) -> list[str]:
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    return [str(name) for name in names] if isinstance(names, list) else []
