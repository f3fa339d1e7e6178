"""The hierarchy learns: an epoch is one pure function of the state of a run.

    epoch(state):
        reset all B environments, clocks at 0
        repeat episode_length / l times                       # one segment: one decision of the Tutor
            act (star/episode.py)
            Controller learns from the segment; where the clock reaches k, Commander learns from the period
            every `unroll` segments: Tutor learns
        forward model learns from the epoch's periods; refinement, after which the Commander counts and plans anew

Each level but the Controller can be left out (`enabled`): no Commander is HIRO, no Tutor is GARA, neither is flat.

A period cut short by the end of an episode teaches the forward model nothing, because it did not last k steps, and the
Commander only that it was lost, if the task ended it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from envs.common.batching import where
from envs.vector import VectorEnv
from star import devices, faults, learners
from star.abstraction import forward_model, refinement, regions
from star.abstraction.forward_model import Outcome
from star.abstraction.regions import Abstraction
from star.agent import adjacency, commander, controller, tutor
from star.agent import play as episode
from star.agent.commander import CommanderState, Decision, Model, Successors
from star.agent.play import Episode, Steps, Streams
from star.agent.sections import AgentConfig
from star.agent.state import TrainState
from star.agent.tutor import Box, Trace
from star.learners.replay import Imitation, Penalty, Transition, flatten, weighted_mean
from star.sgim import selection, strategies
from star.sgim.selection import SgimState
from star.sgim.strategies import Lesson
from star.sgim.teachers import Demonstrations
from star.spec import Spec

Metrics = dict[str, Array]


def epoch(
    config: AgentConfig, spec: Spec, env: VectorEnv, state: TrainState, teachers: Sequence[Demonstrations] = ()
) -> tuple[TrainState, Metrics]:
    """One episode of all environments, its updates, one refinement. `teachers` are those of `config.sgim.teachers`."""
    key, reset_key, scan_key, end_key, lesson_key = jax.random.split(state.key, 5)
    streams = episode.start(spec, env, practice=commander.practice(config.commander), key=reset_key)
    streams = devices.share(streams)
    if config.sgim.enabled:
        state, streams = _begin_lesson(config, spec, env, state, teachers, streams, key=lesson_key)
    known = state.commander.model
    segments = spec.episode_length // config.tutor.period
    blocks = (segments // config.tutor.unroll, config.tutor.unroll)
    (state, streams), (outcomes, metrics, counts) = jax.lax.scan(
        partial(_block, config, spec, env, teachers),
        (state.replace(key=key), streams),
        (jax.random.split(scan_key, blocks[0]), jnp.arange(segments).reshape(blocks)),
    )
    metrics = jax.tree.map(jnp.mean, metrics) | jax.tree.map(jnp.sum, counts)
    metrics |= _episode_metrics("train", streams.episode, (streams.practice < 0).astype(jnp.float32))
    if config.sgim.enabled:
        state, more = _end_lesson(config, spec, state, streams)
        metrics |= _prefix("sgim", more)
    if state.adjacency is not None:
        end_key, near_key = jax.random.split(end_key)
        near, more = adjacency.train(config.tutor.adjacency, state.adjacency, spec.space, key=near_key)
        state, metrics = state.replace(adjacency=near), metrics | _prefix("adjacency", more)
    outcomes = jax.tree.map(lambda x: x.reshape(-1, *x.shape[3:]), devices.whole(outcomes))
    if config.commander.enabled:
        epsilon = commander.epsilon(config.commander, _env_steps(spec, env, state))
        state, more = _learn_between_episodes(config, spec, state, known, outcomes, env.num_envs, key=end_key)
        metrics |= more | {"commander/epsilon": epsilon}
    state = state.replace(epoch=state.epoch + 1)
    return state, metrics | faults.count(state)


def _begin_lesson(
    config: AgentConfig,
    spec: Spec,
    env: VectorEnv,
    state: TrainState,
    teachers: Sequence[Demonstrations],
    streams: Streams,
    *,
    key: Array,
) -> tuple[TrainState, Streams]:
    """Let SGIM choose goals, strategies and teachers of the environments that do not practise."""
    assert state.sgim is not None
    obs = streams.env.obs
    lesson = strategies.assign(
        config.sgim,
        state.sgim,
        teachers,
        start=spec.abstract(obs),
        goal=spec.goal_point(obs),
        taught=streams.practice < 0,
        key=key,
    )
    env_state = episode.pursue(spec, env, streams.env, lesson, jnp.ones_like(lesson.taught))
    lesson = strategies.begin(lesson, env_state.metrics["distance"], radius=spec.success_radius)
    if config.sgim.detours and config.sgim.routes:
        paths, weight = strategies.ways(config.sgim, lesson, spec.abstract(obs))
        state = state.replace(graph=refinement.tell(state.graph, state.abstraction, paths, weight))
    return state, streams.replace(env=env_state, lesson=lesson)


def _end_lesson(config: AgentConfig, spec: Spec, state: TrainState, streams: Streams) -> tuple[TrainState, Metrics]:
    """Let SGIM learn from the epoch."""
    lesson = streams.lesson
    assert lesson is not None
    assert state.sgim is not None
    over = jnp.ones_like(lesson.taught)
    lesson = devices.whole(strategies.grade(lesson, over, streams.episode.distance, radius=spec.success_radius))
    learnt, metrics = strategies.learn(config.sgim, state.sgim, lesson)
    return state.replace(sgim=learnt), metrics


def _imitation(
    config: AgentConfig, spec: Spec, teachers: Sequence[Demonstrations], lesson: Lesson | None, *, key: Array
) -> Imitation | None:
    """Demonstrated actions, as steps towards where the demonstrator was at the end of their segment.

    Without a Tutor they are steps towards the box around the demonstrated outcome.
    """
    batches = []
    for number, (teacher, demos) in enumerate(zip(config.sgim.teachers, teachers, strict=True)):
        if lesson is None or teacher.kind != "action":
            continue
        drawn = strategies.shown(
            demos, config.tutor.period, size=config.sgim.imitation_batch, key=jax.random.fold_in(key, number)
        )
        position = spec.abstract(drawn.state)
        subgoal = spec.pose(drawn.later) - spec.pose(drawn.state)
        if not config.tutor.enabled:
            subgoal = Box.around(drawn.outcome - position, config.commander.goal_margin).corners
        share = strategies.mimicking(config.sgim, lesson, number)
        batches.append(
            Imitation(
                obs=controller.observe(config.controller, spec, drawn.state, subgoal),
                action=drawn.action,
                weight=jnp.full(len(position), config.sgim.imitation * share),
            )
        )
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *batches) if batches else None


def _shown_subgoals(config: AgentConfig, decisions: Transition, shown: Float[Array, "T B"] | None) -> Imitation | None:
    """The subgoals that teachers have set; their weights make the loss a mean over them alone."""
    if shown is None or not config.sgim.shows_subgoals:
        return None
    weight = config.sgim.imitation * shown / jnp.maximum(shown.mean(), 1e-6)
    obs, action, weight = flatten((decisions.obs, decisions.action, weight))
    return Imitation(obs=obs, action=action, weight=weight)


def _block(
    config: AgentConfig,
    spec: Spec,
    env: VectorEnv,
    teachers: Sequence[Demonstrations],
    carry: tuple[TrainState, Streams],
    inputs: tuple[Array, Array],
) -> tuple[tuple[TrainState, Streams], tuple[Any, Metrics, Metrics]]:
    """`tutor.unroll` segments, whose numbers are given, then one update of the Tutor."""
    scan_key, update_key = jax.random.split(inputs[0])
    carry, (decisions, outcomes, metrics, counts) = jax.lax.scan(
        partial(_segment, config, spec, env, teachers),
        carry,
        (jax.random.split(scan_key, config.tutor.unroll), inputs[1]),
    )
    state, streams = carry
    metrics = jax.tree.map(jnp.mean, metrics)
    if decisions is not None:
        relabel = _relabel(config, spec, state) if config.tutor.off_policy_correction else None
        learnt, more = learners.update(
            config.tutor,
            state.tutor,
            decisions,
            relabel=relabel,
            penalty=_penalty(config, spec, state) if config.tutor.adjacency.enabled else None,
            imitation=_shown_subgoals(config, decisions, outcomes[0].shown),
            key=update_key,
        )
        state, metrics = state.replace(tutor=learnt), metrics | _prefix("tutor", more)
    return (state, streams), (outcomes, metrics, counts)


def _segment(
    config: AgentConfig,
    spec: Spec,
    env: VectorEnv,
    teachers: Sequence[Demonstrations],
    carry: tuple[TrainState, Streams],
    inputs: tuple[Array, Array],
) -> tuple[tuple[TrainState, Streams], tuple[Transition | None, Any, Metrics, Metrics]]:
    """One decision of the Tutor: command, act, roll out, let Controller and Commander learn."""
    state, streams = carry
    key, number = inputs
    command_key, tutor_key, rollout_key, update_key, reset_key, imitation_key = jax.random.split(key, 6)
    allowed = episode.successors(config, state)
    now = _env_steps(spec, env, state)
    share = commander.epsilon(config.commander, now)
    shares = commander.spread(config.commander, share, num_envs=env.num_envs)
    streams = episode.command(config, spec, state, allowed, streams, epsilon=shares, key=command_key)

    subgoal, tutor_action = episode.choose_subgoal(config, spec, state, streams, deterministic=False, key=tutor_key)
    began = streams.env.obs
    streams, steps = episode.rollout(config, spec, env, state, streams, subgoal, deterministic=False, key=rollout_key)

    experience = _controller_rollout(config, spec, steps, env_steps=now)
    in_hindsight = partial(_in_hindsight, config, spec) if config.controller.hindsight else None
    controller_state, controller_metrics = learners.update(
        config.controller,
        state.controller,
        experience,
        relabel=in_hindsight,
        imitation=_imitation(config, spec, teachers, streams.lesson, key=imitation_key),
        key=update_key,
    )
    metrics = _prefix(
        "controller", controller_metrics | {"reward": weighted_mean(experience.reward, experience.weight)}
    )
    streams = episode.advance(config, streams)
    decision, outcome = finished_period(config, spec, state, streams, steps)
    if config.commander.enabled:
        known = _command_better(config, state, allowed, devices.whole(decision), number)
        state = state.replace(commander=known)
    transition = None
    if tutor_action is not None:
        transition = _tutor_transition(config, spec, streams, began, tutor_action, steps)
        metrics |= {"tutor/reward": transition.reward.mean()}
    if state.adjacency is not None:
        path = spec.abstract(jnp.concatenate([began[None], steps.next_obs]))
        path, alive = devices.whole((path, steps.alive))
        near = adjacency.observe(config.tutor.adjacency, state.adjacency, spec.space, path, alive)
        state = state.replace(adjacency=near)
    counts = {
        f"env/{name}": (value * steps.alive).sum()
        for name, value in (
            ("terminated", steps.terminated),
            ("non_finite", steps.non_finite),
            ("overflow", steps.overflow),
            ("obs_non_finite", ~(jnp.isfinite(steps.obs) & jnp.isfinite(steps.next_obs)).all(axis=-1)),
        )
    }
    streams = episode.restart_ended(spec, env, streams, steps, key=reset_key)
    return (state.replace(controller=controller_state), streams), (transition, (decision, outcome), metrics, counts)


def _command_better(
    config: AgentConfig, state: TrainState, allowed: Successors, decision: Decision, number: Array
) -> CommanderState:
    """The Commander after the decisions that ended with segment `number` of the episode."""
    learnt = commander.observe(config.commander, state.commander, allowed, decision, margin=config.sgim.margin)
    if learnt.model is None:
        return learnt

    period = config.commander.period // config.tutor.period
    plan = partial(_plan, config, state, allowed)
    return jax.lax.cond(number % period == period - 1, plan, lambda same: same, learnt)


def _plan(config: AgentConfig, state: TrainState, allowed: Successors, learnt: CommanderState) -> CommanderState:
    """The Commander `learnt`, with values by what it knows now."""
    return commander.plan(config.commander, learnt, allowed, believed=episode.believed(config, state))


def _learn_between_episodes(
    config: AgentConfig,
    spec: Spec,
    state: TrainState,
    known: Model | None,
    finished: tuple[Decision, Outcome],
    num_envs: int,
    *,
    key: Array,
) -> tuple[TrainState, Metrics]:
    """Let the forward model learn from the epoch's periods, refine the abstraction, and plan in it.

    `known` is the Commander's model of before the epoch.
    """
    pick_key, train_key, refine_key = jax.random.split(key, 3)
    commander_metrics = commander.measure(
        config.commander, state.commander, episode.successors(config, state), finished[0]
    )
    periods = num_envs * (spec.episode_length // config.commander.period)
    decision, outcome = _complete(finished, min(periods, config.forward_model.buffer_size), key=pick_key)
    goals = refinement.Goals.of(outcome, decision.at_goal, radius=spec.success_radius)
    if config.forward_model.boxes == "reached":
        lower, upper = (corner[decision.next_region] for corner in (state.abstraction.lower, state.abstraction.upper))
        outcome = outcome.replace(lower=lower, upper=upper)
    error = forward_model.errors(config.forward_model, state.forward_model, outcome)
    counted = outcome.weight * (1 - decision.aside) * (decision.at_goal == (decision.region == decision.target))
    graph = refinement.observe(
        config, state.graph, region=decision.region, target=decision.target, error=error, weight=counted
    )
    model, model_metrics = forward_model.train(config.forward_model, state.forward_model, outcome, key=train_key)
    state = state.replace(forward_model=model, graph=graph)
    refine_metrics: Metrics = {}
    if config.refinement.enabled:
        before = state.abstraction
        state, refine_metrics = refine(config, spec, state, goals, key=refine_key)
        state = state.replace(commander=_command_in_parts(config, state, before, known, *finished))
    state = state.replace(commander=commander.fade(config.commander, state.commander))
    if state.commander.model is not None:
        state = state.replace(commander=_plan(config, state, episode.successors(config, state), state.commander))
    metrics = (
        _prefix("commander", commander_metrics)
        | _prefix("forward_model", model_metrics | {"error": jnp.sqrt(weighted_mean(error, outcome.weight))})
        | _prefix("refinement", refine_metrics)
        | {"abstraction/regions": state.abstraction.count}
    )
    return state, metrics


def refine(
    config: AgentConfig, spec: Spec, state: TrainState, goals: refinement.Goals, *, key: Array
) -> tuple[TrainState, Metrics]:
    """Examine pairs, cut regions, and let the tables of SGIM follow every cut."""
    abstraction, graph, splits, metrics = refinement.refine(
        config,
        state.abstraction,
        state.graph,
        state.forward_model,
        goals,
        radius=spec.success_radius,
        weight=1.0 if state.sgim is None else strategies.urgency(config.sgim, state.sgim),
        key=key,
    )

    def follow(known: SgimState, split: refinement.Split) -> tuple[SgimState, None]:
        parts, _ = regions.split(known.abstraction, split.cut, min_width=0.0)
        after = selection.on_split(known, parts, parent=split.parent, child=split.child)
        return where(split.done, after, known), None

    known = None if state.sgim is None else jax.lax.scan(follow, state.sgim, splits)[0]
    return state.replace(abstraction=abstraction, graph=graph, sgim=known), metrics


def _command_in_parts(
    config: AgentConfig,
    state: TrainState,
    before: Abstraction,
    known: Model | None,
    decision: Decision,
    outcome: Outcome,
) -> CommanderState:
    """The Commander in today's regions, after an epoch with those of `before` and the model `known` at its start."""
    find = partial(regions.locate, state.abstraction)
    goal_region = find(decision.goal)
    cells = decision.replace(
        region=find(outcome.start),
        next_region=find(outcome.end),
        goal_region=goal_region,
        target=jnp.where(decision.at_goal, goal_region, decision.target),
    )
    origin = regions.origins(before, state.abstraction)
    return commander.on_refined(config.commander, state.commander, known, decision, cells, origin)


