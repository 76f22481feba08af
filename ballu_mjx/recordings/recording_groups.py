"""Groups in which recordings are reported."""

from __future__ import annotations

OTHER = "other"
"""Group of recordings without a prefix in their name."""


def group_of(name: str) -> str:
    """Return a recording's group, which is the part of its name before the first hyphen.

    `near-3` belongs to the group `near`. `policy` has no hyphen and belongs to the group `other`.
    """
    prefix, hyphen, _ = name.partition("-")
    return prefix if prefix and hyphen else OTHER
