"""Episodes: the clocks of the levels, and how the three of them act together in B environments.

    where the clock is 0:  the Commander chooses a target region
    every l env steps:     the Tutor chooses a subgoal
    every env step:        the Controller acts, and the subgoal moves with the agent

Clocks restart with every episode. Environments that end early wait until the segment of l env steps is over.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs._quiet import State as EnvState
from envs.common.batching import where
from envs.vector import VectorEnv
from star import learners
from star.abstraction import regions
from star.abstraction.regions import Abstraction
from star.agent import commander, controller, tutor
from star.agent.commander import CommanderState, Successors
from star.agent.sections import AgentConfig
from star.agent.state import TrainState
from star.agent.tutor import Box
from star.sgim import strategies
from star.sgim.strategies import Lesson
from star.spec import Spec

_ANY = 1_000_000  # a region to practise that is still to be drawn; larger than any index


class Streams(struct.PyTreeNode):
    """The B environments and where each stands in its Commander period."""

    env: EnvState
    clock: Int[Array, "B"]
    practice: Int[Array, "B"]
    """The region that an environment practises to reach; -1 where it pursues the goal of the task."""
    region: Int[Array, "B"]
    goal_region: Int[Array, "B"]
    target: Int[Array, "B"]
    box: Box
    start: Float[Array, "B d"]
    reward: Float[Array, "B"]
    waypoint: Bool[Array, "B"]
    """Whether the box is that around a waypoint, not the target region or the goal's."""
    episode: Episode
    lesson: Lesson | None = None
    past: Int[Array, "B N 2"] | None = None
    """In greedy episodes the last regions that were left and the targets then; -1 before."""


class Episode(struct.PyTreeNode):
    """Running statistics of each environment's episode."""

    success_any: Float[Array, "B"]
    success_final: Float[Array, "B"]
    distance: Float[Array, "B"]
    total: Float[Array, "B"]
    flipped: Float[Array, "B"]
    """1 where the body lies on its back, at the last step."""

    @classmethod
    def start(cls, num_envs: int) -> Episode:
        """Before the first step."""
        return cls(*(jnp.zeros(num_envs) for _ in range(5)))


Record = Callable[[EnvState, Array, Box, Array], Any]
"""What to keep of an env step, given the B environments before it, subgoals [B, m], target boxes, actions [B, act]."""


class Steps(struct.PyTreeNode):
    """One segment step by step, leading axes [l, B]. `alive` is 1 until the environment has ended.

    `ended` is 1 where an episode ends before its time, `terminated` where nothing is to be bootstrapped either.
    `non_finite` and `overflow` are 1 where that is because the simulator failed. `recorded` is what the `Record`
    given to `rollout` kept.
    """

    obs: Float[Array, "l B obs"]
    next_obs: Float[Array, "l B obs"]
    subgoal: Float[Array, "l B m"]
    next_subgoal: Float[Array, "l B m"]
    action: Float[Array, "l B act"]
    reward: Float[Array, "l B"]
    terminated: Float[Array, "l B"]
    ended: Float[Array, "l B"]
    success: Float[Array, "l B"]
    distance: Float[Array, "l B"]
    alive: Float[Array, "l B"]
    non_finite: Float[Array, "l B"]
    overflow: Float[Array, "l B"]
    recorded: Any = None


def evaluate(config: AgentConfig, spec: Spec, env: VectorEnv, state: TrainState, *, key: Array) -> Episode:
    """The statistics of one greedy episode of every environment of `env`; nothing is learnt."""
    return play(config, spec, env, state, key=key)[0].episode


def play(
    config: AgentConfig,
    spec: Spec,
    env: VectorEnv,
    state: TrainState,
    *,
    goals: Float[Array, "B k"] | None = None,
    record: Record | None = None,
    key: Array,
) -> tuple[Streams, Any]:
    """One greedy episode of every environment of `env`: the streams at its end, and what `record` kept.

    The latter has the leading axis [T] of all env steps of the episode; it is None without `record`. `goals` take the
    place of those that the task draws; the starts stay the same.
    """
    reset_key, scan_key = jax.random.split(key)
    segments = spec.episode_length // config.tutor.period
    streams = start(spec, env, goals=goals, key=reset_key)
    streams = streams.replace(past=jnp.full((env.num_envs, segments, 2), -1))
    allowed = successors(config, state)
    state = state.replace(commander=settled(config, state, episode_length=spec.episode_length))

    def segment(streams: Streams, key: Array) -> tuple[Streams, Any]:
        command_key, tutor_key, rollout_key = jax.random.split(key, 3)
        streams = command(config, spec, state, allowed, streams, epsilon=0.0, key=command_key)
        subgoal, _ = choose_subgoal(config, spec, state, streams, deterministic=True, key=tutor_key)
        streams, steps = rollout(
            config, spec, env, state, streams, subgoal, deterministic=True, record=record, key=rollout_key
        )
        streams = ahead_of_time(config, spec, state.abstraction, advance(config, streams))
        return streams, steps.recorded

    streams, recorded = jax.lax.scan(segment, streams, jax.random.split(scan_key, segments))
    return streams, jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), recorded)