def _controller_rollout(
    config: AgentConfig, spec: Spec, steps: Steps, *, env_steps: Float[Array, ""] | float
) -> Transition:
    observe = partial(controller.observe, config.controller, spec)
    last = jnp.zeros_like(steps.alive).at[-1].set(1.0)
    reward = controller.reward(config.controller, steps.subgoal, steps.next_subgoal, size=len(spec.scale))
    price = controller.price(config.controller, spec, steps.next_obs, steps.terminated, env_steps=env_steps)
    return Transition(
        obs=observe(spec.state(steps.obs), steps.subgoal),
        action=steps.action,
        reward=reward - price,
        next_obs=observe(spec.state(steps.next_obs), steps.next_subgoal),
        terminated=steps.terminated,
        cut=jnp.maximum(last, steps.ended),
        weight=steps.alive,
        extras=_later(spec, steps) if config.controller.hindsight else (),
    )


def _later(spec: Spec, steps: Steps) -> Float[Array, "l B 2 p"]:
    """Where the agent was at the end of the segment, seen from before and from after each of its env steps."""
    before, after = spec.pose(steps.obs), spec.pose(steps.next_obs)
    return jnp.stack([after[-1] - before, after[-1] - after], axis=-2)


def _in_hindsight(config: AgentConfig, spec: Spec, batch: Transition, key: Array) -> Transition:
    """Half of the replayed transitions as if what the agent reached had been its subgoal (Andrychowicz et al. 2017)."""
    p = len(spec.scale)
    size = p if config.tutor.enabled else 2 * p
    reached = batch.extras
    if size != p:
        reached = Box.around(reached, config.commander.goal_margin).corners
    before, after = reached[:, 0], reached[:, 1]
    reward = partial(controller.reward, config.controller, size=p)
    price = reward(batch.obs[:, -size:], batch.next_obs[:, -size:]) - batch.reward  # does not depend on the subgoal
    replaced = jax.random.bernoulli(key, 0.5, batch.reward.shape)

    relabelled = batch.replace(
        obs=batch.obs.at[:, -size:].set(before),
        next_obs=batch.next_obs.at[:, -size:].set(after),
        reward=reward(before, after) - price,
    )
    return where(replaced, relabelled, batch)


