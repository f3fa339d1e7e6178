"""Why does an agent not arrive? A greedy episode of it, period by period, and what its plan knows where it stays.

    python scripts/checks/periods.py RUN [--checkpoint last] [--seed N] [--episodes 8] [--commands 5]

Of the first test episodes the first that fails is told, else the first one. There is a line for each period of the
Commander: the env step, the place and its region, the command (a region, or the goal), the region at the end, and the
subgoals. Then, of the region in which most periods began, the best commands by the plan for this goal, each with

    value   of the plan of greedy episodes
    number  decisions of late, fading
    led     the regions in which these ended: decisions, and the value of each region
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from envs.common.errors import UserError
from envs.vector import VectorEnv
from star.abstraction import regions
from star.agent import acting, hierarchy, levels, play, values
from star.agent.state import TrainState
from star.training import program as programs
from star.training.program import Program

LED = 4  # regions in which a command ended, at most


class Told(NamedTuple):
    """One episode: positions [T, d], corners of the commanded boxes, subgoals [T, m], whether it succeeds, its goal."""

    position: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    subgoal: np.ndarray
    success: bool
    goal: np.ndarray


def played(program: Program, state: TrainState, key: jax.Array, episodes: int) -> Told:
    """The first of the test episodes that fails, or the first."""
    spec, config = program.experiment.tested_spec, program.hyper
    env = VectorEnv(program.experiment.test_env, episodes, auto_reset=False)

    def seen(before: Any, subgoal: jax.Array, box: Any, _: jax.Array) -> tuple[jax.Array, ...]:
        return spec.abstract(before.obs), box.lower, box.upper, subgoal

    streams, moments = jax.jit(lambda state, key: play.greedy(config, spec, env, state, record=seen, key=key))(
        state, key
    )
    success = np.asarray(streams.episode.success_any) > 0
    one = int(np.argmin(success))
    goal = np.asarray(spec.goal_point(streams.env.obs))[one]
    return Told(*(np.asarray(leaf)[:, one] for leaf in moments), bool(success[one]), goal)


class Plan:
    """The regions of an agent, and the plan of its greedy episodes."""

    def __init__(self, program: Program, state: TrainState) -> None:
        agent = levels.of(program.hyper, program.experiment.tested_spec, greedy=True)
        state, roadmap = jax.jit(lambda state: hierarchy.prepare(agent, state))(state)
        self.abstraction = state.abstraction
        self.count = int(state.abstraction.count)
        self.q, self.allowed = jax.device_get((state.commander.q, roadmap.allowed))
        self.values = np.asarray(values.best(state.commander.q, roadmap.allowed))
        self.led = None if state.commander.model is None else np.asarray(state.commander.model.led)

    def region(self, point: np.ndarray) -> int:
        """The index of the region that holds a point [d]."""
        return int(regions.locate(self.abstraction, point[None])[0])

    def commanded(self, lower: np.ndarray, upper: np.ndarray) -> str:
        """The region with these corners, else `goal`."""
        corners = np.concatenate([np.asarray(self.abstraction.lower), np.asarray(self.abstraction.upper)], axis=1)
        apart = np.abs(corners[: self.count] - np.concatenate([lower, upper])).max(axis=1)
        return str(int(np.argmin(apart))) if apart.min() < 1e-3 else "goal"

    def box(self, region: int) -> str:
        """Its corners in words."""
        lower, upper = (np.asarray(corner[region]) for corner in (self.abstraction.lower, self.abstraction.upper))
        return f"{_point(lower)} to {_point(upper)}"


def _point(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.1f}" for x in point) + ")"


def periods(told: Told, plan: Plan, *, period: int, every: int) -> tuple[list[str], Counter[int]]:
    """A line for each period, and how many began in each region."""
    lines, began = [], Counter[int]()
    for t in range(0, len(told.position), period):
        here, there = (plan.region(told.position[min(i, len(told.position) - 1)]) for i in (t, t + period))
        command = plan.commanded(told.lower[t], told.upper[t])
        subgoals = " ".join(_point(one) for one in told.subgoal[t : t + period : every])
        lines.append(f"{t:5} {_point(told.position[t])} in {here} -> {command}, ends in {there}; subgoals {subgoals}")
        began[here] += 1
    return lines, began


def commands(plan: Plan, region: int, goal_region: int, number: int) -> list[str]:
    """A line for each of the best commands of a region, for a goal in `goal_region`."""
    near = plan.allowed.near.region[region]
    (possible,) = values.targets(plan.allowed.near, plan.allowed.greedy, np.array([region]), np.array([goal_region]))
    worth = np.where(possible, plan.q[region, goal_region], -np.inf)
    lines = []
    for place in np.argsort(-worth)[: min(number, plan.count)]:
        target = near[place]
        line = f"  {target} {plan.box(target)}: value {worth[place]:.3f}"
        if plan.led is not None:
            led = plan.led[int(target == goal_region), region, place]
            ends = [
                f"{near[j]}: {led[j]:.1f}, {plan.values[near[j], goal_region]:.3f}"
                for j in np.argsort(-led)[:LED]
                if led[j] > 0
            ]
            line += f", number {led.sum():.1f}, led ({'; '.join(ends)})"
        lines.append(line)
    return lines


def main(arguments: list[str] | None = None) -> None:
    """Tell it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--checkpoint", default="last", metavar="last|best|STEPS")
    parser.add_argument("--seed", type=int, help="which agent of the run (default: its first seed)")
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--commands", type=int, default=5)
    options = parser.parse_args(arguments)
    try:
        program, number, state, env_steps = acting.read(options.run, checkpoint=options.checkpoint, seed=options.seed)
        if not program.config.commander.enabled:
            raise UserError(f"{options.run}: has no Commander, so there are no periods")
    except UserError as error:
        parser.exit(2, f"error: {error}\n")
    key = program.evaluation_keys(0, stream=programs.AFTERWARDS)[number]
    told, plan = played(program, state, key, options.episodes), Plan(program, state)
    goal_region = plan.region(told.goal)
    end = "arrives" if told.success else "does not arrive"
    print(f"seed {program.seeds[number]}, {env_steps:,} env steps, {plan.count} regions; the agent {end}")
    print(f"goal {_point(told.goal)} in {goal_region}, {plan.box(goal_region)}")
    section = program.hyper
    lines, began = periods(told, plan, period=section.commander.period, every=section.tutor.period)
    print(*lines, sep="\n")
    ((region, times),) = began.most_common(1)
    print(f"region {region}, {plan.box(region)}: {times} periods began here; best commands")
    print(*commands(plan, region, goal_region, options.commands), sep="\n")


if __name__ == "__main__":
    main()