def start(
    spec: Spec,
    env: VectorEnv,
    *,
    goals: Float[Array, "B k"] | None = None,
    practice: Float[Array, ""] | float = 0.0,
    key: Array,
) -> Streams:
    """Fresh environments with their clocks at 0, with `goals` if given. A share `practice` of them is to practise."""
    reset_key, practice_key = jax.random.split(key)
    env_state, n = env.reset(reset_key), env.num_envs
    if goals is not None:
        env_state = env.with_goals(env_state, goals, jnp.ones(n, bool))
    nothing = jnp.zeros(n, jnp.int32)
    abstract = spec.abstract(env_state.obs)
    return Streams(
        env=env_state,
        clock=nothing,
        practice=jnp.where(jax.random.uniform(practice_key, (n,)) < practice, _ANY, -1),
        region=nothing - 1,  # none yet
        goal_region=nothing,
        target=nothing,
        box=Box(lower=jnp.zeros_like(abstract), upper=jnp.zeros_like(abstract)),
        start=abstract,
        reward=jnp.zeros(n),
        waypoint=jnp.zeros(n, bool),
        episode=Episode.start(n),
    )


def successors(config: AgentConfig, state: TrainState) -> Successors:
    """Targets that the graph allows from each region under `commander.successors`."""
    return commander.successors(
        config.commander.successors,
        reaches=state.graph.reaches,
        misses=state.graph.misses,
        active=state.abstraction.active,
    )


def believed(config: AgentConfig, state: TrainState) -> Bool[Array, "R R"]:
    """Pairs whose targets count as reachable as long as nobody has tried."""
    neighbours = regions.adjacent(state.abstraction) & (state.graph.told >= 0)
    if config.commander.successors == "all":
        return neighbours
    return state.graph.reaches | (neighbours & ~state.graph.misses)