def _tutor_transition(
    config: AgentConfig, spec: Spec, streams: Streams, began: Array, action: Array, steps: Steps
) -> Transition:
    """The Tutor's decision at `began`; `streams` stand at the end of its segment, still under its target box."""
    observe = partial(tutor.observe, config.tutor)
    path = jnp.concatenate([began[None], steps.next_obs])
    achieved = spec.pose(path)
    distances = jnp.linalg.norm(spec.abstract(path) - streams.box.centre, axis=-1)
    terminated, ended = (jnp.max(flag * steps.alive, axis=0) for flag in (steps.terminated, steps.ended))
    extras: Any = achieved[0] if config.tutor.adjacency.enabled else ()
    if config.tutor.off_policy_correction:
        swap = partial(jnp.swapaxes, axis1=0, axis2=1)
        extras = Trace(states=swap(spec.state(steps.obs)), actions=swap(steps.action), achieved=swap(achieved))
    end = steps.next_obs[-1]
    weight = jnp.ones_like(terminated)
    if streams.lesson is not None:
        weight *= ~strategies.babbles(config.sgim, streams.lesson)
        if config.sgim.shows_subgoals:  # somebody else's, to be imitated
            weight *= ~strategies.guided(config.sgim, streams.lesson)
    return Transition(
        obs=observe(spec.state(began), spec.abstract(began), streams.box),
        action=action,
        reward=tutor.reward(config.tutor, distances, steps.alive) - config.tutor.termination_penalty * terminated,
        next_obs=observe(spec.state(end), spec.abstract(end), streams.box),
        terminated=terminated,
        cut=jnp.maximum(streams.clock == 0, ended) if config.commander.enabled else ended,
        weight=weight,
        extras=extras,
    )


