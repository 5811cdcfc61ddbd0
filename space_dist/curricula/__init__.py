"""The algorithms that choose what to train on next: numpy only, no Ray, no torch, no files."""

from space_dist.curricula.interface import Curriculum, Feedback, Selection, State
from space_dist.curricula.round_robin import RoundRobin
from space_dist.curricula.space import Space

__all__ = ["Curriculum", "Feedback", "RoundRobin", "Selection", "Space", "State"]
