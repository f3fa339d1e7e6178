"""Statistics of episodes, seeds and groups of runs, against slow ones written from the equations."""

import itertools
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from star.agent import episodes
from star.agent.episodes import Trials
from star.agent.play import MISHAPS, Episode
from star.report import statistics
from star.report.statistics import TAUS

GROUP = {"maze": [0.1, 0.9, 0.4, 0.4], "rooms": [0.0, 1.0, 0.7]}
OTHER = {"maze": [0.2, 0.4], "rooms": [0.7, 0.1, 0.9, 1.0], "fall": [0.5]}


def trials(reached, steps, path, there=None):
    """Episodes that begin at the origin."""
    unused = np.zeros(len(reached))
    rest = dict.fromkeys(("success_final", "distance", "total", *MISHAPS), unused)
    there = unused if there is None else np.array(there, float)
    ended = Episode(success_any=np.array(reached, float), time_at_goal=there, **rest)
    places = np.zeros((len(reached), 2))
    return Trials(
        episode=ended,
        steps=np.array(steps, float),
        path=np.array(path, float),
        start=places,
        goal=places,
        failure=places[:, 0],
    )


def slow_interquartile_mean(values):
    cut = len(values) // 4
    middle = sorted(values)[cut : len(values) - cut]
    return sum(middle) / len(middle)


def slow_improvement(better, than):
    tasks = [task for task in better if task in than]
    return sum(
        sum((x > y) + (x == y) / 2 for x, y in itertools.product(better[task], than[task]))
        / (len(better[task]) * len(than[task]))
        for task in tasks
    ) / len(tasks)


def slow_interval(groups, statistic):
    """Every task of every group drawn anew by itself, 2,000 times: the 2.5th and 97.5th percentiles."""
    draw = random.Random(1).choices
    found = [statistic(*({t: draw(x, k=len(x)) for t, x in g.items()} for g in groups)) for _ in range(2000)]
    return np.percentile(found, [2.5, 97.5], axis=0)


def test_the_interquartile_mean_of_groups_is_that_of_all_scores_with_draws_within_each_task():
    scores = {task: 5 * values for task, values in GROUP.items()}
    middle, *interval = statistics.pooled(scores, statistics.interquartile_mean)

    def slow(group):
        return slow_interquartile_mean([x for scores in group.values() for x in scores])

    assert middle == pytest.approx(slow(scores))
    np.testing.assert_allclose(interval, slow_interval([scores], slow), atol=0.05)
    few, *unknown = statistics.pooled(GROUP, statistics.interquartile_mean)
    assert few == pytest.approx((0.1 + 0.4 + 0.4 + 0.7 + 0.9) / 5) and np.isnan(unknown).all()


def test_a_profile_is_the_share_of_scores_above_each_threshold():
    every = np.array([x for values in GROUP.values() for x in values])
    share, low, high = statistics.profile(every)
    np.testing.assert_allclose(share, [sum(x > tau for x in every) / len(every) for tau in TAUS])
    assert share[0] == 6 / 7 and share[-1] == 0.0
    assert (low <= share).all() and (share <= high).all() and high[-1] == pytest.approx(1 - 0.025 ** (1 / 7))


def test_the_probability_of_improvement_is_a_mean_over_common_tasks_of_pairs_with_half_a_tie():
    chance = statistics.improvement(GROUP, OTHER)
    assert chance == pytest.approx(slow_improvement(GROUP, OTHER))
    assert chance + statistics.improvement(OTHER, GROUP) == pytest.approx(1.0)
    assert statistics.improvement({"maze": [1.0]}, {"fall": [0.0]}) is None
    assert statistics.improvement({"maze": [1.0, 1.0]}, {"maze": [0.0]}) == 1.0


@settings(max_examples=30)
@given(st.integers(2, 12), st.integers(2, 12), st.integers(0, 2**32 - 1))
def test_intervals_are_those_of_the_textbook_where_seeds_differ(n, m, seed):
    rng = np.random.default_rng(seed)
    one, other = rng.normal(size=n), 3 + 2 * rng.normal(size=m)
    mean, low, high = statistics.over_seeds(one)
    expected = stats.t.interval(0.95, n - 1, loc=one.mean(), scale=stats.sem(one))
    np.testing.assert_allclose([mean, low, high], [one.mean(), *expected])
    np.testing.assert_allclose(statistics.over_tasks({"maze": one}), [mean, low, high])
    apart = statistics.difference({"maze": one}, {"maze": other})
    welch = stats.ttest_ind(one, other, equal_var=False).confidence_interval()
    np.testing.assert_allclose(apart, [one.mean() - other.mean(), welch.low, welch.high])