def settled(config: AgentConfig, state: TrainState, *, episode_length: int) -> CommanderState:
    """The Commander as it acts in greedy episodes of so many env steps."""
    return commander.settle(
        config.commander,
        state.commander,
        successors(config, state),
        believed=believed(config, state),
        periods=max(1, episode_length // config.commander.period),
    )


def command(
    config: AgentConfig,
    spec: Spec,
    state: TrainState,
    allowed: Successors,
    streams: Streams,
    *,
    epsilon: Float[Array, "B"] | float,
    key: Array,
) -> Streams:
    """The Commander's decision, for the streams whose clock is 0."""
    obs = streams.env.obs
    locate = partial(regions.locate, state.abstraction)
    aim = spec.goal_point(obs)
    region, goal_region = locate(spec.abstract(obs)), locate(aim)
    target, practice, lesson, past = goal_region, streams.practice, streams.lesson, streams.past
    if config.commander.enabled:
        act_key, practice_key = jax.random.split(key)
        another = jax.random.randint(practice_key, practice.shape, 0, state.abstraction.count)
        practice = jnp.where((practice == region) | (practice == _ANY), another, practice)
        worth = None
        if past is not None:
            past, tries = _remembered(streams, region, regions=state.abstraction.capacity)
            worth = config.commander.retry**tries
        target = commander.act(
            state.commander,
            allowed,
            region,
            goal_region,
            practised=practice,
            attraction=None if state.sgim is None else strategies.attraction(config.sgim, state.sgim),
            worth=worth,
            epsilon=epsilon,
            key=act_key,
        )
        if config.commander.hold:
            there = region == goal_region if config.commander.hold == "region" else streams.env.metrics["success"] > 0
            target = jnp.where(there & (practice < 0), goal_region, target)
    to_point = jnp.zeros_like(practice, bool)
    if config.commander.enabled and lesson is not None:
        lesson, target, waypoint, to_point = _led(config, spec, state.abstraction, lesson, obs, region, target)
        aim = jnp.where(to_point[:, None], waypoint, aim)
    around_point = to_point | ((target == goal_region) & (practice < 0))
    fresh = streams.replace(
        practice=practice,
        region=region,
        goal_region=goal_region,
        target=target,
        box=target_box(config, spec, state.abstraction, target, around_point, aim),
        start=spec.abstract(obs),
        reward=jnp.full_like(streams.reward, commander.start_reward(config.commander)),
        waypoint=to_point,
        lesson=lesson,
        past=past,
    )
    return _select(streams.clock == 0, fresh, streams)


def _led(
    config: AgentConfig,
    spec: Spec,
    abstraction: Abstraction,
    lesson: Lesson,
    obs: Float[Array, "B obs"],
    region: Int[Array, "B"],
    target: Int[Array, "B"],
) -> tuple[Lesson, Int[Array, "B"], Float[Array, "B d"], Bool[Array, "B"]]:
    """The lesson by now, the targets under it, its waypoints, and where the Tutor is given these, not a region."""
    locate = partial(regions.locate, abstraction)
    lesson, waypoint, to_point = strategies.impose(config.sgim, lesson, spec.abstract(obs))
    if config.sgim.shows_subgoals:  # on a teacher's route the regions that the Commander will have to choose
        corners = (corner[region] for corner in (abstraction.lower, abstraction.upper))
        beyond, led = strategies.onward(lesson, spec.abstract(obs), *corners)
        led &= strategies.guided(config.sgim, lesson)
        target, to_point = jnp.where(led, locate(beyond), target), to_point & ~led
    return lesson, jnp.where(to_point, locate(waypoint), target), waypoint, to_point


def _remembered(
    streams: Streams, region: Int[Array, "B"], *, regions: int
) -> tuple[Int[Array, "B N 2"], Float[Array, "B R"]]:
    """`streams.past` by now, and how often `region` was left under each of the commands.

    All in vain, as the agent is there again. The last decision is past where the agent is in another region.
    """
    assert streams.past is not None
    last = jnp.stack([streams.region, streams.target], axis=-1)
    past = where(region != streams.region, jnp.concatenate([streams.past[:, 1:], last[:, None]], axis=1), streams.past)
    again = (past[..., 0] == region[:, None]).astype(jnp.float32)
    return past, jax.vmap(lambda target, weight: jnp.zeros(regions).at[target].add(weight))(past[..., 1], again)


def target_box(
    config: AgentConfig,
    spec: Spec,
    abstraction: Abstraction,
    target: Int[Array, "B"],
    around_point: Bool[Array, "B"],
    point: Float[Array, "B d"],
) -> Box:
    """Bounds that the Tutor is given: those of the target region, or point +- margin (of g*, or a waypoint)."""
    whole = Box(lower=abstraction.lower[target], upper=abstraction.upper[target])
    around = around_point[:, None] & spec.in_goal()
    return where(around, Box.around(point, config.commander.goal_margin), whole)


def choose_subgoal(
    config: AgentConfig, spec: Spec, state: TrainState, streams: Streams, *, deterministic: bool, key: Array
) -> tuple[Float[Array, "B m"], Float[Array, "B p"] | None]:
    """(subgoal, action) of the Tutor in every environment; without a Tutor the target box and None."""
    obs = streams.env.obs
    position = spec.abstract(obs)
    if state.tutor is None:
        return streams.box.seen_from(position).corners, None
    seen = tutor.observe(config.tutor, spec.state(obs), position, streams.box)
    action = learners.act(config.tutor, state.tutor, seen, deterministic=deterministic, key=key)
    if streams.lesson is not None and config.sgim.shows_subgoals:
        straight = jnp.clip(spec.towards(obs, strategies.coming(streams.lesson)) / spec.scale, -1.0, 1.0)
        action = jnp.where(strategies.guided(config.sgim, streams.lesson)[:, None], straight, action)
    if streams.lesson is not None and "babbling" in config.sgim.strategies:
        anything = jax.random.uniform(jax.random.fold_in(key, 1), action.shape, minval=-1.0)
        action = jnp.where(strategies.babbles(config.sgim, streams.lesson)[:, None], anything, action)
    return tutor.subgoal(action, spec.scale), action


def rollout(
    config: AgentConfig,
    spec: Spec,
    env: VectorEnv,
    state: TrainState,
    streams: Streams,
    subgoal: Float[Array, "B m"],
    *,
    deterministic: bool,
    record: Record | None = None,
    key: Array,
) -> tuple[Streams, Steps]:
    """L env steps under one subgoal per environment. Environments that end stay as they are in the statistics."""

    def step(carry: tuple[EnvState, Array, Array, Episode], step_key: Array) -> tuple[tuple, Steps]:
        env_state, subgoal, alive, episode = carry
        obs = env_state.obs
        seen = controller.observe(config.controller, spec, spec.state(obs), subgoal)
        action = learners.act(config.controller, state.controller, seen, deterministic=deterministic, key=step_key)
        recorded = record(env_state, subgoal, streams.box, action) if record else None
        env_state = env.step(env_state, action)
        after = controller.next_subgoal(subgoal, spec.pose(obs), spec.pose(env_state.obs))
        steps = Steps(
            obs=obs,
            next_obs=env_state.obs,
            subgoal=subgoal,
            next_subgoal=after,
            action=action,
            reward=env_state.reward,
            success=env_state.metrics["success"],
            distance=env_state.metrics["distance"],
            terminated=env_state.done * (1 - env_state.info["truncation"]),
            ended=env_state.done * (env_state.info["steps"] < spec.episode_length),
            alive=alive,
            non_finite=env_state.metrics["non_finite"],
            overflow=env_state.metrics["overflow"],
            recorded=recorded,
        )
        return (env_state, after, alive * (1 - env_state.done), _record(episode, env_state, alive)), steps

    carry = (streams.env, subgoal, 1 - streams.env.done, streams.episode)
    (env_state, _, _, episode), steps = jax.lax.scan(step, carry, jax.random.split(key, config.tutor.period))
    worth = commander.worth(config.commander, steps.distance, steps.success)
    reward = commander.accumulate(config.commander, streams.reward, worth, steps.alive)
    return streams.replace(env=env_state, episode=episode, reward=reward), steps


def advance(config: AgentConfig, streams: Streams) -> Streams:
    """Move the clocks on by one segment; they return to 0 at the end of a period."""
    return streams.replace(clock=(streams.clock + config.tutor.period) % config.commander.period)


def ahead_of_time(config: AgentConfig, spec: Spec, abstraction: Abstraction, streams: Streams) -> Streams:
    """With `commander.arrival`, clocks at 0 where the target region is reached, unless the goal is aimed at in it.

    For greedy episodes alone: the forward model learns where whole periods lead.
    """
    if not config.commander.arrival:
        return streams
    region = regions.locate(abstraction, spec.abstract(streams.env.obs))
    arrived = (region == streams.target) & (streams.target != streams.goal_region)
    return streams.replace(clock=jnp.where(arrived, 0, streams.clock))


def restart_ended(spec: Spec, env: VectorEnv, streams: Streams, steps: Steps, *, key: Array) -> Streams:
    """Reset the environments that ended early in this segment, with clocks and statistics at their start.

    What SGIM has chosen for them holds again, from its beginning.
    """
    ended = jnp.max(steps.ended * steps.alive, axis=0) > 0
    env_state = env.reset_where(streams.env, ended, key)
    if streams.lesson is not None:
        lesson = strategies.grade(streams.lesson, ended, streams.episode.distance, radius=spec.success_radius)
        env_state = pursue(spec, env, env_state, lesson, ended)
        streams = streams.replace(lesson=lesson.replace(leg=jnp.where(ended, lesson.first, lesson.leg)))
    restarted = streams.replace(clock=jnp.zeros_like(streams.clock), episode=Episode.start(env.num_envs), env=env_state)
    return _select(ended, restarted, streams.replace(env=env_state))


def pursue(spec: Spec, env: VectorEnv, env_state: EnvState, lesson: Lesson, mask: Bool[Array, "B"]) -> EnvState:
    """`env_state` with the goals of the lesson where it is `taught` and an episode has just begun (`mask`)."""
    goals = spec.with_goal_point(spec.goal(env_state.obs), lesson.choice.goal)
    return env.with_goals(env_state, goals, mask & lesson.taught)


def _record(episode: Episode, env_state: EnvState, alive: Float[Array, "B"]) -> Episode:
    success, distance = env_state.metrics["success"], env_state.metrics["distance"]
    return Episode(
        success_any=jnp.maximum(episode.success_any, success * alive),
        success_final=jnp.where(alive > 0, success, episode.success_final),
        distance=jnp.where(alive > 0, distance, episode.distance),
        total=episode.total + env_state.reward * alive,
        flipped=jnp.where(alive > 0, env_state.metrics["flipped"], episode.flipped),
    )


def _select(mask: Bool[Array, "B"], new: Streams, old: Streams) -> Streams:
    """`new` where `mask`, else `old`, environment by environment; the environments' own state is `new`'s."""
    return where(mask, new.replace(env=None), old.replace(env=None)).replace(env=new.env)
