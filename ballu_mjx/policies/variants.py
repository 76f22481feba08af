"""Simulators that policies are trained in, as records, with the names that tables, folders and figures give them."""

from __future__ import annotations

import dataclasses

_VANILLA = "vanilla"
_ROUNDS = "envmimic"
"""The residual that is learned again in each round."""


@dataclasses.dataclass(frozen=True)
class SimulatorVariant:
    """A simulator that policies are trained in: `vanilla`, as it may be improved, or one with a residual."""

    residual: str | None = None
    """How the residual was learned; None: there is none."""
    identified: bool = False
    """Whether a vanilla simulator has identified actuators (`+sysid`)."""
    randomized: bool = False
    """Whether a vanilla simulator is randomized (`+dr`)."""
    round: int = 1
    """In which round the residual was learned."""

    @property
    def name(self) -> str:
        """What the simulator is called in tables and folders."""
        if self.residual is None:
            return _VANILLA + "+sysid" * self.identified + "+dr" * self.randomized
        return self.residual if self.round == 1 else f"{self.residual}-{self.round}"

    @staticmethod
    def parse(name: str) -> SimulatorVariant:
        """Return the simulator that is called `name`."""
        base, *improvements = name.split("+")
        if base == _VANILLA and set(improvements) <= {"sysid", "dr"}:
            return SimulatorVariant(identified="sysid" in improvements, randomized="dr" in improvements)
        method, _, number = name.rpartition("-")
        if method == _ROUNDS and number.isdecimal() and int(number) > 1:
            return SimulatorVariant(method, round=int(number))
        return SimulatorVariant(name)
