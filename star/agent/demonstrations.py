"""Demonstrations of a trained agent: its greedy episodes on training goals that reach the goal, until they do."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from rich.console import Console

from envs.vector import VectorEnv
from star.agent import environment
from star.agent.play import greedy
from star.agent.sections import Config
from star.config import agents
from star.config.section import ConfigError
from star.sgim import teachers
from star.sgim.teachers import Demonstrations
from star.spec import Spec
from star.training.checkpoint import load_agent


class Moments(struct.PyTreeNode):
    """E environments at T moments, one env step apart, or at one moment: leading axes [T, E] or [E].

    `action` is what was done then.
    """

    obs: Any
    success: Any
    action: Any = None


def record(
    config: Config,
    run_dir: Path,
    out: Path,
    *,
    episodes: int,
    checkpoint: str = "last",
    agent: int | None = None,
    seed: int = 0,
    force: bool = False,
    quiet: bool = False,
) -> str:
    """Write the demonstrations of a checkpoint of `run_dir` to `out`; returns a line that says what was written.

    It is the agent of seed `agent` (None: the first); `seed` chooses starts and goals.

    Raises:
      UserError: in one line, for whatever cannot be had; nothing is written then.
    """
    teachers.check_place(out, force=force)
    with contextlib.nullcontext() if quiet else Console(stderr=True).status("recording"):
        moments, spec = play(config, run_dir, checkpoint=checkpoint, agent=agent, episodes=episodes, seed=seed)
    demos = demonstrations(moments, spec, period=config.commander.period)
    if demos is None:
        raise ConfigError(
            f"{agents.told(run_dir)}: none of {episodes} episodes reaches its goal, there is nothing to show"
        )
    teachers.save(out, demos, env=config.env.name, force=force)
    steps = f"{np.median(np.asarray(demos.lengths)):g} env steps (median)"
    return f"{out}: {len(demos.starts)} of {episodes} episodes reach their goal, in {steps}"


def play(
    config: Config, run_dir: Path, *, checkpoint: str, agent: int | None, episodes: int, seed: int
) -> tuple[Moments, Spec]:
    """Greedy episodes on training goals, as NumPy arrays [T + 1, E, ...]; at the last moment nothing is done."""
    program, state, key = load_agent(config, run_dir, checkpoint=checkpoint, agent=agent, seed=seed)
    vector = VectorEnv(environment.make(program.config, "train"), episodes, auto_reset=False)
    spec = program.experiment.spec

    def look(env_state: Any) -> Moments:
        return Moments(obs=env_state.obs, success=env_state.metrics["success"])

    def run(agent: Any, state: Any, key: jax.Array) -> Moments:
        streams, moments = greedy(
            agent,
            spec,
            vector,
            state,
            record=lambda env_state, subgoal, box, action: look(env_state).replace(action=action),
            key=key,
        )
        end = look(streams.env).replace(action=jnp.zeros_like(moments.action[-1]))
        return jax.tree.map(lambda many, one: jnp.concatenate([many, one[None]]), moments, end)

    return jax.device_get(jax.jit(run)(program.config.hyper(), state, key)), spec


def demonstrations(moments: Moments, spec: Spec, *, period: int) -> Demonstrations | None:
    """The episodes in `moments` [T + 1, E] that reach their goal, up to the step that does; None if there are none.

    Waypoints are where the agent was every `period` env steps. Episodes that begin at their goal show nothing.
    """
    first = np.argmax(moments.success > 0, axis=0)
    kept = np.flatnonzero(first > 0)
    if not len(kept):
        return None
    lengths, longest = first[kept], first.max()
    obs, actions = (np.swapaxes(leaf[: longest + 1, kept], 0, 1) for leaf in (moments.obs, moments.action))
    times = np.arange(longest + 1)

    def at(times: Any) -> Any:
        return obs[np.arange(len(kept))[:, None], np.minimum(times, lengths[:, None])]

    acts = (times < lengths[:, None])[..., None]
    done: Any = np.where(acts, np.clip(actions, -1.0, 1.0), 0.0)
    return Demonstrations(
        starts=spec.abstract(obs[:, 0]),
        outcomes=spec.abstract(at(longest)[:, 0]),
        waypoints=spec.abstract(at(np.arange(period, longest + period, period))),
        states=spec.state(at(times)),
        actions=done,
        lengths=lengths,
    )
