"""The Tutor's view, subgoals, reward and off-policy correction."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.abstraction.regions import Box
from star.agent import tutor
from star.agent.segments import Segment
from star.agent.task import Task
from star.agent.tutor import Trace
from star.config import loading
from star.learners.replay import Transition
from star.sgim.lessons import Marks
from star.spec import Spec

N, L = 6, 4
SCALE = np.array([10.0, 5.0], np.float32)


def settings(**values):
    return loading.parse({"tutor": values}).tutor


def task(indices=(0, 1), *, state_dim=3, radius=1.0, reach=None):
    """What the Tutor knows of a task whose abstract dimensions are those of its goals."""
    d = len(indices)
    spec = Spec(
        state_dim=state_dim,
        action_size=1,
        episode_length=1,
        abstract_indices=indices,
        goal_indices=indices,
        subgoal_scale=reach or (1.0,) * d,
        space=((0.0,) * d, (90.0,) * d),
        region_cuts=((),) * d,
        success_radius=radius,
    )
    return Task.of(loading.parse({}), spec)


@pytest.mark.parametrize("relative", [True, False])
def test_it_sees_the_state_and_the_bounds_of_the_box(relative):
    state, here = np.float32([[1.0, 2.0, 7.0]]), np.float32([[1.0, 2.0]])
    box = Box(lower=np.float32([[4.0, 4.0]]), upper=np.float32([[8.0, 10.0]]))
    obs = np.concatenate([state, 9 + here], axis=-1)  # the goal comes last, and is not seen
    seen = jax.jit(partial(tutor.observe, settings(relative_bounds=relative), task()))(obs, box)
    bounds = [3, 2, 7, 8] if relative else [4, 4, 8, 10]
    np.testing.assert_array_equal(seen, [[1, 2, 7, *bounds]])
    np.testing.assert_array_equal(box.centre, [[6, 7]])


@pytest.mark.parametrize("radius", [0.1, 0.5, 1.0, 5.0, 40.0])
@pytest.mark.parametrize("indices", [(0,), (0, 1), (0, 1, 2)])
def test_whoever_is_in_the_box_around_a_goal_has_reached_it(radius, indices):
    goal = np.full((1, len(indices)), 3.0)
    box = task(indices, state_dim=4, radius=radius).goal_box(goal)
    corner = np.linalg.norm(box.upper - goal)
    assert corner <= 0.7 * radius + 1e-5
    assert (box.upper - goal).max() == pytest.approx(min(1.0, 0.7 * radius / len(indices) ** 0.5), abs=1e-5, rel=1e-4)


@pytest.mark.parametrize("straight", [True, False])
def test_a_box_around_a_goal_close_by_is_aimed_at_and_teaches_nothing(straight):
    """Half of the reach of (10, 5): the second box sticks out of it, the third is larger than one around a goal."""
    section, known = settings(straight=straight, ppo={"hidden": [4]}), task(reach=(10.0, 5.0))
    margin = float(known.goal_margin)
    obs = np.tile(np.float32([1.0, 2.0, 7.0, 0.0, 0.0]), (3, 1))
    centre = np.float32([[5.0, 3.0], [5.0, 4.1], [5.0, 3.0]])
    box = Box.around(centre, np.float32([[margin], [margin], [1.2 * margin]]))

    @jax.jit
    def played(key):
        state, marks, steps = tutor.init(key, section, known), Marks(), jnp.zeros((L, 3))
        choice = tutor.act(section, known, state, jnp.asarray(obs), box, marks, explore=True, key=key)
        passed = Segment(
            obs=jnp.stack([obs] * (L + 1)), seen=(), subgoal=(), action=steps, terminated=steps, ended=steps,
            success=steps, arrived=steps, distance=steps, alive=steps + 1, non_finite=steps, overflow=steps,
            box=box, choice=choice,
        )  # fmt: skip
        return choice, tutor.experience(section, known, passed, marks, renewed=jnp.zeros(3, bool))

    choice, learnt = jax.device_get(played(jax.random.key(0)))
    aimed = np.linalg.norm(choice.subgoal - (box.centre - obs[:, :2]), axis=1) < 1e-6
    assert aimed.tolist() == [straight, False, False]
    np.testing.assert_array_equal(learnt.weight, [0.0 if straight else 1.0, 1.0, 1.0])


def test_a_box_higher_than_the_reach_is_close_to_who_is_between_its_bounds():
    """As on Ant Fall: subgoals lie up to .5 m higher, and the box around the goal is 2 m high."""
    known, goal = task((0, 1, 2), radius=5.0, reach=(10.0, 10.0, 0.5)), np.float32([0.0, 27.0, 4.5])
    box = known.goal_box(np.tile(goal, (3, 1)))
    here = np.float32([[3.9, 24.0, 4.8], [3.9, 24.0, 3.4], [4.1, 24.0, 4.8]])  # on the floor, in the gap, too far
    obs = np.concatenate([here, np.tile(goal, (3, 1))], axis=1)
    assert jax.jit(partial(tutor.stands_close, known))(obs, box).tolist() == [True, False, False]


def test_the_reward_told_is_that_of_decisions_that_teach(monkeypatch):
    batch = SimpleNamespace(reward=jnp.array([1.0, 5.0, 9.0]), weight=jnp.array([1.0, 1.0, 0.0]))
    monkeypatch.setattr(tutor.learners, "update", lambda section, state, batch, **_: (state, {}))
    others = {"below": None, "penalty": None, "imitate": None, "key": jax.random.key(0)}
    assert tutor.learn(settings(), task(), (), batch, **others)[1]["reward"] == 3.0


def test_subgoals_are_clipped_to_their_scale():
    actions = np.float32([[0.5, -0.5], [3.0, -3.0]])
    np.testing.assert_allclose(jax.jit(tutor.subgoal)(actions, SCALE), [[5, -2.5], [10, -5]])


@pytest.mark.parametrize("reward", ["distance", "progress"])
def test_the_reward_adds_up_the_steps_before_the_end(reward):
    rng = np.random.default_rng(0)
    distances = rng.random((L + 1, N)).astype(np.float32)
    alive = (np.arange(L)[:, None] < np.array([0, 1, 2, 3, 4, 4])).astype(np.float32)
    got = np.asarray(jax.jit(tutor.reward)(settings(reward=reward, reward_scale=0.1), distances, alive))
    for n in range(N):
        steps = [t for t in range(L) if alive[t, n]]
        if reward == "distance":
            expected = -sum(distances[t + 1, n] for t in steps)
        else:  # telescopes
            expected = distances[0, n] - distances[len(steps), n]
        np.testing.assert_allclose(got[n], 0.1 * expected, rtol=1e-4, atol=1e-6)


def mean_action(states, subgoals):
    """A policy that depends on both."""
    return jnp.tanh(subgoals / 4) + 0.1 * states[..., :2]


def replayed(rng, action):
    path = np.cumsum(rng.normal(size=(N, L + 1, 2)), axis=1).astype(np.float32)
    states = rng.normal(size=(N, L, 3)).astype(np.float32)
    trace = Trace(states=states, actions=rng.normal(size=(N, L, 2)).astype(np.float32), achieved=path)
    zero = np.zeros(N, np.float32)
    return Transition(
        obs=zero[:, None],
        action=action,
        reward=zero,
        next_obs=zero[:, None],
        terminated=zero,
        cut=zero,
        weight=zero + 1,
        extras=trace,
    )


def slow_likelihood(trace, n, action):
    """Up to constants, the log-probability of the Controller actions n under a subgoal that moves with the agent."""
    total, subgoal = 0.0, action * SCALE
    for t in range(L):
        chosen = np.tanh(subgoal / 4) + 0.1 * trace.states[n, t, :2]
        total -= 0.5 * ((trace.actions[n, t] - chosen) ** 2).sum()
        subgoal = trace.achieved[n, t] + subgoal - trace.achieved[n, t + 1]
    return total


@pytest.fixture(scope="module")
def correct():
    chosen = settings(correction_candidates=10)
    return jax.jit(lambda batch, key: tutor.correct(chosen, batch, jnp.asarray(SCALE), mean_action, key=key))


def test_the_correction_keeps_the_candidate_that_makes_the_actions_most_likely(correct):
    rng = np.random.default_rng(1)
    batch = replayed(rng, rng.uniform(-1, 1, (N, 2)).astype(np.float32))
    key = jax.random.key(0)
    got = jax.device_get(correct(batch, key))
    moved = (batch.extras.achieved[:, -1] - batch.extras.achieved[:, 0]) / SCALE
    drawn = moved + 0.5 * np.asarray(jax.random.normal(key, (10, N, 2)))
    changed = 0
    for n in range(N):
        candidates = np.clip([batch.action[n], moved[n], *drawn[:, n]], -1, 1)
        best = max(candidates, key=lambda action, n=n: slow_likelihood(batch.extras, n, action))
        np.testing.assert_allclose(got.action[n], best, atol=1e-5)
        changed += not np.allclose(best, batch.action[n])
    assert changed
    jax.tree.map(np.testing.assert_array_equal, got.replace(action=batch.action), batch)


def test_the_stored_subgoal_is_kept_where_it_explains_the_actions_best(correct):
    rng = np.random.default_rng(2)
    action = rng.uniform(-0.6, 0.6, (N, 2)).astype(np.float32)
    batch = replayed(rng, action)
    path = batch.extras.achieved
    subgoals = action[:, None] * SCALE + path[:, :1] - path[:, :-1]
    done = np.asarray(jax.jit(mean_action)(batch.extras.states, subgoals))
    batch = batch.replace(extras=batch.extras.replace(actions=done))
    np.testing.assert_allclose(correct(batch, jax.random.key(0)).action, action, atol=1e-6)
