"""The exception for unusable input, and the check of numbers that are read from files."""

from typing import Any


class InputError(Exception):
    """Input from the user that cannot be used.

    The message is one sentence. It names the file, the place in the file and the fix. Commands print only this message
    and exit with status 2.
    """


_LARGEST = 3.4e38
"""Magnitude just below the largest number in single precision."""


def is_number(value: Any) -> bool:
    """Return whether a value from JSON or TOML is a number that is finite in single precision. Booleans are not."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -_LARGEST < value < _LARGEST
