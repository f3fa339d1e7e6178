import itertools

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs import worlds
from envs.worlds import dmp, pen
from envs.worlds.pen import Tasks
from tests.envs.worlds import slow

WORLD = worlds.make("pen")
BATCH = 300  # one shape for nearly all: compilation is what costs
SHARES = {  # of 700,000 random sequences of one primitive and a million of four, by task
    1: (1, 0.0189, 0.0130, 0.00136, 0.00127, 0.00263),
    4: (1, 0.0674, 0.0577, 0.0050, 0.0049, 0.0098),
}
PEN, STICK_1, STICK_2 = pen.OBJECTS


def trace(sequences, lengths):
    """Outcomes and paths of up to `BATCH` sequences, as NumPy arrays."""
    padded = np.zeros((BATCH, 4, 14), np.float32)
    padded[: len(sequences)] = sequences
    counts = np.ones(BATCH, np.int32)
    counts[: len(sequences)] = lengths
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(sequences)], WORLD.trace(padded, counts))


def execute(*sequences):
    """(value [n, 6, 4], reached [n, 6]) of sequences of any lengths, each a list of primitives."""
    found = trace([padded(sequence) for sequence in sequences], [len(sequence) for sequence in sequences]).outcomes
    return found.value, found.reached


def padded(sequence):
    return np.pad(np.array(sequence), ((0, 4 - len(sequence)), (0, 0)))


@pytest.fixture(scope="module")
def shown():
    """(sequences, lengths) of the first 80 goals of each task, [6][80, ...]."""
    return [tuple(map(np.asarray, WORLD.demonstrate(task, WORLD.benchmark(task)))) for task in range(6)]


def to(place, via=None):
    """A primitive of the teacher to a place; first it goes to the height `via`."""
    ((*_, command),) = [np.asarray(WORLD.demonstrate("tip", np.append(place, 0.0))[0][:1])]
    command = np.array(command)
    command[12] = place[2] if via is None else via
    return command


def random_sequences(n, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (n, 4, 14)).astype(np.float32)


def test_the_product_form_agrees_with_euler_integration():
    rng = np.random.default_rng(0)
    for primitive in rng.uniform(-1, 1, (5, 14)):
        start, command = rng.uniform(-3, 3, 3), np.pi * primitive[:12].reshape(3, 4)
        product = dmp.rollout(dmp.curves(30), start, command[:, 3], command[:, :3])
        *_, angles, _ = slow.movement(primitive, start, 0.5)
        np.testing.assert_allclose(product[:, -1], angles, atol=1e-5)


def test_it_agrees_with_a_slow_state_machine_step_by_step(shown):
    rng = np.random.default_rng(1)
    taught = np.concatenate([sequences[:10] for sequences, _ in shown])
    disturbed = np.clip(taught + rng.normal(0, 0.05, taught.shape), -1, 1)
    beyond = np.where(disturbed == 0, rng.uniform(-1, 1, taught.shape), disturbed)
    clumsy = np.concatenate([np.tile(to(PEN), (10, 1, 1)), shown[Tasks.JOYSTICK_2][0][:10, :3]], axis=1)
    sequences = np.concatenate([taught, beyond, clumsy, random_sequences(60)]).astype(np.float32)
    lengths = np.concatenate([*(lengths[:10] for _, lengths in shown), np.full(70, 4), rng.integers(1, 5, 60)])
    found = trace(sequences, lengths)
    expected = [slow.pen(*one) for one in zip(sequences, lengths, strict=True)]
    np.testing.assert_array_equal(found.outcomes.reached, [reached for _, reached, _ in expected])
    np.testing.assert_allclose(found.outcomes.value, [value for value, *_ in expected], atol=5e-5)
    assert (found.outcomes.reached.sum(axis=0) >= 10).all()  # all that can happen does
    assert (found.path.hand == pen.Hand.BROKEN).any(axis=1).sum() >= 10
    for path, length, (*_, tips) in zip(found.path.tip, lengths, expected, strict=True):
        np.testing.assert_allclose(path[: 30 * length], tips, atol=2e-5)


@pytest.mark.parametrize("task", Tasks)
def test_the_teacher_reaches_every_goal_of_the_evaluation(task, shown):
    goals = np.asarray(WORLD.benchmark(task))
    found = trace(*shown[task]).outcomes
    assert 200 <= len(goals) <= 400 and found.reached[:, task].all()
    assert np.abs(found.value[:, task] - goals).max() < 0.002


@pytest.mark.parametrize("length", SHARES)
def test_random_sequences_reach_each_task_as_often_as_the_page_says(length):
    n = 12_000
    counts = np.asarray(WORLD.execute(random_sequences(n, seed=7), length).reached).sum(axis=0)
    for count, share in zip(counts, SHARES[length], strict=True):
        assert abs(count - n * share) <= 4 * np.sqrt(n * share * (1 - share)) + 1


def test_without_the_pen_there_is_no_line():
    value, reached = execute([to((0.5, 0.5, -0.1)), to((-0.5, 0.5, -0.1))])
    assert reached[0, Tasks.TIP] and not reached[0, Tasks.PEN] and not reached[0, Tasks.LINE]
    assert not value[0, 1:].any()