def finished_period(
    config: AgentConfig, spec: Spec, state: TrainState, streams: Streams, steps: Steps
) -> tuple[Decision, Outcome]:
    """The Commander's decisions that came to their end with this segment; weight 0 elsewhere."""
    end = spec.abstract(steps.next_obs[-1])
    lesson = streams.lesson
    lost = jnp.max(steps.terminated * steps.alive, axis=0)
    early = jnp.maximum(steps.ended[-1], lost)  # what is lost in the last step of an episode has not `ended` early
    whole_segment = steps.alive[-1] * (1 - early)
    if lesson is not None:  # random subgoals tell nothing of where commands lead
        mine = ~strategies.babbles(config.sgim, lesson)
        whole_segment, lost = whole_segment * mine, lost * mine
    weight = jnp.where(streams.clock == 0, whole_segment, 0.0)
    decision = Decision(
        region=streams.region,
        goal_region=streams.goal_region,
        target=streams.target,
        reward=streams.reward,
        next_region=regions.locate(state.abstraction, end),
        weight=weight,
        lost=lost,
        practised=(streams.practice >= 0).astype(weight.dtype),
        aside=streams.waypoint.astype(weight.dtype),
        goal=spec.goal_point(steps.obs[0]),
        shown=None if lesson is None else strategies.guided(config.sgim, lesson).astype(weight.dtype),
    )
    outcome = Outcome(start=streams.start, lower=streams.box.lower, upper=streams.box.upper, end=end, weight=weight)
    return decision, outcome


