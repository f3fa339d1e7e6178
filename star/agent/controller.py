"""The Controller: moves the body towards the subgoal at every env step, wherever it stands.

    sees      the state without the abstract position, and the relative subgoal g_t; with `frame` body both turned about
              z with the body, so that what was learnt in one direction holds in all
    g_{t+1} = s_t + g_t - s_{t+1}                           the subgoal stays where it is while the agent moves
    reward  = -||s_t + g_t - s_{t+1}||  (`distance`, published)   or   ||g_t|| - ||g_{t+1}||  (`progress`)
              less a penalty for the tilt of the body, and one where the task is terminated

Without a Tutor the subgoal is the target box itself, its lower and upper corner relative to s, [2d] numbers, and
||.|| is the distance to the box, as in GARA (Zadem, Mover and Nguyen 2023).

Source: STAR (ICLR 2024), section 4.1, after HIRO (Nachum et al. 2018), section 3.2.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from star.agent.sections import ControllerConfig
from star.spec import Spec


def observe(
    config: ControllerConfig, spec: Spec, state: Float[Array, "*batch state"], subgoal: Float[Array, "*batch m"]
) -> Float[Array, "*batch seen"]:
    """The state without its abstract coordinates, followed by the relative subgoal, both in the axes of `frame`.

    A box turned with the body is no box: it is given by its nearest point and its centre instead of its corners. What
    a full state holds of blocks stays in the world's axes.
    """
    if config.frame == "body":
        if subgoal.shape[-1] != len(spec.scale):
            centre = sum(jnp.split(subgoal, 2, axis=-1)) / 2
            subgoal = jnp.concatenate([nearest(subgoal, size=len(spec.scale)), centre], axis=-1)
        state, subgoal = spec.turned(state, subgoal)
    kept = np.setdiff1d(np.arange(state.shape[-1]), np.asarray(spec.abstract_indices, int))
    return jnp.concatenate([state[..., kept], subgoal], axis=-1)


def next_subgoal(
    subgoal: Float[Array, "*batch m"], achieved: Float[Array, "*batch d"], next_achieved: Float[Array, "*batch d"]
) -> Float[Array, "*batch m"]:
    """The same subgoal seen from where the agent is now: h(s, g, s') = s + g - s'."""
    moved = jnp.tile(next_achieved - achieved, subgoal.shape[-1] // achieved.shape[-1])
    return subgoal - moved


def nearest(subgoal: Float[Array, "*batch m"], *, size: int) -> Float[Array, "*batch size"]:
    """A subgoal of `size` = d coordinates, or the nearest point of a box given by two corners."""
    if subgoal.shape[-1] == size:
        return subgoal
    lower, upper = jnp.split(subgoal, 2, axis=-1)
    return jnp.maximum(lower, 0.0) + jnp.minimum(upper, 0.0)


def distance(subgoal: Float[Array, "*batch m"], *, size: int) -> Float[Array, "*batch"]:
    """Distance to a subgoal of `size` = d coordinates, or to a box given by two corners."""
    return jnp.linalg.norm(nearest(subgoal, size=size), axis=-1)


def reward(
    config: ControllerConfig, subgoal: Float[Array, "*batch m"], next_subgoal: Float[Array, "*batch m"], *, size: int
) -> Float[Array, "*batch"]:
    """Reward of one env step from the relative subgoals before and after it, of `size` = d coordinates or boxes."""
    before, after = distance(subgoal, size=size), distance(next_subgoal, size=size)
    return config.reward_scale * (-after if config.reward == "distance" else before - after)


def price(
    config: ControllerConfig,
    spec: Spec,
    next_obs: Float[Array, "*batch obs"],
    terminated: Float[Array, "*batch"],
    *,
    env_steps: Float[Array, ""] | float,
) -> Float[Array, "*batch"]:
    """What is taken off the reward of an env step that led to `next_obs`, whatever the subgoal is.

    The share of `tilt_penalty` rises exponentially over the first `tilt_steps` of `env_steps`, those of all
    environments together.
    """
    lost = config.termination_penalty * terminated
    if not spec.orientation:
        return lost
    share = config.tilt_start ** jnp.maximum(1.0 - env_steps / config.tilt_steps, 0.0)
    return lost + share * config.tilt_penalty * spec.tilt(next_obs)
