"""Groups that recordings are reported in."""

from __future__ import annotations

OTHER = "other"
"""The group of recordings whose name has no prefix."""


def group_of(name: str) -> str:
    """Return the group that a recording is reported in: what stands before the first hyphen of its name.

    `near-3` is of the group `near`; `policy`, without a hyphen, of the group `other`.
    """
    prefix, hyphen, _ = name.partition("-")
    return prefix if prefix and hyphen else OTHER
