"""The actors of a run: thin shells around `rollout.Worker` and `cluster.Central`, and what they compute with.

Imports neither Ray, which makes actors of these classes, nor torch, unless the policy needs it.
"""

from __future__ import annotations

import importlib.metadata
import platform
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from threadpoolctl import threadpool_limits

from space_dist.arithmetic import digest, imported_before, numpy_digest, scipy_checks
from space_dist.config import RunConfig
from space_dist.envs import BULLET_IDS
from space_dist.errors import SpaceDistError, exits_refused
from space_dist.rollout import Setup, Worker
from space_dist.run.cluster import Central
from space_dist.system.importing import look_in

CENTRAL = -1  # the curriculum actor, among the rollout actors 0, 1, ...


class _Timed:
    """An actor's side of a call: what it answers, and how long that took."""

    def ready(self, parts: Sequence[str]) -> dict[str, str]:
        """Answers once the actor is up: with what its arithmetic computes, as `computed` says."""
        return computed(parts)

    def host(self) -> str:
        """The name of its machine."""
        return platform.node()

    def timed(self, method: str, several: bool, *arguments: Any, **options: Any) -> tuple[Any, ...]:
        """Seconds, and the answer: one object, or each of `several`."""
        start = time.monotonic()
        with exits_refused():  # which Ray would take for the actor's own wish, and the driver for a loss
            answer = getattr(self, method)(*arguments, **options)
        seconds = time.monotonic() - start
        return (seconds, *answer) if several else (seconds, answer)


class RolloutActor(_Timed, Worker):
    """A `Worker` in a process of its own, with one thread for its arithmetic.

    folders: where a user's own modules may be found.
    """

    def __init__(self, setup: Setup, folders: Sequence[str]) -> None:
        look_in(folders)
        # Ray sets OMP_NUM_THREADS alone, and products of matrices have other bits with other numbers of threads.
        threadpool_limits(limits=1)
        super().__init__(setup)
        # Here and not in the first call: an environment that cannot be made is told while actors start.
        self.make_first()


class CurriculumActor(_Timed, Central):
    """The central curriculum: aggregates the start values that all rollout actors send it, and decides.

    folders: as `RolloutActor`'s.
    """

    def __init__(self, config: RunConfig, setup: Setup, folders: Sequence[str]) -> None:
        look_in(folders)
        threadpool_limits(limits=1)
        super().__init__(
            config, setup.train, setup.spec.context_bounds, setup.given, generator=setup.spec.generator,
            held_out=setup.test,
        )  # fmt: skip


def name_of(index: int) -> str:
    """What messages call an actor."""
    return "the curriculum actor" if index == CENTRAL else f"rollout actor {index}"


def computes_with(config: RunConfig, setup: Setup, *, central: bool) -> tuple[str, ...]:
    """What decides the bits that an actor computes, as `computed` knows it, beside those of the environment itself."""
    if central:
        return ("numpy", *config.libraries)
    from space_dist.learner import is_mlp  # torch, which actors of such policies never import

    also = {"torch": not is_mlp(config.learner, setup.spec.observation_space),
            "pybullet": config.env.id in BULLET_IDS}  # fmt: skip
    return ("numpy", *(name for name, used in also.items() if used))


def computed(parts: Iterable[str]) -> dict[str, str]:
    """By part, a digest of what this process computes with it; of libraries without kernels of their own, the version.

    NumPy's, which is of the system's libm as well, takes some milliseconds, as do SciPy's and torch's once imported.
    """
    found = {}
    for part in parts:
        if part == "numpy":
            found[part] = numpy_digest()
        elif part == "scipy":
            found[part] = digest(scipy_checks())
        elif part == "torch":
            from space_dist.learner import torch_checks  # likewise

            found[part] = digest(torch_checks())
        else:
            found[part] = importlib.metadata.version(part)
    return found


def refuse_other_arithmetic(index: int, found: Mapping[str, str]) -> None:
    """Raise SpaceDistError for an actor whose results, `found` by part, would depend on its being there."""
    here = computed(found)
    other = [f"{part} ({theirs} there, {here[part]} here)" for part, theirs in found.items() if theirs != here[part]]
    if not other:
        return
    what = f"{name_of(index)} computes other bits than this process with {', '.join(other)}"
    if early := imported_before():
        raise SpaceDistError(
            f"{what}: here {early} had been imported before space_dist, too late for the settings that make results "
            "the same on every CPU, and results would depend on who computes what. Start this process anew (of a "
            "notebook, restart the kernel) and import space_dist first"
        )
    raise SpaceDistError(
        f"{what}: its node has another kind of CPU, or other library versions, and results would depend on who "
        "computes what. Keep the run to nodes of one kind (resources.address, or the cluster's own constraints)"
    )
