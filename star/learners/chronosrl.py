"""ChronoSRL (arXiv 2609.36238): a critic of when a goal is reached, and of how long the agent is there.

    tau        = env steps until the agent is within `radius` of the goal, 0..H, or never
    P(tau = k) = h_k prod_{j<k} (1 - h_j)                         # hazards h: survival analysis
    cost       = sum_{t<H} gamma^t P(tau > t)                     # time to the goal
    stay       = sum_{0<d<=H} gamma^d o_d                         # o_d: at the goal d env steps later
    time       = E[huber(||phi(s, a) - psi(g)|| + tau log gamma)] # of goals that are reached
    separation = E_ij[max(0, -H log gamma - ||phi_i - psi_j||)]   # of others, and of those never reached
    critic     = -E[log P(tau)] + E[cross entropy of o] + time + separation
    actor      = E[cost - beta stay + alpha log pi]               # beta: share of episodes to be terminated

An action is a chunk of those of `action_chunk` env steps. Goals are later places of the same episode, the agent's own
place, or that of any other step. No reward is needed; the last numbers of an observation are the goal.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from star import devices
from star.learners import futures, replay, squashed
from star.learners.futures import Future, ReplayState, ahead
from star.learners.networks import ResidualMLP, apply, distance, uniform_dense
from star.learners.protocol import Learner
from star.learners.replay import Imitation, Transition, weighted_mean
from star.learners.sections import ChronoSRLConfig

Metrics = dict[str, Array]

LATER, OWN = 0.85, 0.05  # shares of goals that are later places, and the agent's own; the rest are places of others
CIRCLES = 0.5 ** np.arange(3)  # times the radius: the share of these in which an agent is says how far it is there
BINS = 32  # at most, of occupancy
BASIS = 64  # functions of time of which logits of hazards are weighted sums
FILM = 0.1  # scale of what a goal does to the representation of an action (FiLM, Perez et al. 2018)


class Step(futures.Step):
    """An env step in the buffer, and 1 where the task was terminated with it."""

    terminated: Float[Array, "*batch"]


class Batch(struct.PyTreeNode):
    """Chunks of actions (`acts` numbers), their goals, and what came of them; observations show the goals.

    `arrival` is tau, or H + 1 where the goal is not reached. `occupancy` is the share of the `seen` steps of each bin
    that were at the goal. `ends` is 1 where the task is terminated later in the episode.
    """

    obs: Float[Array, "N obs"]
    action: Float[Array, "N acts"]
    goal: Float[Array, "N k"]
    arrival: Int[Array, "N"]
    occupancy: Float[Array, "N bins"]
    seen: Float[Array, "N bins"]
    ends: Float[Array, "N"]
    weight: Float[Array, "N"]


class Prediction(NamedTuple):
    """The critic's: representations of actions and goals, and logits of hazards (T = H + 1) and occupancy."""

    action: Float[Array, "N n"]
    goal: Float[Array, "N n"]
    hazard: Float[Array, "N T"]
    occupancy: Float[Array, "N bins"]


class Critic(nn.Module):
    """Two encoders, and a head for both: sizes are settings of `ChronoSRLConfig`."""

    width: int
    blocks: int
    representation: int
    horizon: int

    @nn.compact
    def __call__(
        self, state: Float[Array, "*N state"], action: Float[Array, "*N acts"], goal: Float[Array, "*N k"]
    ) -> Prediction:
        """The prediction for chunks of actions in states, and goals."""
        mlp, size = partial(ResidualMLP, self.width, self.blocks), self.representation
        phi = mlp(size, name="action")(jnp.concatenate([state, action], axis=-1))
        psi = mlp(size, name="goal")(goal)
        scale, shift = jnp.split(uniform_dense(2 * size, name="film")(psi), 2, axis=-1)
        modulated = (1 + FILM * scale) * phi + FILM * shift
        together = jnp.concatenate([modulated, psi, modulated - psi, modulated * psi], axis=-1)
        head = mlp(1 + BASIS + bins(self.horizon)[-1] + 1, name="head")(together)
        now, weights, occupancy = jnp.split(head, (1, 1 + BASIS), axis=-1)
        basis = self.param("basis", nn.initializers.normal(0.02), (BASIS, self.horizon))
        bias = self.param("bias", nn.initializers.zeros, (self.horizon,))
        return Prediction(phi, psi, jnp.concatenate([now, weights @ basis + bias], axis=-1), occupancy)


