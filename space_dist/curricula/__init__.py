"""The algorithms that choose what to train on next: no Ray, no torch, no files.

NumPy and SciPy only; ALP-GMM imports scikit-learn when it first fits its mixture. `configured` makes them of a config,
`custom` those that somebody else has written, and `checker` says what is wrong with these.
"""

from space_dist.curricula.draws import Drawn, DrawnState, Draws, Uniform, proportional
from space_dist.curricula.interface import (
    GENERATED,
    Curriculum,
    Episodes,
    Feedback,
    Numbers,
    Probes,
    Selection,
    SetState,
    State,
    Wants,
    decode_state,
    encode_state,
    selection_of,
)
from space_dist.curricula.round_robin import RoundRobin
from space_dist.curricula.space import Space

__all__ = [
    "GENERATED",
    "Curriculum",
    "Drawn",
    "DrawnState",
    "Draws",
    "Episodes",
    "Feedback",
    "Numbers",
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
    "proportional",
    "selection_of",
]
