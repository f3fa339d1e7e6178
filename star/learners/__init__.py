"""Learning of a level from its own transitions: PPO, TD3, or a learner of a user's own.

    name                     `learner` in the settings of a level
    ppo, td3, crl, chronosrl files in this folder, imported when they are first needed
    module:name              a `Learner` in a file of the user's own; its settings stand under `own`

The levels know learners by the functions below alone.
"""

from __future__ import annotations

import importlib
from functools import partial
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from envs.common import plugins
from star.learners import own
from star.learners.protocol import WHOLE, Learner, LearnerConfig, Rollout
from star.learners.sections import LevelConfig

if TYPE_CHECKING:
    from star.learners.replay import Imitation, Penalty, Relabel, Transition

__all__ = ["WHOLE", "Learner", "LearnerConfig", "Rollout", "act", "find", "init", "update"]


def find(name: str) -> Learner:
    """The learner of this name."""
    if plugins.is_plugin(name):
        return own.find(name)
    return importlib.import_module(f"star.learners.{name}").LEARNER


def init(key: Array, section: LevelConfig, *, example: Transition) -> Any:
    """The state of the section's learner before it has learnt, for transitions shaped like `example`."""
    return find(section.learner).init(key, section.settings, example=example)


def act(
    section: LevelConfig,
    state: Any,
    obs: Float[Array, "*batch obs"],
    *,
    explore: bool | Bool[Array, "*batch"],
    key: Array,
) -> Float[Array, "*batch act"]:
    """Actions, with noise to `explore`; meaningful in [-1, 1], and to be clipped to it by whoever executes them."""
    choose = partial(find(section.learner).act, section.settings, state, obs, key=key)
    if isinstance(explore, bool):
        return choose(deterministic=not explore)
    return jnp.where(explore[..., None], choose(deterministic=False), choose(deterministic=True))


def update(
    section: LevelConfig,
    state: Any,
    rollout: Transition,
    *,
    relabel: Relabel | None = None,
    penalty: Penalty | None = None,
    imitation: Imitation | None = None,
    key: Array,
) -> tuple[Any, dict[str, Array]]:
    """Learn from a rollout [T, B]; `relabel` is for learners that replay old transitions."""
    replaying = {"relabel": relabel} if section.settings.replays else {}
    learner = find(section.learner)
    return learner.update(section.settings, state, rollout, penalty=penalty, imitation=imitation, key=key, **replaying)
