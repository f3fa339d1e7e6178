"""ChronoSRL: when goals are reached and how long the agent is there, its losses, chunks of actions, and learning."""

import sys
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as effort
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from star.agent import acting, hierarchy, levels, play
from star.agent.sections import TutorConfig
from star.config import loading
from star.learners import chronosrl
from star.learners.futures import Future
from star.learners.protocol import Learner, LearnerConfig
from star.training import program as programs
from tests.learners import places
from tests.learners.places import ENVS, EXAMPLE, SMALL, filled, slow_left

HORIZON = 24
TINY = {"width": 32, "blocks": 1, "representation": 8, "horizon": HORIZON, "radius": 0.2, "updates_per_rollout": 30}


def parsed(**values):
    return places.parsed("chronosrl", TINY | SMALL | values)


def settings(**values):
    return parsed(**values).controller.chronosrl


SIZES = {"batch_size": 64, "buffer_size": 1536}  # the same twice: compiled once
# Compiled once, not each time that a test calls them.
INIT = jax.jit(partial(chronosrl.init, example=EXAMPLE))
NLL, COST = jax.jit(chronosrl.nll), jax.jit(chronosrl.cost)
LOGITS = st_numpy.arrays(np.float32, (3, HORIZON + 1), elements=st.floats(-9, 9, width=32))


def slow_chances(logits):
    """P(tau = k) for k = 0..H, and that of never."""
    found, left = [], 1.0
    for logit in np.float64(logits):
        hazard = 1 / (1 + np.exp(-logit))
        found.append(left * hazard)
        left *= 1 - hazard
    return [*found, left]


