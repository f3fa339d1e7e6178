"""The Commander: chooses the target region, every k env steps, from a table of values over regions.

    target  <- epsilon-greedy in Q[region, goal region, .] over the successors that reachability allows

    command     where a decision is due, after every k env steps: target and box
    experience  a segment, on which its clock moves on; where a period ends with it, a decision and where that led
    observe     the decisions of an instant, by `planning` or `q_learning`
    follow      once an epoch: the regions may have been cut

Greedy episodes explore nothing, and follow a plan of their own (`settle`), in which a decision is also due where the
agent has come to a better region than ever before, and no target is given twice in vain. But where an agent stands
still (`standing`) Tutor and Controller act with noise.

Source: STAR (ICLR 2024), section 4.1.
"""

from __future__ import annotations

from functools import partial
from types import ModuleType

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from envs.common.batching import where
from star.abstraction import regions
from star.abstraction.forward_model import Outcome
from star.abstraction.regions import Box, Change, Places
from star.agent import planning, q_learning, values
from star.agent.decisions import Decision, Finished, Journey, Memory, Roadmap, Scene, target_box
from star.agent.sections import CommanderConfig
from star.agent.segments import Segment
from star.agent.task import Task
from star.agent.values import CommanderState
from star.learners.replay import weighted_mean
from star.sgim.lessons import Marks

Metrics = dict[str, Array]

STILL = 0.05  # of the farthest subgoal in each dimension: who has moved less stands still, or has come no nearer

_RULES = {"model": planning, "q": q_learning}


def _rule(section: CommanderConfig) -> ModuleType:
    """Its learning from decisions."""
    return _RULES[section.learner]


def init(section: CommanderConfig, *, regions: int) -> CommanderState:
    """Q = 0 everywhere, optimistic for rewards that are negative, and an empty model."""
    near = min(regions, section.nearest or regions)
    model = _rule(section).init(regions=regions, near=near)
    return CommanderState(q=jnp.zeros((regions, regions, near)), chosen=jnp.zeros(regions), model=model)


def epsilon(section: CommanderConfig, env_steps: Float[Array, ""] | float) -> Float[Array, ""]:
    """Share of random choices after `env_steps` of all environments: linear, then constant."""
    progress = jnp.clip(env_steps / section.epsilon_steps, 0.0, 1.0)
    return section.epsilon_start + progress * (section.epsilon_end - section.epsilon_start)


def spread(section: CommanderConfig, share: Float[Array, ""], *, num_envs: int) -> Float[Array, "B"]:
    """Share of random choices of each environment, `share` on average.

    Spread from none to twice as much (or as evenly around `share` as shares allow), some environments walk a long way
    to its end while others leave it often (as in Ape-X, Horgan et al. 2018).
    """
    even = (2 * jnp.arange(num_envs) + 1) / num_envs - 1
    return share + section.epsilon_spread * even * jnp.minimum(share, 1 - share)


def begin(position: Float[Array, "B d"]) -> Memory:
    """Clocks at 0."""
    nothing = jnp.zeros(len(position), jnp.int32)
    return Memory(
        clock=nothing,
        region=nothing,
        goal_region=nothing,
        target=nothing,
        box=Box(lower=jnp.zeros_like(position), upper=jnp.zeros_like(position)),
        start=position,
        goal=jnp.zeros_like(position),
        reward=jnp.zeros(len(position)),
        aside=jnp.zeros(len(position), bool),
    )


def set_out(section: CommanderConfig, memory: Memory, *, capacity: int) -> Memory:
    """The memory at the start of a greedy episode, in which a planner remembers its way through so many regions."""
    if section.learner != "model":
        return memory
    size = len(memory.clock)
    return memory.replace(journey=Journey(best=jnp.full(size, -jnp.inf), given=jnp.full((size, capacity), -1)))


