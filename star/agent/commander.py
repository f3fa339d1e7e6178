"""The Commander: chooses the target region, every k env steps, from a table of values over regions.

    target  <- epsilon-greedy in Q[region, goal region, .] over the successors that reachability allows

After k steps it learns in one of two ways. Q-learning (`q`, published), with r = max over them of -||g* - s||:

    Q[i, g, j] <- Q + alpha_n (r + gamma max_j' Q[i', g, j'] - Q)

The B environments are B streams of one table: the errors of a cell are averaged over the n decisions of a batch that
visited it, and alpha_n = 1 - (1 - alpha)^n is the step that n updates in a row towards that average would make.

Planning (`model`): where the command of a region leads does not depend on the goal, so decisions teach about all other
goals. Counts of (i, j) -> i' and mean rewards make a model of the regions, on which value iteration runs once a period:

    Q[i, g, j] <- r[i, g, j] + gamma sum_i' P(i' | i, j) max_j' Q[i', g, j']

Commanding the goal's own region is another thing, for the Tutor is then given the goal: P(i' | i, g) is counted apart,
and believed to be as where the goal is elsewhere.
The probabilities of i' sum to less than 1 where episodes were lost (terminated). What was not tried is believed to
succeed: a command leads to its target if the graph says so or the boxes touch, and who aims at a goal within his own
region gets there. `prior` decisions weigh as much as this belief. Where regions were cut, the epoch's decisions are
counted anew by today's regions (`on_refined`). Greedy episodes, in which nothing is learnt, follow a plan with hardly
any of it (`settle`).

A share of the environments practises: they pursue random regions instead of the goal, by the same plan with another
reward, 1 in the region pursued. What is hard to reach, and so unattractive to all others, is tried there.

Source: STAR (ICLR 2024), section 4.1; optimistic model: R-max (Brafman and Tennenholtz 2002).
"""

from __future__ import annotations

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from star.agent.sections import CommanderConfig
from star.learners.replay import weighted_mean

Metrics = dict[str, Array]

_HUNCH = 0.1  # what belief is worth where nothing is to be tried
_HABIT = 0.1  # share by which a command that nobody follows has to be better than the usual one


class Model(struct.PyTreeNode):
    """Fading counts of where commands led, and of the rewards on the way."""

    led: Float[Array, "2 R R R"]
    """Decisions by aim (0: the target region, 1: the goal in it), region, target and next region."""
    rewards: Float[Array, "R R R"]
    """Sums of rewards by region, goal region and target, of those that ended an episode too."""
    visits: Float[Array, "R R R"]
    """Decisions by region, goal region and target, with those that ended an episode."""
    lost: Float[Array, "2 R R"]
    """Decisions by aim, region and target during which the episode was terminated."""
    reach: Float[Array, "R R R"]
    """Values like Q for those who practise: discounted chances of being in the pursued region."""


class CommanderState(struct.PyTreeNode):
    """Q over (region, goal region, target region), how often each target was chosen of late, and any `model`."""

    q: Float[Array, "R R R"]
    chosen: Float[Array, "R"]
    model: Model | None = None


class Decision(struct.PyTreeNode):
    """Finished periods of N streams.

    `weight` is 1 where the period really lasted k env steps, `lost` is 1 where the task was terminated in it,
    `practised` is 1 where a random region was pursued instead of the goal, `aside` is 1 where what was commanded was a
    waypoint, which tells nothing of its region, and `shown` is 1 where a teacher chose the target. The reward is that
    for the goal, which was at the point `goal`.
    """

    region: Int[Array, "N"]
    goal_region: Int[Array, "N"]
    target: Int[Array, "N"]
    reward: Float[Array, "N"]
    next_region: Int[Array, "N"]
    weight: Float[Array, "N"]
    lost: Float[Array, "N"]
    practised: Float[Array, "N"]
    aside: Float[Array, "N"]
    goal: Float[Array, "N d"]
    shown: Float[Array, "N"] | None = None

    @property
    def at_goal(self) -> Bool[Array, "N"]:
        """Whether the Tutor was given the goal, not the bounds of a region."""
        return (self.target == self.goal_region) & (self.practised == 0) & (self.aside == 0)


