"""Padded sets: training sets of which a declared share cannot be solved, by any policy.

What a curriculum loses on them it loses to instances that teach nothing. They are told by their ids (`PADDING_IDS`), so
that a set says itself how much of it is padding; neither environments nor policies see ids.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from space_dist.envs import close, make_batched
from space_dist.envs.interface import BatchedEnv, DrawsUnsolvable, FloatArray
from space_dist.envs.singles import BatchedSingles
from space_dist.errors import ConfigError
from space_dist.instances import MAX_INSTANCES, PADDING_IDS, ContextBounds, InstanceSet, refuse_padding, repeats
from space_dist.seeding import Purpose, generator

MAX_REDRAWS: Final = 100
DrawUnsolvable = Callable[[np.random.Generator, int], FloatArray]


def pad(instances: InstanceSet, share: float, seed: int, env_id: str, kwargs: Mapping[str, Any]) -> InstanceSet:
    """The set and, behind it, as many unsolvable instances of the environment as make `share` of the whole.

    As near to `share` as whole instances come. Their ids go on from `PADDING_IDS`; the others keep theirs. A pure
    function of its arguments. Raises ConfigError for a share that is not between 0 and 1 or comes to no instance or to
    too many, for a negative seed, a set that is padded already, an environment that has no unsolvable instances, and
    one whose instances are not within its bounds or not distinct.
    """
    if not 0.0 < share < 1.0:
        raise ConfigError(f"the share {share:g} is not between 0 and 1; 0.5 pads a set with as many again")
    if seed < 0:
        raise ConfigError(f"the seed {seed} is negative; allowed are whole numbers from 0")
    refuse_padding(instances, "the set to be padded")
    count = round(len(instances) * share / (1.0 - share))
    if not 0 < count <= MAX_INSTANCES - len(instances):
        raise ConfigError(
            f"a share of {share:g} beside {len(instances)} instances are {count}: at least 1 is needed, and a set has "
            f"at most {MAX_INSTANCES} instances"
        )
    where = f"env.id {env_id!r}"
    env = make_batched(env_id, 1, context_visible=False, kwargs=kwargs)
    try:
        if instances.names != env.context_bounds.names:
            raise ConfigError(
                f"the set's features are {_listed(instances)}, not {_listed(env.context_bounds)}, those of {where}"
            )
        drawn = _distinct(where, _drawing(where, env), env.context_bounds, instances, count, seed)
    finally:
        close(env)
    ids = np.append(instances.ids, PADDING_IDS + np.arange(count))
    return InstanceSet(ids, np.vstack((instances.contexts, drawn)), instances.names)


def _listed(of: InstanceSet | ContextBounds) -> str:
    names = ", ".join(of.names)
    return names if len(names) <= 120 else f"{names[:119]}…"


def _drawing(where: str, env: BatchedEnv) -> DrawUnsolvable:
    """What draws its unsolvable contexts."""
    if isinstance(env, DrawsUnsolvable):
        return env.draw_unsolvable
    if isinstance(env, BatchedSingles) and env.first.has_wrapper_attr("draw_unsolvable"):
        found: DrawUnsolvable = env.first.get_wrapper_attr("draw_unsolvable")
        return found
    raise ConfigError(
        f"{where} knows of no unsolvable instances, so its sets cannot be padded: it has no draw_unsolvable(rng, n)"
    )


def _distinct(
    where: str, draw: DrawUnsolvable, bounds: ContextBounds, instances: InstanceSet, count: int, seed: int
) -> FloatArray:
    """`(count, d)` drawn contexts, different from each other and from the set's."""
    n = len(instances)
    rng = generator(seed, Purpose.INSTANCES, int.from_bytes(f"padding of {where}".encode(), "big"), n, count)
    known = instances.contexts
    for _ in range(MAX_REDRAWS):
        known = np.vstack((known, _drawn(where, draw, bounds, rng, n + count - len(known))))
        known = np.delete(known, repeats(known)[1], axis=0)  # those of the set are there once, and come first
        if len(known) == n + count:
            return known[n:]
    raise ConfigError(f"{where}: found only {len(known) - n} distinct unsolvable instances where {count} were wanted")


def _drawn(
    where: str, draw: DrawUnsolvable, bounds: ContextBounds, rng: np.random.Generator, n: int
) -> FloatArray:  # fmt: skip
    """`(n, d)` contexts within the bounds. Somebody else's environment may raise or return anything."""
    try:
        found = np.asarray(draw(rng, n), dtype=np.float64)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{where}: draw_unsolvable failed: {type(error).__name__}: {str(error)[:200]}") from error
    wanted = (n, len(bounds.names))
    if found.shape != wanted:
        raise ConfigError(f"{where}: draw_unsolvable(rng, {n}) gave an array of shape {found.shape}, not {wanted}")
    if not ((found >= bounds.low) & (found <= bounds.high)).all():
        raise ConfigError(f"{where}: draw_unsolvable(rng, {n}) gave contexts outside the bounds")
    return found