@settings(max_examples=30)
@given(st.sampled_from([0.0, 0.5, 0.98, 1.0]), st.integers(2, 10), st.integers(1, 500))
def test_seeds_that_agree_leave_open_what_their_episodes_leave_open(score, n, episodes):
    scores = np.full(n, round(score * episodes) / episodes)
    for mean, low, high in (
        statistics.over_seeds(scores, episodes=episodes),
        statistics.over_tasks({"maze": scores}, episodes=episodes),
    ):
        assert 0 <= low <= mean <= high <= 1 and low < high
    _, low, high = statistics.difference({"maze": scores}, {"maze": scores}, episodes=episodes)
    assert low < 0 < high


def test_one_seed_tells_nothing_of_others():
    assert np.isnan(statistics.over_seeds(np.ones(1), episodes=100)[1:]).all()
    assert np.isnan(statistics.over_tasks({"maze": [1.0], "rooms": [0.5, 0.7]}, episodes=100)[1:]).all()
    assert np.isnan(statistics.difference({"maze": [1.0]}, {"maze": [0.5, 0.7]}, episodes=100)[1:]).all()
    assert statistics.difference({"maze": [1.0]}, {"fall": [0.5, 0.7]}) is None


def test_how_many_seeds_have_learnt_comes_with_the_exact_interval():
    found = statistics.above([1.0, 0.95, 0.9, 0.0, 1.0])
    assert (found["seeds"], found["of"]) == (3, 5)
    np.testing.assert_allclose(found["interval"], [0.1466, 0.9473], atol=1e-4)


@pytest.mark.parametrize("n", [3, 5, 10, 20])
def test_of_normal_seeds_intervals_hold_the_truth_as_often_as_they_say(n):
    rng = np.random.default_rng(n)
    _, low, high = statistics.over_seeds(rng.normal(0.6, 0.1, size=(n, 4000)), episodes=10_000)
    assert 0.93 <= ((low < 0.6) & (0.6 < high)).mean() <= 0.97


def test_a_single_score_stays_as_it_is_while_others_are_drawn():
    middle, low, high = statistics.stratified([[1.0], [0.0, 0.5]], lambda one, two: one.mean() + two.mean())
    assert (middle, low, high) == (1.25, 1.0, 1.5)


def test_time_and_way_are_means_over_the_episodes_that_arrive():
    found = episodes.summarise_way(trials([1, 0, 1], [10, 500, 30], [5.0, 99.0, 9.0]), None, dt=0.1, length=500)
    assert (found["steps_to_goal"], found["path_length"]) == (20.0, 7.0)
    assert found["seconds_to_goal"] == pytest.approx(2.0)
    low, high = found["path_length_interval"]
    assert low < 7.0 < high and found["spl"] is None
    nobody = episodes.summarise_way(trials([0, 0], [500, 500], [9.0, 9.0]), np.ones(2), dt=0.1, length=500)
    assert nobody["steps_to_goal"] is nobody["path_length_interval"] is None and nobody["spl"] == 0.0


def test_who_stayed_at_the_goal_was_there_from_the_first_arrival_to_the_end():
    """Arrivals at env steps 1, 401 and 500 of 500: there all the time, half of it, and at the last step alone."""
    found = trials([1, 1, 1, 0], [1, 401, 500, 500], [0.0] * 4, there=[500, 50, 1, 0])
    assert episodes.summarise_way(found, None, dt=0.1, length=500)["stayed"] == pytest.approx(2.5 / 3)
    assert episodes.summarise(found.episode)["time_at_goal"] == 551 / 4
    nobody = episodes.summarise_way(trials([0], [500], [9.0]), None, dt=0.1, length=500)
    assert nobody["stayed"] is nobody["stayed_interval"] is None


def test_success_is_weighted_by_how_much_longer_than_the_shortest_the_way_was():
    reached, path = np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0]), np.array([10.0, 20.0, 10.0, 0.0, 9.0, 3.0])
    shortest = np.array([10.0, 10.0, 10.0, 0.0, 10.0, np.inf])
    np.testing.assert_allclose(episodes.weighted_success(reached, path, shortest), [1.0, 0.5, 0.0, 1.0, 1.0])
