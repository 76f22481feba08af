"""Variants of the simulator in which policies are trained, with their names in tables, folders and figures."""

from __future__ import annotations

import dataclasses

_VANILLA = "vanilla"
ROUNDS = "envmimic"
"""Residual that is learned again in each round. From the second round on, its name ends with the round's number."""


@dataclasses.dataclass(frozen=True)
class SimulatorVariant:
    """A variant of the simulator in which policies are trained: vanilla, possibly improved, or with a residual."""

    residual: str | None = None
    """Method by which the residual was learned. None if there is no residual."""
    identified: bool = False
    """Whether a vanilla simulator has identified actuators (`+sysid`)."""
    randomized: bool = False
    """Whether a vanilla simulator has domain randomization (`+dr`)."""
    round: int = 1
    """Number of the round in which the residual was learned, from 1."""

    @property
    def name(self) -> str:
        """Name of the simulator in tables and folders."""
        if self.residual is None:
            return _VANILLA + "+sysid" * self.identified + "+dr" * self.randomized
        return self.residual if self.round == 1 else f"{self.residual}-{self.round}"

    @staticmethod
    def parse(name: str) -> SimulatorVariant:
        """Return the variant with the given name."""
        base, *improvements = name.split("+")
        if base == _VANILLA and set(improvements) <= {"sysid", "dr"}:
            return SimulatorVariant(identified="sysid" in improvements, randomized="dr" in improvements)
        method, _, number = name.rpartition("-")
        if method == ROUNDS and number.isdecimal() and int(number) > 1:
            return SimulatorVariant(method, round=int(number))
        return SimulatorVariant(name)
