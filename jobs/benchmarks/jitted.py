"""PPO on PointMass as one program of JAX, environment included: the way of PureJaxRL (Lu et al., 2022).

Our environment's dynamics in float32, its episodes begun anew within the program with contexts drawn uniformly; SB3's
networks, loss and hyperparameters; the value behind a truncated step is added to its reward, as SB3 does. Members of a
batch are `vmap`ped. Needs the extra `bench`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from numpy.typing import NDArray

from space_dist.config import PPOConfig
from space_dist.envs.pointmass import (
    ACTION_LIMIT,
    DT,
    FORCE,
    GOAL,
    HORIZON,
    INNER_STEPS,
    NOISE_STD,
    POSITION_LIMIT,
    REWARD_DECAY,
    START,
)
from space_dist.envs.pointmass import BOUNDS as POINTMASS_BOUNDS

Array = Any  # JAX's, whatever is being traced
_INPUTS, _OUTPUTS = len(START) + len(POINTMASS_BOUNDS.names), 2
_HALF_LOG_2_PI = 0.5 * np.log(2.0 * np.pi)


class State(NamedTuple):
    """Of all environments of a member. body: (n, 4) x, vx, y, vy.  context: (n, 3).  time: (n,)."""

    body: Array
    context: Array
    time: Array


class Samples(NamedTuple):
    """(length, n, ...) each, or any other leading axes."""

    observations: Array
    actions: Array
    log_probs: Array
    advantages: Array
    returns: Array


class Learning(NamedTuple):
    """All that goes from one iteration to the next."""

    parameters: Any
    optimiser: Any
    state: State
    key: Array


def step(state: State, actions: Array, noise: Array) -> tuple[State, Array, Array, Array]:
    """`BatchedPointMass.step` with noise (n, inner steps, 2): the state, rewards, crashes and truncations (n,)."""
    (x, vx, y, vy), (gate_x, gate_width, friction) = state.body.T, state.context.T
    force = FORCE * jnp.clip(actions, -ACTION_LIMIT, ACTION_LIMIT)
    drive, decay = DT * (force[:, None] + NOISE_STD * noise), 1.0 - DT * friction
    crashed = jnp.zeros(len(x), bool)
    for inner in range(INNER_STEPS):
        new_x = jnp.clip(x + DT * vx, -POSITION_LIMIT, POSITION_LIMIT)
        new_y = jnp.clip(y + DT * vy, -POSITION_LIMIT, POSITION_LIMIT)
        crossed = (y * new_y <= 0.0) & (y != new_y)
        wall_x = x + y / jnp.where(crossed, y - new_y, 1.0) * (new_x - x)
        hit = crossed & ~crashed & (jnp.abs(wall_x - gate_x) > gate_width / 2)
        x = jnp.where(crashed, x, jnp.where(hit, wall_x, new_x))
        y = jnp.where(crashed, y, jnp.where(hit, 0.0, new_y))
        crashed = crashed | hit
        vx = jnp.where(crashed, 0.0, vx * decay + drive[:, inner, 0])
        vy = jnp.where(crashed, 0.0, vy * decay + drive[:, inner, 1])
    time = state.time + 1
    rewards = jnp.exp(-REWARD_DECAY * jnp.hypot(x - GOAL[0], y - GOAL[1]))
    return State(jnp.stack([x, vx, y, vy], 1), state.context, time), rewards, crashed, (time >= HORIZON) & ~crashed


def observe(state: State) -> Array:
    """(n, 7): the body and its scaled context."""
    low, high = POINTMASS_BOUNDS.low, POINTMASS_BOUNDS.high
    return jnp.concatenate([state.body, 2.0 * (state.context - low) / (high - low) - 1.0], axis=-1)


def _begun(key: Array, contexts: Array, count: int) -> State:
    drawn = contexts[jax.random.randint(key, (count,), 0, len(contexts))]
    return State(jnp.broadcast_to(jnp.asarray(START, jnp.float32), (count, 4)), drawn, jnp.zeros(count, jnp.int32))


def _initial(key: Array, config: PPOConfig) -> dict[str, Any]:
    """As SB3's: orthogonal weights with the gains sqrt(2), and 0.01 and 1 of the last layers; biases of 0."""
    widths, found = [_INPUTS, *config.net_arch], {}
    for name, outputs, last in (("actor", _OUTPUTS, 0.01), ("critic", 1, 1.0)):
        sizes, gains = [*widths, outputs], [2.0**0.5] * len(config.net_arch) + [last]
        key, *keys = jax.random.split(key, len(gains) + 1)
        found[name] = [
            (jax.nn.initializers.orthogonal(gain)(one, (sizes[layer], sizes[layer + 1])), jnp.zeros(sizes[layer + 1]))
            for layer, (one, gain) in enumerate(zip(keys, gains, strict=True))
        ]
    return {**found, "log_std": jnp.zeros(_OUTPUTS)}


def _forward(layers: Any, inputs: Array) -> Array:
    for weights, biases in layers[:-1]:
        inputs = jnp.tanh(inputs @ weights + biases)
    weights, biases = layers[-1]
    return inputs @ weights + biases


def _values(parameters: Any, observations: Array) -> Array:
    return _forward(parameters["critic"], observations)[..., 0]


