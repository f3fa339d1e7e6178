import jax
import numpy as np
import pytest

from envs import worlds
from envs.worlds import table
from envs.worlds.table import Hand, Tasks
from tests.envs.worlds import slow
from tests.scripts import load

WORLD = worlds.make("table")
SHARES = (0.142, 0.0, 0.0, 0.0, 0.0058, 0.0)  # of random single primitives, by task
N = 300


def shown(world, task):
    goals = world.benchmark(task)
    return goals, *jax.device_get(world.demonstrate(task, goals))


def traced(sequences, lengths):
    """What comes of them. One size of batch: it is compiled once."""
    n = len(sequences)
    padded = [np.resize(np.asarray(one), (N, *np.shape(one)[1:])) for one in (sequences, lengths)]
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:n], WORLD.trace(*padded))


def test_it_agrees_with_a_slow_simulation():
    rng = np.random.default_rng(0)
    taught = np.concatenate([np.asarray(shown(WORLD, task)[1])[:8] for task in Tasks])
    varied = np.clip(taught + rng.normal(0, 0.03, taught.shape), -1, 1)
    sequences = np.concatenate([taught, varied, rng.uniform(-1, 1, (12, 5, 18))]).astype(np.float32)
    lengths = np.resize(np.arange(5, 0, -1), len(sequences))
    found = traced(sequences, lengths).outcomes
    expected = [slow.table(*one) for one in zip(sequences, lengths, strict=True)]
    # A goal on the edge of the table is touched or not by a rounding.
    same = (found.reached == [reached for _, reached, _ in expected]).all(axis=1)
    assert same.mean() > 0.97
    np.testing.assert_allclose(found.value[same], np.array([value for value, _, _ in expected])[same], atol=2e-3)
    assert (found.reached.sum(axis=0) > 1).all()


@pytest.mark.parametrize("task", Tasks, ids=lambda task: task.name.lower())
def test_the_teacher_reaches_every_goal_of_the_evaluation(task):
    goals, sequences, lengths = shown(WORLD, task)
    found = traced(sequences, lengths).outcomes
    assert len(goals) == N and np.abs(sequences).max() <= 1
    assert found.reached[:, task].all() and np.abs(found.value[:, task] - goals).max() < 2e-3


def test_random_primitives_touch_as_often_as_the_page_says():
    sequences = np.random.default_rng(7).uniform(-1, 1, (20, N, 5, 18))
    parts = [traced(one, np.ones(N, int)).outcomes for one in sequences]
    found = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    for count, share in zip(found.reached.sum(axis=0), SHARES, strict=True):
        assert abs(count - 20 * N * share) <= 4 * np.sqrt(20 * N * share * (1 - share))
    lower, upper = (np.asarray(bound) for bound in (WORLD.lower, WORLD.upper))
    inside = (found.value >= lower - 1e-6) & (found.value <= upper + 1e-6)
    assert (inside.all(axis=-1) | ~found.reached).all()


def test_goals_are_reached_by_their_parts_one_after_the_other():
    levels = {
        Tasks.BLUE: (Tasks.TOUCH,) * 2,
        Tasks.BURST: (Tasks.BLUE, Tasks.GREEN),
        Tasks.TUNE: (Tasks.BURST, Tasks.RHYTHM),
    }
    for task, tasks in levels.items():
        goals = WORLD.benchmark(task)
        parts = jax.device_get(WORLD.decompose(task, goals))
        assert parts.exists.all() and (parts.tasks == np.array(tasks)).all()
        (first, n), (second, m) = (
            jax.device_get(WORLD.demonstrate(one, parts.goals[:, i])) for i, one in enumerate(tasks)
        )
        joined = np.zeros_like(first)
        joined[:, : n[0]], joined[:, n[0] : n[0] + m[0]] = first[:, : n[0]], second[:, : m[0]]
        found = traced(joined, n + m).outcomes
        assert found.reached[:, task].all() and np.abs(found.value[:, task] - goals).max() < 2e-3
    assert not WORLD.decompose(Tasks.RHYTHM, np.zeros(4)).exists


def test_the_hand_holds_one_object_between_two_touches_and_sounds_come_with_the_last_one():
    goals, sequences, lengths = shown(WORLD, Tasks.TUNE)
    path = jax.tree.map(lambda leaf: leaf[0], traced(sequences, lengths).path)
    ends = np.arange(1, 6) * table.STEPS - 1
    assert path.hand[ends].tolist() == [Hand.BLUE, Hand.NOTHING, Hand.GREEN, Hand.NOTHING, Hand.NOTHING]
    assert path.sounds[ends].tolist() == [[False, False]] * 3 + [[True, False], [True, True]]
    placed = path.objects[-1]
    assert np.linalg.norm(placed[0] - placed[1]) == pytest.approx(float(goals[0, 0]), abs=1e-3)


def test_another_body_reaches_less_with_other_movements():
    small = worlds.make("table", links=0.9, limits=0.8)
    goals, sequences, lengths = shown(small, Tasks.RHYTHM)
    found = small.execute(sequences, lengths)
    assert np.abs(found.value[:, Tasks.RHYTHM] - goals).max() < 2e-3
    assert np.ptp(goals[:, 0]) < np.ptp(WORLD.benchmark(Tasks.RHYTHM)[:, 0])
    assert not traced(sequences, lengths).outcomes.reached[:, Tasks.RHYTHM].all()


def test_the_check_finds_that_mujoco_does_the_same():
    seen = load("checks/worlds").check_table(1)
    assert max(seen["tip"]) < 0.02 and len(seen["tip"]) == 5 and max(seen["carried"]) < 0.1
