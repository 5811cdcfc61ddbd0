"""How much of what a learner plays can teach it, and so how much a curriculum could save: measured, not guessed.

**Signal.** Where an episode succeeds or fails, it says something only if it could have ended otherwise: p (1 - p), with
p an instance's probability of success, is 0 where everything fails and where everything succeeds, and 1/4 at most.
Tzannetos et al. (2023, section 3.2) show that a policy-gradient step gains in proportion to it. The *signal* is the
mean of 4 p (1 - p) over the instances: the share of what the best draws would have given that uniform ones gave.
A learner that drew only instances at p = 1/2 would have as much from `signal` times the steps; no curriculum over these
instances can save more, as long as what it learns on one is worth no more on another.

**Evenness.** Where there is no success, or none that is all or nothing: (sum of s)^2 / (n * sum of s^2), with s an
instance's mean |GAE|. 1: all teach alike, and there is nothing to choose; 1/n: one teaches all.

Where episodes that fail are paid differently (a dense reward), they teach as well, however few succeed: then evenness
decides, and the signal of outcomes bounds nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula.watching import WatchedState
from space_dist.report.statistics import Interval, estimate

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LITTLE: Final = 0.5  # signal or evenness from which on most of what is drawn teaches
JUDGED: Final = 30  # instances with two episodes or more, from which on a share of the steps is looked at by itself
FEW: Final = 0.1  # signal that is reached in no share of the steps where a curriculum saved half of them (docs/wins.md)
ALIKE: Final = 0.01  # of the span of all returns: failures that differ by less are paid alike


@dataclass(frozen=True)
class Headroom:
    """What s uniform runs of one config showed, in w shares of their steps.

    steps: of one run.  signal: `(s, w)`, NaN where no instance had two episodes or success is not known.  evenness:
    `(s, w)`, NaN without advantages.  solved: `(s, w)` share of episodes that succeeded.  never, always: `(s, w)` share
    of the instances with episodes of which none, or each, succeeded.  first: `(s,)` steps by the end of the share in
    which the first success fell; NaN: there was none.  failures: least and greatest return of an episode that failed,
    where these are not all alike: then failures teach.  judged: `(s, w)` how many instances `signal` is the mean over.
    instances: how many there are.
    """

    steps: int
    signal: FloatArray
    evenness: FloatArray
    solved: FloatArray
    never: FloatArray
    always: FloatArray
    first: FloatArray
    judged: FloatArray
    instances: int
    failures: tuple[float, float] | None = None

    def over_all(self, measure: FloatArray) -> Interval:
        """Its mean over time, IQM over seeds; a share of time that has no such number is left out."""
        with np.errstate(invalid="ignore"):
            known = ~np.isnan(measure)
            means = np.where(known, measure, 0.0).sum(axis=1) / known.sum(axis=1)
        return estimate(means).iqm.within(0.0, 1.0)


def signal(episodes: IntArray, successes: IntArray) -> FloatArray:
    """`(w,)` the mean over instances of 4 p (1 - p), from `(w, n)` counts.

    s (m - s) / (m (m - 1)) has p (1 - p) for its expectation, of m >= 2 episodes of which s succeeded; an instance with
    fewer says nothing. NaN where all say nothing.
    """
    enough = episodes >= 2
    pairs = np.where(enough, episodes * (episodes - 1), 1)
    each = np.where(enough, 4.0 * successes * (episodes - successes) / pairs, 0.0)
    return _mean(each, enough)


def evenness(episodes: IntArray, sizes: FloatArray) -> FloatArray:
    """`(w,)` in (0, 1], from `(w, n)` counts and sums of mean |GAE|; instances without episodes are left out.

    NaN where all are, or have advantages of 0.
    """
    played = episodes > 0
    each = np.where(played, sizes / np.maximum(episodes, 1), 0.0)
    total, squares = each.sum(axis=1), (each**2).sum(axis=1)
    found: FloatArray = np.full(len(each), np.nan)
    np.divide(total**2, played.sum(axis=1) * squares, out=found, where=squares > 0.0)
    return found


def _mean(values: FloatArray, counted: NDArray[np.bool_]) -> FloatArray:
    count = counted.sum(axis=1)
    found: FloatArray = np.full(len(values), np.nan)
    np.divide(np.where(counted, values, 0.0).sum(axis=1), count, out=found, where=count > 0)
    return found


def measured(states: list[WatchedState], steps: int) -> Headroom:
    """The headroom that runs of so many steps each showed."""
    rows = [_of_run(state, steps) for state in states]
    arrays: dict[str, FloatArray] = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return Headroom(steps=steps, instances=states[0].episodes.shape[1], failures=_failures(states), **arrays)


def _failures(states: list[WatchedState]) -> tuple[float, float] | None:
    """Least and greatest return of a failure, where failures are not paid alike and success is known."""
    low, high = min(state.failed[0] for state in states), max(state.failed[1] for state in states)
    span = max(state.every[1] for state in states) - min(state.every[0] for state in states)
    known = all(state.knows_success for state in states)
    return (float(low), float(high)) if known and high - low > ALIKE * span else None


def _of_run(state: WatchedState, steps: int) -> dict[str, Any]:
    episodes, successes = state.episodes, state.successes
    unknown = np.full(len(episodes), np.nan)
    played = episodes > 0
    uneven = evenness(episodes, state.sizes)
    if not state.knows_success:
        nothing = dict.fromkeys(("signal", "solved", "never", "always"), unknown)
        return {**nothing, "evenness": uneven, "first": float("nan"), "judged": np.zeros(len(episodes))}
    judged = (episodes >= 2).sum(axis=1).astype(np.float64)
    won = np.flatnonzero(successes.any(axis=1))
    first = (won[0] + 1) * steps / len(episodes) if len(won) else float("nan")
    return {
        "signal": signal(episodes, successes),
        "evenness": uneven,
        "judged": judged,
        "solved": np.divide(successes.sum(axis=1), episodes.sum(axis=1), out=unknown.copy(), where=played.any(axis=1)),
        "never": _mean((successes == 0).astype(np.float64), played),
        "always": _mean((successes == episodes).astype(np.float64), played),
        "first": first,
    }


def in_words(found: Headroom) -> list[str]:
    """What it means, in sentences."""
    seeds = len(found.first)
    told = []
    if found.failures is not None:
        low, high = found.failures
        told.append(
            f"Episodes that fail have returns from {low:.3g} to {high:.3g} here, so they teach as well, however few "
            "succeed: the signal of outcomes bounds nothing."
        )
    elif np.isnan(found.signal).all():
        told.append("Whether an episode succeeds is not known here, so only the sizes of advantages can tell.")
    else:
        missed = int(np.isnan(found.first).sum())
        if missed == seeds:
            told.append(
                f"Nothing succeeded in {found.steps:,} steps, so nothing says what a curriculum could save behind the "
                "first success. Whether it comes sooner is a matter of discovery: breadth, easier instances, luck."
            )
            return told
        told.extend(_of_signal(found))
        late = found.first[~np.isnan(found.first)]
        told.append(
            f"The first success fell within the first {np.median(late):,.0f} steps (median of the seeds that had one"
            + (f"; {missed} of {seeds} had none" if missed else "")
            + "). What comes before it is a matter of discovery, on which this says nothing."
        )
    if not np.isnan(found.evenness).all():
        even = found.over_all(found.evenness)
        told.append(
            f"Evenness of the advantages over the instances: {even.value:.2f}{_span(even, percent=False)}; 1 is where "
            "all teach alike."
        )
    return [*told, verdict(found)]


def _of_signal(found: Headroom) -> list[str]:
    """What uniform draws gave; a bound where enough was seen in every part of the run, and nothing where in none."""
    enough = _enough(found)
    if not enough.any():
        return []
    share = found.over_all(found.signal[:, enough])
    gave = (
        f"niform draws gave {min(1.0, share.value):.0%}{_span(share)} (IQM over seeds) of the signal that draws at "
        "even odds would have given"
    )
    if not enough.all():
        return [
            f"In the {enough.sum()} of {len(enough)} parts of the run in which {JUDGED} instances had two episodes, "
            f"u{gave}. Of the others it says nothing, and so nothing of the whole run: --steps gives longer runs."
        ]  # fmt: skip
    return [
        f"U{gave}: over these {found.steps:,} steps no curriculum over these instances can need less than that share "
        "of the steps, unless what is learned on some carries over to others."
    ]


def _enough(found: Headroom) -> NDArray[np.bool_]:
    """`(w,)` in which shares of the steps enough instances were judged, in the mean over seeds, to say anything."""
    return np.asarray(found.judged.mean(axis=0) >= JUDGED)


def _too_little(found: Headroom) -> str:
    if found.instances < JUDGED:
        return (
            f"There are {found.instances} instances, and fewer than {JUDGED} are too few to say what a curriculum over "
            "them could save."
        )
    return (
        f"In no part of the run {JUDGED} instances had two episodes: these runs are too short to say what a curriculum "
        "could save; --steps gives longer ones."
    )


def verdict(found: Headroom) -> str:
    """One sentence: whether to expect anything of a curriculum, by what was seen of it in docs/wins.md."""
    by_outcome = found.failures is None and not np.isnan(found.signal).all()
    known = found.signal if by_outcome else found.evenness
    if np.isnan(known).all():
        return "Neither success nor advantages are known: nothing can be said."
    if by_outcome and np.isnan(found.first).all():
        return "Nothing succeeded: what a curriculum could save behind the first success is not known."
    if by_outcome:
        known = found.signal[:, _enough(found)]
    if not known.size:
        return _too_little(found)
    if found.over_all(known).value >= LITTLE:
        return "Most of what is drawn teaches: expect little of a curriculum here."
    if not by_outcome:
        return (
            "Advantages differ from instance to instance, which promises nothing: on a world with a reward at every "
            "step that looked so, no curriculum was better than round robin (docs/wins.md)."
        )
    most = min(1.0, max(_average(share) for share in known.T))  # without bias, so of few episodes it may be more
    if most >= FEW:
        return (
            f"In the part of the run where most was taught, draws had {most:.0%} of the signal: on a world with such a "
            "part a curriculum was no faster than uniform draws (docs/wins.md)."
        )
    return (
        f"In no part of the run draws had more than {most:.0%} of the signal, so there is room for a curriculum: on "
        "worlds that looked so one needed less than half of the steps, once its learner was well tuned (docs/wins.md)."
    )


def _span(found: Interval, *, percent: bool = True) -> str:
    if found.low is None or found.high is None:
        return ""
    return f" [{found.low:.0%}, {found.high:.0%}]" if percent else f" [{found.low:.2f}, {found.high:.2f}]"


def table(found: Headroom) -> list[dict[str, str]]:
    """A row for each share of the steps: means over the seeds."""
    shares = found.signal.shape[1]
    columns = {"signal": found.signal, "success": found.solved, "never": found.never, "always": found.always}
    rows = []
    for share in range(shares):
        row = {"steps": f"{(share + 1) * found.steps // shares:,}"}
        row |= {name: _percent(values[:, share]) for name, values in columns.items()}
        row["evenness"] = (
            "-" if np.isnan(found.evenness[:, share]).all() else f"{_average(found.evenness[:, share]):.2f}"
        )
        rows.append(row)
    return rows


def _percent(values: FloatArray) -> str:
    return "-" if np.isnan(values).all() else f"{_average(values):.0%}"


def _average(values: FloatArray) -> float:
    return float(values[~np.isnan(values)].mean())
