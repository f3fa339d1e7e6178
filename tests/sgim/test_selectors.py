"""The rules that SGIM is compared with, against loops written from their formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star import abstraction as regions
from star import sgim
from star.sgim import beds, selectors

R, S = 3, 2


def play(rule, mean, blocks, seed=0):
    """Arms chosen when a block of (r, s) has the competences `mean(t, r, s)`."""
    state, chosen = rule.state, []
    select, update = jax.jit(rule.select), jax.jit(rule.update)
    for t, key in enumerate(jax.random.split(jax.random.key(seed), blocks)):
        region, strategy = (int(x) for x in select(state, key=key))
        chosen.append((region, strategy))
        competences = jnp.full(4, mean(t, region, strategy), jnp.float32)
        state = update(state, region, strategy, jnp.zeros((4, 1)), competences)
    return chosen


def test_round_robin_takes_every_arm_in_turn_and_uniform_each_as_often():
    every = [(r, s) for r in range(R) for s in range(S)]
    assert play(selectors.round_robin(R, S), lambda *_: 0.0, 8) == every + every[:2]
    drawn = play(selectors.uniform(R, S), lambda *_: 0.0, 600)
    counts = np.array([drawn.count(arm) for arm in every])
    assert counts.min() > 60 and counts.max() < 140


@pytest.mark.parametrize(
    "settings", [{}, {"discount": 0.9}, {"window": 7}], ids=["UCB1", "discounted", "sliding window"]
)
def test_ucb_takes_the_arm_of_the_largest_bound(settings):
    rng = np.random.default_rng(0)
    table = rng.uniform(0, 1, (40, R, S))
    bonus = 0.3
    chosen = play(selectors.ucb(R, S, bonus=bonus, **settings), lambda t, r, s: table[t, r, s], 40)
    discount, window = settings.get("discount", 1.0), settings.get("window")
    last, history = [None] * R, []
    for t, (r, s) in enumerate(chosen):
        bound = np.full((R, S), np.inf)
        recent = history if window is None else history[-window:]
        ages = {arm: [(len(history) - 1 - i, d) for i, (a, d) in enumerate(history) if a == arm] for arm, _ in recent}
        total = sum(discount**age for age in range(len(recent)))
        for arm in {arm for arm, _ in recent}:
            mine = [(age, d) for age, d in ages[arm] if age < len(recent)]
            n = sum(discount**age for age, _ in mine)
            if n >= 1e-3:
                bound[arm] = sum(discount**age * d for age, d in mine) / n + bonus * np.sqrt(np.log(1 + total) / n)
        assert bound[r, s] >= bound.max() - 1e-4 or np.isinf(bound[r, s])
        increment = 0.0 if last[r] is None else table[t, r, s] - last[r]
        last[r] = table[t, r, s]
        history.append(((r, s), increment))


@pytest.mark.parametrize("share", [0.0, 0.01], ids=["Exp3", "Exp3.S"])
def test_exp3_comes_to_prefer_the_arm_that_makes_progress(share):
    """Competence of region 1 rises with strategy 0 and falls with strategy 1; elsewhere nothing changes."""
    level = [0.0]

    def mean(t, r, s):
        if r == 1:
            level[0] += 0.1 if s == 0 else -0.1
        return level[0] if r == 1 else 0.5

    chosen = play(selectors.exp3(R, S, rate=0.03, share=share), mean, 600)
    late = chosen[300:]
    assert late.count((1, 0)) > 2 * max(late.count((r, s)) for r in range(R) for s in range(S) if (r, s) != (1, 0))


def test_fixed_frequency_asks_its_teacher_in_every_nth_block():
    space = regions.create(((0.0,), (3.0,)), ((1.0, 2.0),), max_regions=R)
    rule = selectors.fixed_frequency(sgim.Config(), space, S, teacher=1, every=3)
    assert [s for _, s in play(rule, lambda *_: 0.5, 9)] == [0, 0, 1] * 3


def test_the_frontier_is_moved_by_practice_near_it_and_by_the_teacher_only_up_to_where_he_knows():
    bed = beds.frontier(noise=0.0)
    late, key = jnp.array(False), jax.random.key(0)

    def moved(front, strategy, goal):
        goals = jnp.asarray([goal], jnp.float32)
        return float(bed.play(jnp.array(front), jnp.array(0), jnp.array(strategy), goals, late, key=key)[0]) - front

    assert moved(0.3, 0, [0.3, 0.0]) == pytest.approx(0.001, rel=0.01)
    assert moved(0.3, 1, [0.3, 0.0]) == pytest.approx(0.004, rel=0.01)
    for strategy, goal in ((2, [0.3, 0.0]), (0, [0.1, 0.28])):  # no effect; impossible
        assert abs(moved(0.3, strategy, goal)) < 1e-6
    assert abs(moved(0.3, 0, [0.9, 0.0])) < 1e-6
    assert abs(moved(0.7, 1, [0.7, 0.0])) < 1e-6
    seen = bed.play(jnp.array(0.3), jnp.array(0), jnp.array(0), jnp.array([[0.3, 0.0], [0.1, 0.28]]), late, key=key)[1]
    np.testing.assert_allclose(seen, [0.5, 0.0], atol=0.01)
