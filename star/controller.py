"""The Controller: moves the body towards the subgoal at every env step, wherever it stands.

    sees      the state without the abstract position, and the relative subgoal g_t
    g_{t+1} = s_t + g_t - s_{t+1}                           the subgoal stays where it is while the agent moves
    reward  = -||s_t + g_t - s_{t+1}||  (`distance`, published)   or   ||g_t|| - ||g_{t+1}||  (`progress`)

Source: STAR (ICLR 2024), section 4.1, after HIRO (Nachum et al. 2018), section 3.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from star.config import ControllerConfig


def observe(
    state: Float[Array, "*batch state"], subgoal: Float[Array, "*batch d"], *, position: Sequence[int]
) -> Float[Array, "*batch state-p+d"]:
    """The state without its coordinates `position`, followed by the relative subgoal."""
    kept = np.setdiff1d(np.arange(state.shape[-1]), np.asarray(position, int))
    return jnp.concatenate([state[..., kept], subgoal], axis=-1)


def next_subgoal(
    subgoal: Float[Array, "*batch d"], achieved: Float[Array, "*batch d"], next_achieved: Float[Array, "*batch d"]
) -> Float[Array, "*batch d"]:
    """The same subgoal seen from where the agent is now: h(s, g, s') = s + g - s'."""
    return achieved + subgoal - next_achieved


def reward(
    config: ControllerConfig, subgoal: Float[Array, "*batch d"], next_subgoal: Float[Array, "*batch d"]
) -> Float[Array, "*batch"]:
    """Reward of one env step from the relative subgoals before and after it."""
    before, after = jnp.linalg.norm(subgoal, axis=-1), jnp.linalg.norm(next_subgoal, axis=-1)
    return config.reward_scale * (-after if config.reward == "distance" else before - after)