def bins(horizon: int) -> Int[np.ndarray, "H"]:
    """The bin of occupancy for each number of env steps from 1 to `horizon`: bins grow geometrically."""
    starts = np.unique(np.round(horizon ** (np.arange(BINS) / BINS)))
    return np.searchsorted(starts, np.arange(1, horizon + 1), side="right") - 1


def log_later(hazard: Float[Array, "*N T"]) -> Float[Array, "*N T"]:
    """Logarithms of P(tau > t) for t = 0..H, from the logits of hazards."""
    return jnp.cumsum(jax.nn.log_sigmoid(-hazard), axis=-1)


def nll(hazard: Float[Array, "*N T"], arrival: Int[Array, "*N"]) -> Float[Array, "*N"]:
    """-log P(tau = `arrival`); for H + 1 that of tau > H."""
    certain = jnp.zeros((*arrival.shape, 1))
    before = jnp.concatenate([certain, log_later(hazard)], axis=-1)
    now = jnp.concatenate([jax.nn.log_sigmoid(hazard), certain], axis=-1)
    return -jnp.take_along_axis(before + now, arrival[..., None], axis=-1)[..., 0]


def cost(hazard: Float[Array, "*N T"], *, discount: Array | float) -> Float[Array, "*N"]:
    """Expected discounted env steps to the goal, at most H: sum of gamma^t P(tau > t) over t < H."""
    later = jnp.exp(log_later(hazard)[..., :-1])
    return jnp.sum(later * jnp.power(discount, jnp.arange(later.shape[-1])), axis=-1)


def stay(occupancy: Float[Array, "*N bins"], *, discount: Array | float, horizon: int) -> Float[Array, "*N"]:
    """Expected discounted env steps at the goal, from the logits of occupancy."""
    return jnp.sum(jax.nn.sigmoid(occupancy) * _binned(jnp.power(discount, jnp.arange(1, horizon + 1))), axis=-1)


def _binned(x: Float[Array, "*N H"]) -> Float[Array, "*N bins"]:
    """Sums over the steps of each bin."""
    number = bins(x.shape[-1])
    return jnp.matmul(x, jax.nn.one_hot(number, number[-1] + 1), precision=jax.lax.Precision.HIGHEST)


def labels(
    away: Float[Array, "N T"], left: Int[Array, "N"], ends: Float[Array, "N"], *, radius: Array | float
) -> tuple[Int[Array, "N"], Float[Array, "N bins"], Float[Array, "N bins"]]:
    """`arrival`, `occupancy` and `seen` of a batch, given how far `away` from the goal the agent is 0..H steps later.

    Steps beyond the `left` ones are not of the episode. After a termination the agent is nowhere, and that is seen.
    """
    steps = jnp.arange(away.shape[1])
    same = steps <= left[:, None]
    reached = same & (away <= radius)
    arrival = jnp.where(reached.any(axis=1), jnp.argmax(reached, axis=1), len(steps))
    inside = same * jnp.mean(away[..., None] <= radius * CIRCLES, axis=-1)
    known = (same | (ends[:, None] > 0)).astype(jnp.float32)
    count = _binned(known[:, 1:])
    return arrival, _binned(inside[:, 1:]) / jnp.maximum(count, 1), (count > 0).astype(jnp.float32)