def _complete(finished: Any, size: int, *, key: Array) -> Any:
    """A random `size` of the complete ones among all recorded periods, first by weight."""
    weight = finished[1].weight
    order = jnp.argsort(weight + jax.random.uniform(key, weight.shape, maxval=0.5), descending=True)[:size]
    return jax.tree.map(lambda x: x[order], finished)


def _relabel(config: AgentConfig, spec: Spec, state: TrainState) -> Any:
    """The Tutor's off-policy correction under today's Controller."""

    def mean_action(states: Array, subgoals: Array) -> Array:
        seen = controller.observe(config.controller, spec, states, subgoals)
        return learners.act(config.controller, state.controller, seen, deterministic=True, key=state.key)

    def relabel(batch: Transition, key: Array) -> Transition:
        return tutor.correct(config.tutor, batch, spec.scale, mean_action, key=key)

    return relabel


def _penalty(config: AgentConfig, spec: Spec, state: TrainState) -> Penalty:
    """The price of subgoals that are not adjacent to where they are set."""
    known = state.adjacency
    assert known is not None

    def price(batch: Transition, action: Array) -> Array:
        start = batch.extras.achieved[..., 0, :] if config.tutor.off_policy_correction else batch.extras
        d = len(spec.abstract_indices)
        return adjacency.penalty(config.tutor.adjacency, known, start[..., :d], (action * spec.scale)[..., :d])

    return price


def _env_steps(spec: Spec, env: VectorEnv, state: TrainState) -> Float[Array, ""]:
    return state.epoch.astype(jnp.float32) * (spec.episode_length * env.num_envs)


def _episode_metrics(name: str, episode: Episode, weight: Array) -> Metrics:
    return {
        f"{name}/success_any": weighted_mean(episode.success_any, weight),
        f"{name}/success_final": weighted_mean(episode.success_final, weight),
        f"{name}/distance": weighted_mean(episode.distance, weight),
        f"{name}/return": weighted_mean(episode.total, weight),
    }


def _prefix(level: str, metrics: Metrics) -> Metrics:
    return {f"{level}/{name}": value for name, value in metrics.items()}
