"""How times are taken."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def median_cpu(work: Callable[[], object], repeats: int) -> float:
    """CPU seconds per call of this process."""
    return median(work, repeats, time.process_time)


def median(work: Callable[[], object], repeats: int, clock: Callable[[], float]) -> float:
    """Seconds per call; short calls are repeated within one measurement until the clock can resolve them."""
    start = clock()
    work()
    count = max(1, int(0.05 / max(clock() - start, 1e-6)))
    times = []
    for _ in range(repeats):
        start = clock()
        for _ in range(count):
            work()
        times.append((clock() - start) / count)
    return statistics.median(times)


def duration(seconds: float) -> str:
    """As milliseconds."""
    return f"{seconds * 1e3:,.2f} ms"