@effort(max_examples=30)
@given(LOGITS, st.floats(0.5, 0.999))
def test_hazards_make_a_distribution_of_arrivals_and_their_expected_cost(logits, discount):
    count = HORIZON + 2
    rows, arrival = np.repeat(logits, count, axis=0), np.tile(np.arange(count, dtype=np.int32), 3)
    told = np.exp(-np.asarray(NLL(rows, arrival))).reshape(3, count)
    chances = np.array([slow_chances(one) for one in logits])
    np.testing.assert_allclose(told, chances, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(told.sum(axis=1), 1, atol=1e-4)
    costs = [sum(discount**t for t in range(min(tau, HORIZON))) for tau in range(count)]
    np.testing.assert_allclose(COST(logits, discount=discount), chances @ costs, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("horizon", [1, 2, 7, 50, 1000])
def test_bins_of_occupancy_hold_every_step_once_and_grow(horizon):
    number = chronosrl.bins(horizon)
    sizes = np.bincount(number)
    assert len(number) == horizon and number[0] == 0 and set(np.diff(number)) <= {0, 1}
    assert sizes.min() > 0 and len(sizes) <= chronosrl.BINS
    assert horizon < 1000 or (sizes[0] == 1 and 150 < sizes[-1] < 250)


def slow_outcome(away, left, ends, *, radius):
    """Of one step: arrival, and what is in each bin."""
    arrival = HORIZON + 1
    for step in reversed(range(HORIZON + 1)):
        if step <= left and away[step] <= radius:
            arrival = step
    inside = {}
    for step, number in enumerate(chronosrl.bins(HORIZON), start=1):
        if step <= left:
            inside.setdefault(number, []).append(sum(away[step] <= radius / n for n in (1, 2, 4)) / 3)
        elif ends:
            inside.setdefault(number, []).append(0.0)
    return arrival, inside


@effort(max_examples=50)
@given(
    st_numpy.arrays(np.float32, HORIZON + 1, elements=st.sampled_from([0, 0.125, 0.2, 0.25, 0.4, 0.5, 0.7, 3])),
    st.integers(0, HORIZON + 3),
    st.booleans(),
)
def test_arrival_and_occupancy_are_counted_within_the_episode(away, left, ends):
    found = jax.device_get(OUTCOME(away[None], np.int32([left]), np.float32([ends])))
    arrival, occupancy, seen = (x[0] for x in found)
    wanted, inside = slow_outcome(away, left, ends, radius=0.5)
    assert arrival == wanted
    assert set(np.flatnonzero(seen)) == inside.keys()
    for number, values in inside.items():
        assert occupancy[number] == pytest.approx(np.mean(values), abs=1e-6)


OUTCOME = jax.jit(partial(chronosrl.labels, radius=0.5))


def test_chunks_goals_and_what_came_of_them_are_of_one_episode(chunk=3):
    chosen, least = settings(batch_size=96, action_chunk=chunk), chunk - 1
    ring, steps = filled(np.random.default_rng(5), chronosrl._step, 3)  # a quarter of the buffer stays empty
    episodes = {  # of each step, which its first number tells
        float(steps[t].obs[b, 0]): (b, steps[t : t + n + 1]) for (t, b), n in np.ndenumerate(slow_left(steps))
    }
    possible = {first for first, (_, episode) in episodes.items() if len(episode) > least}

    @jax.jit
    def draw(ring, key):
        return chronosrl._drawn(chosen, ring, Future.of(ring, num_envs=ENVS, least=least), key)

    seen, kinds = set(), np.zeros(3)
    for number in range(8):
        batch = jax.device_get(draw(ring, jax.random.key(number)))
        assert batch.weight.all()
        for i, first in enumerate(batch.obs[:, 0].tolist()):
            b, episode = episodes[first]
            np.testing.assert_array_equal(batch.action[i], np.concatenate([s.action[b] for s in episode[:chunk]]))
            places = [s.track.place[b] for s in episode]
            away = np.linalg.norm(np.array(places) - batch.goal[i], axis=1)
            own, later = away[0] == 0, (away[1:] == 0).any()
            kinds += [later, own, not (later or own)]
            away = np.pad(away, (0, HORIZON + 1), constant_values=np.inf)
            lost = bool(episode[-1].terminated[b])
            arrival, inside = slow_outcome(away, len(episode) - 1, lost, radius=chosen.radius)
            assert (batch.arrival[i], batch.ends[i]) == (arrival, lost)
            assert {n: pytest.approx(np.mean(v), abs=1e-6) for n, v in inside.items()} == {
                n: batch.occupancy[i, n] for n in np.flatnonzero(batch.seen[i])
            }
            np.testing.assert_array_equal(batch.obs[i, -2:], batch.goal[i])
            seen.add(first)
    assert seen == possible
    np.testing.assert_allclose(kinds / kinds.sum(), [0.85, 0.05, 0.1], atol=0.04)


def test_the_critics_losses_are_those_of_the_equations():
    chosen = settings(**SIZES, discount=0.9)
    rng, n, count = np.random.default_rng(3), 16, chronosrl.bins(HORIZON)[-1] + 1
    critic = jax.device_get(INIT(jax.random.key(1), chosen).params["critic"])
    arrival, weight = rng.integers(0, HORIZON + 2, n), (rng.random(n) < 0.8).astype(float)
    batch = chronosrl.Batch(
        obs=rng.normal(size=(n, 5)),
        action=rng.normal(size=(n, 4)),
        goal=0.5 * rng.normal(size=(n, 2)),
        arrival=arrival,
        occupancy=rng.random((n, count)),
        seen=(rng.random((n, count)) < 0.7).astype(float),
        ends=np.zeros(n),
        weight=weight,
    )
    batch = jax.tree.map(lambda x: np.asarray(x, np.int32 if x is arrival else np.float32), batch)

    @jax.jit
    def judged(critic, batch):
        return (
            chronosrl._critic_loss(chosen, critic, batch),
            chronosrl._predicted(chosen, critic, batch, batch.action),
        )

    (loss, told), outlook = jax.device_get(judged(critic, batch))
    phi, psi, hazard, occupancy = map(np.float64, outlook)
    step, surprise, time, apart, cross = -np.log(0.9), [], [], [], []
    for i in np.flatnonzero(weight):
        surprise.append(-np.log(slow_chances(hazard[i])[arrival[i]]))
        if 0 < arrival[i] <= HORIZON:
            gap = abs(np.linalg.norm(phi[i] - psi[i]) - step * arrival[i])
            time.append(gap**2 / 2 if gap <= 1 else gap - 0.5)
        for j in np.flatnonzero(weight):
            far = np.linalg.norm(batch.goal[i] - batch.goal[j]) > chosen.radius if i != j else arrival[i] > HORIZON
            apart += [max(0, HORIZON * step - np.linalg.norm(phi[i] - psi[j]))] * int(far)
        chance = 1 / (1 + np.exp(-occupancy[i]))
        label = batch.occupancy[i]
        entropy = -label * np.log(chance) - (1 - label) * np.log(1 - chance)
        cross += entropy[batch.seen[i] > 0].tolist()
    wanted = {
        "arrival_loss": np.mean(surprise),
        "time_loss": np.mean(time),
        "separation_loss": np.mean(apart),
        "occupancy_loss": np.mean(cross),
    }
    assert {name: float(told[name]) for name in wanted} == pytest.approx(wanted, rel=1e-3)
    assert float(loss) == pytest.approx(sum(wanted.values()), rel=1e-3)


def test_it_learns_to_go_to_goals_that_no_reward_tells_of():
    chosen = settings(**SIZES, discount=0.95, goal_discount=0.8, learning_rate=1e-2)
    assert (np.median(places.cosines(chronosrl.LEARNER, chosen, rollouts=4), axis=0) > 0.9).all()


def random(example):
    """A state of one seed with random numbers in the shapes of `example`, which compiles nothing."""
    rng, key = np.random.default_rng(0), jax.random.key(0)

    def filled(x):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return key
        return np.asarray(rng.normal(size=x.shape[1:]) * (x.dtype == np.float32), x.dtype)

    return jax.tree.map(filled, example)


def test_a_chunk_is_played_whatever_is_seen_and_also_by_who_acts_from_observations(tmp_path):
    alone = {"commander.enabled": False, "env.name": "point_maze", "env.options.episode_length": 12, "tutor.unroll": 1}
    program = programs.build(loading.parse(parsed().model_dump(mode="json"), alone | {"trainer.eval_episodes": 2}))
    hyper, spec, env = program.hyper, program.experiment.tested_spec, program.experiment._tested
    state = random(program.example())
    key = program.evaluation_keys(0, stream=programs.AFTERWARDS)[0]
    keep = lambda env, subgoal, box, action: (env.obs, subgoal, action)  # noqa: E731
    agent = levels.of(hyper, spec, greedy=True)

    @jax.jit
    def greedy(state, key):
        _, (obs, subgoal, played) = play.greedy(hyper, spec, env, state, record=keep, key=key)
        seen = hierarchy.observe(agent, obs, subgoal)[::2]
        decided = agent.controller.act(hyper.controller, state.controller, seen, explore=False, key=key)
        return obs, played, decided

    obs, played, decided = jax.device_get(greedy(state, key))
    for t in range(12):  # in the first half of what was decided, or in the second, for each of two bodies
        np.testing.assert_allclose(played[t], np.split(decided[t // 2], 2, axis=1)[t % 2], atol=1e-5)
    trained = acting.TrainedAgent(program, state, run_dir=tmp_path, env_steps=0, seed=program.seeds[0])
    for step in range(12):
        np.testing.assert_array_equal(trained.act(obs[step]), played[step])


@pytest.mark.parametrize(
    ("level", "message"),
    [
        ({"controller": {"frame": "world"}}, "controller: frame: world, but learner chronosrl needs the places of"),
        ({"controller": {"hindsight": True}}, "controller: hindsight needs frame world: where a body stood is not"),
        (
            {"controller": {"chronosrl": {"buffer_size": 100}}},
            "chronosrl.buffer_size: 100 is not a multiple of",
        ),
        ({"controller": {"chronosrl": {"min_transitions": 97}}}, "min_transitions: 97 exceeds buffer_size 96"),
        (
            {"controller": {"chronosrl": {"action_chunk": 4}}},
            "tutor.period: 6 is not a multiple of the 4 env steps for which controller.learner chronosrl decides at",
        ),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(level, message):
    assert message in places.refused(parsed(), level)


def test_a_tutor_chooses_one_subgoal_at_a_time(monkeypatch):
    both = type("Both", (LearnerConfig,), {"chunk": property(lambda self: 2)})
    monkeypatch.setitem(sys.modules, "mine", SimpleNamespace(both=Learner(both, *[lambda: None] * 3)))
    monkeypatch.setenv("STAR_IMPORT", "mine")
    with pytest.raises(ValueError, match="learner: mine:both decides for some env steps at once, which no Tutor can"):
        TutorConfig(learner="mine:both")
    assert not TutorConfig(learner="mine:both", enabled=False).enabled
