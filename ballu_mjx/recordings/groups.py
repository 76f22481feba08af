"""Groups that recordings are reported in."""

from __future__ import annotations

GROUPS = ("near", "far", "all")
"""What recordings are reported in."""


def group_of(name: str) -> str:
    """The group a recording is reported in."""
    head = name.split("-")[0]
    return head if head in GROUPS else "all"
