"""The one exception that users are meant to see, and what all readers of files ask of a value."""

from typing import Any


class InputError(Exception):
    """Something that the user gave cannot be used.

    The message is one sentence that names the file, the place in it and the mend; commands print it alone and exit
    with status 2.
    """


_LARGEST = 3.4e38


def is_number(value: Any) -> bool:
    """Whether a value from JSON or TOML is a finite number, in single precision too."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -_LARGEST < value < _LARGEST
