"""How long a run still takes, by what was seen of it since it began to step."""

from __future__ import annotations

from collections import deque
from typing import Final

_ENOUGH_SECONDS: Final = 5.0  # of stepping, before which a rate says little
_ENOUGH_ROUNDS: Final = 2
_RECENT_SECONDS: Final = 60.0  # over which the rate is taken: rounds and evaluations take their turns
_APART_SECONDS: Final = 1.0  # between two moments that are remembered


class TimeLeft:
    """Told how far a run is after each of its rounds, says how long it still takes.

    What comes before the end of the first round is not looked at: there libraries are loaded and kernels compiled.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float]] = deque()  # when, in seconds, and the share that was done
        self._rounds = -1  # since the first

    def after(self, share: float, now: float) -> float | None:
        """Seconds, another round later; None where it is at its end, or that cannot be told yet."""
        self._rounds += 1
        if not self._seen or now - self._seen[-1][0] >= _APART_SECONDS:
            self._seen.append((now, share))
        while len(self._seen) > _ENOUGH_ROUNDS + 1 and now - self._seen[1][0] >= _RECENT_SECONDS:
            self._seen.popleft()
        began, before = self._seen[0]
        seconds, done = now - began, share - before
        if share >= 1 or done <= 0 or seconds < _ENOUGH_SECONDS or self._rounds < _ENOUGH_ROUNDS:
            return None
        return (1 - share) * seconds / done
