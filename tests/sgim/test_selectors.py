"""The rules that SGIM is compared with, against loops written from their formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from star import sgim
from star.abstraction import regions
from star.sgim import beds, mixtures, selectors

R, S = 3, 2
SPACE = regions.create(((0.0,), (3.0,)), ((1.0, 2.0),), max_regions=R)


def player(rule, mean, blocks):
    """A function of a seed and of what `mean` knows at first, to the arms chosen in so many blocks.

    A block of (r, s) has the competence that `mean(known, t, r, s)` gives, besides what it knows then.
    """

    @jax.jit
    def played(keys, known):
        def block(carry, now):
            (state, known), (t, key) = carry, now
            region, strategy = rule.select(state, key=key)
            known, competence = mean(known, t, region, strategy)
            goals, seen = region + jax.random.uniform(key, (4, 1)), jnp.full(4, competence, jnp.float32)
            return (rule.update(state, region, strategy, goals, seen), known), (region, strategy)

        return jax.lax.scan(block, (rule.state, known), (jnp.arange(blocks), keys))[1]

    def play(known=0.0, seed=0):
        arms = played(jax.random.split(jax.random.key(seed), blocks), known)
        return list(zip(*(arm.tolist() for arm in arms), strict=True))

    return play


def test_round_robin_takes_every_arm_in_turn_and_uniform_each_as_often():
    every = [(r, s) for r in range(R) for s in range(S)]
    nothing = lambda known, *_: (known, 0.0)  # noqa: E731
    assert player(selectors.round_robin(R, S), nothing, 8)() == every + every[:2]
    drawn = player(selectors.uniform(R, S), nothing, 600)()
    counts = np.array([drawn.count(arm) for arm in every])
    assert counts.min() > 60 and counts.max() < 140


@pytest.mark.parametrize(
    "settings", [{}, {"discount": 0.9}, {"window": 7}], ids=["UCB1", "discounted", "sliding window"]
)
def test_ucb_takes_the_arm_of_the_largest_bound(settings):
    rng = np.random.default_rng(0)
    table = rng.uniform(0, 1, (40, R, S)).astype(np.float32)
    bonus = 0.3
    seen = lambda table, t, r, s: (table, table[t, r, s])  # noqa: E731
    chosen = player(selectors.ucb(R, S, bonus=bonus, **settings), seen, 40)(table)
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


@pytest.mark.parametrize(
    "rule",
    [
        selectors.exp3(R, S, rate=0.03),
        selectors.exp3(R, S, rate=0.03, share=0.01),
        selectors.exp4(sgim.Config(), SPACE, S, rate=0.03),
    ],
    ids=["Exp3", "Exp3.S", "Exp4"],
)
def test_the_arm_that_makes_progress_comes_to_be_preferred(rule):
    """Competence of region 1 rises with strategy 0 and falls with strategy 1; elsewhere nothing changes."""

    def mean(level, t, r, s):
        level += jnp.where(r == 1, jnp.where(s == 0, 0.1, -0.1), 0.0)
        return level, jnp.where(r == 1, level, 0.5)

    chosen = player(rule, mean, 600)()
    late = chosen[300:]
    assert late.count((1, 0)) > 2 * max(late.count((r, s)) for r in range(R) for s in range(S) if (r, s) != (1, 0))


def test_fixed_frequency_asks_its_teacher_in_every_nth_block():
    rule = selectors.fixed_frequency(sgim.Config(), SPACE, S, teacher=1, every=3)
    assert [s for _, s in player(rule, lambda known, *_: (known, 0.5), 9)()] == [0, 0, 1] * 3


def test_exp4_trusts_its_experts_as_in_a_loop():
    config = sgim.Config()
    rule = selectors.exp4(config, SPACE, S, rate=0.2)
    update, probabilities, progress = jax.jit(rule.update), jax.jit(sgim.probabilities), jax.jit(sgim.progress)
    rng, state, weights, seen, last = np.random.default_rng(0), rule.state, np.zeros(2 + S), [], [None] * R
    for _ in range(60):
        region, strategy = rng.integers(R), rng.integers(S)
        competences = np.full(4, rng.uniform(), np.float32)
        grown = np.maximum(np.asarray(progress(state[0])), 0)
        where = 0.2 / R + 0.8 * (grown / grown.sum() if grown.sum() > 0 else np.full(R, 1 / R))
        own = np.asarray(probabilities(config, state[0]))[region, strategy]
        advised = np.array([1 / (R * S), own, *(where[region] * (s == strategy) for s in range(S))])
        trust = np.exp(weights - weights.max())
        probability = 0.9 * trust @ advised / trust.sum() + 0.1 / (R * S)
        seen.append(0.0 if last[region] is None else competences[0] - last[region])
        last[region] = competences[0]
        low, high = np.quantile(seen, [0.2, 0.8])
        reward = np.clip(2 * (seen[-1] - low) / max(high - low, 1e-9) - 1, -1, 1)
        weights += 0.2 * advised * reward / probability
        state = update(state, region, strategy, region + np.full((4, 1), 0.5, np.float32), competences)
    np.testing.assert_allclose(state[2], weights - weights.max(), atol=0.02)
    assert np.ptp(weights) > 0.5


def test_a_step_of_expectation_maximisation_is_that_of_a_loop():
    rng = np.random.default_rng(0)
    points, means = rng.normal(size=(20, 2)), rng.normal(size=(3, 2))
    weights, covariances = np.array([0.5, 0.3, 0.2]), np.array([np.eye(2), 2 * np.eye(2), [[1, 0.5], [0.5, 1]]])
    density = [
        w * stats.multivariate_normal(m, c).pdf(points) for w, m, c in zip(weights, means, covariances, strict=True)
    ]
    blame = np.array(density) / np.sum(density, axis=0)
    before = mixtures.Mixture(*(np.float32(x) for x in (weights, means, covariances)))
    after = jax.device_get(jax.jit(mixtures.improve)(before, np.float32(points), floor=0.1))
    for k in range(3):
        middle = np.average(points, axis=0, weights=blame[k])
        np.testing.assert_allclose(after.weights[k], blame[k].mean(), rtol=1e-3)
        np.testing.assert_allclose(after.means[k], middle, rtol=1e-3, atol=1e-4)
        spread = np.cov(points.T, aweights=blame[k], ddof=0) + 0.1 * np.eye(2)
        np.testing.assert_allclose(after.covariances[k], spread, rtol=1e-3, atol=1e-4)


def test_as_many_gaussians_are_fitted_as_there_are_clusters():
    rng, best_fit = np.random.default_rng(1), jax.jit(mixtures.best_fit, static_argnames="most")
    for centres in ([0.0], [-1.0, 1.0]):
        points = np.concatenate([rng.normal(centre, 0.2, (120 // len(centres), 1)) for centre in centres])
        found = best_fit(np.float32(points), most=2, key=jax.random.key(0))
        used = np.asarray(found.weights) > 0
        np.testing.assert_allclose(np.sort(np.asarray(found.means)[used, 0]), centres, atol=0.1)


def test_alp_gmm_draws_goals_where_competence_changes_either_way():
    rule = selectors.alp_gmm(SPACE, S, every=60, most=3, memory=400)
    play = player(rule, lambda noise, t, r, s: (noise, jnp.where(r == 1, noise[t], 0.5)), 120)
    for seed in (0, 18, 20, 23):  # where nothing changes, the mean of a Gaussian is 0 but for rounding, to either side
        chosen = play(np.random.default_rng(seed).uniform(size=120).astype(np.float32), seed)
        assert all(5 < [r for r, _ in chosen[:15]].count(r) + 4 for r in range(R))  # anywhere before the first fit
        late = chosen[30:]
        assert [r for r, _ in late].count(1) > 0.6 * len(late)
        assert 0.3 < np.mean([s for _, s in late]) < 0.7


def test_the_frontier_is_moved_by_practice_near_it_and_by_the_teacher_only_up_to_where_he_knows():
    bed = beds.frontier(noise=0.0)
    play = jax.jit(bed.play)

    def practise(front, strategy, *goals):
        at = np.int32(0), np.int32(strategy), np.float32(goals), np.array(False)
        return jax.device_get(play(np.float32(front), *at, key=jax.random.key(0)))

    def moved(front, strategy, goal):
        return float(practise(front, strategy, goal)[0]) - front

    assert moved(0.3, 0, [0.3, 0.0]) == pytest.approx(0.001, rel=0.01)
    assert moved(0.3, 1, [0.3, 0.0]) == pytest.approx(0.004, rel=0.01)
    for strategy, goal in ((2, [0.3, 0.0]), (0, [0.1, 0.28])):  # no effect; impossible
        assert abs(moved(0.3, strategy, goal)) < 1e-6
    assert abs(moved(0.3, 0, [0.9, 0.0])) < 1e-6
    assert abs(moved(0.7, 1, [0.7, 0.0])) < 1e-6
    np.testing.assert_allclose(practise(0.3, 0, [0.3, 0.0], [0.1, 0.28])[1], [0.5, 0.0], atol=0.01)


def test_practice_in_the_grid_is_that_of_a_loop():
    """Also in walls, before the key and after it, with the poor teacher, and across the door."""
    bed, rng = beds.key_and_door(), np.random.default_rng(0)
    play, key = jax.jit(bed.play), jax.random.key(0)
    rows, columns = beds.PLAN.shape
    skill, slow = bed.start, np.zeros((rows, columns))
    key_cell = next((i, j) for i in range(rows) for j in range(columns) if beds.PLAN[i, j] == "K")
    table = {False: [0.01, 0.0, 0.01], True: [0.002, 0.02, 0.01]}

    def learns(i, j):
        return beds.PLAN[i, j] != "#" and (j < 3 or slow[key_cell] > 0.7)

    def practise(goals, strategy):
        nonlocal skill
        region = int(goals[0][0]) * columns + int(goals[0][1])
        skill, seen = jax.device_get(play(skill, region, strategy, np.float32(goals), np.array(False), key=key))
        for goal, observed in zip(goals, seen, strict=True):
            cell = tuple(int(x) for x in goal)
            i, j = (0, 0) if strategy == 2 else cell
            if learns(i, j):
                spread = {(i, j): 1.0} | {(i + a, j + b): 0.25 for a, b in ((0, 1), (1, 0), (0, -1), (-1, 0))}
                inside = {c: x for c, x in spread.items() if 0 <= c[0] < rows and 0 <= c[1] < columns and learns(*c)}
                for c, share in inside.items():
                    slow[c] += share * table[j >= 3][strategy] * (1 - slow[c])
            np.testing.assert_allclose(observed, slow[cell], rtol=1e-3, atol=1e-5)

    draw = lambda: rng.uniform([0, 0], [rows, columns], (5, 2))  # noqa: E731
    for block in range(40):
        practise(draw(), block % 3)
    assert (slow[:, 3:] == 0).all() and slow[0, 0] > 0
    for _ in range(40):
        practise(np.tile(np.add(key_cell, 0.5), (5, 1)), 0)
    for block in range(60):
        practise(draw(), block % 3)
    assert slow[:, 4:].max() > 0.05 and (slow[beds.PLAN == "#"] == 0).all()
    np.testing.assert_allclose(skill, slow, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(bed.mastery(skill), slow.sum() / (beds.PLAN != "#").sum(), rtol=1e-3)


def test_the_oracle_does_what_the_law_makes_best():
    bed = beds.six_regions(noise=0.2)
    course = jax.device_get(jax.jit(lambda key: beds.run(bed, beds.oracle(bed), key=key))(jax.random.key(0)))
    assert course.mastery.mean() == pytest.approx(0.953, abs=0.002)
    assert 5 * int(beds.until_mastered(course)) == pytest.approx(1260, abs=20)
    assert (int(course.region[0]), int(course.strategy[0])) == (3, 2)
    needed = [int(np.argmax(course.region == r)) for r in range(3)]
    assert needed[0] < needed[1] < needed[2]