def _log_probs(parameters: Any, observations: Array, actions: Array) -> Array:
    log_std = parameters["log_std"]
    deviations = (actions - _forward(parameters["actor"], observations)) * jnp.exp(-log_std)
    return (-0.5 * deviations**2 - log_std - _HALF_LOG_2_PI).sum(axis=-1)


def _loss(parameters: Any, batch: Samples, config: PPOConfig) -> Array:
    advantages = (batch.advantages - batch.advantages.mean()) / (batch.advantages.std(ddof=1) + 1e-8)
    ratios = jnp.exp(_log_probs(parameters, batch.observations, batch.actions) - batch.log_probs)
    clipped = jnp.clip(ratios, 1.0 - config.clip_range, 1.0 + config.clip_range)
    policy = -jnp.minimum(advantages * ratios, advantages * clipped).mean()
    value = ((_values(parameters, batch.observations) - batch.returns) ** 2).mean()
    entropy = (parameters["log_std"] + 0.5 + _HALF_LOG_2_PI).sum()
    return policy + config.vf_coef * value - config.ent_coef * entropy


def _collected(learning: Learning, contexts: Array, config: PPOConfig, n_envs: int) -> tuple[State, Array, Samples]:
    """A rollout of `n_steps` over all environments, and the mean reward in it."""
    parameters, length = learning.parameters, config.n_steps // n_envs
    acting, noisy, drawing = jax.random.split(learning.key, 3)
    noises = jax.random.normal(acting, (length, n_envs, _OUTPUTS))
    physics = jax.random.normal(noisy, (length, n_envs, INNER_STEPS, 2))

    def move(state: State, drawn: Any) -> tuple[State, Any]:
        observations, (noise, winds, key) = observe(state), drawn
        actions = _forward(parameters["actor"], observations) + jnp.exp(parameters["log_std"]) * noise
        after, rewards, crashed, truncated = step(state, actions, winds)
        ended = crashed | truncated
        fresh = _begun(key, contexts, n_envs)
        onward = State(*(jnp.where(ended.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                         for new, old in zip(fresh, after, strict=True)))  # fmt: skip
        return onward, (observations, actions, rewards, crashed, truncated, observe(after))

    state, (observations, actions, rewards, crashed, truncated, following) = lax.scan(
        move, learning.state, (noises, physics, jax.random.split(drawing, length))
    )
    values, behind = _values(parameters, observations), _values(parameters, following)
    ended = crashed | truncated

    def back(advantage: Array, at: Any) -> tuple[Array, Array]:
        reward, value, next_value, crash, end = at
        delta = reward + config.gamma * jnp.where(crash, 0.0, next_value) - value
        advantage = delta + config.gamma * config.gae_lambda * jnp.where(end, 0.0, advantage)
        return advantage, advantage

    _, advantages = lax.scan(back, jnp.zeros(n_envs), (rewards, values, behind, crashed, ended), reverse=True)
    log_probs = _log_probs(parameters, observations, actions)
    return state, rewards.mean(), Samples(observations, actions, log_probs, advantages, advantages + values)


def _iteration(
    learning: Learning, contexts: Array, config: PPOConfig, n_envs: int, optimiser: Any
) -> tuple[Learning, Array]:
    key, shuffling = jax.random.split(learning.key)
    state, reward, samples = _collected(learning._replace(key=key), contexts, config, n_envs)
    flat = Samples(*(array.reshape(config.n_steps, *array.shape[2:]) for array in samples))

    def minibatch(carried: Any, places: Array) -> tuple[Any, None]:
        parameters, moments = carried
        gradients = jax.grad(_loss)(parameters, Samples(*(array[places] for array in flat)), config)
        changes, moments = optimiser.update(gradients, moments)
        return (optax.apply_updates(parameters, changes), moments), None

    orders = jax.vmap(lambda one: jax.random.permutation(one, config.n_steps))(
        jax.random.split(shuffling, config.n_epochs)
    )
    (parameters, moments), _ = lax.scan(
        minibatch, (learning.parameters, learning.optimiser), orders.reshape(-1, config.batch_size)
    )
    return Learning(parameters, moments, state, jax.random.fold_in(key, 1)), reward


def prepare(
    config: PPOConfig, contexts: NDArray[np.float64], *, members: int, n_envs: int
) -> tuple[Callable[[Any], Any], Learning]:
    """A compiled iteration of so many members, (learning) -> (learning, mean rewards), and where they begin.

    n_envs: environments of each member, stepped together.
    """
    optimiser = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm or np.inf), optax.adam(config.learning_rate, eps=1e-5)
    )
    drawn = jnp.asarray(contexts, jnp.float32)

    def begin(key: Array) -> Learning:
        networks, episodes, later = jax.random.split(key, 3)
        parameters = _initial(networks, config)
        return Learning(parameters, optimiser.init(parameters), _begun(episodes, drawn, n_envs), later)

    one: Any = functools.partial(_iteration, contexts=drawn, config=config, n_envs=n_envs, optimiser=optimiser)
    keys = jax.random.split(jax.random.key(0), members)
    start = jax.jit(jax.vmap(begin) if members > 1 else lambda keys: begin(keys[0]))(keys)
    iterate = jax.jit(jax.vmap(one) if members > 1 else one, donate_argnums=0)
    return iterate.lower(start).compile(), start
