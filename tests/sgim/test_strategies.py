"""What SGIM makes of an epoch: its lessons against loops, its teachers' budgets, and the trainer that follows them."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from envs.common.errors import UserError
from star.abstraction import regions
from star.abstraction.regions import Change, Cut, Near, Split
from star.agent import commander, levels, play, q_learning, tutor, values
from star.agent.decisions import Decision, Roadmap, Scene, Successors
from star.agent.segments import Segment
from star.agent.values import CommanderState
from star.config import loading
from star.learners import ppo, td3
from star.learners.replay import Imitation, Transition
from star.sgim import lessons, selection, strategies
from star.sgim.lessons import Marks
from star.sgim.sections import SgimConfig
from star.sgim.teachers import nearest
from star.spec import Spec
from tests.small import ACTS, GUIDE, demonstrations

B, L = 64, 3
AIMS = {"name": "aims", "kind": "outcome", "source": "demos.npz"}


OWN = ["autonomous", "babbling", "decomposition"]

# Compiled once, not each time that a test calls them.
assign = jax.jit(strategies.assign)
learn = jax.jit(lessons.learn)
impose = jax.jit(lessons.impose)
grade = jax.jit(lessons.grade)
ways = jax.jit(lessons.ways, static_argnames=("most", "parts"))
choose = jax.jit(values.choose)


@cache
def four_regions():
    return jax.device_get(regions.create(((0.0, 0.0), (4.0, 4.0)), ((2.0,), (2.0,)), max_regions=6))


def settings(**values):
    return SgimConfig.model_validate(values)


def begun(config):
    """Nothing practised yet in four regions, in NumPy."""
    return jax.device_get(strategies.init(config, four_regions()))


def put(array, index, values):
    """A copy of `array` with other `values` at `index`."""
    array = array.copy()
    array[index] = values
    return array


@cache
def shown(seed, length):
    """What a teacher shows, in NumPy."""
    return jax.device_get(demonstrations(seed, length=length))


def lesson_of(config, state=None, *, seed=0, teachers=None):
    """An assigned lesson, what it was assigned for, and the state, all in NumPy."""
    rng = np.random.default_rng(seed)
    start, goal = (rng.uniform(0, 4, (B, 2)).astype(np.float32) for _ in range(2))
    state = begun(config) if state is None else state
    teachers = [shown(i, i + 1) for i in range(len(config.teachers))] if teachers is None else teachers
    key = jax.random.key(seed)
    lesson = assign(config, state, teachers, start=start, goal=goal, key=key)
    return jax.device_get(lesson), start, goal, state


def located(point):
    table = four_regions()
    return next(
        j for j in range(4) if (table.lower[j] <= point).all() and ((point < table.upper[j]) | (point >= 4)).all()
    )


def test_nothing_is_kept_where_everything_is_left_as_ever(tiny, breaking_env):
    spec = Spec.of(breaking_env.env)

    def kept(values):
        agent = loading.parse({**tiny, "sgim": values}).hyper()
        return jax.eval_shape(lambda key: levels.init(agent, spec, key=key), jax.random.key(0)).sgim

    assert kept({}) is None
    for some in ({"goals": True}, {"exploration": True}, {"refinement": True}, {"teachers": [GUIDE]}):
        assert kept(some) is not None


def test_goals_stay_those_of_the_task_unless_they_may_be_chosen():
    lesson, _, goal, _ = lesson_of(settings(strategies=OWN))
    np.testing.assert_array_equal(lesson.choice.goal, goal)
    assert lesson.choice.region.tolist() == [located(g) for g in goal]
    chosen, _, goal, _ = lesson_of(settings(goals=True))
    assert not np.isclose(chosen.choice.goal, goal).all(axis=1).any()
    assert chosen.choice.region.tolist() == [located(g) for g in chosen.choice.goal]
    assert set(chosen.choice.region.tolist()) == {0, 1, 2, 3}


def test_each_teacher_shows_what_is_nearest_and_only_to_those_who_ask():
    config = settings(teachers=[GUIDE, AIMS, ACTS])
    lesson, start, goal, _ = lesson_of(config)
    demos = [shown(i, i + 1) for i in range(3)]
    asked = lesson.choice.strategy
    assert set(asked) == {0, 1, 2, 3}
    guides, aims, acts = jax.device_get(
        jax.jit(lambda: [nearest(one, None if i == 1 else start, goal) for i, one in enumerate(demos)])()
    )
    for b in range(B):
        expected = {2: demos[1].outcomes[aims[b]], 3: demos[2].outcomes[acts[b]]}.get(asked[b], goal[b])
        np.testing.assert_array_equal(lesson.choice.goal[b], expected)
        assert int(lesson.leg[b]) == (0 if asked[b] == 1 else L)
        if asked[b] == 1:
            np.testing.assert_array_equal(lesson.waypoints[b], np.repeat(demos[0].waypoints[guides[b]], L, axis=0))
    np.testing.assert_array_equal(lessons.guided(config, lesson), asked == 1)


def test_own_decomposition_goes_by_way_of_what_is_mastered_best_in_a_region():
    config = settings(strategies=OWN)
    state = begun(config)
    competences = put(state.competences, (1, slice(3)), [0.9, 0.2, 0.5])
    goals = put(state.goals, (1, slice(3)), [[1.5, 3.5], [0.5, 2.5], [1.0, 3.0]])
    state = state.replace(competences=competences, goals=goals, written=put(state.written, 1, 3))
    lesson = lesson_of(config, state)[0]
    mine = lesson.choice.strategy == 2
    assert mine.any() and not mine.all()
    via = ((state.abstraction.lower + state.abstraction.upper) / 2)[:4]
    via[1] = [1.5, 3.5]  # of the others nothing is known: their centres
    first = lesson.waypoints[:, 0]
    assert all(any((point == one).all() for one in via) for point in first[mine])
    assert len(np.unique(first[mine], axis=0)) == 4
    np.testing.assert_array_equal(lesson.leg == 0, mine)
    assert not lessons.guided(config, lesson).any()


def test_own_decomposition_has_one_waypoint_however_many_teachers_show():
    config = settings(strategies=["autonomous", "decomposition"], teachers=[GUIDE])
    lesson, *_ = lesson_of(config, teachers=[shown(0, L)])
    mine = lesson.choice.strategy == 1
    assert mine.any() and lesson.waypoints.shape[1] == L
    after, _, to_point = jax.device_get(impose(config, lesson, lesson.waypoints[:, 0]))
    assert not to_point[mine].any() and (after.leg[mine] == L).all()


def test_no_teacher_is_asked_more_often_than_his_budget_and_none_who_is_away():
    config = settings(teachers=[{**GUIDE, "max_queries": 5}, {**AIMS, "availability": 0}])
    state, asked = None, 0
    for seed in range(3):
        lesson, _, _, state = lesson_of(config, state, seed=seed)
        asked += (lesson.choice.strategy == 1).sum()
        assert asked == 5 and not (lesson.choice.strategy == 2).any()
        lesson = grade(lesson, np.ones(B, bool), np.ones(B, np.float32), radius=0.5)
        state, metrics = learn(config, state, lesson)
        assert int(metrics["queries_guide"]) == 5


def test_asking_evenly_pays_no_heed_to_progress():
    config = settings(ask="evenly", teachers=[{**GUIDE, "cost": 100}, AIMS])
    state = begun(config)
    state = state.replace(gains=put(state.gains, (slice(None), 2), 1.0))
    counts = sum(np.bincount(lesson_of(config, state, seed=seed)[0].choice.strategy, minlength=3) for seed in range(5))
    assert stats.chisquare(counts).pvalue > 1e-3


def test_who_has_mastered_a_region_asks_nobody_there():
    mastery = [0.0, 0.25, 1.0, 0.75]
    asked = {}
    for unaided in (False, True):
        config = settings(teachers=[GUIDE, AIMS], unaided=unaided)
        state = begun(config)
        known = put(state.competences, (slice(4), 0), mastery)
        state = state.replace(competences=known, written=put(state.written, slice(4), 1))
        asked[unaided] = np.zeros(4)
        for seed in range(12):
            lesson, _, goal, _ = lesson_of(config, state, seed=seed)
            region = [located(g) for g in goal]
            asked[unaided] += np.bincount(region, lesson.choice.strategy > 0, minlength=4)
    share = asked[True] / asked[False]
    assert share[0] == 1 and share[2] == 0
    assert abs(share[1] - 0.75) < 0.15 and abs(share[3] - 0.25) < 0.15


def test_ways_are_points_on_the_straight_legs_of_those_who_are_led():
    config = settings(teachers=[GUIDE, AIMS])
    lesson, start, _, _ = lesson_of(config)
    led = np.flatnonzero(lesson.choice.strategy == 1)
    paths, weight = ways(config, lesson, start, most=len(led) + 2, parts=5)
    assert paths.shape == (len(led) + 2, lesson.waypoints.shape[1] * 5, 2) and weight.tolist() == [1.0] * len(led) + [
        0.0,
        0.0,
    ]
    for path, b in zip(np.asarray(paths), led, strict=False):
        corners = [start[b], *lesson.waypoints[b]]
        expected = [np.linspace(a, b, 5) for a, b in zip(corners, corners[1:], strict=False)]
        np.testing.assert_allclose(path, np.concatenate(expected), atol=1e-5)
    fewer, _ = ways(config, lesson, start, most=2, parts=5)
    np.testing.assert_array_equal(fewer, np.asarray(paths)[:2])


def test_waypoints_are_passed_where_the_agent_is_near():
    rng = np.random.default_rng(0)
    points, position = rng.uniform(0, 4, (B, L, 2)).astype(np.float32), rng.uniform(0, 4, (B, 2)).astype(np.float32)
    leg = rng.integers(0, L + 1, B)
    config = settings(teachers=[GUIDE], waypoint_radius=1.2)
    lesson = lesson_of(config)[0].replace(waypoints=points, leg=leg)
    after, coming, guided = jax.device_get(impose(config, lesson, position))
    passed = 0
    for b in range(B):
        expected = leg[b]
        for i in range(leg[b], L):
            if np.linalg.norm(points[b, i] - position[b]) < 1.2:
                expected = i + 1
        assert int(after.leg[b]) == expected and bool(guided[b]) == (expected < L)
        if expected < L:
            np.testing.assert_array_equal(coming[b], points[b, expected])
        passed += expected > leg[b]
    assert passed > 5


def test_a_way_leaves_a_region_where_one_who_walks_it_first_does():
    config = settings(teachers=[GUIDE])
    rng = np.random.default_rng(1)
    position, points = rng.uniform(0, 4, (B, 2)).astype(np.float32), rng.uniform(0, 4, (B, L, 2)).astype(np.float32)
    leg = rng.integers(0, L + 1, B)
    lower, upper = (np.floor(position / 2) * 2 + side for side in (0, 2))
    lesson = lesson_of(config)[0].replace(waypoints=points, leg=leg)
    onward = jax.jit(lambda *known: lessons.onward(lesson, *known, parts=5))
    found, leaves = jax.device_get(onward(position, lower, upper))
    for b in range(B):
        corners = [position[b], *points[b, leg[b] :]]
        way = [p for a, c in zip(corners, corners[1:], strict=False) for p in np.linspace(a, c, 5, dtype=np.float32)]
        outside = [p for p in way if ((p < lower[b]) | (p >= upper[b])).any()]
        assert bool(leaves[b]) == bool(outside)
        if outside:
            np.testing.assert_allclose(found[b], outside[0], atol=1e-5)
    assert leaves.any() and not leaves.all()


def test_competence_is_how_much_nearer_the_first_episode_came():
    far = lambda distance: np.full(B, distance, np.float32)  # noqa: E731
    everybody = np.ones(B, bool)
    lesson = lesson_of(settings(goals=True))[0].replace(away=far(8.0))
    lesson = jax.device_get(grade(lesson, np.arange(B) == 0, far(6.0), radius=2.0))  # from 8 m to 4 m
    assert float(lesson.competence[0]) == pytest.approx(0.5) and np.isinf(lesson.competence[1:]).all()
    lesson = jax.device_get(grade(lesson, everybody, far(1.0), radius=2.0))
    assert float(lesson.competence[0]) == pytest.approx(0.5) and (lesson.competence[1:] == 1).all()
    away = lesson.replace(competence=far(np.inf))
    worse = jax.device_get(grade(away, everybody, far(30.0), radius=2.0))
    assert (worse.competence == 0).all()


def test_a_lesson_is_learnt_from_and_told_of():
    config = settings(strategies=OWN)
    lesson, _, _, state = lesson_of(config)
    lesson = lesson.replace(competence=np.where(np.arange(B) < B // 4, 0.5, 1.0).astype(np.float32))
    after, metrics = jax.device_get(learn(config, state, lesson))
    assert float(after.episodes.sum()) == B
    assert float(metrics["competence"]) == pytest.approx(0.875)
    for number, name in enumerate(OWN):
        assert float(metrics[f"share_{name}"]) == pytest.approx((lesson.choice.strategy == number).mean())
    np.testing.assert_array_equal(lessons.babbles(config, lesson), lesson.choice.strategy == 1)


def test_edges_to_what_is_half_mastered_and_stands_still_are_the_most_urgent():
    config = settings(refinement=True)
    state = begun(config)
    window = state.competences.shape[1]
    competences = np.repeat(np.float32([0.0, 1.0, 0.5, 0.5, 0, 0])[:, None], window, axis=1)
    competences[3] = np.where(np.arange(window) < window // 2, 0.2, 0.8)
    state = state.replace(competences=competences, written=np.full(6, window, np.int32))
    weight = np.asarray(jax.jit(lessons.urgency)(config, state))
    assert weight[2] == pytest.approx(1) and weight[0] == weight[1] == pytest.approx(0.1)
    assert weight[0] < weight[3] < weight[2]
    assert lessons.urgency(settings(goals=True), state) == 1.0


def drawn(allowed, attraction, *, where, n=4000):
    """How often each of five regions is the random target of `n` who are `where` and have their goal there."""
    state = CommanderState(q=np.zeros((5, 5, 5), np.float32), chosen=np.zeros(5, np.float32))
    both, here = Successors(Near.every(5), allowed, allowed), np.full(n, where)
    attraction, key = np.float32(attraction), jax.random.key(0)
    found = choose(state, both, here, here, attraction=attraction, epsilon=1.0, key=key)
    return np.bincount(found, minlength=5)


def test_random_targets_follow_their_attraction():
    allowed = put(np.ones((5, 5), bool), (slice(None), 1), False)
    counts = drawn(allowed, [0.1, 0.4, 0.2, 0.3, 0.0], where=0)
    assert counts[1] == counts[4] == 0
    assert stats.chisquare(counts[[0, 2, 3]], 4000 * np.array([1, 2, 3]) / 6).pvalue > 1e-3


def test_targets_that_hardly_attract_are_drawn_evenly_among_themselves():
    allowed = put(np.ones((5, 5), bool), (slice(None), 0), False)
    counts = drawn(allowed, [1.0, 1e-4, 1e-4, 1e-4, 1e-4], where=1)
    assert counts[0] == 0 and stats.chisquare(counts[1:]).pvalue > 1e-3


def test_what_a_teacher_chose_rises_to_a_margin_above_the_rest():
    config = loading.parse({"commander": {"learner": "q", "learning_rate": 0.5, "reward": "mean"}}).commander
    q = put(np.zeros((3, 3, 3), np.float32), (0, 1), [0.0, 1.0, 0.4])
    state = CommanderState(q=q, chosen=np.zeros(3, np.float32))
    allowed = Successors(Near.every(3), np.ones((3, 3), bool), np.ones((3, 3), bool))
    one = lambda value: np.full(1, value, np.int32 if isinstance(value, int) else np.float32)  # noqa: E731
    decision = Decision(
        region=one(0),
        goal_region=one(1),
        target=one(2),
        reward=one(0.0),
        next_region=one(2),
        weight=one(1.0),
        lost=one(0.0),
        aside=one(1.0),
        goal=np.zeros((1, 2), np.float32),
        shown=one(1.0),
    )
    alone = state.q[0, 1, 2]  # a waypoint tells nothing of what its region is worth
    roadmap = Roadmap(abstraction=None, allowed=allowed, believed=None)

    observe = jax.jit(q_learning.observe)

    def learnt(shown, **margin):
        return float(observe(config, state, roadmap, decision.replace(shown=shown), **margin).q.tolist()[0][1][2])

    assert learnt(None) == alone
    assert learnt(one(1.0), margin=0.2) == pytest.approx(float(alone) + 0.5 * (1.0 + 0.2 - float(alone)))
    assert learnt(one(0.0), margin=0.2) == pytest.approx(float(alone))


@pytest.mark.parametrize("learner", [ppo, td3])
def test_the_actor_comes_near_to_demonstrated_actions(learner):
    name = learner.__name__.rsplit(".", 1)[-1]
    small = {"hidden": [16], "batch_size": 8, "buffer_size": 64, "min_transitions": 64}
    small |= {"policy_delay": 1, "actor_learning_rate": 1e-2}
    values = {"hidden": [16], "passes": 1, "minibatches": 1, "learning_rate": 1e-3} if learner is ppo else small
    alone = {"tutor": {"enabled": False}}
    parsed = loading.parse({"controller": {"learner": name, name: values}, "trainer": {"num_envs": 4}, **alone})
    config = parsed.controller.settings
    rng = np.random.default_rng(0)
    noise = lambda *shape: rng.normal(size=(4, 8, *shape)).astype(np.float32)  # noqa: E731
    nothing, whole = np.zeros((4, 8), np.float32), np.ones((4, 8), np.float32)
    rollout = Transition(
        obs=noise(3),
        action=noise(2),
        reward=nothing,
        next_obs=noise(3),
        terminated=nothing,
        cut=whole,
        weight=whole,
    )
    example = jax.tree.map(lambda x: x[0, 0], rollout)
    shown = Imitation(
        obs=rng.normal(size=(16, 3)).astype(np.float32),
        action=np.full((16, 2), 0.5, np.float32),
        weight=np.ones(16, np.float32),
    )

    @jax.jit
    def far(weight, rollout, shown):
        def once(state, key):
            imitation = shown.replace(weight=weight * shown.weight)
            return learner.update(config, state, rollout, imitation=imitation, key=key)[0], None

        state = learner.init(jax.random.key(0), config, example=example)
        state, _ = jax.lax.scan(once, state, jax.random.split(jax.random.key(1), 60))
        done = learner.act(config, state, shown.obs, deterministic=True, key=jax.random.key(0))
        return jnp.abs(done - shown.action).mean()

    assert far(10.0, rollout, shown) < 0.5 * far(0.0, rollout, shown)


def test_steps_of_demonstrations_lead_to_the_end_of_their_segment():
    demos = shown(0, L)
    drawn = jax.device_get(
        jax.jit(lambda demos, key: lessons.shown(demos, 3, size=200, key=key))(demos, jax.random.key(0))
    )
    states, lengths = demos.states, demos.lengths
    seen = set()
    for state, later, action, outcome in zip(drawn.state, drawn.later, drawn.action, drawn.outcome, strict=True):
        n, t = (int(i[0]) for i in np.nonzero((states == state).all(axis=-1)))
        assert t < lengths[n]
        np.testing.assert_array_equal(later, states[n, min(t // 3 * 3 + 3, lengths[n])])
        np.testing.assert_array_equal(action, demos.actions[n, t])
        np.testing.assert_array_equal(outcome, demos.outcomes[n])
        seen.add((n, t))
    assert seen == {(n, t) for n in range(5) for t in range(lengths[n])}


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"sgim": {"teachers": [{**AIMS, "source": "map"}]}}, "aims"),
        ({"sgim": {"teachers": [GUIDE, GUIDE]}}, "guide"),
        ({"sgim": {"strategies": []}}, "sgim.strategies"),
        ({"sgim": {"teachers": [{**GUIDE, "costs": 3}]}}, "did you mean sgim.teachers.0.cost?"),
        ({"sgim": {"teachers": [{**GUIDE, "cost": 0}]}}, "sgim.teachers.0.cost: 0 is not allowed"),
        ({"sgim": {"strategies": ["babbling"]}, "tutor": {"enabled": False}}, "babbling needs tutor.enabled"),
        ({"sgim": {"teachers": [GUIDE]}, "commander": {"enabled": False}}, "decomposition needs commander.enabled"),
        ({"sgim": {"exploration": True}, "commander": {"enabled": False}}, "sgim.exploration: needs commander.enabled"),
        ({"sgim": {"refinement": True}, "refinement": {"enabled": False}}, "sgim.refinement: needs commander.enabled"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(values, told):
    with pytest.raises(UserError) as error:
        loading.parse(values)
    assert told in str(error.value) and "\n" not in str(error.value)


def test_sgim_follows_every_cut_of_the_agents_regions():
    config = settings(teachers=[GUIDE])
    table = regions.create(((-4.0, -4.0), (20.0, 20.0)), ((4.0,), (10.0,)), max_regions=7)
    known, last = jax.device_get(strategies.init(config, table)), 4  # region 2 is [4, 20) x [-4, 10)
    cuts = [Cut(np.int32(2), np.int32(0), np.float32(9.0)), Cut(np.int32(last), np.int32(1), np.float32(5.0))]
    undone = Cut(np.int32(3), np.int32(0), np.float32(-2.0))
    splits = [Split(np.array(True), cut, np.int32(last + i)) for i, cut in enumerate(cuts)]
    splits.append(Split(np.array(False), undone, np.int32(last + 1)))
    goals = [[5.0, 1.0], [12.0, 3.0], [12.0, 8.0]]  # below the first cut, below and above the second
    known = known.replace(
        goals=put(known.goals, (2, slice(3)), goals),
        competences=put(known.competences, (2, slice(3)), [0.1, 0.2, 0.3]),
        written=put(known.written, 2, 3),
        episodes=put(known.episodes, 2, 8.0),
    )

    @jax.jit
    def followed(known, splits):
        table = known.abstraction
        for cut in cuts:
            table, _ = regions.split(table, cut, min_width=0.01)
        after = lessons.follow(known, Change.of(known.abstraction, table, splits))
        return after, table, selection.competence(after)

    after, table, competence = jax.device_get(followed(known, jax.tree.map(lambda *parts: np.stack(parts), *splits)))
    jax.tree.map(np.testing.assert_array_equal, after.abstraction, table)
    assert table.count == 6
    parts = [2, last, last + 1]
    assert after.written[parts].tolist() == [1, 1, 1]
    assert after.episodes[parts, 0].tolist() == [4, 2, 2]  # halved at each cut
    np.testing.assert_allclose(competence[parts], [0.1, 0.2, 0.3])


def lived(obs, box, choice, *, terminated=0.0):
    """A segment of L steps in which nobody moves."""
    steps = jnp.zeros((L, len(obs)))
    return Segment(
        obs=jnp.stack([obs] * (L + 1)), seen=(), subgoal=(), action=steps, terminated=steps + terminated, ended=steps,
        success=steps, arrived=steps, distance=steps, alive=steps + 1, non_finite=steps, overflow=steps,
        box=box, choice=choice,
    )  # fmt: skip


def commanded_in(playing, state, streams, lesson, *, key):
    """The memory of a greedy Commander under a lesson, which is due everywhere, and what the lesson says."""
    config, spec, obs = playing.config, playing.task.spec, streams.env.obs
    scene = Scene(spec.abstract(obs), spec.goal_point(obs), streams.env.metrics["success"])
    roadmap = Roadmap.of(config.commander, state.abstraction, state.graph)
    _, marks = lessons.mark(config.sgim, lesson, state.abstraction, scene.position, due=jnp.ones(len(obs), bool))
    memory = commander.command(
        config.commander,
        playing.task,
        state.commander,
        roadmap,
        streams.memory,
        scene,
        marks,
        env_steps=None,
        key=key,
    )
    return memory, marks, roadmap


def test_a_teacher_leads_by_the_regions_that_the_commander_will_have_to_choose(tiny, breaking_env, fresh):
    agent, spec = (
        loading.parse({**tiny, "sgim": {"teachers": [GUIDE], "waypoint_radius": 0.01}}).hyper(),
        Spec.of(breaking_env.env),
    )
    n = breaking_env.num_envs
    lesson = jax.tree.map(lambda x: x[:n], lesson_of(agent.sgim)[0])
    led = lessons.guided(agent.sgim, lesson)
    playing, state = levels.of(agent, spec), fresh()

    @jax.jit
    def commanded(state, key, waypoints):
        streams = play.start(playing, breaking_env, key=key)
        memory, *_ = commanded_in(playing, state, streams, lesson.replace(waypoints=waypoints), key=key)
        return spec.goal_point(streams.env.obs), memory

    table, key = jax.device_get(state.abstraction), jax.random.key(0)
    locate = jax.jit(jax.vmap(regions.locate, in_axes=(None, 0)))
    goal, _ = jax.device_get(commanded(state, key, np.zeros((n, 3, 2), np.float32)))
    beside = np.tile(np.float32([[-0.1, 0.1], [0.3, 0.1]]), (n, 1, 1))  # two regions on, then to the goal
    _, after = jax.device_get(commanded(state, key, np.concatenate([beside, goal[:, None]], axis=1)))
    for b in np.flatnonzero(led):
        corners = [after.start[b], *beside[b], goal[b]]
        way = [p for a, c in zip(corners, corners[1:], strict=False) for p in np.linspace(a, c, 16)]
        onward = next(j for j in locate(table, np.float32(way)).tolist() if j != int(after.region[b]))
        assert int(after.target[b]) == onward != int(after.goal_region[b])
        np.testing.assert_array_equal(after.box.lower[b], table.lower[onward])
        np.testing.assert_array_equal(after.box.upper[b], table.upper[onward])
    _, direct = jax.device_get(commanded(state, key, np.repeat(goal[:, None], 3, axis=1) + np.float32(0.5)))
    arriving = led & (direct.target == direct.goal_region)
    assert arriving.any()
    np.testing.assert_allclose(direct.box.centre[arriving], goal[arriving], atol=1e-4)  # as without a teacher


def test_on_the_way_to_a_teachers_waypoint_subgoals_are_straight_ahead_and_the_tutor_imitates_them(
    tiny, breaking_env, turning, monkeypatch
):
    tutoring = {**tiny["tutor"], "straight": False}
    agent = loading.parse({**tiny, "tutor": tutoring, "sgim": {"teachers": [GUIDE], "imitation": 2.0}}).hyper()
    lesson, _, _, _ = lesson_of(agent.sgim)
    n = breaking_env.num_envs
    lesson = jax.tree.map(lambda x: x[:n], lesson)
    led = lessons.guided(agent.sgim, lesson)
    assert led.any() and not led.all()
    playing = levels.of(agent, turning)

    @jax.jit
    def chosen(key, lesson, table):
        state, streams = tutor.init(key, agent.tutor, playing.task), play.start(playing, breaking_env, key=key)
        obs, box = streams.env.obs, streams.memory.box
        _, marks = lessons.mark(agent.sgim, lesson, table, turning.abstract(obs), due=jnp.zeros(n, bool))
        act = lambda marks: tutor.act(  # noqa: E731
            agent.tutor, playing.task, state, obs, box, marks, explore=True, key=key
        )
        choice = act(marks)
        renewed, passed = jnp.zeros(n, bool), lived(obs, box, choice)
        learnt = tutor.experience(agent.tutor, playing.task, passed, marks, renewed=renewed)
        return turning.pose(obs), choice.subgoal, act(Marks()).subgoal, learnt

    pose, subgoal, alone, decisions = jax.device_get(chosen(jax.random.key(0), lesson, four_regions()))
    np.testing.assert_array_equal(subgoal[~led], alone[~led])
    scale = np.asarray(turning.scale)
    for b in np.flatnonzero(led):
        way = lesson.waypoints[b, 0] - pose[b, :2]
        straight = np.concatenate([way, turning.heading * way / np.linalg.norm(way) - pose[b, 2:]])
        np.testing.assert_allclose(subgoal[b], np.clip(straight, -scale, scale), atol=1e-4)

    np.testing.assert_array_equal(decisions.weight, ~led)  # what is shown is no experience of the Tutor's own
    stacked = jax.tree.map(lambda x: np.stack([x, x]), decisions)
    taken = []
    monkeypatch.setattr(tutor.learners, "update", lambda *_, imitation, **__: taken.append(imitation) or (None, {}))
    for given in (jnp.stack([led, led & False]), None):
        imitate = lessons.imitating(agent.sgim, given)
        tutor.learn(
            agent.tutor, playing.task, None, stacked, below=None, penalty=None, imitate=imitate, key=jax.random.key(0)
        )
    imitation, nothing = taken
    np.testing.assert_array_equal(imitation.action, np.concatenate([decisions.action, decisions.action]))
    assert float(imitation.weight.mean()) == pytest.approx(2) and imitation.weight.shape == (2 * n,)
    np.testing.assert_array_equal(np.asarray(imitation.weight) > 0, np.concatenate([led, led & False]))
    assert nothing is None


def test_what_teachers_only_go_around_to_is_not_believed_to_be_reached(tiny, fresh):
    agent, state = loading.parse(tiny).hyper(), fresh()
    adjacent = np.asarray(jax.jit(regions.adjacent)(state.abstraction))
    i, j = map(int, np.argwhere(adjacent & ~np.eye(len(adjacent), dtype=bool))[0])
    where, numbers = np.zeros(3, np.int32), np.zeros(3, np.float32)
    decision = Decision(*[where] * 3, numbers, where, *[numbers] * 4)

    @jax.jit
    def value(told):
        graph = state.graph.replace(told=state.graph.told.at[i, j].set(told))
        roadmap = Roadmap.of(agent.commander, state.abstraction, graph)
        known = commander.observe(agent.commander, state.commander, roadmap, decision, due=jnp.array(True))
        return known.q[i, j, j]

    assert float(value(-1)) < float(value(0)) == float(value(1))


def test_what_babblers_and_those_on_a_detour_do_tells_nothing_of_commands(tiny, breaking_env, fresh):
    agent = loading.parse({**tiny, "sgim": {"strategies": OWN, "waypoint_radius": 0.01}}).hyper()
    lesson = jax.tree.map(lambda x: x[: breaking_env.num_envs], lesson_of(agent.sgim)[0])
    babbling, detour = (lesson.choice.strategy == number for number in (1, 2))
    assert babbling.any() and detour.any() and not (babbling | detour).all()
    playing, section = levels.of(agent, Spec.of(breaking_env.env)), agent.commander

    @jax.jit
    def finished(state, key, terminated):
        streams = play.start(playing, breaking_env, key=key)
        memory, marks, roadmap = commanded_in(playing, state, streams, lesson, key=key)
        passed = lived(streams.env.obs, memory.box, None, terminated=terminated)
        last = memory.replace(clock=memory.clock + section.period - agent.tutor.period)
        return commander.experience(section, playing.task, roadmap, last, passed, marks)[1]

    decision, outcome = jax.device_get(finished(fresh(), jax.random.key(0), 0.0))
    np.testing.assert_array_equal(decision.aside, detour)
    for told in (decision.weight, finished(fresh(), jax.random.key(0), 1.0).decision.lost, outcome.weight):
        np.testing.assert_array_equal(np.asarray(told) > 0, ~babbling)
