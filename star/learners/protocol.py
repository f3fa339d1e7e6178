"""The protocol of a learner: settings, and a few pure functions. Light: importing it imports no learner."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax

from star.config.section import Section

WHOLE = -1  # in the place of an axis: not cut


class Rollout(NamedTuple):
    """The size of what a learner is given at once: decisions of each environment, environments, and devices."""

    decisions: int
    num_envs: int
    devices: int = 1

    @property
    def size(self) -> int:
        """Transitions in it."""
        return self.decisions * self.num_envs


class LearnerConfig(Section):
    """Settings of a learner, and what must be known of it before it is imported."""

    replays: ClassVar[bool] = False
    """True if old transitions are learnt from again; `update` then takes `relabel`."""

    futures: ClassVar[bool] = False
    """True if goals are drawn from the future. Then `extras` are a `Track`, and observations end in the goal."""

    @property
    def chunk(self) -> int:
        """The number of env steps for which a Controller decides at once: `act` gives the actions of all of them."""
        return 1

    def check(self, rollout: Rollout) -> None:
        """Raise ValueError in one line, beginning with the setting, if such rollouts cannot be learnt from."""

    def scratch_bytes(self, rollout: Rollout) -> int:
        """Memory that an update takes besides state and rollout, at least."""
        return 0

    def samples_per_transition(self, rollout: Rollout) -> float | None:
        """Average number of times that a transition is learnt from; None: a run does not say it."""
        return None


def whole(state: Any) -> Any:
    """`state` with `WHOLE` in the place of every leaf: each device holds all of it."""
    return jax.tree.map(lambda _: WHOLE, state)


class Learner(NamedTuple):
    """A learner: PPO, TD3, or one of a user's own.

    All functions are pure, and are jitted and vmapped by whoever calls them. `config` is an instance of `Config`; its
    floats may be traced. [T, B] are the axes of a rollout of `star.learners.replay.Transition`.
    """

    Config: type[LearnerConfig]
    """The type of its settings."""
    init: Callable[..., Any]
    """(key, config, *, example) -> state, for transitions shaped like `example`, without leading axes."""
    act: Callable[..., Any]
    """(config, state, obs [..., obs], *, deterministic, key) -> actions [..., chunk * act], meaningful in [-1, 1].

    They are those of the next `config.chunk` env steps, one after another: for most learners of one.
    """
    update: Callable[..., tuple[Any, dict[str, jax.Array]]]
    """(config, state, rollout, *, penalty, imitation, key) -> state, metrics.

    `penalty(batch, actions)` [N] is what the actor's `actions` cost in a batch of transitions, or None. `imitation` is
    a `star.learners.replay.Imitation` whose loss is added to that of the actor, or None. One that `replays` also takes
    `relabel(batch, key)`, which rewrites each batch that it replays, or None.
    """
    shards: Callable[[Any], Any] = whole
    """state -> for each of its leaves the axis that is cut among devices, or `WHOLE`."""