def command(
    section: CommanderConfig,
    task: Task,
    state: CommanderState,
    roadmap: Roadmap,
    memory: Memory,
    scene: Scene,
    marks: Marks,
    *,
    env_steps: Float[Array, ""] | float | None,
    key: Array,
) -> Memory:
    """The decisions of those who are due; greedy where `env_steps`, those of all environments so far, is None."""
    locate = partial(regions.locate, roadmap.abstraction)
    region, goal_region = locate(scene.position), locate(scene.goal)
    due, journey, vain = _on_the_way(task, state, roadmap, memory, scene.position, region, goal_region)
    target = values.choose(
        state,
        roadmap.allowed,
        region,
        goal_region,
        vain=vain,
        attraction=roadmap.attraction,
        epsilon=_shares(section, env_steps, num_envs=len(region)),
        key=key,
    )
    if section.hold:
        there = region == goal_region if section.hold == "region" else scene.success > 0
        target = jnp.where(there, goal_region, target)
    aim, aside = scene.goal, jnp.zeros_like(region, bool)
    if marks.way is not None:
        aside, aim = marks.way.aside, jnp.where(marks.way.aside[:, None], marks.way.point, aim)
        target = jnp.where(marks.way.target >= 0, marks.way.target, target)
    around = aside | (target == goal_region)
    memory = memory.replace(journey=journey)
    fresh = memory.replace(
        region=region,
        goal_region=goal_region,
        target=target,
        box=target_box(task, roadmap.abstraction, target, around=around, point=aim),
        start=jnp.where((memory.clock == 0)[:, None], scene.position, memory.start),
        goal=scene.goal,
        reward=jnp.full_like(memory.reward, start_reward(section)),
        aside=aside,
    )
    if journey is not None:
        given = journey.given.at[jnp.arange(len(region)), region].set(target)
        fresh = fresh.replace(journey=journey.replace(given=given))
    return where(due, fresh, memory)


def _on_the_way(
    task: Task,
    state: CommanderState,
    roadmap: Roadmap,
    memory: Memory,
    position: Float[Array, "B d"],
    region: Int[Array, "B"],
    goal_region: Int[Array, "B"],
) -> tuple[Bool[Array, "B"], Journey | None, Int[Array, "B"] | None]:
    """True for those due for a decision; the journeys, and the targets that were given in vain where they are, or -1.

    A decision is due where a period begins. On a journey it also is where the agent comes to a better region than ever
    before: so there are no more such decisions than regions. Who comes back to a region was given a target there in
    vain, and would be led around in a circle by it; who has not come nearer to its box in a period would stay where it
    is. In training there is no journey: what is counted is where whole periods lead, and random targets end circles.
    """
    begins, journey = memory.clock == 0, memory.journey
    if journey is None:
        return begins, None, None
    value = values.worth(state, roadmap.allowed, region, goal_region)
    same = goal_region == memory.goal_region
    best, given = jnp.where(same, journey.best, -jnp.inf), jnp.where(same[:, None], journey.given, -1)
    scale = task.spec.scale[: position.shape[-1]]
    before, now = (memory.box.distance(point, scale) for point in (memory.start, position))
    failed = (region != memory.region) | (begins & (now > before - STILL))
    vain = jnp.where(failed & (region != goal_region), given[jnp.arange(len(region)), region], -1)
    return begins | (value > best), Journey(best=jnp.maximum(best, value), given=given), vain


def _shares(
    section: CommanderConfig, env_steps: Float[Array, ""] | float | None, *, num_envs: int
) -> Float[Array, "B"] | float:
    """Share of random choices of each environment; none in greedy episodes."""
    return 0.0 if env_steps is None else spread(section, epsilon(section, env_steps), num_envs=num_envs)


def experience(
    section: CommanderConfig, task: Task, roadmap: Roadmap, memory: Memory, segment: Segment, marks: Marks
) -> tuple[Memory, Finished]:
    """The memory after a segment, and the periods that came to their end with it; weight 0 elsewhere.

    A period in which success ends the episode counts as if the agent had stayed at the goal for the rest of it.
    """
    worthy = worth(section, segment.distance, segment.success)
    last = jnp.sum(worthy * segment.terminated * segment.alive, axis=0)
    arrived = segment.arrived * segment.alive
    left = section.period - memory.clock - segment.alive.sum(axis=0)  # env steps of the period
    memory = tick(section, memory, steps=len(segment.alive))
    memory = memory.replace(reward=accumulate(section, memory.reward, worthy, segment.alive + arrived * left))
    end, lost = task.spec.abstract(segment.obs[-1]), segment.lost
    early = jnp.maximum(segment.ended[-1], lost)  # what is lost in the last step of an episode has not `ended` early
    weight = jnp.maximum(jnp.where(memory.clock == 0, segment.alive[-1] * (1 - early), 0.0), arrived.max(axis=0))
    if marks.own is not None:  # random subgoals tell nothing of where commands lead
        weight, lost = weight * marks.own, lost * marks.own
    decision = Decision(
        region=memory.region,
        goal_region=memory.goal_region,
        target=memory.target,
        reward=jnp.where(segment.lost > 0, lost_reward(section, memory.reward, last), memory.reward),
        next_region=regions.locate(roadmap.abstraction, end),
        weight=weight,
        lost=lost,
        aside=memory.aside.astype(weight.dtype),
        goal=memory.goal,
        shown=None if marks.shown is None else marks.shown.astype(weight.dtype),
    )
    box = memory.box
    return memory, Finished(decision, Outcome(memory.start, box.lower, box.upper, end, weight))


