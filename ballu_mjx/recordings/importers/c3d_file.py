"""Parser of the C3D file format (https://www.c3d.org): parameters and points, for all three processor types.

A file has a header of 512 bytes, a section of parameters in groups, and frames of points and analog samples. Numbers
have the format of the processor that the parameters name: Intel or MIPS (IEEE, little or big endian), or DEC. Points
are 16-bit integers with a scale, or floating point numbers if the scale is negative.
"""

from __future__ import annotations

import dataclasses
import re
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

BLOCK = 512
_MARK = 0x50
_LARGEST_COUNT = 65535
"""Largest count in 16 bits. Longer trials are counted in a parameter, or this count wraps around."""
_SCALE_TOLERANCE = 1e-3
_INTEL, _DEC, _MIPS = 84, 85, 86
_PROCESSORS = (_INTEL, _DEC, _MIPS)
_NAME = re.compile(rb"[ -~\x80-\xff]+")


class C3DError(ValueError):
    """Error in a C3D file, with the problem and a fix."""

    def __init__(self, problem: str, fix: str = "copy or export it again") -> None:
        super().__init__(problem, fix)
        self.problem, self.fix = problem, fix


@dataclasses.dataclass(frozen=True, eq=False)
class C3DPoints:
    """Points of a C3D file, as stored."""

    rate: float | None
    """Frame rate (Hz). None if not stated."""
    unit: str
    """Unit of length. Empty if not stated."""
    labels: tuple[str, ...]
    """Labels of the points. In irregular files there are fewer or more labels than points."""
    first_frame: int
    """Number of the first frame. Trials begin at 1."""
    position: Float[np.ndarray, "3 points frames"]
    """Positions, in `unit`. NaN where a point was not seen."""


@dataclasses.dataclass(frozen=True)
class _Header:
    parameter_block: int
    points: int
    analog_words: int
    """Analog words in each frame, over all channels."""
    first: int
    last: int
    scale: float
    data_block: int
    analog_samples: int
    """Analog samples of each channel in a frame."""
    rate: float


class _Numbers:
    """Decoder of numbers in a processor's format."""

    def __init__(self, processor: int) -> None:
        self.order = ">" if processor == _MIPS else "<"
        self.dec = processor == _DEC

    def integers(self, content: bytes, *, signed: bool = True) -> Shaped[np.ndarray, " n"]:
        return np.frombuffer(content, f"{self.order}{'i' if signed else 'u'}2").astype(np.int64)

    def floats(self, content: bytes) -> Float[np.ndarray, " n"]:
        if not self.dec:
            with np.errstate(invalid="ignore"):  # Padding may hold signalling NaNs.
                return np.frombuffer(content, f"{self.order}f4").astype(float)
        # DEC swaps the two words, and its exponents are larger by two.
        words = np.frombuffer(content, "<u2").reshape(-1, 2)
        bits = words[:, 0].astype(np.uint32) << 16 | words[:, 1]
        with np.errstate(invalid="ignore"):
            values = bits.view("f4").astype(float) / 4
        # The largest exponent means infinity or NaN in IEEE, but not in DEC. The smallest means 0 in DEC.
        exponent, fraction = bits >> 23 & 0xFF, (bits & 0x7FFFFF).astype(float) / 2**23
        sign = np.where(bits >> 31, -1.0, 1.0)
        values = np.where(exponent == 255, sign * (1 + fraction) * 2.0**126, values)
        return np.where(exponent == 0, 0.0, values)