def test_of_two_lines_the_last_counts():
    a, b, c = (0.5, 0.6, -0.1), (0.1, 0.8, -0.1), (0.6, 0.2, -0.1)
    taken, first = to(PEN), to(a, via=0.25)
    value, reached = execute([taken, first, to(b)], [taken, first, to(c, via=0.3)], [taken, first, to(c, via=-0.1)])
    assert reached[:, Tasks.LINE].all()
    expected = [(*a[:2], *b[:2]), (*c[:2], *c[:2]), (*a[:2], *c[:2])]
    np.testing.assert_allclose(value[:, Tasks.LINE], expected, atol=0.003)


def test_the_character_waits_for_the_end_of_the_primitive():
    there = np.add(STICK_1, (0.16, 0.0, 0.0))
    found = trace([padded([to(STICK_1), to(there)])], [2])
    character = found.path.sticks[0, :, 0, 0]
    assert (np.abs(character[:59]) < 0.01).all() and (character[59:] > 0.79).all()
    assert found.path.tip[0, 45, 0] > STICK_1[0] + 0.15  # while the joystick was there long before
    np.testing.assert_allclose(found.outcomes.value[0, Tasks.CHARACTER, :2], (0.8, 0.0), atol=0.002)


def test_a_broken_pen_draws_nothing():
    taken, down = to(PEN), to((0.5, 0.6, -0.1), via=0.25)
    hard, elsewhere = to((0.5, 0.6, -0.35), via=0.25), to((0.6, 0.2, -0.1), via=0.3)
    value, reached = execute([taken, down, elsewhere], [taken, hard, elsewhere], [taken, to((0.6, 0.2, -0.35)), down])
    assert reached[:, Tasks.LINE].all() and reached[:, Tasks.PEN].all()
    np.testing.assert_allclose(value[0, Tasks.LINE], (0.6, 0.2, 0.6, 0.2), atol=0.003)
    np.testing.assert_allclose(value[1, Tasks.LINE], (0.5, 0.6, 0.5, 0.6), atol=0.003)  # drawn before it broke
    assert np.linalg.norm(value[2, Tasks.LINE, 2:] - (0.5, 0.6)) > 0.1


def test_touching_another_object_leaves_only_the_tip():
    value, reached = execute([to(PEN), to(STICK_1)], [to(STICK_1), to(np.add(STICK_1, (0.0, 0.1, 0.0))), to(PEN)])
    assert reached[0].tolist() == [True] + 5 * [False] and not value[0, 1:].any()
    assert reached[1].tolist() == [True, True, False, True, False, True]  # let go on the way, the pen taken instead


@pytest.mark.parametrize("task", [Tasks.JOYSTICK_1, Tasks.JOYSTICK_2, Tasks.CHARACTER])
def test_exact_subgoals_of_a_decomposition_reach_all_corners(task):
    corners = np.array([(*corner, 0.0) for corner in itertools.product((-1.0, 1.0), repeat=3)])
    corners[:, 2] *= task != Tasks.CHARACTER
    value, reached = execute(*[followed(task, corner) for corner in corners])
    assert reached[:, task].all()
    np.testing.assert_allclose(value[:, task], corners, atol=0.003)


def test_exact_subgoals_of_a_decomposition_draw_most_lines():
    goals = np.asarray(WORLD.benchmark(Tasks.LINE))[:40]
    value, reached = execute(*[followed(Tasks.LINE, goal) for goal in goals])
    near = np.abs(value[:, Tasks.LINE] - goals).max(axis=1) < 0.01
    assert (reached[:, Tasks.LINE] & near).mean() > 0.8  # on the way to the others the pen meets a joystick


def followed(task, goal):
    """The sequence of demonstrations that reaches the two subgoals of a goal, one after the other."""
    parts = WORLD.decompose(int(task), goal)
    assert parts.exists
    sequence = []
    for subtask, subgoal in zip(parts.tasks.tolist(), parts.goals, strict=True):
        shown, length = WORLD.demonstrate(subtask, subgoal)
        sequence += list(np.asarray(shown)[: int(length)])
    return sequence


def test_the_tip_alone_has_no_decomposition():
    parts = WORLD.decompose("tip", np.zeros((5, 4)))
    assert not parts.exists.any() and parts.tasks.shape == (5, 2) and parts.goals.shape == (5, 2, 4)


@settings(max_examples=5)
@given(st.integers(0, 2**31 - 1))
def test_outcomes_lie_within_their_bounds_and_a_longer_sequence_begins_like_a_shorter(seed):
    sequences = np.tile(random_sequences(75, seed), (4, 1, 1))
    lengths = np.repeat(np.arange(1, 5), 75)
    found = trace(sequences, lengths)
    inside = (found.outcomes.value >= WORLD.lower) & (found.outcomes.value <= WORLD.upper)
    assert inside[found.outcomes.reached].all() and not found.outcomes.value[~found.outcomes.reached].any()
    tips = found.path.tip.reshape(4, 75, 120, 3)
    for length in range(1, 4):
        np.testing.assert_array_equal(tips[length - 1, :, : 30 * length], tips[3, :, : 30 * length])
        np.testing.assert_array_equal(np.ptp(tips[length - 1, :, 30 * length - 1 :], axis=1), 0)  # then it stays


@settings(max_examples=5)
@given(st.integers(0, 2**31 - 1), st.permutations(range(60)))
def test_the_order_of_a_batch_does_not_matter(seed, order):
    sequences, lengths = random_sequences(60, seed), np.random.default_rng(seed).integers(1, 5, 60)
    one, other = trace(sequences, lengths), trace(sequences[order], lengths[order])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[order], b), one, other)
