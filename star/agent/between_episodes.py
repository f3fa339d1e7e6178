"""Learning about the regions between two episodes, once all periods of the epoch are known.

    forward model    learns from the epoch's complete periods, after its error on them was measured
    refinement       examines pairs of regions and cuts some
    Commander, SGIM  follow the cuts; the Commander fades and plans anew

Periods cut short by the end of an episode teach the forward model nothing, because they did not last k steps; unless
success ended it, where the agent counts as having stayed.
"""

from __future__ import annotations

from types import ModuleType

import jax
import jax.numpy as jnp
from jaxtyping import Array

from star.abstraction import forward_model, refinement
from star.abstraction.forward_model import Outcome
from star.agent import commander
from star.agent.decisions import Decision, Finished, Roadmap
from star.agent.sections import AgentConfig
from star.agent.state import TrainState, Upcoming
from star.agent.values import CommanderState
from star.learners.replay import weighted_mean
from star.spec import Spec

Metrics = dict[str, Array]

_CELLS = 32  # of the grid on which ground is counted, along each dimension


def learn(
    config: AgentConfig,
    spec: Spec,
    guide: ModuleType,
    state: TrainState,
    *,
    known: CommanderState,
    finished: Finished,
    num_envs: int,
    env_steps: Array,
    key: Array,
) -> tuple[TrainState, Metrics]:
    """The state after an epoch with the periods `finished` [N] in its regions, and its `upcoming` with new cuts.

    `known` is the Commander before the epoch, and `env_steps` are those of all environments before it.
    """
    section = config.commander
    pick_key, train_key, refine_key = jax.random.split(key, 3)
    roadmap = Roadmap.of(section, state.abstraction, state.graph)
    metrics = {
        f"commander/{k}": x for k, x in commander.measure(section, state.commander, roadmap, finished[0]).items()
    }
    metrics["commander/ground"] = _ground(spec, finished.outcome)
    periods = num_envs * (spec.episode_length // section.period)
    decision, outcome = _complete(finished, periods, key=pick_key)
    goals = outcome.replace(weight=outcome.weight * decision.at_goal)
    state, more = _learn_where_commands_lead(config, state, decision, outcome, key=train_key)
    metrics |= more
    later = state
    if config.refinement.enabled:
        later, more = refine(config, spec, guide, state, goals, known=known, finished=finished, key=refine_key)
        metrics |= more
    roadmap = Roadmap.of(section, later.abstraction, later.graph)
    planned = commander.plan(section, commander.fade(section, later.commander), roadmap)
    metrics |= {
        "abstraction/regions": state.abstraction.count,
        "commander/epsilon": commander.epsilon(section, env_steps),
    }
    return state.replace(upcoming=Upcoming.of(later.replace(commander=planned))), metrics


def nothing(config: AgentConfig, spec: Spec, guide: ModuleType, state: TrainState, **_: object) -> tuple:
    """Without a Commander nobody needs regions: the next epoch begins with the state as it is, no metrics."""
    return state.replace(upcoming=Upcoming.of(state)), {}


def refine(
    config: AgentConfig,
    spec: Spec,
    guide: ModuleType,
    state: TrainState,
    goals: Outcome,
    *,
    known: CommanderState,
    finished: Finished,
    key: Array,
) -> tuple[TrainState, Metrics]:
    """Examine pairs and cut regions; the Commander and SGIM follow."""
    graph, change, metrics = refinement.refine(
        config,
        state.abstraction,
        state.graph,
        state.forward_model,
        goals,
        cube=spec.cube,
        weight=guide.urgency(config.sgim, state.sgim),
        key=key,
    )
    traffic = forward_model.traffic(state.forward_model, change.after)
    state = state.replace(
        abstraction=change.after,
        graph=graph,
        commander=commander.follow(config.commander, state.commander, change, known, finished, traffic),
        sgim=guide.follow(state.sgim, change),
    )
    return state, {f"refinement/{name}": value for name, value in metrics.items()}


def _learn_where_commands_lead(
    config: AgentConfig, state: TrainState, decision: Decision, outcome: Outcome, *, key: Array
) -> tuple[TrainState, Metrics]:
    """The forward model after complete periods, and the graph with how well it had predicted them."""
    section = config.forward_model
    if section.boxes == "reached":
        lower, upper = (corner[decision.next_region] for corner in (state.abstraction.lower, state.abstraction.upper))
        outcome = outcome.replace(lower=lower, upper=upper)
    error = forward_model.errors(section, state.forward_model, outcome)
    counted = outcome.weight * (1 - decision.aside) * (decision.at_goal == (decision.region == decision.target))
    graph = refinement.observe(
        config, state.graph, region=decision.region, target=decision.target, error=error, weight=counted
    )
    kept = jax.tree.map(lambda x: x[: section.buffer_size], outcome)  # they are in random order
    model, metrics = forward_model.train(section, state.forward_model, kept, key=key)
    metrics |= {"error": jnp.sqrt(weighted_mean(error, outcome.weight))}
    return state.replace(forward_model=model, graph=graph), {
        f"forward_model/{name}": value for name, value in metrics.items()
    }


def _ground(spec: Spec, outcome: Outcome) -> Array:
    """The share of the cells of a grid over the first two dimensions of the space in which periods ended."""
    lower, upper = (jnp.asarray(corner)[:2] for corner in spec.space)
    share = (outcome.end[..., :2] - lower) / (upper - lower)
    cells = jnp.clip(jnp.floor(_CELLS * share), 0, _CELLS - 1).astype(jnp.int32)
    occupied = jnp.zeros((_CELLS,) * len(lower)).at[tuple(jnp.moveaxis(cells, -1, 0))].max(outcome.weight)
    return jnp.mean(occupied > 0)


def _complete(finished: Finished, size: int, *, key: Array) -> Finished:
    """`size` of all recorded periods in random order, but the complete ones first."""
    weight = finished.outcome.weight
    order = jnp.argsort(weight + jax.random.uniform(key, weight.shape, maxval=0.5), descending=True)[:size]
    return jax.tree.map(lambda x: x[order], finished)