class Successors(struct.PyTreeNode):
    """Which targets may follow a region: `greedy` for the best choice, `explore` for the random one.

    Besides, the region of a goal, or one that is practised, may always follow itself.
    """

    greedy: Bool[Array, "R R"]
    explore: Bool[Array, "R R"]


def init(config: CommanderConfig, *, regions: int) -> CommanderState:
    """Q = 0 everywhere, optimistic for rewards that are negative, and an empty model."""
    cube = jnp.zeros((regions, regions, regions))
    model = None
    if config.learner == "model":
        both = jnp.stack([cube, cube])
        model = Model(led=both, rewards=cube, visits=cube, lost=both[:, 0], reach=cube)
    return CommanderState(q=cube, chosen=jnp.zeros(regions), model=model)


def successors(
    mode: Literal["all", "any", "possible", "known"],
    *,
    reaches: Bool[Array, "R R"],
    misses: Bool[Array, "R R"],
    active: Bool[Array, "R"],
) -> Successors:
    """Targets allowed from each region by what is known of reachability.

    Random choices leave out the targets shown unreachable. Greedy ones are made among all targets (`any`) or among
    those not shown unreachable (`possible`). A region may be its own target. With `known`, as published, both are made
    among others shown reachable, if there are any. With `all` nothing is left out.
    """
    pairs = active[:, None] & active[None, :]
    own = jnp.eye(active.shape[0], dtype=bool)
    possible = pairs & (~misses | own)
    if mode == "all":
        return Successors(greedy=pairs, explore=pairs)
    if mode != "known":
        return Successors(greedy=pairs if mode == "any" else possible, explore=possible)
    known = pairs & reaches & ~own
    chosen = jnp.where(known.any(axis=1, keepdims=True), known, possible)
    return Successors(greedy=chosen, explore=chosen)


def epsilon(config: CommanderConfig, env_steps: Float[Array, ""]) -> Float[Array, ""]:
    """Share of random choices after `env_steps` of all environments: linear, then constant."""
    progress = jnp.clip(env_steps / config.epsilon_steps, 0.0, 1.0)
    return config.epsilon_start + progress * (config.epsilon_end - config.epsilon_start)


def spread(config: CommanderConfig, share: Float[Array, ""], *, num_envs: int) -> Float[Array, "B"]:
    """Share of random choices of each environment, `share` on average.

    Spread from none to twice as much (or as evenly around `share` as shares allow), some environments walk a long way
    to its end while others leave it often (as in Ape-X, Horgan et al. 2018).
    """
    even = (2 * jnp.arange(num_envs) + 1) / num_envs - 1
    return share + config.epsilon_spread * even * jnp.minimum(share, 1 - share)


def practice(config: CommanderConfig) -> Float[Array, ""] | float:
    """Share of the environments that practise: none without a Commander, since there is nobody to send them."""
    return config.practice if config.enabled else 0.0


