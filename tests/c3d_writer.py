"""Write valid and inconsistent C3D files of every processor type, by the format's definition (https://www.c3d.org)."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

INTEL, DEC, MIPS = 84, 85, 86
BLOCK = 512


def floats(values: Float[np.ndarray, " n"], processor: int) -> bytes:
    """Return single-precision numbers encoded for a processor."""
    if processor != DEC:
        return np.asarray(values, ">f4" if processor == MIPS else "<f4").tobytes()
    bits = (np.asarray(values, "f4") * 4).view(np.uint32)  # DEC's exponents are larger by two
    bits = np.where(np.asarray(values) == 0, 0, bits)
    return np.stack([bits >> 16, bits & 0xFFFF], axis=-1).astype("<u2").tobytes()


def integers(values: Sequence[int] | np.ndarray, processor: int) -> bytes:
    """Return 16-bit integers encoded for a processor. Larger ones wrap."""
    wrapped = np.asarray(values, np.int64) & 0xFFFF
    return wrapped.astype(">u2" if processor == MIPS else "<u2").tobytes()


def c3d_bytes(
    position: Float[np.ndarray, "T points 3"],
    labels: Sequence[str | bytes],
    *,
    processor: int = INTEL,
    scale: float = -1.0,
    rate: float = 100.0,
    unit: str = "mm",
    analog_words: int = 0,
    first: int = 1,
    last: int | None = None,
    parameters: Mapping[tuple[str, str], tuple[int, Sequence[float] | Sequence[str]]] | None = None,
) -> bytes:
    """Return the content of a C3D file of points.

    **Arguments**

    - `position`: positions (in `unit`). NaN marks samples without a measurement.
    - `scale`: negative for floating-point data, else the unit of the 16-bit integers.
    - `last`: number of the last frame in the header. None for the true number, in 16 bits.
    - `parameters`: further parameters by group and name, each with its type (1, 2 or 4 bytes) and values.
    """
    frames, points = position.shape[:2]
    names = [name if isinstance(name, bytes) else name.encode() for name in labels]
    width = max(map(len, names))
    params: dict[tuple[str, str], bytes] = {
        ("POINT", "USED"): b"\x02\x00" + integers([points], processor),
        ("POINT", "FRAMES"): b"\x02\x00" + integers([frames], processor),
        ("POINT", "SCALE"): b"\x04\x00" + floats(np.array([scale]), processor),
        ("POINT", "RATE"): b"\x04\x00" + floats(np.array([rate]), processor),
        ("POINT", "UNITS"): bytes([255, 1, len(unit)]) + unit.encode(),
        ("POINT", "LABELS"): bytes([255, 2, width, points]) + b"".join(name.ljust(width) for name in names),
    }
    for key, (kind, values) in (parameters or {}).items():
        encode = {1: bytes, 2: lambda v: integers(v, processor), 4: lambda v: floats(np.array(v), processor)}[kind]
        params[key] = bytes([kind, 1, len(values)]) + encode(values)
    groups = {name: number for number, name in enumerate(dict.fromkeys(group for group, _ in params), 1)}
    section = bytearray()
    for name, number in groups.items():
        section += bytes([len(name), 256 - number]) + name.encode() + integers([3], processor) + b"\x00"
    for (group, name), value in params.items():
        record = bytes([len(name), groups[group]]) + name.encode()
        section += record + integers([2 + len(value) + 1], processor) + value + b"\x00"
    section += b"\x00\x00"
    blocks = -(-(len(section) + 4) // BLOCK)
    header = struct.pack("BB", 2, 0x50) + integers([points, analog_words, first], processor)
    header += integers([first + frames - 1 if last is None else last, 0], processor)
    header += floats(np.array([scale]), processor) + integers([2 + blocks, 1], processor)
    header += floats(np.array([rate]), processor)
    table = bytes([1, 0x50, blocks, processor]) + bytes(section)
    words = np.zeros((frames, 4 * points + analog_words))
    hidden = np.asarray(np.isnan(position).any(axis=2))
    values = np.where(hidden[..., None], 0.0, position) / (1.0 if scale < 0 else scale)
    places = words[:, : 4 * points].reshape(frames, points, 4)
    places[..., :3] = values if scale < 0 else np.round(values)
    places[..., 3] = np.where(hidden, -1, 0)
    words[:, 4 * points :] = 7.0
    flat = words.reshape(-1)
    data = floats(flat, processor) if scale < 0 else integers(flat.astype(np.int64), processor)
    return header.ljust(BLOCK, b"\0") + table.ljust(blocks * BLOCK, b"\0") + data
