"""One decision of a run, line by line of Algorithm 1, with its numbers: made again from the ledger by our own code.

`jobs/audit.py` makes the same decisions without it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from space_dist.config import CustomConfig, FixedConfig, GrowingConfig, RoundRobinConfig, RunConfig
from space_dist.curricula import Feedback, SetState
from space_dist.curricula.making import make_curriculum
from space_dist.curricula.variants import readings
from space_dist.errors import ConfigError, LedgerError
from space_dist.instances import ContextBounds, InstanceSet
from space_dist.ledger import CURRICULUM, METRICS, VALUES, Ledger, Row, decode_values

_SHOWN = 12  # instances of a list or a table; the rest are counted


def explain(
    ledger: Ledger, config: RunConfig, bounds: ContextBounds, train: InstanceSet, iteration: int | None = None
) -> list[str]:  # fmt: skip
    """Lines 6 to 13 behind an iteration, counted from 1; None: the last behind which something was decided.

    config, train: the run's; bounds: of its contexts. Raises ConfigError where nothing is decided about sets, or there
    is no such iteration; LedgerError where the values of a decision are not there, or lead to another set than the run
    trained on.
    """
    settings = config.curriculum
    if not isinstance(settings, GrowingConfig | RoundRobinConfig | FixedConfig):
        what = "chooses by rules of its own" if isinstance(settings, CustomConfig) else "draws its instances"
        raise ConfigError(
            f"{ledger.folder}: curriculum.kind: {settings.kind} {what}, so it has no lines 6 to 13; "
            "explained are space, random_growth, cspace, manual, round_robin and fixed"
        )
    if len(config.curricula) > 1 or config.fork is not None:
        raise ConfigError(
            f"{ledger.folder}: its {'seed' if config.fork else 'curriculum'} changes on the way "
            f"({'fork' if config.fork else 'schedule'}), so its decisions cannot be made again from its start"
        )
    decided = [row for row in ledger.rows(METRICS) if row["kind"] == "iteration" and row["complete"]]
    taken = ", the last; --iteration N shows another" if iteration is None else ""
    iteration = len(decided) if iteration is None else iteration
    if not 1 <= iteration <= len(decided):
        raise ConfigError(
            f"--iteration {iteration}: {ledger.folder} has decisions behind iterations 1 to {len(decided)}"
            if decided else f"{ledger.folder} has no complete iteration yet"
        )  # fmt: skip
    scored, trained = ledger.rows(VALUES), [row["trained"] for row in ledger.rows(CURRICULUM)]
    if [row["iteration"] for row in scored[: iteration + 1]] != list(range(iteration + 1)):
        raise LedgerError(
            f"{ledger.folder / VALUES} does not hold the start values of every decision up to iteration {iteration}: "
            "the run was begun by an earlier version, or its set is too large"
        )
    curriculum = make_curriculum(config, train, bounds)
    state, selection = curriculum.start()
    for row in decided[:iteration]:
        feedback = _feedback(scored, row)
        before, (state, selection, numbers) = state, curriculum.step(state, feedback)
    if not isinstance(before, SetState) or not isinstance(state, SetState):
        raise TypeError(f"the state of {settings.kind} has no set")
    if trained[iteration : iteration + 1] not in ([], [selection.ids.tolist()]):
        raise LedgerError(
            f"{ledger.folder}: iteration {iteration + 1} trained on another set than these values lead to; "
            "jobs/audit.py says where they part"
        )
    lines = [
        f"{config.name}, seed {config.seed}, {settings.kind}: iteration {iteration}, {row['steps']:,} steps{taken}"
    ]
    lines.append(f"Trained on: S = {before.size} of {len(train)} instances: {_listed(train.ids[before.selected])}")
    if isinstance(settings, GrowingConfig):
        lines += _growth(settings, feedback, before, state, numbers)
        ranking = getattr(settings, "pic", None) or getattr(settings, "distance", None) or settings.kind
        lines.append(
            f"Lines 10-11: d_t(i) = V_t(i) - V_t-1(i), from {_short(numbers['smallest_pic'])} to "
            f"{_short(numbers['largest_pic'])}. Ranked by: {ranking}{', reversed' if _reversed(settings) else ''}"
            f"{', which does not look at d_t' if ranking == settings.kind else ''}"
        )
    else:
        lines.append(f"Lines 6-11: {settings.kind} asks no values; the order never changes")
    lines.append(f"Line 12: I_curr := {_listed(selection.ids)}")
    lines += _table(feedback, before, state, train)
    came = "the run has trained on these" if len(trained) > iteration else "the run has not trained on these yet"
    return [*lines, f"Line 13: t := {iteration + 1}; {came}"]


def _feedback(scored: list[Row], row: Row) -> Feedback:
    """What the decision behind an iteration was made from."""
    iteration = row["iteration"]
    now = scored[iteration]
    before = decode_values(now["before"] if "before" in now else scored[iteration - 1]["after"])
    return Feedback(iteration - 1, before, decode_values(now["after"]), row["gradient_steps"])


def _growth(
    settings: GrowingConfig, feedback: Feedback, before: SetState, after: SetState, numbers: Row
) -> Iterator[str]:  # fmt: skip
    inside = np.sort(before.selected)
    read = readings(feedback.values_before[inside], feedback.values_after[inside], before.mean_value)
    reading = read[settings.mean]
    yield f"Line 6: V_t = {_short(after.mean_value)}, V_t-1 = {_short(reading.reference)} (mean: {settings.mean})"
    eta = numbers["eta"]
    if not feedback.gradient_steps:
        yield "Line 7: not tested, for the iteration made no gradient step"
    elif eta is None:
        yield f"Line 7: not asked (growth: {settings.growth})"
    else:
        within = reading.within(eta)
        yield (
            f"Line 7: change {_short(reading.change)} {'<=' if within else '>'} eta * max(V_t-1, 1e-8) = {_short(eta)} "
            f"* {_short(max(reading.reference, 1e-8))}, a relative change of {_short(reading.relative())}"
        )
    times = settings.growth == "multiply"
    wanted = f"{before.size} {'*' if times else '+'} {settings.kappa}"
    if after.size < (before.size * settings.kappa if times else before.size + settings.kappa):
        wanted = f"min({wanted}, {after.size})"
    yield (
        f"Line 8: S := {wanted} = {after.size}" if numbers["grew"]
        else f"Line 8: S stays {after.size}, after {after.stalled} tests without growth"
    )  # fmt: skip


def _table(feedback: Feedback, before: SetState, after: SetState, train: InstanceSet) -> Iterator[str]:
    """The first of the next set in its order, then those of the last set that dropped out."""
    yield f"{'':8}{'id':>8} {'V_t-1':>12} {'V_t':>12} {'d_t':>12}"
    dropped = before.selected[~np.isin(before.selected, after.selected)]
    for what, indices in (("next", after.selected), ("dropped", dropped)):
        for one in indices[:_SHOWN].tolist():
            old, new = feedback.values_before[one], feedback.values_after[one]
            yield f"{what:8}{train.ids[one]:>8} {old:>12.6g} {new:>12.6g} {new - old:>12.6g}"
        if len(indices) > _SHOWN:
            yield f"{what:8}{'...':>8} and {len(indices) - _SHOWN} more"


def _reversed(settings: GrowingConfig) -> bool:
    return bool(getattr(settings, "reverse", False))


def _listed(ids: np.ndarray) -> str:
    text = ", ".join(str(one) for one in ids[:_SHOWN].tolist())
    return text + (f", ... and {len(ids) - _SHOWN} more" if len(ids) > _SHOWN else "")


def _short(number: object) -> str:
    return f"{number:.6g}" if isinstance(number, float | int) else "none"
