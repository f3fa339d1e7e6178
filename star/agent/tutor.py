"""The Tutor: chooses, every l env steps, a subgoal on the way to the target region. It never sees g*.

    subgoal  g  = clip(action, -1, 1) * scale           relative to s: to its abstract dimensions, and with a heading
                                                    to the vector ahead of the body
    reward      = -sum over its l steps ||s_t - centre(G)||      (`distance`, published)
             or   ||s_0 - centre(G)|| - ||s_l - centre(G)||      (`progress`)

Source: STAR (ICLR 2024), section 4.1; off-policy correction: HIRO (Nachum et al. 2018), section 3.3.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from star.agent.sections import TutorConfig
from star.learners.replay import Transition


class Box(struct.PyTreeNode):
    """Target boxes in the abstract dimensions, lower and upper corners [..., d]."""

    lower: Float[Array, "*batch d"]
    upper: Float[Array, "*batch d"]

    @classmethod
    def around(cls, point: Float[Array, "*batch d"], margin: float | Array) -> Box:
        """The box of half-width `margin` with `point` at its centre."""
        return cls(lower=point - margin, upper=point + margin)

    @property
    def centre(self) -> Float[Array, "*batch d"]:
        """The point that the Tutor is rewarded for approaching."""
        return (self.lower + self.upper) / 2

    @property
    def corners(self) -> Float[Array, "*batch m"]:
        """Both corners as one vector, as the Controller sees them where there is no Tutor."""
        return jnp.concatenate([self.lower, self.upper], axis=-1)

    def seen_from(self, origin: Float[Array, "*batch d"]) -> Box:
        """The box relative to `origin`."""
        return Box(lower=self.lower - origin, upper=self.upper - origin)


class Trace(struct.PyTreeNode):
    """What the Controller saw and did during one decision of the Tutor, for its off-policy correction."""

    states: Float[Array, "*batch l state"]
    actions: Float[Array, "*batch l act"]
    achieved: Float[Array, "*batch l+1 p"]


def observe(
    config: TutorConfig, state: Float[Array, "*batch state"], abstract: Float[Array, "*batch d"], box: Box
) -> Float[Array, "*batch state+2*d"]:
    """The state with the bounds of the target box, relative to `abstract`, its abstract part, or as they are."""
    origin = abstract if config.relative_bounds else jnp.zeros_like(abstract)
    return jnp.concatenate([state, box.seen_from(origin).corners], axis=-1)


def subgoal(action: Float[Array, "*batch p"], scale: Float[Array, "p"]) -> Float[Array, "*batch p"]:
    """The relative subgoal that an action in [-1, 1]^p stands for."""
    return jnp.clip(action, -1.0, 1.0) * scale


def reward(config: TutorConfig, distances: Float[Array, "states *batch"], alive: Float[Array, "l *batch"]) -> Array:
    """Reward of one decision from the distances to the box's centre before and after each of its env steps.

    `alive` [l, ...] is 0 for steps after the environment had ended; they count for nothing.
    """
    if config.reward == "distance":
        return -config.reward_scale * jnp.sum(distances[1:] * alive, axis=0)
    return config.reward_scale * jnp.sum((distances[:-1] - distances[1:]) * alive, axis=0)


def correct(
    config: TutorConfig,
    batch: Transition,
    scale: Float[Array, "p"],
    mean_action: Callable[[Array, Array], Array],
    *,
    key: Array,
) -> Transition:
    """Replace replayed subgoals by those that make the stored Controller actions most likely today (HIRO).

    Candidates per transition: the stored subgoal, the displacement that happened, and draws from
    N(displacement, (scale / 2)^2), clipped to +-scale. `batch.extras` is a `Trace` [N, l, ...];
    `mean_action(states, subgoals)` is the Controller's policy.
    """
    trace: Trace = batch.extras
    moved = (trace.achieved[:, -1] - trace.achieved[:, 0]) / scale
    shape = (config.correction_candidates, *moved.shape)
    drawn = moved + 0.5 * jax.random.normal(key, shape)
    candidates = jnp.clip(jnp.concatenate([batch.action[None], moved[None], drawn]), -1.0, 1.0)

    def log_likelihood(action: Array) -> Float[Array, "N"]:
        path = trace.achieved[:, :1] - trace.achieved[:, :-1]
        goals = action[:, None] * scale + path
        return -0.5 * jnp.sum(jnp.square(trace.actions - mean_action(trace.states, goals)), axis=(-2, -1))

    best = jnp.argmax(jax.vmap(log_likelihood)(candidates), axis=0)
    return batch.replace(action=jnp.take_along_axis(candidates, best[None, :, None], axis=0)[0])
