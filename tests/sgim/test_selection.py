"""What SGIM selects: against a slow implementation with lists, its exact distribution, and how it follows splits."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from star import sgim
from star.abstraction import regions

R, S, D = 5, 3, 2  # capacity, of which four regions are active
CONFIG = sgim.Config(window=6, per_block=3)
COSTS = [1.0, 2.0, 5.0]


@cache
def four_regions():
    return regions.create(((0.0, 0.0), (4.0, 4.0)), ((2.0,), (2.0,)), max_regions=R)


def begun(config=CONFIG, costs=COSTS, table=None):
    """Nothing practised yet, in four regions or those of a `table`, in NumPy."""
    return jax.device_get(sgim.init(config, four_regions() if table is None else table, costs))


def choice_of(region, strategy, goal):
    n = len(region)
    return sgim.Choice(
        region=np.asarray(region, np.int32),
        strategy=np.asarray(strategy, np.int32),
        goal=np.asarray(goal, np.float32),
        mode=np.zeros(n, np.int32),
        log_prob=np.zeros(n, np.float32),
    )


def random_block(rng, n=8, regions_in_use=4):
    region = rng.integers(0, regions_in_use, n)
    corner = np.array([[0, 0], [0, 2], [2, 0], [2, 2]])[region % 4]
    goal = (corner + rng.uniform(0.01, 1.99, (n, D))).astype(np.float32)
    return choice_of(region, rng.integers(0, S, n), goal), rng.uniform(0, 1, n).astype(np.float32)


# Compiled once, not each time that a test calls them.
update = jax.jit(sgim.update)
probabilities = jax.jit(sgim.probabilities)
progress, interest = jax.jit(sgim.progress), jax.jit(sgim.interest)
select = jax.jit(sgim.select)
locate = jax.jit(jax.vmap(regions.locate, in_axes=(None, 0)))


@partial(jax.jit, static_argnames="n")
def drawn(config, state, key, available, admissible, *, n):
    return jax.vmap(lambda key: sgim.select(config, state, available, admissible, key=key))(jax.random.split(key, n))


def draw(config, state, *, seed=0, n=4000, available=(True,) * S, admissible=(True,) * R):
    """`n` choices, in NumPy."""
    masks = np.array(available), np.array(admissible)
    return jax.device_get(drawn(config, state, jax.random.key(seed), *masks, n=n))


@partial(jax.jit, static_argnames="region")
def cut_at(state, position, *, region):
    """The state after a cut of a region along dimension 1, and whether it was cut."""
    cut = regions.Cut(region=jnp.array(region), dimension=jnp.array(1), position=position)
    after, done = regions.split(state.abstraction, cut, min_width=0.1)
    return sgim.on_split(state, after, regions.Split(done, cut, state.abstraction.count)), done


def practised(blocks, seed=0, config=CONFIG):
    """A state after `blocks` random blocks, and what they were."""
    rng = np.random.default_rng(seed)
    state, history = begun(config), []
    for _ in range(blocks):
        choice, competences = random_block(rng)
        state = update(config, state, choice, competences)
        history.append((choice, competences))
    return jax.device_get(state), history


class Slow:
    """The same with lists, region by region."""

    def __init__(self, config):
        self.config = config
        self.remembered = [[] for _ in range(R)]
        self.last = [None] * R  # mean and shares of the block before
        self.gains, self.doubt = np.zeros((R, S)), np.ones((R, S))

    def block(self, choice, competences):
        for r in range(R):
            mine = np.asarray(choice.region) == r
            if not mine.any():
                continue
            mean = competences[mine].mean()
            shares = np.bincount(np.asarray(choice.strategy)[mine], minlength=S) / mine.sum()
            if self.last[r] is not None:
                due = (shares + self.last[r][1]) / 2
                error = mean - self.last[r][0] - due @ self.gains[r]
                rate = due * self.doubt[r] / (1 + due**2 @ self.doubt[r])
                self.gains[r] += rate * error
                self.doubt[r] *= 1 - rate * due
            self.last[r] = mean, shares
        self.doubt += self.config.drift

    def progress(self, r):
        last = self.remembered[r][-self.config.window :]
        half = len(last) // 2
        return np.mean(last[-half:]) - np.mean(last[-2 * half : -half]) if half else 0.0

    def interest(self, r, s):
        hope = min(self.config.optimism, max(self.gains.max(), 1e-6))
        return (max(self.gains[r, s], 0) + hope * self.doubt[r, s] ** 0.5) / COSTS[s]

    def probability(self, available, admissible):
        pairs = [(r, s) for r in np.flatnonzero(admissible[:4]) for s in np.flatnonzero(available)]
        wanted = [self.interest(r, s) ** self.config.sharpness for r, s in pairs]
        total = np.zeros((R, S))
        for pair, worth in zip(pairs, wanted, strict=True):
            total[pair] = self.config.random / len(pairs) + (1 - self.config.random) * worth / sum(wanted)
        return total


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**31),
    blocks=st.integers(0, 12),
    absent=st.sets(st.integers(0, S - 1), max_size=S - 1),
    barred=st.sets(st.integers(0, 3), max_size=3),
)
def test_probabilities_are_those_of_lists(seed, blocks, absent, barred):
    """No region gets more than `per_block` episodes of a block here, since any of them might be left out."""
    config = sgim.Config(window=16, per_block=8)
    state, history = practised(blocks, seed, config)
    slow = Slow(config)
    for choice, competences in history:
        slow.block(choice, competences)
    for r in range(4):  # the order within a block is drawn at random: read it off the window
        slow.remembered[r] = remembered(state, r)
    available = np.array([s not in absent for s in range(S)])
    admissible = np.array([r not in barred for r in range(R)])
    found = np.asarray(probabilities(config, state, available, admissible))
    np.testing.assert_allclose(
        np.asarray(interest(config, state))[:4], [[slow.interest(r, s) for s in range(S)] for r in range(4)], atol=1e-5
    )
    np.testing.assert_allclose(found, slow.probability(available, admissible), atol=1e-3)
    np.testing.assert_allclose(np.asarray(progress(state))[:4], [slow.progress(r) for r in range(4)], atol=1e-5)
    np.testing.assert_allclose(found.sum(), 1, atol=1e-5)
    assert (found[:, ~available] == 0).all() and (found[~admissible] == 0).all() and (found[4] == 0).all()


def remembered(state, r):
    """Competences in the window of region r, oldest first."""
    written, window = int(state.written[r]), state.competences.shape[1]
    return [float(state.competences[r, i % window]) for i in range(max(0, written - window), written)]


def test_each_region_remembers_its_last_episodes_and_at_most_so_many_of_a_block():
    state = begun()
    block = choice_of([0] * 5 + [3], [0] * 6, [[1, 1]] * 5 + [[3, 3]])
    state = jax.device_get(update(CONFIG, state, block, np.float32([0.1, 0.2, 0.3, 0.4, 0.5, 0.9])))
    assert len(remembered(state, 0)) == 3 and set(np.round(remembered(state, 0), 3)) < {0.1, 0.2, 0.3, 0.4, 0.5}
    np.testing.assert_allclose(remembered(state, 3), [0.9])
    np.testing.assert_allclose(state.mean[[0, 3]], [0.3, 0.9])  # of all episodes
    for competence in (0.6, 0.7, 0.8, 0.85):
        state = update(CONFIG, state, choice_of([0], [1], [[1, 1]]), np.float32([competence]))
    state = jax.device_get(state)
    assert len(remembered(state, 0)) == 6
    np.testing.assert_allclose(remembered(state, 0)[2:], [0.6, 0.7, 0.8, 0.85], rtol=1e-6)
    assert int(state.blocks) == 5 and float(state.episodes.sum()) == 10


def test_select_draws_as_often_as_probabilities_say():
    state, _ = practised(10, 3)
    masks = np.array([True, False, True]), np.array([True, True, False, True, True])
    chosen = draw(CONFIG, state, n=100_000, available=masks[0], admissible=masks[1])
    expected = np.asarray(probabilities(CONFIG, state, *masks))
    counts = np.zeros((R, S))
    np.add.at(counts, (chosen.region, chosen.strategy), 1)
    possible = expected > 0
    assert counts[~possible].sum() == 0 and possible.sum() == 6
    wanted = expected[possible].astype(float)
    assert stats.chisquare(counts[possible], wanted / wanted.sum() * 100_000).pvalue > 1e-3
    np.testing.assert_allclose(chosen.log_prob, np.log(expected[chosen.region, chosen.strategy]), rtol=1e-5)
    modes = np.bincount(chosen.mode, minlength=3) / 100_000
    np.testing.assert_allclose(modes, [0.05, 0.75, 0.2], atol=0.01)


WORST = sgim.Config(window=8, per_block=4, best_point="worst", random=0.0, best=1.0)
FIRST = np.arange(R) == 0


def test_goals_lie_in_their_region_and_near_its_best_point_if_the_mode_says_so():
    goals = [[0.2, 0.2], [1.5, 1.5], [1.0, 0.3], [0.4, 1.8]]
    state = update(WORST, begun(WORST), choice_of([0] * 4, [0] * 4, goals), np.float32([0.8, 0.1, 0.5, 0.6]))
    near = draw(WORST, state, seed=1, admissible=FIRST).goal
    assert (np.abs(near - np.array([1.5, 1.5])) <= 0.2 + 1e-6).all()  # a tenth of a width of 2
    anywhere = draw(WORST, state, seed=1, admissible=~FIRST)
    np.testing.assert_array_equal(locate(four_regions(), anywhere.goal), anywhere.region)


def test_the_best_point_by_progress_is_where_competence_grew_most_between_neighbours():
    config = sgim.Config(window=6, per_block=3, random=0.0, best=1.0, focus=0.01)
    state = begun(config)
    for goal, competence in [
        ([0.2, 0.2], 0.1), ([1.8, 1.8], 0.6), ([1.0, 1.0], 0.4),
        ([0.3, 0.2], 0.5), ([1.7, 1.8], 0.7), ([1.1, 1.0], 0.4),
    ]:  # fmt: skip
        state = update(config, state, choice_of([0], [0], [goal]), np.float32([competence]))
    chosen = draw(config, state, admissible=FIRST)
    np.testing.assert_allclose(chosen.goal[0], [0.3, 0.2], atol=0.02 + 1e-6)


def test_what_is_not_finite_is_counted_and_changes_nothing_else():
    state, _ = practised(4)
    rng = np.random.default_rng(7)
    choice, competences = random_block(rng)
    broken, lost = competences.copy(), np.array(choice.goal)
    broken[[1, 4]], lost[6, 0] = [np.nan, np.inf], np.nan
    kept = np.isfinite(broken) & np.isfinite(lost).all(axis=1)
    refused = update(CONFIG, state, choice.replace(goal=lost), broken)
    left_out = update(CONFIG, state, choice, competences, weight=np.float32(kept))
    assert int(refused.refused) == 3 and int(left_out.refused) == 0
    assert_same(refused.replace(refused=left_out.refused), left_out)
    assert np.isfinite(np.asarray(probabilities(CONFIG, refused))).all()


def assert_same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_independent_learners_can_be_vmapped_and_without_jit_all_is_the_same():
    states = [practised(6, seed)[0] for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *states)
    keys = [jax.random.key(seed) for seed in range(3)]
    together = jax.jit(jax.vmap(lambda state, seed: sgim.select(CONFIG, state, key=jax.random.key(seed))))
    together = jax.device_get(together(stacked, np.arange(3)))
    for i, (state, key) in enumerate(zip(states, keys, strict=True)):
        alone = (
            sgim.select(CONFIG, jax.tree.map(jnp.asarray, state), key=key) if i == 0 else select(CONFIG, state, key=key)
        )
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
            np.testing.assert_allclose(a, b[i], rtol=1e-5)
    rng = np.random.default_rng(1)
    choice, competences = random_block(rng)
    first, choice, competences = jax.tree.map(jnp.asarray, (states[0], choice, competences))
    fast, slow = update(CONFIG, first, choice, competences), sgim.update(CONFIG, first, choice, competences)
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_a_split_hands_every_remembered_goal_to_the_part_it_lies_in_and_compiles_nothing():
    traces = 0

    @jax.jit
    def step(state, keys):
        nonlocal traces
        traces += 1
        choices = jax.vmap(lambda key: sgim.select(CONFIG, state, key=key))(keys)
        return sgim.update(CONFIG, state, choices, jnp.ones(len(keys))), choices

    state, _ = practised(9, 2)
    keys = jax.random.split(jax.random.key(1), 500)
    step(state, keys)
    before = list(zip(state.goals[0].tolist(), state.competences[0].tolist(), strict=True))
    oldest = int(state.written[0]) % CONFIG.window  # nine blocks fill the window
    in_time = before[oldest:] + before[:oldest]
    parted, done = jax.device_get(cut_at(state, 1.0, region=0))
    assert bool(done)
    for part, above in ((0, False), (4, True)):
        mine = [(goal, competence) for goal, competence in in_time if (goal[1] >= 1.0) == above]
        assert int(parted.written[part]) == len(mine) > 0
        np.testing.assert_allclose(parted.goals[part, : len(mine)], [goal for goal, _ in mine])
        np.testing.assert_allclose(parted.competences[part, : len(mine)], [c for _, c in mine])
        np.testing.assert_array_equal(parted.gains[part], state.gains[0])
    np.testing.assert_allclose(parted.episodes.sum(), state.episodes.sum(), rtol=1e-6)
    _, choices = step(parted, keys)
    assert traces == 1
    assert 4 in np.asarray(choices.region)


LEARNT = sgim.Config(window=60, min_side=5)


@jax.jit
def practise(state, regions, goals, competences):
    """The state after blocks of one episode each, and whether a region was cut then."""

    def once(state, block):
        region, goal, competence = jax.tree.map(lambda x: x[None], block)
        zero = jnp.zeros_like(region)
        choice = sgim.Choice(region=region, strategy=zero, goal=goal, mode=zero, log_prob=0.0 * competence)
        return sgim.update(LEARNT, state, choice, competence), None

    state, _ = jax.lax.scan(once, state, (regions, goals, competences))
    return sgim.split(LEARNT, state)


def learnt(cuts, blocks):
    """The parted state, and whether it was cut, after `blocks` of (region, goal, competence) in the space [0, 4]^2."""
    table = regions.create(((0.0, 0.0), (4.0, 4.0)), cuts, max_regions=3)
    where, goals, competences = zip(*blocks, strict=True)
    arrays = np.int32(where), np.float32(goals), np.float32(competences)
    return jax.device_get(practise(begun(LEARNT, [1.0], table), *arrays))


@pytest.mark.parametrize("dimension", [0, 1])
def test_a_region_of_its_own_is_cut_where_progress_differs(dimension):
    """Competence grows where the coordinate is above 2.6, elsewhere it is noise."""
    hits = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        blocks = []
        for t in range(60):
            goal = rng.uniform(0, 4, 2)
            blocks.append((0, goal, t / 60 if goal[dimension] > 2.6 else 0.5 + 0.1 * rng.normal()))
        parted, done = learnt(((), ()), blocks)
        assert bool(done) and int(parted.abstraction.count) == 2
        assert int(parted.written.sum()) == 60
        width = parted.abstraction.upper[0] - parted.abstraction.lower[0]
        hits += width[dimension] < 4 and 1.6 < width[dimension] < 3.4
    assert hits >= 9


def test_where_nothing_was_practised_nothing_is_cut():
    parted, done = learnt(((), ()), [(0, (1.0, 1.0), np.nan)] * 60)  # which does not count
    assert not bool(done) and not parted.written.any()


def test_a_region_that_cannot_be_cut_does_not_keep_others_from_it():
    """Region 0 remembers one goal again and again; in region 1 competence grows on one side."""
    rng, blocks = np.random.default_rng(0), []
    for t in range(60):
        blocks.append((0, (0.5, 2.0), rng.uniform()))
        goal = rng.uniform(2, 4)
        blocks.append((1, (goal, 2.0), t / 60 if goal > 3 else 0.5))
    parted, done = learnt(((2.0,), ()), blocks)
    assert bool(done) and 2.5 < float(parted.abstraction.upper[1, 0]) < 3.5


def test_where_nothing_is_learnt_a_shift_of_attention_makes_no_cut():
    """Older goals lie on the left, newer ones on the right; all are reached equally well."""
    rng = np.random.default_rng(0)
    blocks = [(0, (rng.uniform(0, 2) + 2 * (t >= 30), 2.0), 0.8) for t in range(60)]
    assert not bool(learnt(((), ()), blocks)[1])


def test_goals_near_a_face_stay_in_their_region():
    block = choice_of([0] * 4, [0] * 4, [[1.95, 0.01]] * 4)
    state = update(WORST, begun(WORST), block, np.full(4, 0.1, np.float32))
    chosen = draw(WORST, state, admissible=FIRST)
    assert (np.asarray(locate(four_regions(), chosen.goal)) == 0).all() and len(np.unique(chosen.goal[:, 0])) > 400


def test_lost_competence_is_worth_what_forgetting_says():
    state = begun(costs=[1.0, 1.0])
    state = state.replace(gains=np.tile(np.float32([-0.3, 0.3]), (R, 1)))
    for forgetting, expected in ((0.0, 0.0), (0.5, 0.15), (1.0, 0.3)):
        config = sgim.Config(forgetting=forgetting, optimism=0.0)
        np.testing.assert_allclose(np.asarray(interest(config, state))[0], [expected, 0.3], rtol=1e-6)


def test_what_is_unknown_is_worth_no_more_than_the_best_that_is_known():
    config = sgim.Config(optimism=0.1)
    for best in (0.001, 0.5):
        known = begun(config, [1.0, 1.0])
        gains, doubt = known.gains.copy(), known.doubt.copy()
        gains[0, 0], doubt[0, 0] = best, 0.0
        found = np.asarray(interest(config, known.replace(gains=gains, doubt=doubt)))
        np.testing.assert_allclose([found[0, 0], found[1, 0]], [best, min(best, config.optimism)], rtol=1e-5)


def test_what_was_not_tried_for_long_is_tried_again():
    """All that was ever played has brought nothing; the pair that waits longest becomes the most interesting."""
    state = begun(costs=[1.0, 1.0])
    for region, strategy in [(0, 0), (0, 0), (0, 1), (0, 1)] + 40 * [(1, 0)]:
        state = update(CONFIG, state, choice_of([region], [strategy], [[1.0, 1.0]]), np.float32([0.5]))
    found = np.asarray(interest(CONFIG, state))
    assert found[2, 0] == found[1, 1] > found[0, 0] > found[1, 0] > 0


@pytest.mark.parametrize("costs", [[], [1.0, 0.0], [1.0, -2.0], [float("nan")], [[1.0, 2.0]]])
def test_costs_that_are_not_positive_numbers_are_refused_in_one_line(costs):
    with pytest.raises(ValueError, match="^costs: .*allowed: a list of positive numbers") as caught:
        sgim.init(CONFIG, four_regions(), costs)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "values, said", [({"random": 0.7, "best": 0.4}, "make more than 1"), ({"window": 8}, "more than half of window 8")]
)
def test_settings_that_do_not_fit_one_another_are_refused(values, said):
    with pytest.raises(ValueError, match=said):
        sgim.Config(**values)


@pytest.mark.parametrize("random, best", [(0.8, 0.2), (1.0, 0.0), (0.0, 0.3)])
def test_modes_are_drawn_as_often_as_their_shares_say(random, best):
    config = sgim.Config(window=6, per_block=3, random=random, best=best)
    chosen = draw(config, practised(4, config=config)[0])
    modes = np.bincount(chosen.mode, minlength=3) / len(chosen.mode)
    np.testing.assert_allclose(modes, [random, 1 - random - best, best], atol=0.03)


@pytest.mark.parametrize("available, admissible", [([False] * S, [True] * R), ([True] * S, [False] * R)])
def test_where_nothing_is_left_to_choose_the_choice_says_so(available, admissible):
    state, _ = practised(4)
    assert not np.asarray(probabilities(CONFIG, state, np.array(available), np.array(admissible))).any()
    assert (draw(CONFIG, state, available=available, admissible=admissible).log_prob == -np.inf).all()


def test_a_cut_alone_credits_no_strategy():
    """The parts differ in competence, but nothing is learnt in either."""
    state, competences = begun(), np.float32([0.9, 0.1] * 4)
    goals = [[0.5, 0.5], [0.5, 1.5]] * 4
    for _ in range(3):
        state = update(CONFIG, state, choice_of([0, 0] * 4, [0, 1] * 4, goals), competences)
    np.testing.assert_allclose(state.gains, 0, atol=1e-6)
    state, _ = cut_at(state, 1.0, region=0)
    for _ in range(2):
        state = update(CONFIG, state, choice_of([0, 4] * 4, [0, 1] * 4, goals), competences)
    np.testing.assert_allclose(state.gains, 0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(state.mean)[[0, 4]], [0.9, 0.1])


def test_an_absent_strategy_does_not_drown_the_differences_between_those_available():
    config = sgim.Config(window=6, per_block=3, sharpness=20.0, optimism=0.0)
    state, _ = practised(4, config=config)
    state = state.replace(gains=np.tile(np.float32([0.1, 1e-4, 0.0]), (R, 1)))
    shares = np.asarray(probabilities(config, state, np.array([False, True, True]), np.ones(R, bool))).sum(axis=0)
    assert shares[0] == 0 and shares[1] > 3 * shares[2]


def test_a_barred_region_does_not_drown_the_differences_between_those_admissible():
    state, _ = practised(4)
    gains = np.zeros((R, S), np.float32)
    gains[:3, 0] = [1e6, 0.1, 0.05]
    shares = np.asarray(probabilities(CONFIG, state.replace(gains=gains), np.ones(S, bool), ~FIRST)).sum(axis=1)
    assert shares[0] == 0 and shares[1] > 3 * shares[2] > 0
