"""The algorithms that choose what to train on next: no Ray, no torch, no files.

NumPy and SciPy only; ALP-GMM imports scikit-learn when it first fits its mixture. `configured` makes them of a config.
"""

from space_dist.curricula.draws import Draws, Uniform
from space_dist.curricula.interface import (
    GENERATED,
    Curriculum,
    Episodes,
    Feedback,
    Probes,
    Selection,
    SetState,
    State,
    Wants,
    decode_state,
    encode_state,
)
from space_dist.curricula.round_robin import RoundRobin
from space_dist.curricula.space import Space

__all__ = [
    "GENERATED",
    "Curriculum",
    "Draws",
    "Episodes",
    "Feedback",
    "Probes",
    "RoundRobin",
    "Selection",
    "SetState",
    "Space",
    "State",
    "Uniform",
    "Wants",
    "decode_state",
    "encode_state",
]
