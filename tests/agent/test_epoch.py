"""What each level learns from, against loops written from the equations, and the epoch as one pure, jitted function."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.abstraction import forward_model, refinement, regions
from star.abstraction.forward_model import Outcome
from star.agent import between_episodes, checks, commander, controller, epoch, levels
from star.agent.decisions import Decision, Finished
from star.agent.task import Task
from star.config import loading
from star.learners import replay
from star.learners.replay import Transition
from star.sgim import selection
from star.sgim.lessons import Marks
from star.spec import Spec
from tests.small import ACTS, GUIDE, demonstrations

K, L, B = 6, 3, 8  # commander.period, tutor.period and trainer.num_envs of the tiny hierarchy


def segments(recording):
    return [(i, b) for i in range(len(recording.subgoal)) for b in range(B)]


def ended(recording, i, b):
    return (recording.steps.ended[i, :, b] * recording.steps.alive[i, :, b]).any()


def finished(recording, i, b):
    """Whether segment i completes k uninterrupted env steps under one target."""
    return recording.before.memory.clock[i, b] == K - L and not ended(recording, i, b)


def test_only_periods_of_exactly_k_steps_teach_commander_and_forward_model(recording):
    count = 0
    for i, b in segments(recording):
        expected = finished(recording, i, b)
        assert recording.decision.weight[i, b] == recording.outcome.weight[i, b] == expected
        count += expected
    assert 0 < count < B * len(recording.subgoal) // 2


def test_a_period_is_lost_where_the_task_was_terminated_and_not_where_it_was_truncated(recording):
    lost = 0
    for i, b in segments(recording):
        expected = (recording.steps.terminated[i, :, b] * recording.steps.alive[i, :, b]).any()
        assert recording.decision.lost[i, b] == expected
        if expected:  # the distance at its end is paid for ever
            last = int(recording.steps.alive[i, :, b].sum()) - 1
            worth = -recording.steps.distance[i, last, b] / (1 - recording.config.commander.discount)
            np.testing.assert_allclose(recording.decision.reward[i, b], worth, rtol=1e-5)
        lost += expected
    assert 0 < lost < sum(ended(recording, i, b) for i, b in segments(recording))


def test_a_period_lost_in_the_last_step_of_an_episode_is_not_counted_as_finished_too(recording):
    # time is up there, so `ended`, which is for ends before it, is 0 though the task terminated
    fatal = (recording.steps.terminated * recording.steps.alive)[:, -1].any(axis=1)
    config, lost = recording.config.hyper(), 0
    task, roadmap = Task.of(config, recording.spec), SimpleNamespace(abstraction=recording.abstraction)
    for i in np.flatnonzero(fatal):
        memory, passed = (jax.tree.map(lambda x, i=i: x[i], tree) for tree in (recording.commanded, recording.passed))
        passed = passed.replace(ended=np.zeros_like(passed.ended))
        memory, finished = commander.experience(config.commander, task, roadmap, memory, passed, Marks())
        last = passed.terminated[-1] * passed.alive[-1] > 0
        assert (finished.decision.lost[last] == 1).all()
        assert not finished.decision.weight[last].any() and not finished.outcome.weight[last].any()
        lost += (last & (memory.clock == 0)).sum()
    assert lost > 0


def test_a_finished_period_tells_where_it_began_what_it_aimed_at_and_where_it_ended(recording):
    began = {}
    for i, b in segments(recording):
        if recording.before.memory.clock[i, b] == 0:
            began[b] = i
        if not finished(recording, i, b):
            continue
        first, decision, outcome = began[b], recording.decision, recording.outcome
        assert first == i - 1
        assert decision.region[i, b] == recording.commanded.region[first, b]
        assert decision.goal_region[i, b] == recording.commanded.goal_region[first, b]
        assert decision.target[i, b] == recording.commanded.target[first, b]
        steps = -np.concatenate([recording.steps.distance[first, :, b], recording.steps.distance[i, :, b]])
        expected = steps.max() if recording.published else steps.mean()
        np.testing.assert_allclose(decision.reward[i, b], expected, rtol=1e-5)
        end = recording.steps.next_obs[i, -1, b, :2]
        np.testing.assert_array_equal(outcome.start[i, b], recording.steps.obs[first, 0, b, :2])
        np.testing.assert_array_equal(outcome.end[i, b], end)
        np.testing.assert_array_equal(outcome.lower[i, b], recording.commanded.box.lower[first, b])
        np.testing.assert_array_equal(outcome.upper[i, b], recording.commanded.box.upper[first, b])
        region = decision.next_region[i, b]
        assert (recording.abstraction.lower[region] <= end).all() and (end < recording.abstraction.upper[region]).all()


def test_the_controller_is_paid_for_the_distance_to_its_moving_subgoal(recording):
    for i, b in segments(recording):
        for t in range(L):
            g = recording.steps.subgoal[i, t, b]
            s, after = recording.steps.obs[i, t, b, :2], recording.steps.next_obs[i, t, b, :2]
            left = np.linalg.norm(s + g - after)
            expected = 0.5 * (-left if recording.published else np.linalg.norm(g) - left)
            expected -= recording.config.controller.termination_penalty * recording.steps.terminated[i, t, b]
            np.testing.assert_allclose(recording.controller.reward[i, t, b], expected, atol=1e-5)


def test_the_controller_sees_no_position_but_the_subgoal_before_and_after_the_step(recording):
    steps, seen = recording.steps, recording.controller
    before = np.concatenate([steps.obs[..., 2:4], steps.subgoal], axis=-1)
    after = np.concatenate([steps.next_obs[..., 2:4], steps.next_subgoal], axis=-1)
    np.testing.assert_array_equal(seen.obs, before)
    np.testing.assert_array_equal(seen.next_obs, after)


def test_the_controllers_chain_is_cut_where_the_subgoal_or_the_episode_ends(recording):
    for i, b in segments(recording):
        for t in range(L):
            assert recording.controller.terminated[i, t, b] == recording.steps.terminated[i, t, b]
            assert recording.controller.cut[i, t, b] == (t == L - 1 or recording.steps.ended[i, t, b])
            assert recording.controller.weight[i, t, b] == recording.steps.alive[i, t, b]


def test_the_tutor_is_paid_for_the_distance_to_the_centre_of_its_box(recording):
    for i, b in segments(recording):
        box = recording.commanded.box
        centre = (box.lower[i, b] + box.upper[i, b]) / 2
        expected = 0.0
        for t in range(L):
            if recording.steps.alive[i, t, b]:
                before = np.linalg.norm(recording.steps.obs[i, t, b, :2] - centre)
                after = np.linalg.norm(recording.steps.next_obs[i, t, b, :2] - centre)
                expected += -after if recording.published else before - after
        np.testing.assert_allclose(recording.tutor.reward[i, b], 0.1 * expected, rtol=1e-4, atol=1e-6)


def test_the_tutor_sees_the_state_and_the_bounds_of_its_box_but_never_the_goal(recording):
    for i, b in segments(recording):
        box = recording.commanded.box
        for seen, obs in (
            (recording.tutor.obs[i, b], recording.steps.obs[i, 0, b]),
            (recording.tutor.next_obs[i, b], recording.steps.next_obs[i, -1, b]),
        ):
            origin = 0 if recording.published else obs[:2]
            expected = np.concatenate([obs[:4], box.lower[i, b] - origin, box.upper[i, b] - origin])
            np.testing.assert_allclose(seen, expected, atol=1e-5)


def test_the_tutors_chain_is_cut_where_the_target_or_the_episode_ends(recording):
    for i, b in segments(recording):
        terminated = (recording.steps.terminated[i, :, b] * recording.steps.alive[i, :, b]).any()
        assert recording.tutor.terminated[i, b] == terminated
        assert recording.tutor.cut[i, b] == (recording.before.memory.clock[i, b] == K - L or ended(recording, i, b))
    box, position = recording.passed.box, recording.spec.abstract(recording.passed.obs[:, 0])
    farthest = np.maximum(np.abs(box.lower - position), np.abs(box.upper - position))
    small = ((box.upper - box.lower) / 2 <= 1.0 + 1e-3).all(axis=-1)  # the goal's margin
    close = small & (farthest <= np.array(recording.spec.subgoal_scale) / 2).all(axis=-1)
    assert close.any() and not close.all()
    np.testing.assert_array_equal(recording.tutor.weight, 1 if recording.published else ~close)


class Epoch:
    """The jitted epoch of a configuration, with the number of times it was traced."""

    def __init__(self, env, values, spec=None, teachers=()):
        self.spec = spec or Spec.of(env.env)
        self.config = loading.parse(values)
        self.traces = 0

        def once(agent, state):
            self.traces += 1
            return epoch.epoch(agent, self.spec, env, state, teachers)

        self.one = jax.jit(once)
        self.init = jax.jit(lambda key: levels.init(self.config.hyper(), self.spec, key=key))


SGIM = {
    "goals": True,
    "strategies": ["autonomous", "babbling", "decomposition"],
    "teachers": [GUIDE, ACTS],
    "exploration": True,
    "refinement": True,
}


@pytest.fixture(scope="module")
def jitted(breaking_env, tiny):
    """All levels, and all that SGIM can do."""
    teachers = [demonstrations(length=2), demonstrations(1, length=1)]
    return Epoch(breaking_env, {**tiny, "sgim": SGIM}, teachers=teachers)


@pytest.fixture(scope="module")
def course(jitted):
    """The states of three epochs, and the metrics of each."""
    states, metrics = [jitted.init(jax.random.key(22))], []  # a region is cut, which is rare in so few epochs
    for _ in range(3):
        state, more = jitted.one(jitted.config.hyper(), states[-1])
        states.append(state)
        metrics.append(more)
    return states, metrics


@pytest.fixture(scope="module")
def first(course):
    """Start and end of the first epoch, and its metrics."""
    (start, end, *_), (metrics, *_) = course
    return start, end, metrics


def stack(*trees):
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *trees)


def to_numpy(tree):
    """The tree with NumPy arrays, typed keys left out."""
    keyless = [x for x in jax.tree.leaves(tree) if not jnp.issubdtype(x.dtype, jax.dtypes.prng_key)]
    return [np.asarray(x) for x in keyless]


def assert_close(actual, expected):
    for a, b in zip(to_numpy(actual), to_numpy(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=1e-4)


def test_an_epoch_changes_every_level_and_nothing_about_shapes_types_or_structure(first):
    start, end, _ = first
    kinds = [[(x.shape, x.dtype, getattr(x, "weak_type", False)) for x in jax.tree.leaves(s)] for s in (start, end)]
    assert kinds[0] == kinds[1]
    assert jax.tree.structure(start) == jax.tree.structure(end)
    for name in ("commander", "tutor", "controller", "graph", "forward_model"):
        before, after = (to_numpy(getattr(state, name)) for state in (start, end))
        assert any((a != b).any() for a, b in zip(before, after, strict=True)), name
    assert int(end.epoch) == 1


def test_metrics_are_finite_scalars_prefixed_by_level(first):
    _, _, metrics = first
    parts = {"commander", "tutor", "controller", "forward_model", "refinement", "abstraction", "sgim", "train", "env"}
    assert {name.split("/")[0] for name in metrics} == parts
    for name, value in metrics.items():
        assert value.shape == () and np.isfinite(value), name


def test_early_ends_are_counted_by_their_reason(first):
    """An environment ends early at most once a segment; the fuses of the tiny environment never drop contacts."""
    metrics = first[2]
    for name in ("env/terminated", "env/non_finite"):
        count = float(metrics[name])
        assert count == round(count) and 0 < count <= B * 30 // L
    assert float(metrics["env/overflow"]) == 0
    assert float(metrics["env/obs_non_finite"]) == 0


def test_periods_beyond_the_room_of_the_buffer_count_for_refinement_too(tiny):
    config = loading.parse(tiny, {"forward_model.buffer_size": 8}).hyper()
    n, space = 10, np.float32([[0, 0], [9, 9]])
    point = np.random.default_rng(0).uniform(1, 8, (n, 2)).astype(np.float32)
    whole, none = np.ones(n, np.float32), np.zeros(n, np.int32)
    outcome = Outcome(start=point, lower=point - 1, upper=point + 1, end=point, weight=whole)
    decision = Decision(
        region=none, goal_region=none, target=none + 1, reward=none, next_region=none, weight=whole, lost=none,
        aside=none, goal=point,
    )  # fmt: skip

    @jax.jit
    def learnt(key):
        state = SimpleNamespace(
            forward_model=forward_model.init(key, config.forward_model, space=space),
            graph=refinement.init(capacity=2, dimensions=2),
            abstraction=regions.create(tuple(space), [[3.0], []], max_regions=2),
            replace=lambda **parts: SimpleNamespace(**parts),
        )
        after, _ = between_episodes._learn_where_commands_lead(config, state, decision, outcome, key=key)
        return after.graph, forward_model.remembered(after.forward_model)

    graph, kept = jax.device_get(learnt(jax.random.key(0)))
    assert graph.transitions[0, 1] == n
    np.testing.assert_array_equal(kept.start, point[:8])


def test_cuts_wait_for_the_next_epoch(tiny, fresh, breaking_env, monkeypatch):
    """Greedy episodes in between see the regions that were played in, and what was counted there."""
    section = tiny["abstraction"] | {"max_regions": 17}
    config, state = loading.parse({**tiny, "abstraction": section}).hyper(), fresh(abstraction=section)
    middle = regions.Cut(jnp.int32(0), jnp.int32(0), (state.abstraction.lower + state.abstraction.upper)[0, 0] / 2)
    cut, done = regions.split(state.abstraction, middle, min_width=0.1)
    q = jnp.ones_like(state.commander.q)
    monkeypatch.setattr(between_episodes, "_learn_where_commands_lead", lambda config, state, *_, **__: (state, {}))
    monkeypatch.setattr(
        between_episodes,
        "refine",
        lambda _, __, ___, state, *____, **_____: (
            state.replace(abstraction=cut, commander=state.commander.replace(q=q)), {},
        ),
    )  # fmt: skip
    point, none = np.ones((4, 2), np.float32), np.zeros(4, np.int32)
    outcome = Outcome(start=point, lower=point, upper=point, end=point, weight=none + 1.0)
    decision = Decision(
        region=none, goal_region=none, target=none, reward=none + 0.0, next_region=none, weight=none + 1.0,
        lost=none + 0.0, aside=none + 0.0, goal=point,
    )  # fmt: skip
    after, _ = between_episodes.learn(
        config, Spec.of(breaking_env.env), None, state, known=state.commander, finished=Finished(decision, outcome),
        num_envs=4, env_steps=jnp.float32(0), key=jax.random.key(0),
    )  # fmt: skip
    jax.tree.map(np.testing.assert_array_equal, after.abstraction, state.abstraction)
    np.testing.assert_array_equal(after.commander.q, state.commander.q)
    begun = after.renewed()
    assert bool(done) and int(begun.abstraction.count) == int(state.abstraction.count) + 1
    jax.tree.map(np.testing.assert_array_equal, begun.abstraction, cut)
    assert np.asarray(begun.commander.q != state.commander.q).any()


def test_complete_periods_enter_the_forward_models_buffer_and_cut_ones_do_not(first):
    _, end, _ = first
    items, written = jax.tree.map(np.asarray, replay.contents(end.forward_model.ring))
    complete = items.weight * written > 0
    assert 0 < complete.sum() < B * 30 // K  # fewer than if no episode had ended early
    assert np.isfinite(items.start[complete]).all() and np.isfinite(items.end[complete]).all()


def test_epochs_after_the_first_compile_nothing_and_other_hyperparameters_neither(jitted, course):
    values = jitted.config.model_dump(mode="json")
    other = loading.parse(values, {"commander.discount": 0.5, "tutor.reward_scale": 0.3})
    jitted.one(other.hyper(), course[0][-1])
    assert jitted.traces == 1


def test_sgim_follows_the_agent_through_its_epochs(jitted, course):
    states, metrics = course
    assert jitted.traces == 1
    for state in states:
        jax.tree.map(np.testing.assert_array_equal, state.sgim.abstraction, state.abstraction)
    for more in metrics:
        shares = [float(more[f"sgim/share_{name}"]) for name in jitted.config.sgim.names]
        assert sum(shares) == pytest.approx(1)
        assert 0 <= float(more["sgim/competence"]) <= 1 and int(more["sgim/refused"]) == 0
    assert float(states[-1].sgim.episodes.sum()) > 0
    remembered = selection.competence(states[-1].sgim)
    assert np.isfinite(remembered).all() and (remembered > 0).any()
    for name, value in metrics[-1].items():
        assert np.isfinite(value), name


def test_after_a_split_the_commander_counts_by_the_new_regions(jitted):
    config, spec = jitted.config.hyper(), jitted.spec
    state = jitted.init(jax.random.key(0))
    state = jax.device_get(state.replace(key=None, controller=None, tutor=None))  # so that `refined` alone is compiled
    before = state.abstraction
    capacity = before.capacity
    count = int(state.abstraction.count)
    q = np.arange(float(capacity**3), dtype=np.float32).reshape(3 * (capacity,))
    # A model that predicts a step of +0.1 along x, and one due pair that it splits: region 0 and the next along x.
    params = jax.tree.map(np.zeros_like, state.forward_model.params)
    half = (state.abstraction.space[1] - state.abstraction.space[0]) / 2
    last = params["params"]["Dense_1"]
    params = {"params": {**params["params"], "Dense_1": {**last, "bias": np.array([1.9, 0.0], np.float32) / half}}}
    rng = np.random.default_rng(0)
    starts = rng.uniform(-4, -0.2, (64, 2)).astype(np.float32)

    def filled(ring):
        example, _ = replay.contents(ring)
        return replay.add(ring, example.replace(start=starts, weight=jnp.ones(64)))

    target = 4  # the grid of 4 x 4 is stored row by row, so this is the box beside region 0 along x
    ring = jax.jit(filled)(state.forward_model.ring)
    upper, transitions, stable = (np.array(x) for x in (before.upper, state.graph.transitions, state.graph.stable))
    upper[target, 0], transitions[0, target], stable[0, target] = 2.0, 9.0, True
    state = state.replace(
        commander=state.commander.replace(q=q, chosen=np.ones(capacity, np.float32)),
        forward_model=state.forward_model.replace(params=params, ring=ring),
        abstraction=before.replace(upper=upper),
        graph=state.graph.replace(transitions=transitions, stable=stable),
    )
    goals = Outcome(*jnp.zeros((4, 1, 2)), weight=jnp.zeros(1))

    @jax.jit
    def refined(state):
        return refinement.refine(
            config,
            state.abstraction,
            state.graph,
            state.forward_model,
            goals,
            cube=spec.cube,
            key=jax.random.key(0),
        )

    _, change, metrics = jax.device_get(refined(state))
    assert int(metrics["splits"]) == 1
    assert int(change.after.count) == count + 1
    expected = np.array(q)
    expected[count] = expected[0]
    expected[:, count] = expected[:, 0]
    expected[:, :, count] = expected[:, :, 0]
    # Without the overlap, in which nobody can be located: one decision from each part to the other.
    upper = np.array(change.after.upper)
    upper[target] = before.upper[target]
    mended = change.after.replace(upper=upper)
    change = change.replace(after=mended)
    start, end, goal = (
        mended.lower[np.array(where)] + np.float32(0.01) for where in ([0, count], [count, 0], [target, count])
    )
    ones, region = np.ones(2, np.float32), np.zeros(2, np.int32)
    aims = np.array([target, 0], np.int32)
    decision = Decision(region, aims, aims, ones, region, ones, *[0 * ones] * 2, goal=goal)
    outcome = Outcome(start=start, lower=start, upper=start, end=end, weight=ones)
    known, follow = state.commander, jax.jit(commander.follow)
    of_epoch = Finished(decision, outcome), np.zeros_like(known.q[0])
    learnt = follow(config.commander, known, change, known, *of_epoch)
    np.testing.assert_array_equal(learnt.q, expected)
    without = known.replace(model=None)
    by_values = follow(config.commander.model_copy(update={"learner": "q"}), without, change, without, *of_epoch)
    np.testing.assert_array_equal(by_values.q, expected)
    assert by_values.model is None
    assert float(learnt.chosen[0]) == float(learnt.chosen[count]) == 0.5
    led = np.argwhere(np.asarray(learnt.model.led))
    assert led.tolist() == [[1, 0, target, count], [1, count, count, 0]]
    assert np.argwhere(np.asarray(learnt.model.visits)).tolist() == [[0, target, target], [count, count, count]]


@pytest.mark.parametrize("section", ["forward_model", "tutor.td3", "controller.td3"])
def test_a_batch_larger_than_its_buffer_is_refused_in_one_line(breaking_env, tiny, section):
    overrides = {f"{section}.batch_size": 65, f"{section}.buffer_size": 64}
    if "." in section:
        overrides[f"{section.split('.')[0]}.learner"] = "td3"
    with pytest.raises(ValueError) as caught:
        checks.check(loading.parse(tiny, overrides), Spec.of(breaking_env.env))
    assert section in str(caught.value) and "batch_size" in str(caught.value) and "\n" not in str(caught.value)


ADJACENCY = {"enabled": True, "hidden": [8], "batch_size": 8, "updates_per_epoch": 2}
REPLAY = {"hidden": [8], "batch_size": 16, "buffer_size": 64, "min_transitions": 32, "updates_per_rollout": 2}


@pytest.fixture(scope="module")
def hrac(breaking_env, turning, tiny):
    """HIRO, which replays and corrects old subgoals, with a loss more; its subgoals set a heading too."""
    replaying = {"tutor.learner": "td3", "tutor.off_policy_correction": True, "tutor.td3": REPLAY}
    values = loading.parse(tiny, {"commander.enabled": False, "tutor.adjacency": ADJACENCY} | replaying)
    return Epoch(breaking_env, values.model_dump(mode="json"), turning)


def test_the_commander_can_be_left_out(hrac):
    """In `test_trainer.py` both upper levels are, and in `test_development.py` the Tutor."""
    start = hrac.init(jax.random.key(0))
    end, metrics = hrac.one(hrac.config.hyper(), start)
    moved = {
        name: any((a != b).any() for a, b in zip(*map(to_numpy, pair), strict=True))
        for name, pair in {
            "controller": (start.controller.params, end.controller.params),
            "actor": (start.tutor.params["actor"], end.tutor.params["actor"]),
            "critic": (start.tutor.params["critic"], end.tutor.params["critic"]),
        }.items()
    }
    assert all(moved.values()), moved
    assert "tutor/q" in metrics
    assert int(end.tutor.updates) == 2 * (hrac.spec.episode_length // (2 * L) - 1)  # not of the first 16 decisions
    assert "abstraction/regions" not in metrics and not np.any(jax.device_get(end.commander.chosen))
    assert np.any(jax.device_get(end.adjacency.adjacent))


@pytest.mark.parametrize("tutored", [True, False])
def test_hindsight_makes_what_was_reached_the_subgoal_of_half_of_the_batch(breaking_env, tiny, tutored):
    learner = {"controller.learner": "td3", "controller.hindsight": True, "tutor.enabled": tutored}
    agent, spec = loading.parse(tiny, learner).hyper(), Spec.of(breaking_env.env)
    rng = np.random.default_rng(0)
    n, size = 400, 2 if tutored else 4
    reached = rng.normal(size=(n, 2, 2)).astype(np.float32)
    price = rng.random(n) * (rng.random(n) < 0.3)
    batch = Transition(
        obs=jnp.full((n, 2 + size), 7.0),
        action=jnp.zeros((n, 2)),
        reward=jnp.asarray(2 * np.sqrt(2) - price, jnp.float32),
        next_obs=jnp.full((n, 2 + size), 5.0),
        terminated=jnp.asarray(rng.random(n) < 0.3, jnp.float32),
        cut=jnp.zeros(n),
        weight=jnp.ones(n),
        extras=jnp.asarray(reached),
    )
    got = controller._in_hindsight(agent.controller, Task.of(agent, spec), batch, jax.random.key(0))
    changed = np.asarray(got.obs)[:, -1] != 7.0
    assert 0.4 < changed.mean() < 0.6
    np.testing.assert_array_equal(got.obs[:, :2], batch.obs[:, :2])
    around = 0.0 if tutored else agent.commander.goal_margin
    np.testing.assert_array_equal(np.asarray(got.reward)[~changed], np.asarray(batch.reward)[~changed])
    for seen, was, place in ((got.obs, 7.0, 0), (got.next_obs, 5.0, 1)):
        np.testing.assert_array_equal(np.asarray(seen)[~changed], was)
        corners = [reached[changed, place] - around, reached[changed, place] + around][: size // 2]
        np.testing.assert_allclose(np.asarray(seen)[changed, 2:], np.concatenate(corners, axis=-1), atol=1e-6)
    distance = np.linalg.norm(np.maximum(np.abs(reached) - around, 0.0), axis=-1)
    expected = distance[:, 0] - distance[:, 1] - price
    np.testing.assert_allclose(np.asarray(got.reward)[changed], expected[changed], atol=1e-5)


def test_a_termination_costs_its_penalty(recording):
    passed = jax.tree.map(lambda x: jnp.asarray(x[0]), recording.passed)
    config = recording.config.hyper()
    paid, less = (
        controller.experience(
            config.controller.model_copy(update={"termination_penalty": price}),
            Task.of(config, recording.spec),
            passed,
            env_steps=0.0,
        ).reward
        for price in (0.0, 3.0)
    )
    np.testing.assert_allclose(paid - less, 3.0 * passed.terminated, atol=1e-5)
    assert passed.terminated.any()


def test_an_epoch_charges_for_tilts_by_the_env_steps_before_it(hrac):
    env_steps = hrac.spec.episode_length * B  # in an epoch
    rising = {"tilt_penalty": 100.0, "tilt_start": 0.01, "tilt_steps": 2.0 * env_steps}
    values = loading.parse(hrac.config.model_dump(mode="json"), {f"controller.{key}": x for key, x in rising.items()})
    start = hrac.init(jax.random.key(0))
    first, middle, last = (
        float(hrac.one(values.hyper(), start.replace(epoch=start.epoch + done))[1]["controller/reward"])
        for done in (0, 1, 2)
    )
    assert hrac.traces == 1
    assert first - last > 1
    assert (first - middle) / (first - last) == pytest.approx((0.1 - 0.01) / (1 - 0.01), rel=0.2)


def test_what_is_reached_later_in_the_segment_is_seen_from_every_step(recording):
    passed = jax.tree.map(lambda x: jnp.asarray(x[0]), recording.passed)
    later = np.asarray(controller._later(Task.of(recording.config, recording.spec), passed))
    end = recording.steps.next_obs[0, -1, :, :2]
    for t in range(L):
        np.testing.assert_allclose(later[t, :, 0], end - recording.steps.obs[0, t, :, :2], atol=1e-5)
        np.testing.assert_allclose(later[t, :, 1], end - recording.steps.next_obs[0, t, :, :2], atol=1e-5)
