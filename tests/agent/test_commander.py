"""Q-learning and planning over regions, against loops over decisions and cells."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.abstraction import regions
from star.abstraction.forward_model import Outcome
from star.abstraction.regions import Change, Near, Places
from star.agent import commander, planning, values
from star.agent.decisions import Decision, Finished, Roadmap, Scene, Successors, successors
from star.agent.segments import Segment
from star.agent.task import Task
from star.agent.values import CommanderState, Model
from star.config import loading
from star.sgim.lessons import Marks
from star.spec import Spec

R, N = 5, 40
ALL = Near.every(R)

# Compiled once, not each time that a test calls them.
counts = jax.jit(planning.observe)
recounted = jax.jit(
    lambda section, earlier, batch, cells, origin, traffic: planning.recounted(
        section, earlier, batch, cells, Places(origin, ALL, ALL), traffic
    )
)
plan, settle = jax.jit(commander.plan), jax.jit(planning.settle, static_argnames="periods")
fade, follow = jax.jit(commander.fade), jax.jit(commander.follow)
towards = jax.jit(values.towards)
follows = jax.jit(successors, static_argnums=0)
spread = jax.jit(commander.spread, static_argnames="num_envs")


@jax.jit
def chosen_by(state, allowed, region, goal_region, epsilon, key):
    return values.choose(state, allowed, region, goal_region, epsilon=epsilon, key=key)


def choose(state, allowed, region, goal_region, *, epsilon, n=4000):
    """The targets of `n` who are in a region, or of each in an array."""
    whole = lambda number: np.broadcast_to(np.asarray(number, np.int32), n)  # noqa: E731
    return np.asarray(chosen_by(state, allowed, whole(region), whole(goal_region), epsilon, jax.random.key(0)))


def begun(chosen):
    """Nothing learnt yet, in NumPy."""
    return jax.device_get(commander.init(chosen, regions=R))


EVERYTHING = Successors(ALL, np.ones((R, R), bool), np.ones((R, R), bool))


def known(allowed, believed=None):
    """A roadmap that says so; where the regions lie is of no account."""
    return Roadmap(abstraction=None, allowed=allowed, believed=np.zeros((R, R), bool) if believed is None else believed)


def counted(chosen, state, batch):
    """`state` with the decisions of `batch` in its model."""
    return counts(chosen, state, known(EVERYTHING), batch)


def settings(**values):
    return loading.parse({"commander": values}).commander


def plane(*, subgoal_scale=(1.0, 1.0)):
    """A task on a square of 9 m, with episodes of 6 env steps."""
    return Spec(
        state_dim=2, action_size=1, episode_length=6, abstract_indices=(0, 1), goal_indices=(0, 1), success_radius=1.0,
        subgoal_scale=subgoal_scale, space=((0.0, 0.0), (9.0, 9.0)), region_cuts=((), ()),
    )  # fmt: skip


def test_who_has_hardly_moved_within_a_period_stands_still_unless_at_the_goal():
    spec = plane(subgoal_scale=(10.0, 5.0, 1.0))  # with a heading
    began = np.tile(np.float32([3.0, 4.0]), (6, 1))
    moved = np.float32([[0.4, -0.2], [0.6, 0.0], [0.0, -0.3], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    memory = commander.begin(began).replace(clock=np.int32([10, 10, 10, 40, 0, 10]))
    scene = Scene(position=began + moved, goal=began, success=np.float32([0, 0, 0, 0, 0, 1]))
    standing = jax.jit(partial(commander.standing, Task.of(loading.parse({}), spec)))(memory, scene)
    assert standing.tolist() == [True, False, False, True, False, False]


@pytest.fixture(scope="module")
def in_a_row():
    """Three regions in a row, a table in which each leads to the next one and on to the goal, and commands by it."""
    spec = plane()
    abstraction = regions.create(spec.space, ((3.0, 6.0), ()), max_regions=R)
    row = left, middle, right = np.asarray(regions.locate(abstraction, np.float32([[1, 1], [4, 1], [7, 1]]))).tolist()
    q = np.zeros((R, R, R), np.float32)
    q[left, right, middle], q[middle, right, right], q[right, right, right] = 0.2, 0.5, 0.9
    roadmap = known(EVERYTHING).replace(abstraction=abstraction)

    def commanded(position, *, learner="model", greedy=True, best=None, given=None, **memory):
        """The memory after commands at `position`, by agents who began their last decision as `memory` says."""
        chosen, n = settings(learner=learner, epsilon_start=0.0, epsilon_end=0.0), len(position)
        parts = {name: np.int32(x) for name, x in ({"goal_region": [right] * n} | memory).items()}
        before = commander.begin(np.full((n, 2), 2.0, np.float32)).replace(**parts)
        if greedy:
            before = commander.set_out(chosen, before, capacity=R)
        if before.journey is not None:
            journey = before.journey.replace(best=np.float32(best))
            before = before.replace(journey=journey if given is None else journey.replace(given=np.int32(given)))
        task, state = Task.of(loading.parse({}), spec), begun(chosen).replace(q=q)
        scene = Scene(np.float32(position), np.float32([[8, 1]] * n), np.zeros(n, np.float32))
        command = jax.jit(partial(commander.command, chosen, task), static_argnames="env_steps")
        env_steps = None if greedy else 0.0
        return command(state, roadmap, before, scene, Marks(), env_steps=env_steps, key=jax.random.key(0))

    return row, commanded


@pytest.mark.parametrize(("learner", "greedy"), [("model", True), ("model", False), ("q", True)])
def test_a_greedy_plan_is_asked_again_where_the_agent_has_come_to_a_better_region(in_a_row, learner, greedy):
    (left, middle, right), commanded = in_a_row
    # A period begins; in one the agent is where it was, has come to a better region, a worse one, or back to the best.
    position = [[1, 1], [1, 2], [4, 1], [1, 3], [4, 2]]
    after = commanded(
        position, learner=learner, greedy=greedy, best=[-np.inf, 0.2, 0.2, 0.5, 0.5],
        clock=[0, 3, 3, 3, 3], region=[left, left, left, middle, left], target=[left] * 5,
    )  # fmt: skip
    again = learner == "model" and greedy
    assert after.target.tolist() == [middle, left, right if again else left, left, left]
    assert after.region.tolist() == [left, left, middle if again else left, middle, left]
    np.testing.assert_array_equal(after.start, [position[0]] + [[2, 2]] * 4)  # who stands still is told by the period
    assert (after.journey is not None) == again
    if again:
        np.testing.assert_allclose(after.journey.best, [0.2, 0.2, 0.5, 0.5, 0.5])
        assert after.journey.given[:, left].tolist() == [middle, -1, -1, -1, -1]
        assert after.journey.given[:, middle].tolist() == [-1, -1, right, -1, -1]


def test_a_target_that_was_given_in_vain_is_not_given_again_at_once_unless_the_goal_is_here(in_a_row):
    (left, middle, right), commanded = in_a_row
    given = np.full((5, R), -1)
    given[:, left], given[4, right] = middle, right
    # Back from the middle; no nearer to the box at (0, 0) in a period; nearer; back for another goal; at the goal.
    after = commanded(
        [[1, 1], [2, 2.1], [1, 1], [1, 1], [7, 1]], best=[0.9] * 5, given=given, clock=[0] * 5, target=[left] * 5,
        region=[middle, left, left, middle, middle], goal_region=[right, right, right, left, right],
    )  # fmt: skip
    assert middle not in after.target[:2]
    assert after.target[2:].tolist() == [middle, middle, right]
    np.testing.assert_array_equal(after.journey.given[:2, left], after.target[:2])


def random_batch(seed):
    rng = np.random.default_rng(seed)
    few = lambda: rng.integers(0, 3, N).astype(np.int32)  # noqa: E731  # so that cells are met repeatedly
    return Decision(
        region=few(),
        goal_region=few(),
        target=few(),
        reward=-rng.random(N).astype(np.float32),
        next_region=rng.integers(0, R, N).astype(np.int32),
        weight=(rng.random(N) < 0.7).astype(np.float32),
        lost=(rng.random(N) < 0.2).astype(np.float32),
        aside=(rng.random(N) < 0.2).astype(np.float32),
        goal=np.zeros((N, 2), np.float32),
    )


def random_state(seed):
    rng = np.random.default_rng(seed)
    q = -rng.random((R, R, R)).astype(np.float32)
    allowed = rng.random((R, R)) < 0.6
    np.fill_diagonal(allowed, True)
    return CommanderState(q=q, chosen=np.zeros(R, np.float32)), Successors(ALL, allowed, allowed)


def slow_update(q, allowed, batch, *, alpha, discount):
    new = q.copy()
    for i, g, j in {*zip(batch.region.tolist(), batch.goal_region.tolist(), batch.target.tolist(), strict=True)}:
        errors = []
        for n in range(N):
            if (
                max(batch.weight[n], batch.lost[n])
                and not batch.aside[n]
                and (batch.region[n], batch.goal_region[n], batch.target[n]) == (i, g, j)
            ):
                after = batch.next_region[n]
                best = max(q[after, g, k] for k in range(R) if allowed[after, k])
                errors.append(batch.reward[n] + (0 if batch.lost[n] else discount * best) - q[i, g, j])
        if errors:
            new[i, g, j] += (1 - (1 - alpha) ** len(errors)) * np.mean(errors)
    return new


@pytest.fixture(scope="module")
def observe():
    """Takes in decisions, and plans nothing."""
    return jax.jit(
        lambda chosen, state, allowed, batch: commander.observe(
            chosen, state, known(allowed), batch, due=jnp.array(False)
        )
    )


@pytest.mark.parametrize("seed", range(3))
def test_q_learning_averages_the_errors_of_each_cell(observe, seed):
    state, allowed = random_state(seed)
    batch = random_batch(seed)
    chosen = settings(learner="q", learning_rate=0.1, discount=0.9)
    after = observe(chosen, state, allowed, batch)
    q = np.float64(state.q)
    expected = slow_update(q, np.asarray(allowed.greedy), batch, alpha=0.1, discount=0.9)
    assert (expected != q).sum() > 10
    np.testing.assert_allclose(after.q, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("learner", ["q", "model"])
def test_who_loses_the_task_at_a_distance_does_no_better_than_who_waits_there(observe, learner):
    """Whatever the learner: an end must not look like a way out of rewards that are negative."""
    chosen = settings(learner=learner, reward="mean", discount=0.9, learning_rate=1.0, prior=1e-3, sweeps=200)

    def value(batch):
        state = begun(chosen)
        for _ in range(200):
            state = observe(chosen, state, EVERYTHING, batch)
        return float(np.asarray(plan(chosen, state, known(EVERYTHING)).q)[1, 4, 2])

    nothing, lost_reward, worth = np.zeros(1, np.float32), jax.jit(commander.lost_reward), jax.jit(commander.worth)
    end = np.asarray(lost_reward(chosen, nothing, worth(chosen, nothing + 7, nothing)))
    loses = value(many(1, 2, 0, count=8, lost=1.0, reward=float(end[0])).replace(weight=np.zeros(8, np.float32)))
    assert loses == pytest.approx(-70.0, rel=1e-2)
    assert settings().reward == "success"
    np.testing.assert_array_equal(lost_reward(settings(), nothing + np.float32(0.3), nothing + 1), np.float32([0.3]))


def test_the_measured_reward_is_that_of_whole_periods_with_the_goal_of_the_task():
    state, allowed = random_state(0)
    batch = random_batch(0)
    metrics = jax.jit(commander.measure)(settings(), state, known(allowed), batch)
    np.testing.assert_allclose(metrics["reward"], batch.reward[batch.weight > batch.aside].mean(), rtol=1e-5)


@pytest.mark.parametrize("learner", ["q", "model"])
def test_periods_with_weight_0_teach_nothing(observe, learner):
    chosen, (state, allowed) = settings(learner=learner), random_state(0)
    state = state.replace(model=begun(chosen).model)
    nothing = np.zeros(N, np.float32)
    after = observe(chosen, state, allowed, random_batch(0).replace(weight=nothing, lost=nothing))
    jax.tree.map(np.testing.assert_array_equal, after, state)


def slow_plan(batch, allowed, believed, *, discount, prior, sweeps, belief=1.0):
    """Value iteration from 0 over a model counted decision by decision."""
    q = np.zeros((R, R, R))
    reward, visits = np.zeros((2, R, R, R))
    to_region, to_goal = np.zeros((2, R, R, R + 1))
    for n in range(N):
        i, g, j = batch.region[n], batch.goal_region[n], batch.target[n]
        if batch.aside[n]:
            continue
        led = to_goal if j == g else to_region
        led[i, j, batch.next_region[n]] += batch.weight[n]
        led[i, j, R] += batch.lost[n]  # a state that is worth nothing
        reward[i, g, j] += max(batch.weight[n], batch.lost[n]) * batch.reward[n]
        visits[i, g, j] += max(batch.weight[n], batch.lost[n])

    def weight(number):
        return prior * math.exp(-number / prior)

    for _ in range(sweeps):
        value = np.zeros((R + 1, R))
        for i in range(R):
            for g in range(R):
                value[i, g] = max(q[i, g, j] for j in range(R) if allowed[i, j])
        for i in range(R):
            for j in range(R):
                chances, believing = to_region[i, j].copy(), weight(to_region[i, j].sum())
                chances[j] += believing * belief * believed[i, j]
                chances[i] += believing * (1 - belief * believed[i, j])
                chances /= chances.sum()
                at_goal = to_goal[i, j] + weight(to_goal[i, j].sum()) * chances
                at_goal /= at_goal.sum()
                for g in range(R):
                    succeeding = weight(visits[i, g, j])
                    r = reward[i, g, j] + succeeding * belief * (i == g == j)
                    later = (at_goal if j == g else chances) @ value[:, g]
                    q[i, g, j] = r / (visits[i, g, j] + succeeding) + discount * later
    return q


@pytest.mark.parametrize("seed", range(2))
def test_planning_is_value_iteration_on_the_counted_model(observe, seed):
    rng = np.random.default_rng(seed)
    chosen = settings(learner="model", reward="success", discount=0.9, prior=2.0, sweeps=3)
    _, allowed = random_state(seed)
    batch = random_batch(seed)
    believed = rng.random((R, R)) < 0.4
    state = observe(chosen, begun(chosen), allowed, batch)
    roadmap = known(allowed, believed)
    planned = plan(chosen, state, roadmap)
    q = slow_plan(batch, np.asarray(allowed.greedy), believed, discount=0.9, prior=2.0, sweeps=3)
    np.testing.assert_allclose(planned.q, q, rtol=1e-5)
    q = slow_plan(batch, np.asarray(allowed.greedy), believed, discount=0.9, prior=2.0, sweeps=4, belief=0.1)
    for before in (state, planned):  # whatever was planned before
        settled = settle(chosen, before, roadmap, periods=4)
        np.testing.assert_allclose(settled.q, q, rtol=1e-5, atol=1e-12)


def corridor(batch_of, *, shortcut=False, greedy=False, periods=10):
    """Plans in regions 0-1-2-3 in a row, of which each believes to reach its neighbours, and 3 by the `shortcut`."""
    chosen = settings(learner="model", reward="success", discount=0.9, prior=1.0, sweeps=60)
    neighbours = np.abs(np.subtract.outer(np.arange(R), np.arange(R))) == 1
    neighbours[0, 3] = shortcut
    state = begun(chosen)
    for batch in batch_of:
        state = counted(chosen, state, batch)
    roadmap = known(EVERYTHING, neighbours)
    if greedy:
        return np.asarray(settle(chosen, state, roadmap, periods=periods).q)
    return np.asarray(plan(chosen, state, roadmap).q)


def many(region, target, next_region, *, goal=4, count=100, lost=0.0, reward=0.0):
    ones = np.ones(count, np.int32)
    return Decision(
        region=region * ones,
        goal_region=goal * ones,
        target=target * ones,
        reward=np.float32(reward) * ones,
        next_region=next_region * ones,
        weight=np.float32(1 - lost) * ones,
        lost=np.float32(lost) * ones,
        aside=np.zeros(count, np.float32),
        goal=np.zeros((count, 2), np.float32),
    )


def test_what_was_not_tried_is_believed_and_what_failed_is_not():
    assert corridor([])[0, 3].argmax() == 1  # 0 -> 1 -> 2 -> 3
    q = corridor([many(1, 2, 1)])  # a wall between 1 and 2
    assert q[0, 3].max() < 0.3 * corridor([])[0, 3].max()
    assert corridor([many(1, 2, 1), many(1, 4, 3, goal=0)])[1, 3].argmax() == 4  # aiming at 4 leads to 3


def test_greedy_episodes_go_where_others_went_and_by_belief_only_where_nobody_was():
    tried = [many(0, 1, 1), many(1, 2, 2), many(2, 3, 3)]
    assert corridor(tried, shortcut=True)[0, 3].argmax() == 3
    assert corridor(tried, shortcut=True, greedy=True)[0, 3].argmax() == 1
    assert corridor([], shortcut=True, greedy=True)[0, 3].argmax() == 3
    assert corridor([many(0, 3, 0, count=1000)], shortcut=True, greedy=True)[0, 3].argmax() == 1


@pytest.mark.parametrize("changed", [{"learner": "q"}, {"reward": "max"}])
def test_values_stay_as_they_are_where_nothing_is_counted_or_nothing_is_best(changed):
    chosen = settings(**{"learner": "model", "reward": "success"} | changed)
    state, allowed = random_state(0)
    state = begun(chosen).replace(q=state.q)
    roadmap = known(allowed, np.ones((R, R), bool))
    settled = jax.jit(commander.settle, static_argnames="episode_length")(
        chosen, state, roadmap, episode_length=3 * chosen.period
    )
    np.testing.assert_array_equal(settled.q, state.q)


def test_what_aiming_at_the_goal_does_tells_nothing_of_aiming_at_its_region():
    for greedy in (False, True):
        at_goal = corridor([many(1, 2, 2, goal=2), many(2, 3, 3)], greedy=greedy)
        through = corridor([many(1, 2, 1, goal=2), many(2, 3, 3)], greedy=greedy)
        np.testing.assert_array_equal(at_goal[1, 3], through[1, 3])
        assert at_goal[1, 2, 2] > through[1, 2, 2]


@pytest.mark.parametrize("greedy", [False, True])
def test_a_wall_that_was_run_against_twenty_times_is_no_way_however_long_the_other_one(greedy):
    tried = [many(0, 3, 0, count=20)]
    for i in range(3):  # one of twenty periods leads on
        tried += [many(i, i + 1, i, count=19), many(i, i + 1, i + 1, count=1)]
    q = corridor(tried, shortcut=True, greedy=greedy, periods=60)
    assert 0 < q[0, 3, 3] < 0.91 * q[0, 3, 1]  # to run against it once more costs a period, discounted by .9
    assert corridor(tried[1:], shortcut=True, greedy=greedy, periods=60)[0, 3].argmax() == 3  # who has not yet tried


def test_where_the_goals_region_is_cut_nobody_aims_beside_the_goal():
    """Region 2, which was only aimed at for the goal in it, is cut in two, and the goal is in the new half, 3."""
    chosen = settings(learner="model", reward="success", discount=0.9, prior=1.0)
    state = begun(chosen)
    for batch in (many(0, 2, 2, goal=2, reward=0.5), many(2, 2, 2, goal=2, reward=1.0)):
        state = counted(chosen, state, batch)
    origin, nothing = np.array([0, 1, 2, 2, 4]), many(0, 0, 0, count=0)
    state = state.replace(model=recounted(chosen, state.model, nothing, nothing, origin, np.ones((R, R), np.float32)))
    settled = jax.device_get(settle(chosen, state, known(EVERYTHING, np.ones((R, R), bool)), periods=20))
    for region, goal, wrong in ((0, 3, 2), (2, 3, 2), (0, 2, 3), (3, 2, 3)):
        assert settled.q[region, goal, goal] > settled.q[region, goal, wrong] + 0.2


def test_a_command_that_ends_the_episode_is_worth_less_than_one_that_fails():
    stays, dies = corridor([many(1, 2, 1, count=3)]), corridor([many(1, 2, 1, count=3, lost=1.0)])
    assert dies[1, 3, 2] < stays[1, 3, 2]


def test_decisions_fade_by_the_memory_each_epoch_but_for_the_last_twenty_of_a_command():
    chosen = settings(learner="model", memory=0.25)
    state = jax.device_get(counted(chosen, begun(chosen), random_batch(0)))
    number = np.asarray(state.model.led.sum(axis=-1) + state.model.lost)
    scale = np.float32(30 / number.max())  # some commands many times, others seldom
    state = state.replace(model=jax.tree.map(lambda x: scale * x, state.model))
    faded = jax.device_get(fade(chosen, state).model)
    for n, names in ((scale * number, ("led", "lost")), (np.asarray(state.model.visits), ("rewards", "visits"))):
        for name in names:
            before, after = (np.asarray(getattr(model, name)) for model in (state.model, faded))
            for cell in np.ndindex(n.shape):
                left = 0.25 if n[cell] > 80 else min(1.0, 20 / max(n[cell], 1e-9))
                np.testing.assert_allclose(after[cell], left * before[cell], rtol=1e-6)
    assert (scale * number > 20).any() and ((scale * number < 20) & (number > 0)).any()
    gone = fade(chosen, state.replace(model=jax.tree.map(lambda x: np.float32(1000) * x, state.model))).model
    np.testing.assert_allclose(np.asarray(gone.led).sum(), 250 * state.model.led.sum(), rtol=1e-5)


def test_success_alone_counts_or_distance_alone():
    distance, success = np.float32([0.5, 7.0]), np.float32([1.0, 0.0])
    np.testing.assert_array_equal(commander.worth(settings(reward="success"), distance, success), [1.0, 0.0])
    for reward in ("mean", "max"):
        np.testing.assert_array_equal(commander.worth(settings(reward=reward), distance, success), [-0.5, -7.0])


def test_epsilon_falls_linearly_and_stays():
    chosen = settings(epsilon_start=0.9, epsilon_end=0.1, epsilon_steps=1000.0)
    epsilon = jax.jit(commander.epsilon)
    for steps, expected in ((0, 0.9), (250, 0.7), (500, 0.5), (1000, 0.1), (5000, 0.1)):
        np.testing.assert_allclose(epsilon(chosen, np.float32(steps)), expected, rtol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 100])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_spread_epsilon_is_the_same_on_average_and_differs_between_environments(count, share):
    apart = np.asarray(spread(settings(epsilon_spread=True), np.float32(share), num_envs=count))
    assert apart.shape == (count,) and len(set(apart.tolist())) == count and 0 <= apart.min() and apart.max() <= 1
    np.testing.assert_allclose(apart.mean(), share, rtol=1e-5)
    assert count < 100 or share > 0.5 or (apart.min() < 0.02 * share and apart.max() > 1.98 * share)
    same = spread(settings(epsilon_spread=False), np.float32(share), num_envs=count)
    np.testing.assert_allclose(same, [share] * count, rtol=1e-6)


# Regions 0-3 are active, 4 is not. 0 is known to reach 1; 2 is shown unreachable from 0 and 1, as 3 is from itself.
REACHES = np.zeros((R, R), bool)
REACHES[0, 1] = REACHES[0, 4] = True
MISSES = np.zeros((R, R), bool)
MISSES[0, 2] = MISSES[1, 2] = MISSES[3, 3] = True
ACTIVE = np.arange(R) < 4


def slow_successors(mode, reaches, misses, active):
    greedy, explore = np.zeros((2, R, R), bool)
    for i in range(R):
        for j in range(R):
            if active[i] and active[j]:
                explore[i, j] = i == j or not misses[i, j]
                known = [k for k in range(R) if active[k] and reaches[i, k] and k != i]
                if mode == "known" and known:
                    explore[i, j] = j in known
                greedy[i, j] = mode == "any" or explore[i, j]
    return greedy, explore


@pytest.mark.parametrize("mode", ["any", "possible", "known"])
def test_successors_by_mode(mode):
    got = follows(mode, ALL, reaches=REACHES, misses=MISSES, active=ACTIVE)
    greedy, explore = slow_successors(mode, REACHES, MISSES, ACTIVE)
    np.testing.assert_array_equal(got.greedy, greedy)
    np.testing.assert_array_equal(got.explore, explore)


def test_known_falls_back_to_what_is_possible_where_nothing_is_known():
    got = jax.device_get(follows("known", ALL, reaches=REACHES, misses=MISSES, active=ACTIVE))
    assert got.greedy[0].tolist() == [False, True, False, False, False]
    assert got.greedy[1].tolist() == [True, True, False, True, False]
    assert got.greedy[3].tolist() == [True, True, True, True, False]


def test_a_goals_region_may_always_follow_itself():
    """Though others are known to be reachable from there, for choices and for what is to come."""
    onto = np.tile(np.arange(R) == 1, (R, 1))
    allowed, q = Successors(near=ALL, greedy=onto, explore=onto), np.zeros((R, R, R), np.float32)
    q[..., 0] = 1.0
    state = CommanderState(q=q, chosen=np.zeros(R, np.float32))
    for there, greedy, random in ((0, {0}, {0, 1}), (2, {1}, {1})):
        assert set(choose(state, allowed, 0, there, epsilon=0.0).tolist()) == greedy
        assert set(choose(state, allowed, 0, there, epsilon=1.0).tolist()) == random
    worth, targets = towards(state, allowed, 0)
    assert worth.tolist() == [1.0, *[0.0] * (R - 1)] and targets.tolist() == [0, *[1] * (R - 1)]


def test_the_greedy_choice_is_the_best_allowed_target_and_ties_break_at_random():
    q, allowed = np.zeros((R, R, R), np.float32), np.tile(np.arange(R) != 2, (R, 1))
    q[0, 1] = [0.0, 3.0, 9.0, 3.0, 1.0]
    state = CommanderState(q=q, chosen=np.zeros(R, np.float32))
    chosen, counts = np.unique(choose(state, Successors(ALL, allowed, allowed), 0, 1, epsilon=0.0), return_counts=True)
    assert chosen.tolist() == [1, 3]
    assert counts.min() > 0.3 * counts.sum()


def test_epsilon_is_the_share_of_random_choices():
    q = np.zeros((R, R, R), np.float32)
    q[..., 0] = 1.0
    state = CommanderState(q=q, chosen=np.zeros(R, np.float32))
    shares = np.bincount(choose(state, EVERYTHING, 0, 0, epsilon=0.5), minlength=R) / 4000
    np.testing.assert_allclose(shares, [0.6, 0.1, 0.1, 0.1, 0.1], atol=0.03)


@pytest.mark.parametrize("reward", ["max", "mean"])
def test_the_reward_of_a_period_is_the_max_or_mean_over_all_its_steps(reward):
    chosen = settings(reward=reward, period=30)
    external = -np.random.default_rng(0).random((3, 10, 4)).astype(np.float32)
    alive = np.ones((3, 10, 4), np.float32)
    alive[2, 6:, 1] = 0
    total, accumulate = np.full(4, commander.start_reward(chosen), np.float32), jax.jit(commander.accumulate)
    for part in range(3):
        total = accumulate(chosen, total, external[part], alive[part])
    for b in range(4):
        lived = [external[p, t, b] for p in range(3) for t in range(10) if alive[p, t, b]]
        expected = max(lived) if reward == "max" else sum(lived) / 30
        np.testing.assert_allclose(np.asarray(total)[b], expected, rtol=1e-5)


@pytest.mark.parametrize("reward", ["success", "mean", "max"])
@pytest.mark.parametrize("clock", [2, 4])
def test_a_period_that_success_ends_counts_as_if_the_agent_stayed_for_the_rest_of_it(reward, clock):
    """A segment of two env steps in a period of six: one arrives at once, one flips, one goes on."""
    chosen = loading.parse({"commander": {"reward": reward, "period": 6}, "tutor": {"period": 2}}).commander
    spec = plane()
    task, table = Task.of(loading.parse({}), spec), regions.create(spec.space, [[3.0], []], max_regions=2)
    obs, end = np.full((3, 3, 4), 5.0, np.float32), np.float32([[1, 0, 0], [0, 0, 0]])
    obs[0, ..., :2] = 1.0  # in the other region
    distance, so_far = np.float32([[3, 3, 3], [9, 9, 2]]), {"success": 0.0, "mean": -9 / 6, "max": -4.0}[reward]
    flipped, none = end[:, [1, 0, 2]], np.zeros((2, 3), np.float32)
    passed = Segment(
        obs=obs, seen=(), subgoal=(), action=none, terminated=flipped, ended=end + flipped, success=end, arrived=end,
        distance=distance, alive=np.float32([[1, 1, 1], [0, 0, 1]]), non_finite=none, overflow=none, box=None,
        choice=None,
    )  # fmt: skip
    roadmap = Roadmap(abstraction=table, allowed=EVERYTHING, believed=None)
    memory = commander.begin(obs[0, :, :2])
    memory = memory.replace(clock=memory.clock + clock, reward=jnp.full(3, so_far), goal=memory.goal + 7)
    run = jax.jit(lambda memory, passed: commander.experience(chosen, task, roadmap, memory, passed, Marks()))
    after, (decision, outcome) = jax.device_get(run(memory, passed))
    whole = float(clock == 4)
    assert decision.weight.tolist() == outcome.weight.tolist() == [1.0, 0.0, whole]
    assert decision.lost.tolist() == [0.0, 1.0, 0.0]
    assert (decision.region[0], decision.next_region[0], after.clock[0]) == (0, 1, (clock + 2) % 6)
    assert (decision.goal == 7).all()  # where it was when the target was chosen, not at 5
    left = 6 - clock - 1
    expected = {"success": (1 + left) / 6, "mean": so_far - 3 / 6 - left * 3 / 6, "max": -3.0}[reward]
    np.testing.assert_allclose(decision.reward[0], expected, rtol=1e-6)


# Regions 0, 1, 2 become 0, 1, 2 and 3, of which 1 and 3 were cut from 1; region 4 is not in use.
ORIGIN = [0, 1, 2, 1, 4]


def slow_recount(batch, cells, earlier, traffic, *, prior):
    """The model after an epoch whose decisions are `batch`, in today's regions `cells`, in loops over cells."""
    every = range(R)
    parts = [ORIGIN.count(o) for o in ORIGIN]
    new = {name: np.zeros_like(getattr(earlier, name)) for name in ("led", "rewards", "visits", "lost")}
    for d in range(N):
        if batch.aside[d]:
            continue
        at_goal = batch.target[d] == batch.goal_region[d]
        i, g, n = cells.region[d], cells.goal_region[d], cells.next_region[d]
        for j in [g] if at_goal else [j for j in every if ORIGIN[j] == batch.target[d]]:
            new["led"][int(at_goal), i, j, n] += batch.weight[d]
            new["lost"][int(at_goal), i, j] += batch.lost[d]
            told = max(batch.weight[d], batch.lost[d])
            new["visits"][i, g, j] += told
            new["rewards"][i, g, j] += told * batch.reward[d]
    model = {name: table.copy() for name, table in new.items()}
    of_whole = lambda i: [m for m in every if ORIGIN[m] == ORIGIN[i]]  # noqa: E731
    for i in every:
        began = sum(traffic[k].sum() for k in of_whole(i))
        part = 1.0 if parts[i] == 1 else traffic[i].sum() / began if began else 0.0
        for j in every:
            for aim in (0, 1):
                whence = earlier.led[aim, ORIGIN[i], ORIGIN[j]]
                old = np.zeros(R)
                for n in every:
                    between = sum(traffic[k, m] for k in of_whole(i) for m in of_whole(n))
                    share = traffic[i, n] / between if between else 0.0
                    old[n] = whence[ORIGIN[n]] * (share if parts[i] > 1 or parts[n] > 1 else 1.0)
                lost = part * earlier.lost[aim, ORIGIN[i], ORIGIN[j]]
                number = old.sum() + lost
                kept = min(1.0, prior / max(number, 1e-9)) if parts[i] > 1 else 1.0
                model["led"][aim, i, j] += kept * old
                model["lost"][aim, i, j] += kept * lost
            for g in every:
                elsewhere = i != g and max(parts[i], parts[g]) > 1
                if not elsewhere and (ORIGIN[g] != ORIGIN[j] or g == j):
                    number = part * earlier.visits[ORIGIN[i], ORIGIN[g], ORIGIN[j]]
                    kept = min(1.0, prior / max(number, 1e-9)) if max(parts[i], parts[g]) > 1 else 1.0
                    model["visits"][i, g, j] += kept * number
                    model["rewards"][i, g, j] += kept * part * earlier.rewards[ORIGIN[i], ORIGIN[g], ORIGIN[j]]
    return model


