"""The faults of a rehearsal: of which kinds, when they fall, and what came of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

KINDS = (
    "kill rollout actor", "stop rollout actor", "kill curriculum actor", "stop curriculum actor", "kill driver",
    "stop driver", "kill supervisor", "stop supervisor", "kill pool worker", "stop pool worker", "kill conductor",
    "kill submitter", "kill Ray head", "kill tracking server",
)  # fmt: skip
OF_ALL = ("conductor", "submitter", "Ray head", "tracking server")  # parts that all runs share
_FIRST, LAST = 0.03, 0.9  # of all steps: when the first and the last fault may fall
_MOST_DELAY, _MOST_PAUSE = 2.0, 3.0  # seconds: after the step count that calls for a fault; before a restart


@dataclass(frozen=True)
class Fault:
    """One of KINDS. It falls `delay` seconds after `after_steps` were committed by all runs together.

    choice: in [0, 1), which of the possible victims. pause: seconds before whoever has to be restarted is.
    """

    kind: str
    after_steps: float
    delay: float
    pause: float
    choice: float


@dataclass(frozen=True)
class Hit:
    """A fault that fell. seconds: until everything that was at work had got on; None if it did not."""

    fault: Fault
    run: str
    at: float
    seconds: float | None


@dataclass
class Result:
    """What a rehearsal has shown."""

    hits: list[Hit] = field(default_factory=list)
    misses: dict[str, int] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)  # what is not as it must be, one sentence each
    runs: int = 0
    identical: int = 0
    ends: dict[str, int] = field(default_factory=dict)  # how attempts ended
    submissions: int = 0
    seconds: float = 0.0


def plan(kinds: Sequence[str], count: int, steps: int, seed: int, last: float = LAST) -> list[Fault]:
    """`count` faults over a grid of `steps` environment steps, every kind as often as any other, give or take one.

    last: by which share of the steps all have fallen.
    """
    draws = np.random.default_rng(np.random.SeedSequence(seed))
    chosen = [kinds[number % len(kinds)] for number in range(count)]
    draws.shuffle(chosen)
    moments = np.sort(draws.uniform(_FIRST * steps, last * steps, count))
    return [
        Fault(kind, float(moment), float(draws.uniform(0.0, _MOST_DELAY)), float(draws.uniform(0.0, _MOST_PAUSE)),
              float(draws.random()))
        for kind, moment in zip(chosen, moments, strict=True)
    ]  # fmt: skip