def standing(task: Task, memory: Memory, scene: Scene) -> Bool[Array, "B"]:
    """True for those whom the period under way has not moved, though the goal is not reached.

    Greedy policies may come to rest where no action changes what they see. Training's noise gets them out.
    """
    moved = jnp.abs(scene.position - memory.start)
    least = STILL * task.spec.scale[: moved.shape[-1]]
    return (memory.clock > 0) & jnp.all(moved < least, axis=-1) & (scene.success == 0)


def tick(section: CommanderConfig, memory: Memory, *, steps: int) -> Memory:
    """The memory with its clock moved on by so many env steps."""
    return memory.replace(clock=(memory.clock + steps) % section.period)


def renewed(memory: Memory) -> Bool[Array, "B"]:
    """True where another target follows."""
    return memory.clock == 0


def observe(
    section: CommanderConfig,
    state: CommanderState,
    roadmap: Roadmap,
    batch: Decision,
    *,
    due: Bool[Array, ""],
    margin: Float[Array, ""] | float = 0.0,
) -> CommanderState:
    """Take in what the streams decided at one instant, and where it is `due`, plan by it for their goals.

    Q-learning also raises what a teacher chose towards `margin` above all else.
    """
    rule = _rule(section)
    state = state.replace(chosen=state.chosen.at[batch.target].add(batch.weight))
    state = rule.observe(section, state, roadmap, batch, margin=margin)
    return rule.plan(section, state, roadmap, goals=batch.goal_region, due=due)


def settle(section: CommanderConfig, state: CommanderState, roadmap: Roadmap, *, episode_length: int) -> CommanderState:
    """The Commander as it acts in greedy episodes of so many env steps."""
    return _rule(section).settle(section, state, roadmap, periods=max(1, episode_length // section.period))


def follow(
    section: CommanderConfig,
    state: CommanderState,
    change: Change,
    known: CommanderState,
    finished: Finished,
    traffic: Float[Array, "R R"],
) -> CommanderState:
    """The tables in today's regions, after an epoch that began with what was `known` and whose periods are `finished`.

    Parts inherit the values of the whole. `traffic` says how many remembered periods led from each region into each.
    """
    origin, places = change.origin, Places.of(change, section.nearest)
    parts = regions.over_parts(jnp.ones(len(origin)), origin)
    model = _rule(section).follow(section, state, change, places, known.model, finished, traffic)
    q = values.inherited(state.q, places)
    return state.replace(q=q, chosen=state.chosen[origin] / parts, model=model)


def fade(section: CommanderConfig, state: CommanderState) -> CommanderState:
    """Let one epoch pass: old decisions count less."""
    return state.replace(chosen=0.9 * state.chosen, model=_rule(section).fade(section, state))


def plan(section: CommanderConfig, state: CommanderState, roadmap: Roadmap) -> CommanderState:
    """Values by what is known now."""
    return _rule(section).plan(section, state, roadmap)


def measure(section: CommanderConfig, state: CommanderState, roadmap: Roadmap, batch: Decision) -> Metrics:
    """Mean reward of the whole periods in `batch` and their mean absolute error of temporal difference."""
    weight = batch.weight * (1 - batch.aside)
    error = values.td_error(section, state, roadmap.allowed, batch)
    return {"reward": weighted_mean(batch.reward, weight), "td_error": weighted_mean(jnp.abs(error), weight)}


def worth(section: CommanderConfig, distance: Float[Array, "*n"], success: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The Commander's reward of one env step: whether g* counts as reached, or minus the distance to it.

    Distances deceive in a maze, and where they pay, so does waiting at the near side of a wall.
    """
    return success if section.reward == "success" else -distance


def lost_reward(section: CommanderConfig, reward: Float[Array, "B"], last: Float[Array, "B"]) -> Float[Array, "B"]:
    """Of a period in which the task was terminated, with nothing to follow; `last` is the worth of its last env step.

    Success so far counts. Distances are paid for ever, last / (1 - gamma), or else it would be best to end early.
    """
    return reward if section.reward == "success" else last / (1.0 - section.discount)


def start_reward(section: CommanderConfig) -> float:
    """A period's reward before its first env step."""
    return -jnp.inf if section.reward == "max" else 0.0


def accumulate(
    section: CommanderConfig,
    reward: Float[Array, "B"],
    external: Float[Array, "l B"],
    alive: Float[Array, "l B"],
) -> Float[Array, "B"]:
    """The reward of periods so far, after l more env steps with rewards `external`, each as often as `alive` says.

    The maximum is the same whether the agent stays at the goal or leaves it again; the mean tells them apart.
    """
    if section.reward == "max":
        return jnp.maximum(reward, jnp.where(alive > 0, external, -jnp.inf).max(axis=0))
    return reward + jnp.sum(external * alive, axis=0) / section.period