def act(
    state: CommanderState,
    allowed: Successors,
    region: Int[Array, "B"],
    goal_region: Int[Array, "B"],
    *,
    practised: Int[Array, "B"] | None = None,
    attraction: Float[Array, "R"] | None = None,
    worth: Float[Array, "B R"] | None = None,
    epsilon: Float[Array, "B"] | float,
    key: Array,
) -> Int[Array, "B"]:
    """Target regions: with probability `epsilon` any allowed one, else the best, ties broken at random.

    Random ones are drawn evenly, or in proportion to `attraction`. `practised` are regions to pursue instead of the
    goal where they are not negative. `worth`, from 0 to 1, makes less of the values.
    """
    explore_key, random_key, tie_key = jax.random.split(key, 3)
    values = state.q[region, goal_region]
    if worth is not None:
        values -= (1 - worth) * jnp.abs(values)
    if practised is not None:
        reach = state.q if state.model is None else state.model.reach
        values = jnp.where((practised >= 0)[:, None], reach[region, practised], values)
    pursued = goal_region if practised is None else jnp.where(practised >= 0, practised, goal_region)
    best = jnp.where(_targets(allowed.greedy, region, pursued), values, -jnp.inf)
    ties = best >= best.max(axis=-1, keepdims=True)
    greedy = jnp.argmax(jnp.where(ties, jax.random.uniform(tie_key, best.shape), -1.0), axis=-1)
    luck = jax.random.gumbel(random_key, best.shape)
    if attraction is not None:
        luck += jnp.log(jnp.maximum(attraction, 1e-6))
    anything = jnp.where(_targets(allowed.explore, region, pursued), luck, -jnp.inf)
    exploring = jax.random.uniform(explore_key, region.shape) < epsilon
    return jnp.where(exploring, jnp.argmax(anything, axis=-1), greedy)


def observe(
    config: CommanderConfig,
    state: CommanderState,
    allowed: Successors,
    batch: Decision,
    *,
    margin: Float[Array, ""] | float = 0.0,
) -> CommanderState:
    """Take in what the streams decided at one instant: a step of Q-learning, or counts for the model.

    Q-learning also raises what a teacher chose towards `margin` above all else.
    """
    state = state.replace(chosen=state.chosen.at[batch.target].add(batch.weight))
    if state.model is None:
        state = _q_learning(config, state, allowed, batch)
        return state if batch.shown is None else _follow_teacher(config, state, batch, batch.shown, margin)
    return state.replace(model=_counted(state.model, batch, cells=batch))


def _counted(model: Model, batch: Decision, *, cells: Decision) -> Model:
    """`model` with the decisions of `batch`, in the tables' cells that the regions of `cells` say."""
    direct = 1 - batch.aside
    # Who practises and aims at the goal's region aims at its centre, which tells nothing of aiming at the goal.
    beside = batch.practised * (batch.target == batch.goal_region)
    telling = jnp.maximum(batch.weight, batch.lost) * direct * (1 - beside)
    command = (batch.at_goal.astype(jnp.int32), cells.region, cells.target)
    pursuit = (cells.region, cells.goal_region, cells.target)
    return model.replace(
        led=model.led.at[*command, cells.next_region].add(batch.weight * direct),
        rewards=model.rewards.at[pursuit].add(telling * batch.reward),
        visits=model.visits.at[pursuit].add(telling),
        lost=model.lost.at[command].add(batch.lost * direct),
    )


def plan(
    config: CommanderConfig,
    state: CommanderState,
    allowed: Successors,
    *,
    believed: Bool[Array, "R R"],
) -> CommanderState:
    """`config.sweeps` sweeps of value iteration on the model, from the values of last time.

    As long as nothing is known, region j is held reachable from i where `believed` [i, j], and who aims at a goal in
    his own region is taken to succeed (or, with rewards that are negative, to lose nothing anywhere).
    """
    model = state.model
    assert model is not None
    chances, reward = _expectations(config, model, believed, belief=1.0)
    pursued = jnp.broadcast_to(jnp.eye(state.chosen.shape[0])[..., None], reward.shape)
    values, rewards = jnp.stack([state.q, model.reach]), jnp.stack([reward, pursued])
    q, reach = _iterated(config, allowed, values, rewards, chances, sweeps=config.sweeps)
    return state.replace(q=q, model=model.replace(reach=reach))


