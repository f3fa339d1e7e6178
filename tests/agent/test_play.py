"""The clocks of the levels, the moving subgoal and the statistics, against loops written from the equations."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import envs
from envs._quiet import State
from star.abstraction import regions
from star.agent import commander, levels, play
from star.agent.decisions import Roadmap, Scene, target_box
from star.agent.segments import Choice
from star.agent.task import Task
from star.config import loading
from star.sgim.lessons import Marks
from star.spec import Spec

K, L, B = 6, 3, 8  # commander.period, tutor.period and the environments of the recording


def streams_and_segments(recording):
    segments = recording.subgoal.shape[0]
    return [(i, b) for i in range(segments) for b in range(B)]


def ended(recording, i, b):
    """Whether environment b ended early in segment i."""
    return any(recording.steps.ended[i, t, b] * recording.steps.alive[i, t, b] for t in range(L))


def slow_locate(abstraction, point):
    for j in range(int(abstraction.count)):
        if all(abstraction.lower[j] <= point) and all(point < abstraction.upper[j]):
            return j
    raise AssertionError("outside the space")


def test_the_recording_shows_everything_that_the_tests_below_are_about(recording):
    ends = [ended(recording, i, b) for i, b in streams_and_segments(recording)]
    assert any(ends) and not all(ends)
    over = recording.steps.ended * recording.steps.alive  # ends in either segment and at the end of a period
    assert over[:, 1].any() and over[:, 0].any() and over[:, 2].any()
    assert (over * recording.steps.terminated).any() and (over * recording.steps.non_finite).any()
    assert len(np.unique(recording.decision.region)) > 2
    at_goal = recording.commanded.target == recording.commanded.goal_region
    assert at_goal.any() and not at_goal.all()


def test_the_clock_counts_env_steps_modulo_k_and_restarts_with_the_episode(recording):
    clock = np.zeros(B, int)
    for i in range(len(recording.subgoal)):
        np.testing.assert_array_equal(recording.before.memory.clock[i], clock)
        clock = (clock + L) % K
        for b in range(B):
            if ended(recording, i, b):
                clock[b] = 0
    np.testing.assert_array_equal(recording.last.memory.clock, clock)


def test_target_and_box_change_only_where_the_clock_is_0(recording):
    before, after = recording.before.memory, recording.commanded
    going_on = before.clock != 0
    assert going_on.any()
    for old, new in (
        (before.target, after.target),
        (before.box.lower, after.box.lower),
        (before.box.upper, after.box.upper),
        (before.start, after.start),
        (before.region, after.region),
        (before.reward, after.reward),
    ):
        np.testing.assert_array_equal(old[going_on], new[going_on])


def test_a_decision_starts_from_the_regions_of_state_and_goal(recording):
    for i, b in streams_and_segments(recording):
        if recording.before.memory.clock[i, b] == 0:
            obs = recording.before.env.obs[i, b]
            assert recording.commanded.region[i, b] == slow_locate(recording.abstraction, obs[:2])
            assert recording.commanded.goal_region[i, b] == slow_locate(recording.abstraction, obs[4:6])
            np.testing.assert_array_equal(recording.commanded.start[i, b], obs[:2])


def test_the_box_is_the_region_or_the_surroundings_of_the_goal_in_its_own_region(recording):
    margin = recording.config.commander.goal_margin
    for i, b in streams_and_segments(recording):
        target, goal = recording.commanded.target[i, b], recording.before.env.obs[i, b, 4:6]
        lower, upper = recording.abstraction.lower[target], recording.abstraction.upper[target]
        if target == recording.commanded.goal_region[i, b]:
            lower, upper = goal - margin, goal + margin
        np.testing.assert_allclose(recording.commanded.box.lower[i, b], lower, rtol=1e-6)
        np.testing.assert_allclose(recording.commanded.box.upper[i, b], upper, rtol=1e-6)


def test_targets_are_active_regions(recording):
    assert recording.commanded.target.max() < recording.abstraction.count


def test_the_subgoal_moves_with_the_agent(recording):
    assert np.abs(recording.subgoal).max() <= 10
    for i, b in streams_and_segments(recording):
        g = recording.subgoal[i, b]
        for t in range(L):
            s, after = recording.steps.obs[i, t, b, :2], recording.steps.next_obs[i, t, b, :2]
            np.testing.assert_allclose(recording.steps.subgoal[i, t, b], g, atol=1e-5)
            g = s + g - after
            np.testing.assert_allclose(recording.steps.next_subgoal[i, t, b], g, atol=1e-5)


def test_the_tutor_decides_once_in_l_steps_from_what_the_environment_shows(recording):
    np.testing.assert_array_equal(recording.steps.obs[:, 0], recording.before.env.obs)
    np.testing.assert_array_equal(recording.steps.obs[:, 1:], recording.steps.next_obs[:, :-1])
    np.testing.assert_array_equal(recording.rolled.env.obs, recording.steps.next_obs[:, -1])
    clipped = np.clip(recording.tutor.action, -1, 1) * np.array(recording.spec.subgoal_scale)
    np.testing.assert_allclose(recording.subgoal, clipped, rtol=1e-6)


def test_the_commander_is_paid_the_max_or_the_mean_of_the_external_reward_over_its_k_steps(recording):
    total = [[] for _ in range(B)]
    for i, b in streams_and_segments(recording):
        if recording.before.memory.clock[i, b] == 0:
            total[b] = []
        total[b] += [-recording.steps.distance[i, t, b] for t in range(L) if recording.steps.alive[i, t, b]]
        expected = max(total[b]) if recording.published else sum(total[b]) / K
        np.testing.assert_allclose(recording.advanced.memory.reward[i, b], expected, rtol=1e-5)


def test_the_distance_is_that_to_the_goal(recording):
    next_obs = recording.steps.next_obs
    distance = np.linalg.norm(next_obs[..., :2] - next_obs[..., 4:6], axis=-1)
    np.testing.assert_allclose(recording.steps.distance, distance, rtol=1e-5)


def test_an_environment_that_ended_waits_for_the_end_of_the_segment(recording):
    waited = 0
    for i, b in streams_and_segments(recording):
        alive = 1.0
        for t in range(L):
            assert recording.steps.alive[i, t, b] == alive
            if recording.steps.ended[i, t, b]:
                alive = 0.0
            elif not alive:
                pytest.fail("an ended environment went on without a reset")
        if not alive:
            waited += 1
            last = int(recording.steps.alive[i, :, b].sum()) - 1
            rest = recording.steps.next_obs[i, last:, b]
            np.testing.assert_array_equal(rest, np.broadcast_to(rest[0], rest.shape))
    assert waited


def test_an_environment_that_ended_is_reset_and_no_other_is(recording):
    for i, b in streams_and_segments(recording):
        if i + 1 == len(recording.subgoal):
            continue
        now, before = recording.before.env.obs[i + 1, b], recording.rolled.env.obs[i, b]
        if ended(recording, i, b):
            assert np.abs(now[:2]).max() <= 0.1
            assert (now[4:6] != before[4:6]).all()
            assert recording.before.env.info["steps"][i + 1, b] == 0
        else:
            np.testing.assert_array_equal(now, before)


def test_an_episode_that_has_just_begun_counts_as_far_from_its_goal_as_its_start(recording):
    obs = recording.before.env.obs
    away = np.linalg.norm(obs[..., :2] - obs[..., 4:6], axis=-1)
    begun = recording.before.env.info["steps"] == 0
    assert begun[1:].any()
    np.testing.assert_allclose(recording.before.episode.distance[begun], away[begun], rtol=1e-5)


def test_episode_statistics_are_those_of_the_steps_since_the_last_reset_but_success_any_of_all(recording):
    any_, total, there = np.zeros(B), np.zeros(B), np.zeros(B)
    for i, b in streams_and_segments(recording):
        for t in range(L):
            if recording.steps.alive[i, t, b]:
                obs = recording.steps.next_obs[i, t, b]
                distance = np.linalg.norm(obs[:2] - obs[4:6])
                any_[b], total[b] = max(any_[b], distance < 5), total[b] - distance
                there[b] += distance < 5
                final, flipped = float(distance < 5), recording.steps.terminated[i, t, b]
        seen = recording.advanced.episode
        assert seen.success_any[i, b] == any_[b]
        assert seen.success_final[i, b] == final
        assert seen.flipped[i, b] == flipped
        assert seen.time_at_goal[i, b] == there[b]
        np.testing.assert_allclose(seen.distance[i, b], distance, rtol=1e-5)
        np.testing.assert_allclose(seen.total[i, b], total[b], rtol=1e-4)
        if ended(recording, i, b):
            total[b] = there[b] = 0
    np.testing.assert_allclose(recording.last.episode.total, total, rtol=1e-4)


@pytest.mark.parametrize(("flipped", "success", "lost"), [(0, 0, 1), (1, 0, 1), (0, 1, 0), (1, 1, 1)])
def test_an_end_for_success_alone_is_no_loss(flipped, success, lost):
    mishaps = {"flipped": flipped, "fallen": 0, "unhealthy": 0}
    metrics = {name: jnp.ones(2) * value for name, value in {**mishaps, "success": success}.items()}
    after = State(None, None, None, done=jnp.array([1.0, 0.0]), metrics=metrics, info={"truncation": jnp.zeros(2)})
    np.testing.assert_array_equal(play._lost(after), [lost, 0])


def test_dimensions_that_the_goal_leaves_open_keep_the_bounds_of_the_region(tiny):
    spec = Spec(
        state_dim=4,
        action_size=2,
        episode_length=30,
        abstract_indices=(0, 1, 3),
        goal_indices=(1, 0),
        subgoal_scale=(1.0, 1.0, 1.0),
        space=((0.0, 0.0, 0.0), (8.0, 8.0, 8.0)),
        region_cuts=((), (), (4.0,)),
        success_radius=5.0,
    )
    obs = jnp.array([[1.0, 2.0, 9.0, 5.0, 7.0, 6.0]])  # state 1, 2, 9, 5; goal y = 7, x = 6
    point = spec.goal_point(obs)
    np.testing.assert_array_equal(point, [[6, 7, 5]])
    np.testing.assert_array_equal(spec.abstract(obs), [[1, 2, 5]])
    made = regions.create(spec.space, spec.region_cuts, max_regions=2)
    region = jnp.array([1])
    task = Task.of(loading.parse(tiny), spec)
    box = target_box(task, made, region, around=jnp.array([True]), point=point)
    np.testing.assert_array_equal(box.lower, [[5, 6, 4]])
    np.testing.assert_array_equal(box.upper, [[7, 8, 8]])


def test_the_pose_adds_a_vector_of_the_length_of_the_heading_that_points_where_the_body_faces():
    env = envs.make("ant_maze_cam", engine="native")
    spec = Spec.of(env, heading=3.0)
    rng = np.random.default_rng(0)
    obs = rng.normal(size=(50, env.observation_size)).astype(np.float32)
    yaw = rng.uniform(-np.pi, np.pi, 50)
    roll = Rotation.from_euler("ZYX", np.stack([yaw, *rng.uniform(-1, 1, (2, 50))], axis=-1))
    obs[:, 3:7] = roll.as_quat(scalar_first=True)
    expected = np.stack([obs[:, 0], obs[:, 1], 3 * np.cos(yaw), 3 * np.sin(yaw)], axis=-1)
    np.testing.assert_allclose(spec.pose(obs), expected, atol=1e-5)
    np.testing.assert_array_equal(spec.scale, [10, 10, 3, 3])
    np.testing.assert_array_equal(Spec.of(env).pose(obs), obs[:, :2])
    np.testing.assert_array_equal(Spec.of(env).scale, [10, 10])


def test_subgoals_with_a_heading_stay_where_they_are_while_the_agent_moves_and_turns(breaking_env, tiny, turning):
    spec = turning
    agent = loading.parse(tiny).hyper()

    def rolled(key):
        state = levels.init(agent, spec, key=key)
        playing = levels.of(agent, spec)
        streams = play.start(playing, breaking_env, key=key)
        choice = Choice(subgoal=jax.random.normal(key, (B, 4)))
        return play.rollout(playing, breaking_env, state, streams, choice, explore=True, key=key)[1]

    passed = jax.tree.map(np.asarray, jax.jit(rolled)(jax.random.key(0)))
    pose = np.asarray(spec.pose(passed.obs))[:-1]
    going = passed.alive.min(axis=0) > 0
    wanted = (pose + passed.subgoal[:-1])[:, going]
    assert going.any() and (np.ptp(pose[:, going], axis=0) > 1e-3).all()
    np.testing.assert_allclose(wanted, np.broadcast_to(wanted[0], wanted.shape), atol=1e-3)


def test_who_was_at_the_goal_before_an_episode_ended_is_counted_in_the_next_one(breaking_env, tiny, fresh):
    agent, spec = loading.parse(tiny).hyper(), Spec.of(breaking_env.env)
    playing, ended = levels.of(agent, spec), np.arange(B) % 2
    row = np.float32(ended)[None]

    def restarted(state, key):
        streams = play.start(playing, breaking_env, key=key)
        choice = Choice(subgoal=jnp.zeros((B, len(spec.scale))))
        streams, passed = play.rollout(playing, breaking_env, state, streams, choice, explore=True, key=key)
        there = streams.episode.replace(success_any=jnp.ones(B), time_at_goal=jnp.ones(B))
        passed = passed.replace(ended=row, alive=jnp.ones_like(row))
        return play.restart_ended(playing, breaking_env, streams.replace(episode=there), passed, key=key).episode

    episode = jax.device_get(jax.jit(restarted)(fresh(3), jax.random.key(0)))
    assert (episode.success_any == 1).all()
    np.testing.assert_array_equal(episode.time_at_goal, 1 - ended)


def scene_of(spec, env_state):
    """What the Commander sees."""
    return Scene(spec.abstract(env_state.obs), spec.goal_point(env_state.obs), env_state.metrics["success"])


@pytest.mark.parametrize("hold", [True, False, "region"])
def test_who_has_arrived_is_commanded_to_the_goal(breaking_env, tiny, fresh, hold):
    agent = loading.parse(tiny, {"commander.hold": hold}).hyper()
    spec = Spec.of(breaking_env.env)

    def commanded(state, key):
        playing = levels.of(agent, spec, greedy=True)
        away = jnp.zeros_like(state.commander.q).at[..., 2].set(1.0)  # everybody is sent to region 2
        known = state.commander.replace(q=away)
        streams = play.start(playing, breaking_env, key=key)
        success = (jnp.arange(B) < 4).astype(jnp.float32)
        seen = scene_of(spec, streams.env)
        goal = jnp.where((jnp.arange(B) < 2)[:, None], seen.position, seen.goal)
        seen = seen._replace(goal=goal, success=success)  # the first two are in the region of their goal
        roadmap = Roadmap.of(agent.commander, state.abstraction, state.graph)
        return commander.command(
            agent.commander, playing.task, known, roadmap, streams.memory, seen, Marks(), env_steps=None, key=key
        )

    got = jax.jit(commanded)(fresh(3), jax.random.key(3))
    at_goal = np.asarray(got.target == got.goal_region)
    sent = np.asarray(got.target) == 2
    inside = np.asarray(got.region == got.goal_region)
    assert (np.asarray(got.goal_region) != 2).all() and 0 < inside.sum() < B
    held = inside if hold == "region" else (np.arange(B) < 4) & hold
    np.testing.assert_array_equal(at_goal, held)
    np.testing.assert_array_equal(sent, ~held)


def test_an_episode_shorter_than_a_period_has_a_plan_too(tiny, fresh):
    agent, state = loading.parse(tiny).hyper(), fresh()
    roadmap = Roadmap.of(agent.commander, state.abstraction, state.graph)
    settle = jax.jit(
        partial(commander.settle, agent.commander, state.commander, roadmap), static_argnames="episode_length"
    )
    short, one = (settle(episode_length=steps).q for steps in (K - L, K))
    assert np.asarray(one).any()
    np.testing.assert_array_equal(short, one)
