"""What the compiled worlds do to single numbers, as NumPy does it to arrays."""

from __future__ import annotations

from typing import Any

from space_dist.kernels.lanes import compiled


@compiled
def clipped(value: Any, limit: Any) -> Any:
    """`value` within +-limit; what is not a number stays so, as with NumPy's minimum and maximum."""
    if value > limit:
        return limit
    if value < -limit:
        return -limit
    return value