def init(key: Array, config: ChronoSRLConfig, *, example: Transition) -> ReplayState:
    """A learner for transitions shaped like `example` (no leading axes), whose extras are a `Track`."""
    actor_key, critic_key = jax.random.split(key)
    goal, chunk = example.extras.place, jnp.tile(example.action, config.action_chunk)
    params = {
        "actor": _actor(config, 2 * len(chunk)).init(actor_key, example.obs),
        "critic": _critic(config).init(critic_key, example.obs[: -len(goal)], chunk, goal),
    }
    return ReplayState.create(params, _step(example), size=config.buffer_size)


def _actor(config: ChronoSRLConfig, out: int) -> ResidualMLP:
    return ResidualMLP(config.width, config.blocks, out)


def _critic(config: ChronoSRLConfig) -> Critic:
    return Critic(config.width, config.blocks, config.representation, config.horizon)


def _step(transition: Transition) -> Step:
    return Step.of(transition, terminated=transition.terminated)


def act(
    config: ChronoSRLConfig,
    state: ReplayState,
    obs: Float[Array, "*batch obs"],
    *,
    deterministic: bool = False,
    key: Array,
) -> Float[Array, "*batch acts"]:
    """Actions of the next `action_chunk` env steps, in [-1, 1]: drawn, or those in the middle of what would be."""
    return squashed.act(*_policy(config, state.params["actor"], obs), deterministic=deterministic, key=key)


def _policy(config: ChronoSRLConfig, params: Any, obs: Array) -> tuple[Array, Array]:
    """Mean and deviation of actions before tanh."""
    return squashed.moments(apply(_actor(config, params["params"]["out"]["bias"].shape[-1]), params, obs))


def _least(config: ChronoSRLConfig) -> int:
    """The number of steps of the same episode that follow the first one of a chunk, at least."""
    return max(1, config.action_chunk - 1)


def _drawn(config: ChronoSRLConfig, ring: replay.Ring, future: Future, key: Array) -> Batch:
    """A batch of chunks within one episode, and what came of them; without weight if there are none."""
    slot_key, goal_key = jax.random.split(key)
    items, _ = replay.contents(ring)
    slot = future.draw(slot_key, size=config.batch_size)
    left = future.left[slot]
    goal = _goals(config, items, future, slot, goal_key)
    ways = future.later(items.track.place, slot[:, None], jnp.arange(config.horizon + 1)) - goal[:, None]
    ends = future.later(items.terminated, slot, left)
    arrival, occupancy, seen = labels(jnp.linalg.norm(ways, axis=-1), left, ends, radius=config.radius)
    chunk = future.later(items.action, slot[:, None], jnp.arange(config.action_chunk))
    return Batch(
        obs=items.obs[slot].at[:, -goal.shape[-1] :].set(goal),
        action=chunk.reshape(len(slot), -1),
        goal=goal,
        arrival=arrival,
        occupancy=occupancy,
        seen=seen,
        ends=ends,
        weight=items.weight[slot] * (left >= _least(config)),
    )


def _goals(
    config: ChronoSRLConfig, items: Step, future: Future, slot: Int[Array, "N"], key: Array
) -> Float[Array, "N k"]:
    """Goals for the steps `slot`: later places, own places, and places of others."""
    kind_key, ahead_key, other_key = jax.random.split(key, 3)
    kind = jax.random.uniform(kind_key, slot.shape)
    steps = ahead(future.left[slot], jax.random.uniform(ahead_key, slot.shape), discount=config.goal_discount)
    own = future.later(items.track.place, slot, jnp.where(kind < LATER, steps, 0))
    other = items.track.place[future.draw(other_key, size=len(slot))]
    return jnp.where((kind < LATER + OWN)[:, None], own, other)