def read_c3d_points(content: bytes) -> C3DPoints:
    """Read the points of a C3D file.

    **Raises** `C3DError` if the content is not C3D, is cut off, or contradicts itself.
    """
    if len(content) < BLOCK or content[1] != _MARK:
        raise C3DError("not a C3D file", "give a C3D file or a CSV")
    start = (max(content[0], 1) - 1) * BLOCK
    if len(content) < start + 4:
        raise C3DError("too short for its parameters")
    processor = content[start + 3]
    if processor not in _PROCESSORS:
        raise C3DError(f"not a complete C3D file (processor type {processor} in its parameters)")
    numbers = _Numbers(processor)
    header = _read_header(content, numbers)
    begin = (header.data_block - 1) * BLOCK
    # Read up to the frames, because the section's own count of blocks is unreliable.
    parameters = _read_parameters(content[start : begin if begin > start else None], numbers)
    point = parameters.get("POINT", {})
    scale = _number(point, "SCALE", header.scale)
    used = _number(point, "USED", float(header.points))
    if used % 2**16 != header.points:
        raise C3DError(f"its header counts {header.points} points in a frame, POINT:USED {used:g}", "export it again")
    for name, value in (("POINT:SCALE", scale), ("its header's scale", header.scale)):
        if value == 0 or not np.isfinite(value):
            raise C3DError(f"{name} is {value:g}", "export it again")
    if np.signbit(scale) != np.signbit(header.scale):
        raise C3DError("its header and POINT:SCALE do not agree whether its numbers are integers")
    if scale > 0 and abs(scale / header.scale - 1) > _SCALE_TOLERANCE:
        raise C3DError(f"its header states a scale of {header.scale:.4g}, POINT:SCALE {scale:.4g}", "export it again")
    size = 4 if scale < 0 else 2
    header = dataclasses.replace(header, analog_words=_analog_words(header, parameters, len(content) - begin, size))
    frame_bytes = (4 * header.points + header.analog_words) * size
    if header.points == 0:
        raise C3DError("holds no points", "export it with markers")
    if header.data_block < 2 or begin > len(content):
        raise C3DError("not a complete C3D file (its frames begin beyond its end)")
    if not any(_labels(point)):
        raise C3DError("has no names of points (POINT:LABELS)", "label the markers and export it again")
    first, count = _frames(header, parameters, (len(content) - begin) // frame_bytes)
    rate = _number(point, "RATE", header.rate)
    return C3DPoints(
        rate=float(rate) if np.isfinite(rate) and rate > 0 else None,
        unit=next(iter(_texts(point, "UNITS")), ""),
        labels=_labels(point),
        first_frame=first,
        position=_positions(content[begin : begin + count * frame_bytes], header, scale, numbers),
    )


def _read_header(content: bytes, numbers: _Numbers) -> _Header:
    points, analog, first, last = numbers.integers(content[2:10], signed=False).tolist()
    data_block, samples = numbers.integers(content[16:20], signed=False).tolist()
    (scale,), (rate,) = numbers.floats(content[12:16]).tolist(), numbers.floats(content[20:24]).tolist()
    return _Header(content[0], points, analog, first, last, scale, data_block, samples, rate)


def _read_parameters(section: bytes, numbers: _Numbers) -> dict[str, dict[str, Any]]:
    """Read the parameters by group and name. A value is a list of text or an array of numbers."""
    groups: dict[int, str] = {}
    found: dict[int, dict[str, Any]] = {}
    place = 4
    while place + 2 <= len(section):
        length, number = struct.unpack_from("bb", section, place)
        if length == 0:
            break
        name = section[place + 2 : place + 2 + abs(length)]
        offset = place + 2 + abs(length)
        if len(section) < offset + 2 or not _NAME.fullmatch(name) or number == 0:
            raise C3DError("not a complete C3D file (its parameters are cut off)")
        (ahead,) = numbers.integers(section[offset : offset + 2], signed=False).tolist()
        title = name.decode("latin-1").strip().upper()
        if number < 0:
            groups.setdefault(-number, title)
        else:
            found.setdefault(number, {}).setdefault(title, _value(section[offset + 2 :], numbers))
        if ahead == 0:
            break
        place = offset + ahead
    parameters: dict[str, dict[str, Any]] = {}
    for number, values in found.items():
        parameters.setdefault(groups.get(number, ""), {}).update(values)
    return parameters


def _value(rest: bytes, numbers: _Numbers) -> list[str] | Shaped[np.ndarray, " n"]:
    if len(rest) < 2 or len(rest) < 2 + rest[1]:
        raise C3DError("not a complete C3D file (its parameters are cut off)")
    (kind,) = struct.unpack_from("b", rest)
    shape = list(rest[2 : 2 + rest[1]])
    count = int(np.prod(shape, dtype=np.int64)) if shape else 1
    content = rest[2 + len(shape) : 2 + len(shape) + abs(kind) * count]
    if kind not in (-1, 1, 2, 4):
        raise C3DError(f"not a complete C3D file (a parameter has the unknown type {kind})")
    if len(content) < abs(kind) * count:
        raise C3DError("not a complete C3D file (its parameters are cut off)")
    if kind == -1:
        width = shape[0] if shape else 1
        return [_text(content[i : i + width]) for i in range(0, len(content), width)] if width else []
    if kind == 1:
        return np.frombuffer(content, np.int8).astype(np.int64)
    return numbers.integers(content) if kind == 2 else numbers.floats(content)


def _text(content: bytes) -> str:
    """Decode text as UTF-8, or else as Latin-1, which older programs write."""
    content = content.split(b"\0")[0].strip()
    try:
        return content.decode()
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _number(group: Mapping[str, Any], name: str, otherwise: float) -> float:
    value = group.get(name)
    return float(value[0]) if isinstance(value, np.ndarray) and len(value) else otherwise


def _texts(group: Mapping[str, Any], name: str) -> list[str]:
    value = group.get(name)
    return value if isinstance(value, list) else []


def _labels(point: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the labels of the points. Beyond 255 labels, more are in LABELS2 and so on."""
    labels, number = _texts(point, "LABELS"), 2
    while more := _texts(point, f"LABELS{number}"):
        labels, number = labels + more, number + 1
    return tuple(labels)


def _frames(header: _Header, parameters: Mapping[str, Mapping[str, Any]], held: int) -> tuple[int, int]:
    """Return the number of the first frame and the number of frames in a file with room for `held` frames.

    The header counts up to 65,535 frames. Beyond that, its count stops there or wraps around, and the group TRIAL or
    POINT has the full count.
    """
    point, trial = parameters.get("POINT", {}), parameters.get("TRIAL", {})
    first, count = header.first, header.last - header.first + 1
    start, end = (_long(trial, f"ACTUAL_{name}_FIELD") for name in ("START", "END"))
    stated = [int(v) for name in ("LONG_FRAMES", "FRAMES") if np.isfinite(v := _number(point, name, 0.0)) and v > 0]
    if start is not None and end is not None and (start % 2**16 == first or first == _LARGEST_COUNT):
        first = start
        stated.insert(0, end - start + 1)
    if header.last == _LARGEST_COUNT:
        count = next((n for n in stated if count <= n <= held), count)
        if count < held - BLOCK:  # The rest is more than padding.
            problem = f"its header counts to {_LARGEST_COUNT:,}, the limit of 16 bits, but it holds {held:,} frames"
            raise C3DError(problem, "export it in parts of fewer than 65,536 frames")
    else:
        count = next((n for n in stated if n > _LARGEST_COUNT and n % 2**16 == count % 2**16), count)
    if count < 1 or held < count:
        raise C3DError(f"too short for the {max(count, 0):,} frames that its header states")
    if held - count >= _LARGEST_COUNT:
        problem = f"holds {held:,} frames, but its header counts {count:,}, a 16-bit count that wrapped around"
        raise C3DError(problem, "export it in parts of fewer than 65,536 frames")
    return first, count


def _analog_words(header: _Header, parameters: Mapping[str, Mapping[str, Any]], held: int, size: int) -> int:
    """Return the number of analog words after the points of each frame.

    All frames are in `held` bytes, and a word has `size` bytes. Header and parameters state the number in several ways,
    and some programs write one of them wrongly. If they differ, the length of the file decides.
    """
    analog = parameters.get("ANALOG", {})
    channels = _number(analog, "USED", 0.0) % 2**16
    if not channels >= 1:
        return header.analog_words
    counted = {header.analog_words, int(channels) * max(header.analog_samples, 1)}
    rates = _number(analog, "RATE", 0.0), _number(parameters.get("POINT", {}), "RATE", header.rate)
    if all(np.isfinite(rates)) and min(rates) > 0 and rates[0] / rates[1] < _LARGEST_COUNT:
        counted.add(int(channels) * max(round(rates[0] / rates[1]), 1))
    if len(counted) == 1 or header.last == _LARGEST_COUNT:
        return header.analog_words
    count = header.last - header.first + 1
    fitting = [words for words in counted if 0 <= held - count * (4 * header.points + words) * size < BLOCK]
    if header.analog_words in fitting:
        return header.analog_words
    if len(fitting) == 1:
        return fitting[0]
    said = " and ".join(map(str, sorted(counted)))
    raise C3DError(f"its header and its parameters state {said} analog words in a frame", "export it again")


def _long(trial: Mapping[str, Any], name: str) -> int | None:
    """Return a number that is stored in two words, the lower word first. None if it is missing."""
    value = trial.get(name)
    if not isinstance(value, np.ndarray) or len(value) != 2:
        return None
    low, high = (int(word) & 0xFFFF for word in value)
    return low + (high << 16)


def _positions(
    content: bytes, header: _Header, scale: float, numbers: _Numbers
) -> Float[np.ndarray, "3 points frames"]:
    words = numbers.floats(content) if scale < 0 else numbers.integers(content).astype(float)
    frames = words.reshape(-1, 4 * header.points + header.analog_words)
    points = frames[:, : 4 * header.points].reshape(len(frames), header.points, 4)
    position = points[..., :3] * (1.0 if scale < 0 else scale)
    # The fourth word is negative if the point was not seen. Otherwise it holds residual and cameras.
    position[(points[..., 3] < 0) | (position == 0).all(axis=2)] = np.nan
    return np.ascontiguousarray(position.transpose(2, 1, 0))
