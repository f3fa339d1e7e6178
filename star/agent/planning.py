"""Planning on a learnt model of the regions, the Commander's default learner.

The end of a region's command does not depend on the goal, so decisions teach about all other goals. Counts of
(i, j) -> i' and mean rewards make a model of the regions, on which value iteration runs once a period:

    Q[i, g, j] <- r[i, g, j] + gamma sum_i' P(i' | i, j) max_j' Q[i', g, j']

Commanding the goal's own region is another thing, for the Tutor is then given the goal: P(i' | i, g) is counted apart,
and believed to be as where the goal is elsewhere.
The probabilities of i' sum to less than 1 where episodes were lost (terminated). An untried command is believed to
succeed: a command leads to its target if the graph says so or the boxes touch, and who aims at a goal within his own
region gets there. This belief weighs `prior` decisions, and e^(-n / prior) of that after n decisions. After cuts of
regions, the epoch's decisions are counted anew by today's regions, and older ones are shared out by where periods began
and ended (`follow`). Greedy episodes, in which nothing is learnt, follow a plan with hardly any belief (`settle`).

Source: optimistic model, R-max (Brafman and Tennenholtz 2002).
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from star.abstraction import regions
from star.abstraction.regions import Change, Near, Places
from star.agent import values
from star.agent.decisions import Decision, Finished, Roadmap, Successors
from star.agent.sections import CommanderConfig
from star.agent.values import CommanderState, Model

_HUNCH = 0.1  # what belief is worth where nothing is to be tried
_TOGETHER = 32  # goal regions whose values are iterated at once
_KEPT = 20.0  # decisions of a command that do not fade, since rare ones would be forgotten before they are enough


def init(*, regions: int, near: int) -> Model:
    """Nothing counted."""
    cube = jnp.zeros((regions, near, near))
    both = jnp.stack([cube, cube])
    return Model(led=both, rewards=cube, visits=cube, lost=both[:, :, 0])


def observe(
    section: CommanderConfig, state: CommanderState, roadmap: Roadmap, batch: Decision, *, margin: Array | float = 0.0
) -> CommanderState:
    """Count what the streams decided at one instant; teachers count like all others."""
    return state.replace(model=_counted(roadmap.allowed.near, _model(state), batch, cells=batch))


def plan(
    section: CommanderConfig,
    state: CommanderState,
    roadmap: Roadmap,
    *,
    goals: Int[Array, "N"] | None = None,
    due: Bool[Array, ""] | None = None,
) -> CommanderState:
    """Values by what is known now, where it is `due` (None: now), for goals in the regions `goals` (None: in all)."""
    now = partial(_plan, section, roadmap, state, goals)
    return state.replace(q=now() if due is None else jax.lax.cond(due, now, lambda: state.q))


def _plan(
    section: CommanderConfig, roadmap: Roadmap, state: CommanderState, goals: Int[Array, "N"] | None
) -> Float[Array, "R R S"]:
    """Q by `section.sweeps` sweeps of value iteration on the model, from the values of last time.

    As long as nothing is known, region j is held reachable from i where `believed` [i, j], and who aims at a goal in
    his own region is taken to succeed (or, with rewards that are negative, to lose nothing anywhere).
    """
    chances, reward = _expectations(section, _model(state), roadmap, belief=1.0)
    every = jnp.arange(len(state.q))
    iterated = partial(_iterated, section, roadmap.allowed, chances, sweeps=section.sweeps)
    if goals is None or len(every) <= _TOGETHER:
        return iterated(state.q, reward, every)
    wanted = jnp.zeros(len(every), bool).at[goals].set(True)
    beyond = jnp.full(-len(every) % _TOGETHER, len(every))  # neither read nor written
    parts = jnp.concatenate([jnp.argsort(~wanted, stable=True), beyond]).reshape(-1, _TOGETHER)

    def one(number: Array, q: Array) -> Array:
        some = parts[number]
        return q.at[:, some].set(iterated(q[:, some], reward[:, some], some))

    return jax.lax.fori_loop(0, -(-wanted.sum() // _TOGETHER), one, state.q)


def settle(section: CommanderConfig, state: CommanderState, roadmap: Roadmap, *, periods: int) -> CommanderState:
    """The Commander for greedy episodes of so many `periods`, with Q by what commands have led to.

    The belief that what was not tried succeeds makes agents try it, which is of no use where nothing is learnt: here it
    only decides among what is unknown, and none of it is left over, as this plan begins from nothing. Q stays as it is
    with rewards by distance, of which nothing is the best.
    """
    if section.reward != "success":
        return state
    chances, reward = _expectations(section, _model(state), roadmap, belief=_HUNCH)
    nothing, every = jnp.zeros_like(state.q), jnp.arange(len(state.q))
    return state.replace(q=_iterated(section, roadmap.allowed, chances, nothing, reward, every, sweeps=periods))


def fade(section: CommanderConfig, state: CommanderState) -> Model:
    """Let one epoch pass: the lower levels have learnt, so old decisions count less, but for the last `_KEPT`."""
    model = _model(state)
    left = lambda number: jnp.maximum(section.memory, _KEPT / jnp.maximum(number, _KEPT))  # noqa: E731
    of_commands, of_pursuits = left(model.led.sum(axis=-1) + model.lost), left(model.visits)
    return model.replace(
        led=model.led * of_commands[..., None],
        lost=model.lost * of_commands,
        rewards=model.rewards * of_pursuits,
        visits=model.visits * of_pursuits,
    )


def follow(
    section: CommanderConfig,
    state: CommanderState,
    change: Change,
    places: Places,
    earlier: Model,
    finished: Finished,
    traffic: Float[Array, "R R"],
) -> Model:
    """The model after an epoch whose regions were cut, so that region j of today is (a part of) `origin` [j] of then.

    It becomes the `earlier` one, with which the epoch began, and all decisions of the epoch, `finished`, counted anew
    by today's regions. `traffic` says how many periods, of all that are remembered, led from each of them into each.
    """
    find = partial(regions.locate, change.after)
    decision, outcome = finished
    goal_region = find(decision.goal)
    cells = decision.replace(
        region=find(outcome.start),
        next_region=find(outcome.end),
        goal_region=goal_region,
        target=jnp.where(decision.at_goal, goal_region, decision.target),
    )
    return recounted(section, earlier, decision, cells, places, traffic)


def recounted(
    section: CommanderConfig,
    earlier: Model,
    batch: Decision,
    cells: Decision,
    places: Places,
    traffic: Float[Array, "R R"],
) -> Model:
    """The `earlier` model and the decisions of `batch`.

    `cells` holds them with today's regions, but for the targets, which count as all their parts unless they were goals.
    """
    origin, now = places.origin, places.now
    counted = _counted(now, jax.tree.map(jnp.zeros_like, earlier), batch, cells=cells)
    beside, own = _beside(now, origin), jnp.eye(now.region.shape[1], dtype=bool)
    whole = jnp.take_along_axis(now.place, origin[now.region], axis=1)  # the place of what keeps the older index
    of_whole = partial(regions.moved, places=whole)
    to_parts = lambda table: table.at[0].set(of_whole(table[0], axis=1))  # noqa: E731
    in_pursuit = lambda table: jnp.where(own, table, jnp.where(beside, 0.0, of_whole(table, axis=2)))  # noqa: E731
    new = counted.replace(
        led=to_parts(counted.led),
        lost=to_parts(counted.lost),
        rewards=in_pursuit(counted.rewards),
        visits=in_pursuit(counted.visits),
    )
    old = _inherited(section, earlier, traffic, places)
    return jax.tree.map(jnp.add, old, new)


def _counted(near: Near, model: Model, batch: Decision, *, cells: Decision) -> Model:
    """`model` with the decisions of `batch`, in the tables' cells that the regions of `cells` say.

    What led to a region that is not near has no cell and is not counted.
    """
    direct = 1 - batch.aside
    telling = jnp.maximum(batch.weight, batch.lost) * direct
    place = lambda region: near.place[cells.region, region]  # noqa: E731
    command = (batch.at_goal.astype(jnp.int32), cells.region, place(cells.target))
    pursuit = (cells.region, place(cells.goal_region), place(cells.target))
    return model.replace(
        led=model.led.at[*command, place(cells.next_region)].add(batch.weight * direct),
        rewards=model.rewards.at[pursuit].add(telling * batch.reward),
        visits=model.visits.at[pursuit].add(telling),
        lost=model.lost.at[command].add(batch.lost * direct),
    )


def _expectations(
    section: CommanderConfig, model: Model, roadmap: Roadmap, *, belief: float
) -> tuple[Float[Array, "2 R S S"], Float[Array, "R R S"]]:
    """P(i' | i, j) by aim, and r[i, g, j]: what was counted, and `belief` in what was not, else staying in place.

    Nothing is earned where the goal is not near.
    """
    near, believed = roadmap.allowed.near, roadmap.believed
    own = near.home.astype(model.led.dtype)
    there, here = jnp.eye(believed.shape[1])[None], own[:, None]
    expected = jnp.where(believed[..., None], belief * there + (1 - belief) * here, here)
    number = model.led.sum(axis=-1) + model.lost
    weight = _weight_of_belief(section, number)[..., None]
    counted = number[..., None] + weight
    to_region = (model.led[0] + weight[0] * expected) / counted[0]
    to_goal = (model.led[1] + weight[1] * to_region) / counted[1]
    chances = jnp.stack([to_region, to_goal])
    arrived = (section.reward == "success") * belief * own[:, :, None] * own[:, None]
    weight = _weight_of_belief(section, model.visits)
    reward = (model.rewards + weight * arrived) / (model.visits + weight)
    return chances, regions.moved(reward, near.place, axis=1)


def _weight_of_belief(section: CommanderConfig, number: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Weight of the belief in a command, in decisions, after a `number` of them.

    It fades faster than its share in a mean would. Who may try again and again needs no more than a small chance to
    find the way through a wall better than the long one around it.
    """
    return section.prior * jnp.exp(-number / section.prior)


def _iterated(
    section: CommanderConfig,
    allowed: Successors,
    chances: Float[Array, "2 R S S"],
    q: Float[Array, "R G S"],
    reward: Float[Array, "R G S"],
    goals: Int[Array, "G"],
    *,
    sweeps: int,
) -> Float[Array, "R G S"]:
    """The values `q` of the regions `goals` after sweeps of value iteration."""
    (to_region, to_goal), near = chances, allowed.near.region
    product = partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)
    at_goal = near[:, None] == goals[None, :, None]
    column = jnp.zeros(len(near), jnp.int32).at[goals].set(jnp.arange(len(goals)))[near]

    def sweep(q: Array, _: None) -> tuple[Array, None]:
        future = values.best(q, allowed, goals)[near]
        later = product("ijn,ing->igj", to_region, future)
        there = product("ijn,inj->ij", to_goal, jnp.take_along_axis(future, column[:, None], axis=2))
        return reward + section.discount * jnp.where(at_goal, there[:, None], later), None

    return jax.lax.scan(sweep, q, None, length=sweeps)[0]