def settle(
    config: CommanderConfig,
    state: CommanderState,
    allowed: Successors,
    *,
    believed: Bool[Array, "R R"],
    periods: int,
) -> CommanderState:
    """The Commander for greedy episodes of so many `periods`, with Q by what commands have led to.

    The belief that what was not tried succeeds makes agents try it, which is of no use where nothing is learnt: here it
    only decides among what is unknown, and none of it is left over, as this plan begins from nothing. Of commands that
    look about as good the usual one is better known: regions are coarse, and what leads on where agents stood when they
    tried it may lead nowhere from where they enter. So what was chosen less often is worth a little less. Q stays as it
    is without a model, and with rewards by distance, of which nothing is the best.
    """
    if state.model is None or config.reward != "success":
        return state
    chances, reward = _expectations(config, state.model, believed, belief=_HUNCH)
    q = _iterated(config, allowed, jnp.zeros_like(state.q)[None], reward[None], chances, sweeps=periods)[0]
    visits = state.model.visits
    usual = visits / jnp.maximum(visits.max(axis=-1, keepdims=True), 1.0)
    return state.replace(q=q * (1 - _HABIT * (1 - usual)))


def _expectations(
    config: CommanderConfig, model: Model, believed: Bool[Array, "R R"], *, belief: float
) -> tuple[Float[Array, "2 R R R"], Float[Array, "R R R"]]:
    """P(i' | i, j) by aim, and r[i, g, j]: what was counted, and `belief` in what was not, else staying in place."""
    identity = jnp.eye(believed.shape[0])
    there, here = identity[None], identity[:, None]
    expected = jnp.where(believed[..., None], belief * there + (1 - belief) * here, here)
    counted = (model.led.sum(axis=-1) + model.lost + config.prior)[..., None]
    to_region = (model.led[0] + config.prior * expected) / counted[0]
    to_goal = (model.led[1] + config.prior * to_region) / counted[1]
    chances = jnp.stack([to_region, to_goal])
    arrived = (config.reward == "success") * belief * identity[:, :, None] * identity[:, None]
    return chances, (model.rewards + config.prior * arrived) / (model.visits + config.prior)


def _iterated(
    config: CommanderConfig,
    allowed: Successors,
    values: Float[Array, "V R R R"],
    rewards: Float[Array, "V R R R"],
    chances: Float[Array, "2 R R R"],
    *,
    sweeps: int,
) -> Float[Array, "V R R R"]:
    """The tables `values` after sweeps of value iteration, each with its rewards; the first is that of goals."""
    to_region, to_goal = chances
    product = partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)
    own = jnp.eye(values.shape[1], dtype=bool)

    def sweep(values: Array, _: None) -> tuple[Array, None]:
        future = jax.vmap(partial(_best, allowed=allowed.greedy))(values)
        later = product("ijn,vng->vigj", to_region, future)
        at_goal = product("ign,ng->ig", to_goal, future[0])
        later = later.at[0].set(jnp.where(own, at_goal[..., None], later[0]))
        return rewards + config.discount * later, None

    return jax.lax.scan(sweep, values, None, length=sweeps)[0]


def fade(config: CommanderConfig, state: CommanderState) -> CommanderState:
    """Let one epoch pass: the lower levels have learnt, so old decisions count less."""
    model = state.model
    if model is not None:
        model = jax.tree.map(lambda x: config.memory * x, model).replace(reach=model.reach)
    return state.replace(chosen=0.9 * state.chosen, model=model)


def measure(config: CommanderConfig, state: CommanderState, allowed: Successors, batch: Decision) -> Metrics:
    """Mean reward of the decisions in `batch` and their mean absolute error of temporal difference."""
    weight = _towards_goals(batch)
    error = _td_error(config, state, allowed, batch)
    return {"reward": weighted_mean(batch.reward, weight), "td_error": weighted_mean(jnp.abs(error), weight)}


def _q_learning(config: CommanderConfig, state: CommanderState, allowed: Successors, batch: Decision) -> CommanderState:
    error = _td_error(config, state, allowed, batch)
    return _step(config, state, batch, error, weight=_towards_goals(batch))


