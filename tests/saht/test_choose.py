"""The choice of task, strategy and goal, and what tables are told: against a filter of lists."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from star import sgim
from star.abstraction import regions
from star.saht import choose
from star.saht.choose import Choice, Progress
from star.saht.sections import ChoiceConfig

TASKS, WAYS = 3, 4
DIMENSIONS = jnp.arange(4) < jnp.array([[3], [2], [1]])
ALL = jnp.ones(WAYS, bool)
CONFIG = ChoiceConfig(regions=8)


def table(gains, costs=(1.0, 1.0, 2.0, 2.0)):
    """Tables in which each strategy adds so much to each task."""
    tables = choose.init(CONFIG, TASKS, [1.0] * WAYS)
    return tables.replace(
        choice=tables.choice.replace(
            gains=jnp.asarray(gains, jnp.float32), costs=jnp.array(costs), doubt=jnp.zeros((TASKS, WAYS))
        )
    )


@jax.jit
def many(config, tables, available, keys):
    return jax.vmap(lambda key: choose.draw(config, tables, available, DIMENSIONS, key=key))(keys)


def draws(config, tables, available=ALL):
    return jax.device_get(many(config, tables, available, jax.random.split(jax.random.key(0), 4000)))


told, credit = jax.jit(choose.told), jax.jit(sgim.credit)
SECTION = CONFIG.selection


@settings(max_examples=20)
@given(st.integers(0, 10**6))
def test_credit_is_a_kalman_filter_of_every_pair(seed):
    rng = np.random.default_rng(seed)
    state = choose.init(CONFIG, TASKS, [1.0] * WAYS).choice
    gains, doubt = np.zeros((TASKS, WAYS)), np.ones((TASKS, WAYS))
    for _ in range(4):
        n = 6
        region, way = rng.integers(0, TASKS, n), rng.integers(0, WAYS, n)
        grown, weight = rng.normal(size=n), rng.choice([0.0, 0.1, 1.0], n)
        state = credit(
            SECTION,
            state,
            *(jnp.asarray(x, jnp.float32 if x.dtype == float else jnp.int32) for x in (region, way, grown, weight)),
        )
        for r in range(TASKS):
            for s in range(WAYS):
                mine = (region == r) & (way == s)
                precision = 1 / doubt[r, s] + weight[mine].sum()  # of independent measurements
                gains[r, s] = (gains[r, s] / doubt[r, s] + (weight * grown)[mine].sum()) / precision
                doubt[r, s] = 1 / precision + SECTION.drift
    np.testing.assert_allclose(state.gains, gains, atol=1e-4)
    np.testing.assert_allclose(state.doubt, doubt, rtol=1e-4)


def test_increments_that_are_not_finite_are_counted_and_change_nothing_else():
    state = choose.init(CONFIG, TASKS, [1.0] * WAYS).choice
    grown = np.array([np.nan, np.inf, 0.5], np.float32), np.array([1.0, 0.0, 1.0], np.float32)
    after = credit(SECTION, state, np.array([0, 1, 2]), np.array([0, 0, 0]), *grown)
    assert after.refused == 1 and after.gains[0, 0] == 0 and after.gains[2, 0] == 0.25


def test_task_and_strategy_are_drawn_in_proportion_to_powers_of_interest():
    gains = np.array([[0.4, 0.2, 0.0, 0.0], [0.0, 0.1, 0.4, 0.0], [0.1, 0.1, 0.1, 0.1]])
    config = CONFIG.model_copy(update={"random": 0.0, "optimism": 0.0})
    drawn = draws(config, table(gains))
    worth = gains / np.array([1.0, 1.0, 2.0, 2.0])
    share = worth.max(axis=1) / worth.max(axis=1).sum()
    np.testing.assert_allclose(np.bincount(drawn.task, minlength=TASKS) / 4000, share, atol=0.03)
    of_first = worth[0] ** config.sharpness
    mine = np.asarray(drawn.strategy)[np.asarray(drawn.task) == 0]
    np.testing.assert_allclose(np.bincount(mine, minlength=WAYS) / len(mine), of_first / of_first.sum(), atol=0.04)


def test_strategies_that_are_not_there_are_never_chosen_and_chance_draws_all_others_evenly():
    available = jnp.array([True, False, True, True])
    drawn = draws(CONFIG.model_copy(update={"random": 1.0}), table(np.eye(TASKS, WAYS)), available)
    np.testing.assert_allclose(np.bincount(drawn.strategy, minlength=WAYS) / 4000, [1 / 3, 0, 1 / 3, 1 / 3], atol=0.03)
    by_interest = draws(CONFIG.model_copy(update={"random": 0.0}), table(np.eye(TASKS, WAYS)), available)
    assert not (by_interest.strategy == 1).any()


def test_goals_lie_in_their_task_and_are_0_where_it_has_no_dimension():
    drawn = draws(CONFIG, table(np.ones((TASKS, WAYS))))
    used = np.asarray(DIMENSIONS)[np.asarray(drawn.task)]
    goal = np.asarray(drawn.goal)
    assert (goal[~used] == 0).all() and goal[used].min() < 0.05 and goal[used].max() > 0.95


def test_a_region_of_goals_is_practised_as_its_interest_and_its_size_say():
    tables = table(np.ones((TASKS, WAYS)))
    cut = regions.Cut(jnp.array(0), jnp.array(1), jnp.array(0.25))  # of the first task
    after, done = regions.split(tables.goals.abstraction, cut, min_width=1e-3)
    gains = jnp.zeros((8, 1)).at[:, 0].set(jnp.array([0.3, 1, 1, 0.1, 0, 0, 0, 0]))
    goals = tables.goals.replace(abstraction=after, gains=gains, doubt=jnp.zeros((8, 1)))
    drawn = draws(CONFIG.model_copy(update={"random": 0.0}), tables.replace(goals=goals))
    mine = np.asarray(drawn.goal)[np.asarray(drawn.task) == 0, 0]
    assert done and abs((mine < 0.25).mean() - 0.5) < 0.05  # .25 x .3 beside .75 x .1


def test_a_block_tells_of_its_goal_and_of_what_was_reached_on_the_way():
    tables = choose.init(CONFIG, TASKS, [1.0] * WAYS)
    choice = Choice(jnp.array(1), jnp.array(2), jnp.array([0.5, 0.5, 0.0, 0.0]))
    new = jnp.array([[0.0, 0.3, 0.1], [0.2, 0.3, 9.0]])
    reached = jnp.array([[True, False, True], [True, False, False]])
    seen = Progress(before=jnp.array(0.2), after=jnp.array(0.1), new=new, reached=reached)
    after = told(CONFIG, tables, choice, seen)
    rate = lambda weight: weight / (1 + weight)  # noqa: E731
    expected = np.zeros((TASKS, WAYS))
    expected[1, 2] = rate(1.0) * 0.5
    expected[0, 2] = rate(0.2) * 0.5  # what was known, and what is as far as competence goes
    expected[2, 2] = rate(0.1) * 0.5
    np.testing.assert_allclose(after.choice.gains, expected, atol=1e-6)
    assert after.goals.gains[1, 0] == 0.25 and after.goals.written.tolist()[:3] == [0, 1, 0]
    assert after.goals.competences[1, 0] == 0.5


def test_regions_are_cut_within_a_task_and_never_along_tasks_or_what_a_task_has_not():
    tables = choose.init(CONFIG, TASKS, [1.0] * WAYS)
    split = jax.jit(choose.split)
    rng = np.random.default_rng(0)
    for number in range(250):
        task = number % TASKS
        goal = np.where(np.asarray(DIMENSIONS)[task], rng.uniform(size=4), 0.0).astype(np.float32)
        learnt = 0.2 * (1 - number / 250) if goal[0] > 0.5 else 0.2
        seen = Progress(
            np.float32(0.2), np.float32(learnt), np.ones((1, TASKS), np.float32), np.zeros((1, TASKS), bool)
        )
        tables = told(CONFIG, tables, Choice(np.int32(task), np.int32(0), goal), seen)
        tables = split(CONFIG, tables) if number > 200 else tables
    where = jax.device_get(tables.goals.abstraction)
    assert where.count > TASKS
    for i in range(int(where.count)):
        task = int(where.lower[i, 0])
        assert where.upper[i, 0] == task + 1
        free = np.append(False, ~np.asarray(DIMENSIONS)[task])
        assert (np.asarray(where.upper - where.lower)[i][free] == 1).all()


def test_a_number_is_drawn_in_proportion_to_its_weight_and_never_one_of_weight_0():
    weights = np.array([0.0, 1.0, 0.0, 3.0, 0.0], np.float32)
    dice = np.linspace(0, 1, 401).astype(np.float32)
    found = np.asarray(jax.jit(jax.vmap(choose.drawn, (None, 0)))(weights, dice))
    assert np.bincount(found[:-1], minlength=5).tolist() == [0, 100, 0, 300, 0] and found[-1] == 3