def _inherited(section: CommanderConfig, earlier: Model, traffic: Float[Array, "R R"], places: Places) -> Model:
    """Counts of before the epoch in which regions were cut, by those of after it.

    Nobody knows any more which command led from where to where within the regions of then. But how many periods led
    from each part into each is known by `traffic`, and by that the counts are shared out: nothing leads through a wall
    where nothing ever did. What began in a part is but a belief in what happens there, of `section.prior` decisions at
    most, as is what aiming at the goal pays in its own part. What goals elsewhere paid is forgotten: nobody knows in
    which part they were, and one success in fifteen, believed of the wrong part, holds agents before a wall.
    """
    origin, now = places.origin, places.now
    moved, together = partial(regions.moved, places=places.parts), partial(regions.over_parts, origin=origin)
    cut = together(jnp.ones(len(origin))) > 1
    share = jnp.where(cut[:, None] | cut, traffic / jnp.maximum(together(traffic), 1.0), 1.0)
    began = traffic.sum(axis=1)
    of_part = jnp.where(cut, began / jnp.maximum(together(began), 1.0), 1.0)
    led = moved(moved(earlier.led[:, origin], axis=2, rows=1), axis=3, rows=1) * now.pairs(share)[:, None]
    lost = moved(earlier.lost[:, origin], axis=2, rows=1) * of_part[:, None]
    either = now.pairs(cut[:, None] | cut)
    elsewhere = either & ~now.home
    kept = jnp.where(elsewhere[..., None] | _beside(now, origin), 0.0, of_part[:, None, None])
    rewards, visits = (
        moved(moved(table[origin], axis=1), axis=2) * kept for table in (earlier.rewards, earlier.visits)
    )

    doubt = lambda number: section.prior / jnp.maximum(number, section.prior)  # noqa: E731
    of_commands = jnp.where(cut[:, None], doubt(led.sum(axis=-1) + lost), 1.0)
    of_pursuits = jnp.where(either[..., None], doubt(visits), 1.0)
    return earlier.replace(
        led=led * of_commands[..., None],
        lost=lost * of_commands,
        rewards=rewards * of_pursuits,
        visits=visits * of_pursuits,
    )


def _beside(near: Near, origin: Int[Array, "R"]) -> Bool[Array, "R S S"]:
    """Mask of pairs, of those near a region, that are parts of one older region."""
    of = origin[near.region]
    return (of[:, :, None] == of[:, None]) & ~jnp.eye(of.shape[1], dtype=bool)


def _model(state: CommanderState) -> Model:
    assert state.model is not None
    return state.model