@pytest.mark.parametrize("seed", range(3))
def test_after_cuts_an_epochs_decisions_are_counted_by_todays_regions(seed):
    chosen, batch = settings(learner="model", prior=2.0), random_batch(seed)
    half = lambda region: np.where((region == 1) & (np.arange(N) % 3 == 0), 3, region)  # noqa: E731
    next_region = np.minimum(batch.next_region, 2)
    goal_region = half(batch.goal_region)
    batch = batch.replace(next_region=next_region)
    cells = batch.replace(
        region=half(batch.region),
        next_region=half(next_region),
        goal_region=goal_region,
        target=np.where(batch.at_goal, goal_region, batch.target),
    )
    q, visits, rewards, *led = 3 * np.random.default_rng(seed).random((5, R, R, R), np.float32)
    led, lost = np.stack(led), np.stack([visits[0], rewards[0]])
    led[:, :, :, 3:] = led[:, 3:] = led[:, :, 3:] = 0  # nothing there
    earlier = Model(led=led, rewards=rewards, visits=visits, lost=lost)
    traffic = np.random.default_rng(seed).integers(0, 3, (R, R)).astype(np.float32)
    model = recounted(chosen, earlier, batch, cells, np.array(ORIGIN), traffic)
    for name, table in slow_recount(batch, cells, earlier, traffic, prior=2.0).items():
        np.testing.assert_allclose(getattr(model, name), table, rtol=1e-5, atol=1e-6)

    boxes = jax.device_get(regions.create(((0.0, 0.0), (5.0, 1.0)), ((1.0, 2.0, 3.0, 4.0), ()), max_regions=R))
    centre = lambda region: (boxes.lower + boxes.upper)[region] / 2  # noqa: E731
    decisions = batch.replace(goal=centre(cells.goal_region))
    where = centre(cells.region), centre(cells.next_region)
    finished = Finished(decisions, Outcome(where[0], where[0], where[0], where[1], batch.weight))
    began = CommanderState(q=q, chosen=np.arange(1, R + 1, dtype=np.float32), model=earlier)
    state = began.replace(model=jax.tree.map(lambda x: x + 1, earlier))  # which the epoch's counts have changed
    change = Change(before=boxes, after=boxes, splits=None, origin=np.array(ORIGIN))
    after = jax.device_get(follow(chosen, state, change, began, finished, traffic))
    jax.tree.map(np.testing.assert_array_equal, after.model, model)
    cube = np.ix_(ORIGIN, ORIGIN, ORIGIN)
    np.testing.assert_array_equal(after.q, q[cube])
    np.testing.assert_array_equal(after.chosen, [1, 1, 3, 1, 5])