def _one_update(
    config: ChronoSRLConfig, imitation: Imitation | None, future: Future, state: ReplayState, key: Array
) -> tuple[ReplayState, Metrics]:
    """The critic, then by it the actor, then the temperature."""
    draw_key, noise_key = jax.random.split(key)
    batch = devices.whole(_drawn(config, state.ring, future, draw_key))
    rate, ready = config.learning_rate, replay.filled(state.ring) >= config.min_transitions
    slope, told = jax.grad(partial(_critic_loss, config), has_aux=True)(state.params["critic"], batch)
    state = state.stepped({"critic": slope}, rate=rate, ready=ready)
    slope, more = jax.grad(partial(_actor_loss, config, imitation), has_aux=True)(
        state.params["actor"], state.params["critic"], state.log_alpha, batch, noise_key
    )
    alpha_slope = squashed.temperature_gradient(state.log_alpha, more["entropy"], size=batch.action.shape[-1])
    metrics = told | more | {"alpha": jnp.exp(state.log_alpha)}
    state = state.stepped({"actor": slope, "alpha": alpha_slope}, rate=rate, ready=ready)
    return state.replace(updates=state.updates + ready.astype(jnp.int32)), metrics


def _predicted(config: ChronoSRLConfig, critic: Any, batch: Batch, action: Array) -> Prediction:
    found = _critic(config).apply(critic, batch.obs[:, : -batch.goal.shape[-1]], action, batch.goal)
    return Prediction(*found)


def _critic_loss(config: ChronoSRLConfig, critic: Any, batch: Batch) -> tuple[Array, Metrics]:
    found, never = _predicted(config, critic, batch, batch.action), batch.arrival > config.horizon
    step, pairs = -jnp.log(config.discount), distance(found.action[:, None], found.goal[None])
    error = jnp.diagonal(pairs) - step * batch.arrival
    hinge = jnp.maximum(config.horizon * step - pairs, 0)
    apart = jnp.where(jnp.eye(len(pairs)), never[:, None], distance(batch.goal[:, None], batch.goal) > config.radius)
    wrong = jax.nn.softplus(found.occupancy) - found.occupancy * batch.occupancy
    reached = batch.weight * (~never & (batch.arrival > 0))
    losses = {
        "arrival_loss": weighted_mean(nll(found.hazard, batch.arrival), batch.weight),
        "occupancy_loss": weighted_mean(wrong, batch.seen * batch.weight[:, None]),
        "time_loss": weighted_mean(jnp.where(abs(error) < 1, 0.5 * error**2, abs(error) - 0.5), reached),
        "separation_loss": weighted_mean(hinge, apart * batch.weight[:, None] * batch.weight),
    }
    loss = jnp.sum(jnp.stack(list(losses.values())))
    return loss, losses | {"critic_loss": loss, "reached": weighted_mean(1.0 - never, batch.weight)}


def _actor_loss(
    config: ChronoSRLConfig,
    imitation: Imitation | None,
    actor: Any,
    critic: Any,
    log_alpha: Array,
    batch: Batch,
    key: Array,
) -> tuple[Array, Metrics]:
    action, log_prob = squashed.draw(*_policy(config, actor, batch.obs), key=key)
    found = _predicted(config, critic, batch, action)
    late, ends = cost(found.hazard, discount=config.discount), weighted_mean(batch.ends, batch.weight)
    there = stay(found.occupancy, discount=config.discount, horizon=config.horizon)
    loss = weighted_mean(jnp.exp(log_alpha) * log_prob + late - ends * there, batch.weight)
    if imitation is not None:  # of the first action of a chunk
        mean = jnp.tanh(_policy(config, actor, imitation.obs)[0])
        loss += imitation.loss(mean[:, : imitation.action.shape[-1]])
    told = {"time_to_goal": weighted_mean(late, batch.weight), "ends": ends}
    return loss, told | {"actor_loss": loss, "entropy": -weighted_mean(log_prob, batch.weight)}


LEARNER = Learner(
    Config=ChronoSRLConfig, init=init, act=act, update=futures.updating(_one_update, step=_step, least=_least)
)
