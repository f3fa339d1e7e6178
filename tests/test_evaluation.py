"""Statistics of episodes, seeds and groups of runs, against slow ones written from the equations."""

import itertools
import random

import numpy as np
import pytest

from star import evaluation
from star.agent.play import Episode
from star.evaluation import TAUS, Trials

GROUP = {"maze": [0.1, 0.9, 0.4, 0.4], "rooms": [0.0, 1.0, 0.7]}
OTHER = {"maze": [0.2, 0.4], "rooms": [0.7, 0.1, 0.9, 1.0], "fall": [0.5]}


def trials(reached, steps, path):
    """Episodes that begin at the origin."""
    unused = np.zeros(len(reached))
    rest = dict.fromkeys(("success_final", "distance", "total", "flipped"), unused)
    ended = Episode(success_any=np.array(reached, float), **rest)
    places = np.zeros((len(reached), 2))
    return Trials(episode=ended, steps=np.array(steps, float), path=np.array(path, float), start=places, goal=places)


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
    middle, *interval = evaluation.pooled(GROUP, evaluation.interquartile_mean)

    def slow(group):
        return slow_interquartile_mean([x for scores in group.values() for x in scores])

    assert middle == pytest.approx(slow(GROUP)) == pytest.approx((0.1 + 0.4 + 0.4 + 0.7 + 0.9) / 5)
    np.testing.assert_allclose(interval, slow_interval([GROUP], slow), atol=0.05)


def test_a_profile_is_the_share_of_scores_above_each_threshold():
    share, low, high = evaluation.pooled(GROUP, evaluation.profile)

    def slow(group):
        scores = [x for values in group.values() for x in values]
        return [sum(x > tau for x in scores) / len(scores) for tau in TAUS]

    np.testing.assert_allclose(share, slow(GROUP))
    assert share[0] == 6 / 7 and share[-1] == 0.0
    np.testing.assert_allclose([low, high], slow_interval([GROUP], slow), atol=0.15)


def test_the_probability_of_improvement_is_a_mean_over_common_tasks_of_pairs_with_half_a_tie():
    middle, *interval = evaluation.improvement(GROUP, OTHER)
    assert middle == pytest.approx(slow_improvement(GROUP, OTHER))
    assert middle + evaluation.improvement(OTHER, GROUP)[0] == pytest.approx(1.0)
    np.testing.assert_allclose(interval, slow_interval([GROUP, OTHER], slow_improvement), atol=0.05)
    assert evaluation.improvement({"maze": [1.0]}, {"fall": [0.0]}) is None
    assert evaluation.improvement({"maze": [1.0, 1.0]}, {"maze": [0.0]}) == (1.0, 1.0, 1.0)


def test_a_single_score_stays_as_it_is_while_others_are_drawn():
    middle, low, high = evaluation.stratified([[1.0], [0.0, 0.5]], lambda one, two: one.mean() + two.mean())
    assert (middle, low, high) == (1.25, 1.0, 1.5)


def test_time_and_way_are_means_over_the_episodes_that_arrive():
    found = evaluation.summarise_way(trials([1, 0, 1], [10, 500, 30], [5.0, 99.0, 9.0]), None, dt=0.1)
    assert (found["steps_to_goal"], found["path_length"]) == (20.0, 7.0)
    assert found["seconds_to_goal"] == pytest.approx(2.0)
    low, high = found["path_length_interval"]
    assert low < 7.0 < high and found["spl"] is None
    nobody = evaluation.summarise_way(trials([0, 0], [500, 500], [9.0, 9.0]), np.ones(2), dt=0.1)
    assert nobody["steps_to_goal"] is nobody["path_length_interval"] is None and nobody["spl"] == 0.0


def test_success_is_weighted_by_how_much_longer_than_the_shortest_the_way_was():
    reached, path = np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0]), np.array([10.0, 20.0, 10.0, 0.0, 9.0, 3.0])
    shortest = np.array([10.0, 10.0, 10.0, 0.0, 10.0, np.inf])
    np.testing.assert_allclose(evaluation.weighted_success(reached, path, shortest), [1.0, 0.5, 0.0, 1.0, 1.0])


def test_the_share_of_failures_that_end_on_the_back_is_none_where_nothing_fails():
    rest = dict.fromkeys(("success_final", "distance", "total"), np.zeros(4))
    ended = Episode(success_any=np.array([1.0, 0.0, 0.0, 0.0]), flipped=np.array([1.0, 1.0, 0.0, 1.0]), **rest)
    found = evaluation.summarise(ended)
    assert found["flipped"] == 3 / 4 and found["failed_flipped"] == 2 / 3
    assert evaluation.summarise(ended.replace(success_any=np.ones(4)))["failed_flipped"] is None
