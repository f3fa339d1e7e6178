"""The one interface through which Tutor and Controller use PPO or TD3.

A learner is a module with three functions:

    init(key, config, *, example)                         -> state
    act(config, state, obs, *, deterministic, key)        -> action
    update(config, state, rollout, *, key)                -> state, metrics

`update` sees a rollout [T, B] of `star.learners.replay.Transition`. An off-policy learner also takes `relabel`,
applied to every batch it replays. Every learner takes `penalty`, which prices the actor's action in a transition, and
`imitation`, actions of somebody else to come near to.
"""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float

from star.learners import ppo, td3
from star.learners.replay import Imitation, Penalty, Transition
from star.learners.sections import LevelConfig

State = ppo.PPOState | td3.TD3State
Metrics = dict[str, Array]


def init(key: Array, config: LevelConfig, *, example: Transition) -> State:
    """The learner that `config.learner` names, for transitions shaped like `example` (no leading axes)."""
    if config.learner == "ppo":
        return ppo.init(key, config.ppo, example=example)
    return td3.init(key, config.td3, example=example)


def act(
    config: LevelConfig, state: Any, obs: Float[Array, "*batch obs"], *, deterministic: bool = False, key: Array
) -> Float[Array, "*batch act"]:
    """Actions of the level; meaningful in [-1, 1], and to be clipped to it by whoever executes them."""
    if config.learner == "ppo":
        return ppo.act(config.ppo, state, obs, deterministic=deterministic, key=key)
    return td3.act(config.td3, state, obs, deterministic=deterministic, key=key)


def update(
    config: LevelConfig,
    state: Any,
    rollout: Transition,
    *,
    relabel: td3.Relabel | None = None,
    penalty: Penalty | None = None,
    imitation: Imitation | None = None,
    key: Array,
) -> tuple[Any, Metrics]:
    """Learn from a rollout [T, B]; `relabel` is used by learners that replay old transitions."""
    if config.learner == "ppo":
        return ppo.update(config.ppo, state, rollout, penalty=penalty, imitation=imitation, key=key)
    return td3.update(config.td3, state, rollout, relabel=relabel, penalty=penalty, imitation=imitation, key=key)