def _towards_goals(batch: Decision) -> Float[Array, "N"]:
    """The weight of the decisions that pursued the goal of the task by way of a region."""
    return batch.weight * (1 - batch.practised) * (1 - batch.aside)


def _follow_teacher(
    config: CommanderConfig,
    state: CommanderState,
    batch: Decision,
    shown: Float[Array, "N"],
    margin: Float[Array, ""] | float,
) -> CommanderState:
    """A step of the large-margin loss of DQfD (Hester et al. 2018) on the decisions that were shown."""
    row = state.q[batch.region, batch.goal_region]
    chosen = jax.nn.one_hot(batch.target, row.shape[-1])
    lacking = jnp.max(row + margin * (1 - chosen), axis=-1) - jnp.sum(row * chosen, axis=-1)
    return _step(config, state, batch, lacking, weight=batch.weight * shown)


def _step(
    config: CommanderConfig,
    state: CommanderState,
    batch: Decision,
    error: Float[Array, "N"],
    *,
    weight: Float[Array, "N"],
) -> CommanderState:
    """Q after as many updates of each visited cell as its `weight` makes, all towards their mean `error`."""
    cell = (batch.region, batch.goal_region, batch.target)
    visits = jnp.zeros_like(state.q).at[cell].add(weight)
    total = jnp.zeros_like(state.q).at[cell].add(weight * error)
    alpha = 1 - (1 - config.learning_rate) ** visits
    return state.replace(q=state.q + alpha * total / jnp.maximum(visits, 1.0))


def _td_error(
    config: CommanderConfig, state: CommanderState, allowed: Successors, batch: Decision
) -> Float[Array, "N"]:
    """R + gamma max Q' - Q; time limits are not seen here, so every period bootstraps."""
    future = _best(state.q, allowed.greedy)[batch.next_region, batch.goal_region]
    return batch.reward + config.discount * future - state.q[batch.region, batch.goal_region, batch.target]