def test_without_cuts_counting_anew_changes_nothing():
    chosen, batch = settings(learner="model"), random_batch(0)
    before = begun(chosen)
    model = counted(chosen, before, batch).model
    again = recounted(chosen, before.model, batch, batch, np.arange(R), np.zeros((R, R), np.float32))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), again, model)


def test_who_began_beyond_the_cut_tells_nothing_of_this_side():
    """A wall cuts region 1 in two: from part 3 region 2 is reached, from part 1 it is not, whatever was known."""
    chosen = settings(learner="model", prior=1.0)
    began = counted(chosen, begun(chosen), many(1, 2, 2, count=1000))
    join = partial(jax.tree.map, lambda *parts: np.concatenate(parts))
    batch = join(many(1, 2, 1), many(1, 2, 2))
    cells = join(many(1, 2, 1), many(3, 2, 2))
    traffic = np.zeros((R, R), np.float32)
    traffic[1, 1], traffic[3, 2] = 700.0, 1000.0
    after = recounted(chosen, began.model, batch, cells, np.array(ORIGIN), traffic)
    led = np.asarray(after.led)[0, :, 2]
    assert led[1, 2] / led[1].sum() < 0.02 and led[3, 2] / led[3].sum() > 0.98


def test_the_value_towards_a_goal_is_that_of_the_best_allowed_target():
    state, allowed = random_state(3)
    value, target = map(np.asarray, towards(state, allowed, 2))
    q, greedy = np.asarray(state.q), np.asarray(allowed.greedy)
    for region in range(R):
        best = max((j for j in range(R) if greedy[region, j]), key=lambda j: q[region, 2, j])
        assert target[region] == best and value[region] == q[region, 2, best]
