"""No Commander: the goal is commanded all the time, as in HIRO. Nothing is learnt of regions."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from envs.common.batching import where
from star.abstraction import regions
from star.agent.commander import begin, init, tick
from star.agent.decisions import Finished, Memory, Roadmap, Scene, target_box
from star.agent.sections import CommanderConfig
from star.agent.segments import Segment
from star.agent.task import Task

__all__ = ["begin", "command", "experience", "init", "observe", "renewed", "set_out", "settle", "standing", "tick"]


def command(
    section: CommanderConfig,
    task: Task,
    state: Any,
    roadmap: Roadmap,
    memory: Memory,
    scene: Scene,
    *_: Any,
    **__: Any,
) -> Memory:
    """The box around the goal where the clock is 0; dimensions that the goal leaves open have its region's bounds."""
    region = regions.locate(roadmap.abstraction, scene.goal)
    everywhere = jnp.ones(len(region), bool)
    box = target_box(task, roadmap.abstraction, region, around=everywhere, point=scene.goal)
    return where(memory.clock == 0, memory.replace(goal_region=region, target=region, box=box), memory)


def set_out(section: CommanderConfig, memory: Memory, **_: Any) -> Memory:
    """Nothing is remembered of the way."""
    return memory


def experience(
    section: CommanderConfig, task: Task, roadmap: Roadmap, memory: Memory, segment: Segment, *_: Any
) -> tuple[Memory, Finished]:
    """Periods pass, and nothing is told of them."""
    return tick(section, memory, steps=len(segment.alive)), Finished(None, None)


def renewed(memory: Memory) -> Bool[Array, "B"]:
    """Nowhere does another target follow before the episode ends."""
    return jnp.zeros(len(memory.clock), bool)


def observe(section: CommanderConfig, state: Any, *_: Any, **__: Any) -> Any:
    """Nothing is learnt."""
    return state


def standing(*_: Any) -> bool:
    """Nobody explores in greedy episodes, as in those of HIRO, HRAC and flat agents."""
    return False


def settle(section: CommanderConfig, state: Any, *_: Any, **__: Any) -> Any:
    """Greedy episodes are commanded alike."""
    return state
