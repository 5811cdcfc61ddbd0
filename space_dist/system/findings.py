"""What a check of somebody's own code found: an environment's, or a curriculum's."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Findings:
    """faults: what must be repaired, a sentence each.  notes: what is allowed but may not be meant."""

    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


class FaultError(Exception):
    """A fault that ends such a check: what comes behind could not be told apart from it."""