def worth(config: CommanderConfig, distance: Float[Array, "*n"], success: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The Commander's reward of one env step: whether g* counts as reached, or minus the distance to it.

    Distances deceive in a maze, and where they pay, so does waiting at the near side of a wall.
    """
    return success if config.reward == "success" else -distance


def start_reward(config: CommanderConfig) -> float:
    """What the reward of a period is accumulated from."""
    return -jnp.inf if config.reward == "max" else 0.0


def accumulate(
    config: CommanderConfig,
    reward: Float[Array, "B"],
    external: Float[Array, "l B"],
    alive: Float[Array, "l B"],
) -> Float[Array, "B"]:
    """The reward of periods so far, after l more env steps with rewards `external`; `alive` masks ended ones.

    The maximum is the same whether the agent stays at the goal or leaves it again; the mean tells them apart.
    """
    if config.reward == "max":
        return jnp.maximum(reward, jnp.where(alive > 0, external, -jnp.inf).max(axis=0))
    return reward + jnp.sum(external * alive, axis=0) / config.period


def on_refined(
    config: CommanderConfig,
    state: CommanderState,
    earlier: Model | None,
    batch: Decision,
    cells: Decision,
    origin: Int[Array, "R"],
) -> CommanderState:
    """The tables after an epoch whose regions were cut, so that region j of today is (a part of) `origin` [j] of then.

    Parts inherit the values of the whole. The model becomes the `earlier` one, with which the epoch began, and all
    decisions of the epoch, `batch`, counted anew: `cells` holds them with today's regions, but for the targets, which
    count as all their parts unless they were goals.
    """
    parts = jnp.zeros(len(origin)).at[origin].add(1.0)[origin]
    cube = (origin[:, None, None], origin[:, None], origin)
    state = state.replace(q=state.q[cube], chosen=state.chosen[origin] / parts)
    if state.model is None or earlier is None:
        return state
    counted = _counted(jax.tree.map(jnp.zeros_like, earlier), batch, cells=cells)
    beside, own = _beside(origin), jnp.eye(len(origin), dtype=bool)
    to_parts = lambda table: table.at[0].set(table[0][:, origin])  # noqa: E731
    in_pursuit = lambda table: jnp.where(own, table, jnp.where(beside, 0.0, table[..., origin]))  # noqa: E731
    new = counted.replace(
        led=to_parts(counted.led),
        lost=to_parts(counted.lost),
        rewards=in_pursuit(counted.rewards),
        visits=in_pursuit(counted.visits),
    )
    old = _inherited(config, earlier, new, origin, parts)
    model = jax.tree.map(jnp.add, old, new)
    return state.replace(model=model.replace(reach=state.model.reach[cube]))


def _inherited(
    config: CommanderConfig, earlier: Model, new: Model, origin: Int[Array, "R"], parts: Float[Array, "R"]
) -> Model:
    """Counts of before the epoch that cut each `origin` into so many `parts`, beside its own counts `new`.

    Nobody knows any more where in a region these decisions began and ended. So those that may have begun in a part are
    but a belief in what happens there, of `config.prior` decisions at most, as are rewards where the goal may have been
    in a part, and all arrived in the parts as those of the epoch did. What aiming at the goal paid tells nothing of
    aiming at a part in which the goal is not.
    """
    cube = (origin[:, None, None], origin[:, None], origin)
    arrived = jnp.zeros_like(new.led).at[..., origin].add(new.led)[..., origin]
    share = jnp.where(arrived > 0, new.led / jnp.where(arrived > 0, arrived, 1.0), 1 / parts)
    led, lost = earlier.led[:, *cube] * share, earlier.lost[:, *cube[1:]]
    beside = _beside(origin)
    rewards, visits = (jnp.where(beside, 0.0, table[cube]) for table in (earlier.rewards, earlier.visits))

    cut = parts[:, None] > 1
    doubt = lambda number: config.prior / jnp.maximum(number, config.prior)  # noqa: E731
    of_commands = jnp.where(cut, doubt(led.sum(axis=-1) + lost), 1.0)
    of_pursuits = jnp.where(cut[:, None] | cut, doubt(visits), 1.0)
    return earlier.replace(
        led=led * of_commands[..., None],
        lost=lost * of_commands,
        rewards=rewards * of_pursuits,
        visits=visits * of_pursuits,
    )


def _beside(origin: Int[Array, "R"]) -> Bool[Array, "R R"]:
    """Which regions are parts of the same one, and not the same."""
    return (origin[:, None] == origin) & ~jnp.eye(len(origin), dtype=bool)


def towards(
    state: CommanderState, allowed: Successors, goal_region: Int[Array, ""]
) -> tuple[Float[Array, "R"], Int[Array, "R"]]:
    """For g* in `goal_region`: the value of every region, and the target that is best there, the first of equals."""
    possible = _targets(allowed.greedy, jnp.arange(state.chosen.shape[0]), goal_region)
    values = jnp.where(possible, state.q[:, goal_region], -jnp.inf)
    return _best(state.q, allowed.greedy)[:, goal_region], jnp.argmax(values, axis=-1)


def _best(q: Float[Array, "R R R"], allowed: Bool[Array, "R R"]) -> Float[Array, "R R"]:
    """Value of every region and goal region; 0 for regions that are not in use."""
    own = jnp.arange(q.shape[0])
    best = jnp.where(allowed[:, None], q, -jnp.inf).max(axis=-1)
    best = best.at[own, own].max(q[own, own, own])
    return jnp.where(allowed.any(axis=1)[:, None], best, 0.0)


def _targets(allowed: Bool[Array, "R R"], region: Int[Array, "n"], goal_region: Int[Array, "*n"]) -> Bool[Array, "n R"]:
    """What may follow each `region`, if the goal is in `goal_region`."""
    home = jax.nn.one_hot(region, allowed.shape[0], dtype=bool)
    return allowed[region] | (home & (region == goal_region)[:, None])
