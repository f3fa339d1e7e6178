"""The parts of CHIME, beside slow ones in NumPy that know nothing of them."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from envs.worlds import room as rooms
from envs.worlds.room import Room, RoomState
from star.saht.chime import candidates, evolution, memory, models, planner
from star.saht.chime.candidates import NOBODY
from star.saht.chime.evolution import Judged
from star.saht.chime.figures import firsts
from star.saht.chime.models import ACTION, Model, Rows
from star.saht.chime.planner import Aim
from star.saht.chime.sections import ChimeConfig

ROOM = Room(movable=2, fixed=1)
NAMES, INPUTS = len(ROOM.names), len(ROOM.contexts)
CONFIG = ChimeConfig(models=4, candidates=3, few=4)

possible, succeed, switch = (jax.jit(x) for x in (candidates.possible, evolution.succeed, evolution.switch))
in_the_roles_of = jax.jit(candidates.in_the_roles_of, static_argnums=0)
imagine = jax.jit(planner.imagine, static_argnums=0, static_argnames="slots")
levels = jax.jit(planner.levels, static_argnums=0, static_argnames="slots")


def slow_step(room, places, action):
    """One action, pair by pair."""
    kind = ["robot"] + ["movable"] * room.movable + ["fixed"] * room.fixed
    places = np.array(places, float)

    def shares(i, j, heavy):
        if "robot" in (kind[i], kind[j]) and not heavy:
            return float(kind[i] == "robot"), float(kind[j] == "robot")
        weight = {"robot": 1, "movable": 0, "fixed": 2}
        a, b = weight[kind[i]], weight[kind[j]]
        return (0.5 * (a < 2), 0.5 * (a < 2)) if a == b else (float(a < b), float(b < a))

    def relax(heavy):
        moves = np.zeros_like(places)
        for i, j in itertools.combinations(range(len(places)), 2):
            line = places[i] - places[j]
            overlap = 40 - np.hypot(*line)
            if overlap > 0:
                mine, other = shares(i, j, heavy)
                moves[i] += mine * overlap * line / np.hypot(*line)
                moves[j] -= other * overlap * line / np.hypot(*line)
        for i, place in enumerate(places + moves):
            x, y = np.clip(place[0], 70, 530), np.clip(place[1], 70, 480)
            near = np.array([np.clip(x, 250, 270), np.clip(y, 200, 400)])
            away = np.array([x, y]) - near
            if room.wall and np.hypot(*away) < 20:
                x, y = near + 20 * away / np.hypot(*away)
            places[i] = x, y

    for _ in range(12):
        places[0] += np.clip(action, -1, 1) * 20 / 12
        for heavy in (True, True, True, False):
            relax(heavy)
    return places


@pytest.fixture(scope="module")
def played():
    """Places before and after random actions, and the actions."""

    def episode(key):
        reset_key, key = random.split(key)
        actions = 1.3 * random.normal(key, (10, 2))

        def one(state, action):
            after = rooms.step(ROOM, state, action)
            return after, (state.places, after.places)

        return (*jax.lax.scan(one, rooms.reset(ROOM, key=reset_key), actions)[1], actions)

    found = jax.jit(jax.vmap(episode))(random.split(random.key(0), 400))
    return [np.asarray(x).reshape(-1, *x.shape[2:]) for x in found]


def test_discs_stay_in_the_room_outside_one_another_and_of_the_wall(played):
    before, after, _ = played
    assert (after >= 70 - 1e-3).all() and (after <= [530 + 1e-3, 480 + 1e-3]).all()
    near = np.clip(after, rooms.WALL[0], rooms.WALL[1])
    assert np.linalg.norm(after - near, axis=-1).min() > 20 - 1e-2
    apart = np.linalg.norm(after[:, :, None] - after[:, None], axis=-1) + 1e3 * np.eye(4)
    assert apart.min() > 36 and (apart < 39).mean() < 1e-3
    np.testing.assert_array_equal(before[:, 3], after[:, 3])


def test_an_action_does_what_a_slow_room_does(played):
    before, after, actions = played
    pushed = np.flatnonzero(np.abs(after[:, 1:3] - before[:, 1:3]).max(axis=(1, 2)) > 1)
    both = np.flatnonzero((np.abs(after[:, 1:3] - before[:, 1:3]).max(axis=2) > 1).all(axis=1))
    assert len(pushed) > 50 and len(both) > 2
    for i in [*pushed[:40], *both[:10], *range(20)]:
        np.testing.assert_allclose(after[i], slow_step(ROOM, before[i], actions[i]), atol=0.05)


def test_a_robot_pushes_what_can_be_moved_and_stops_at_what_cannot():
    room = Room(movable=1, fixed=1, wall=False)
    for disc, other in ((1, 2), (2, 1)):
        places = jnp.zeros((3, 2)).at[0].set(jnp.array([200.0, 300.0])).at[disc].set(jnp.array([245.0, 300.0]))
        state = RoomState(places.at[other].set(jnp.array([100.0, 100.0])), jnp.zeros((2, 2)))
        after = rooms.step(room, state, jnp.array([1.0, 0.0])).places
        moved = np.asarray(after - state.places)[:, 0]
        assert moved[disc] == pytest.approx(15.0 if disc == 1 else 0.0, abs=0.1)
        assert moved[0] == pytest.approx(20.0 if disc == 1 else 5.0, abs=0.1)


def values_of(key, n):
    places = random.uniform(key, (n, 4, 2), minval=60, maxval=480)
    return jnp.concatenate([places, random.uniform(key, (n, 3, 2))], axis=1)


def model(context, *, key=0, outcome=1, control=0):
    weights = jax.tree.map(lambda leaf: leaf[0], models.init(INPUTS, 1, key=random.key(key)))
    chosen = jnp.array([name in context for name in ROOM.contexts])
    return Model(jnp.int32(outcome), jnp.int32(control), chosen, weights)


def slow_prediction(one, seen, control):
    """Unit by unit."""
    w = jax.tree.map(np.asarray, one.weights)
    hidden = []
    for h in range(models.HIDDEN):
        total = w.bias[h] + sum(control[k] * w.control[k, h] for k in range(2))
        for o in np.flatnonzero(one.context):
            total += sum(seen[o, k] * w.context[2 * o + k, h] for k in range(2))
        hidden.append(np.tanh(total))
    a, b, c, d = np.array(hidden) @ w.out + w.last
    return np.array([a * control[0] + b * control[1], c * control[0] + d * control[1]])


def test_a_model_predicts_what_a_slow_one_does_and_sees_only_its_contexts():
    one = model({"robot", "object_1_from_robot"})
    seen, change = random.normal(random.key(1), (5, INPUTS, 2)), random.normal(random.key(2), (5, NAMES, 2))
    rows = Rows(seen, jnp.zeros((5, 2)), change)
    found = models.predict(one, rows)
    expected = [slow_prediction(one, np.asarray(seen[i]), np.asarray(change[i, 0])) for i in range(5)]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    others = seen + ~one.context[:, None] * 9.0
    np.testing.assert_allclose(models.predict(one, rows._replace(seen=others)), found, rtol=1e-5)
    still = rows._replace(change=change.at[:, 0].set(0.0))
    assert not models.predict(one, still).any()


def test_what_is_seen_of_a_disc_is_its_direction_and_how_large_it_looks():
    values = values_of(random.key(3), 6)
    seen = np.asarray(rooms.see(ROOM, values))
    for row, (i, j) in itertools.product(range(6), ROOM.pairs):
        line = np.asarray(values[row, j] - values[row, i])
        distance = max(np.hypot(*line), 20.0)
        at = NAMES + ROOM.pairs.index((i, j))
        np.testing.assert_allclose(seen[row, at], line / distance * (40 / distance) ** 2, rtol=1e-4, atol=1e-6)


def test_a_model_in_other_roles_predicts_the_same_of_discs_that_have_changed_places():
    one = model({"robot", "colour_object_1", "object_1_from_robot", "object_2_from_object_1", "fixed_1_from_robot"})
    one = one._replace(context=one.context & (jnp.arange(INPUTS) != ROOM.contexts.index("colour_object_1")))
    values = values_of(random.key(4), 5)
    for outcome, control in ((2, 1), (2, 0), (1, 2)):
        other = in_the_roles_of(ROOM, one, jnp.int32(outcome), jnp.int32(control))
        assert int(other.outcome) == outcome and other.context.sum() == one.context.sum()
        discs = [control, outcome, *({0, 1, 2} - {control, outcome}), 3]  # of which robot, object 1, ... play the roles
        turned = values.at[:, jnp.array(discs)].set(values[:, :4])
        moved = random.normal(random.key(5), (5, 2))

        def predicted(model, values, control, moved=moved):
            change = jnp.zeros((5, NAMES, 2)).at[:, control].set(moved)
            return models.predict(model, Rows(rooms.see(ROOM, values), jnp.zeros((5, 2)), change))

        np.testing.assert_allclose(predicted(other, turned, control), predicted(one, values, 0), rtol=1e-3, atol=1e-5)


def remembered(n=64, key=6):
    """Actions with the robot always moving, object 1 sometimes and object 2 seldom, only with object 1."""
    change = np.zeros((n, NAMES, 2), np.float32)
    change[:, 0] = 1.0
    change[::4, 1], change[1::8, 1], change[::8, 2] = 0.5, 0.5, 0.3
    rows = Rows(random.normal(random.key(key), (n, INPUTS, 2)), jnp.ones((n, 2)), jnp.asarray(change))
    return memory.write(memory.empty(96, NAMES, INPUTS), rows, values_of(random.key(key), n))


def test_draws_are_even_and_half_of_a_mixture_has_moved():
    known = remembered()
    among = jnp.arange(96) < known.written
    dice = (jnp.arange(640) + 0.5) / 640
    assert set(np.bincount(memory.draw(among, dice), minlength=96)) == {0, 10}
    pairs = jnp.stack(jnp.meshgrid(dice[::16], dice[::16]), axis=-1).reshape(-1, 2)
    drawn = np.asarray(memory.mixture(known, among, jnp.int32(2), jnp.int32(1), pairs))
    moved = np.asarray(known.moved)
    assert moved[drawn, 1].all() and 0.45 < moved[drawn, 2].mean() < 0.55
    assert moved[np.asarray(memory.mixture(known, among, jnp.int32(0), jnp.int32(ACTION), pairs)), 0].all()
    kept, held = memory.parts(known)
    assert not (kept & held).any() and held.sum() == 16 and (kept | held).sum() == 64


def population(*slots):
    """Slots of (outcome, control, competence, on)."""
    empty = candidates.empty(CONFIG, INPUTS, key=random.key(0))
    for i, (outcome, control, competence, on) in enumerate(slots):
        found = empty.models
        empty = empty.replace(
            models=found._replace(outcome=found.outcome.at[i].set(outcome), control=found.control.at[i].set(control)),
            active=empty.active.at[i].set(True),
            enabled=empty.enabled.at[i].set(on),
            competence=empty.competence.at[i].set(competence),
            born=empty.born.at[i].set(100),
        )
    return empty


@pytest.mark.parametrize(
    ("slots", "expected"),
    [
        ([], {(0, ACTION), (1, ACTION), (2, ACTION)}),
        ([(0, ACTION, 0.9, True)], {(1, 0), (2, 0)}),
        ([(0, ACTION, 0.3, True)], {(1, ACTION), (2, ACTION)}),  # not competent enough to control others
        ([(0, ACTION, 0.9, False)], {(1, ACTION), (2, ACTION)}),
        ([(0, ACTION, 0.9, True), (1, 0, 0.9, True)], {(2, 0), (2, 1)}),
        ([(0, ACTION, 0.9, True), (1, 0, 0.9, True), (2, 1, 0.5, True)], {(2, 0)}),
    ],
)
def test_a_model_is_tried_of_what_moved_by_way_of_what_is_controllable_and_in_no_circle(slots, expected):
    known = remembered()
    found = possible(CONFIG, population(*slots), known, jnp.arange(96) < known.written)
    pairs = {(int(o), ACTION if c == NAMES else int(c)) for o, c in np.argwhere(found)}
    assert pairs == expected


def judged(own, slots, parent=1.0):
    none = np.full((7, 4), np.inf, np.float32)
    for (i, j), value in slots.items():
        none[i, j] = value
    return Judged(own=jnp.full(7, 1.0).at[4].set(own), slots=jnp.asarray(none), parent=jnp.full(7, parent))


@pytest.mark.parametrize(
    ("own", "rival", "born"), [(0.5, 0.9, True), (0.5, 0.51, False), (0.75, np.inf, False), (0.5, np.inf, True)]
)
def test_what_is_competent_and_explains_more_than_others_is_born_and_the_first_birth_is_kept(own, rival, born):
    known = population((0, ACTION, 0.9, True), (2, 0, 0.9, True))
    found = known.models
    known = known.replace(
        models=found._replace(outcome=found.outcome.at[4].set(1), control=found.control.at[4].set(0)),
        active=known.active.at[4].set(True),
        age=known.age.at[4].set(CONFIG.trial - 1),
    )
    births = jnp.full((NAMES, NAMES + 1), NOBODY, jnp.int32)
    told = judged(own, {(4, 1): rival})
    after, births = succeed(CONFIG, known, told, births, now=jnp.int32(250))
    assert bool(after.active[2]) == born and int(births[1, 0]) == (250 if born else NOBODY)
    assert not after.active[4]
    young = known.replace(age=known.age.at[4].set(0))
    after, _ = succeed(CONFIG, young, told, births, now=jnp.int32(250))
    assert not after.active[2] and after.active[4]


@pytest.mark.parametrize(
    ("own", "parent", "inputs", "better"),
    [(0.4, 0.5, 1, True), (0.48, 0.5, 1, False), (0.505, 0.5, 0, True), (0.6, 0.5, 0, False)],
)
def test_a_changed_copy_takes_the_place_of_its_parent_if_it_is_better_or_simpler(own, parent, inputs, better):
    known = population((1, ACTION, 0.5, True))
    context = known.models.context.at[0, :1].set(inputs == 0).at[4, 1 : 1 + inputs].set(True)
    known = known.replace(
        models=known.models._replace(context=context, outcome=known.models.outcome.at[4].set(1)),
        active=known.active.at[4].set(True),
        age=known.age.at[4].set(CONFIG.trial),
        parent=known.parent.at[4].set(0),
    )
    births = jnp.full((NAMES, NAMES + 1), NOBODY, jnp.int32)
    after, _ = succeed(CONFIG, known, judged(own, {}, parent), births, now=jnp.int32(250))
    np.testing.assert_array_equal(after.models.context[0], context[4 if better else 0])
    assert int(after.born[0]) == 100 and after.active.sum() == 1


def test_a_slot_of_no_use_is_switched_off_after_a_while_and_on_again():
    known, told = population((1, ACTION, 0.1, True)), judged(1.0, {})
    for count in range(1, CONFIG.patience + 1):
        known = switch(CONFIG, known, told)
        assert bool(known.enabled[0]) == (count < CONFIG.patience)
    known = known.replace(competence=known.competence.at[0].set(0.8))
    for count in range(1, CONFIG.patience + 1):
        known = switch(CONFIG, known, told.replace(own=told.own.at[0].set(0.2)))
        assert bool(known.enabled[0]) == (count == CONFIG.patience)


def test_what_is_imagined_follows_from_one_model_to_the_next_and_the_largest_change_counts():
    chain = [(0, ACTION), (1, 0), (2, 1), (2, 0)]
    known = population(*((outcome, control, 0.9, True) for outcome, control in chain))
    contexts = jnp.array([[name == "object_1_from_robot" for name in ROOM.contexts]] * 7)
    known = known.replace(models=known.models._replace(context=contexts))
    values, actions = values_of(random.key(8), 1)[0], jnp.array([[0.5, -0.2], [1.0, 0.3]])
    path = imagine(ROOM, known, values, actions, slots=4)
    now = np.array(values)
    for t in range(2):
        seen = np.asarray(rooms.see(ROOM, jnp.asarray(now)))
        change = {ACTION: np.asarray(actions[t])}
        for disc in range(3):
            each = [
                slow_prediction(jax.tree.map(lambda leaf, k=k: leaf[k], known.models), seen, change[control])
                for k, (outcome, control) in enumerate(chain)
                if outcome == disc
            ]
            change[disc] = max(each, key=np.linalg.norm)
            now[disc] = np.clip(now[disc] + 20 * change[disc], rooms.LOWER, rooms.UPPER)
        np.testing.assert_allclose(path[t], now, rtol=1e-4, atol=1e-2)


def test_to_push_an_object_a_plan_first_goes_to_where_a_push_came_from():
    known = population((0, ACTION, 0.9, True), (1, 0, 0.8, True))
    at = ROOM.contexts.index("object_1_from_robot")
    known = known.replace(models=known.models._replace(context=known.models.context.at[1, at].set(True)))
    values = np.zeros((8, NAMES, 2), np.float32)
    values[:, 0], values[:, 1] = [300.0, 300.0], [300.0, 340.0]
    values[4:, 0] = [340.0, 340.0]  # right of the object, from where it goes left
    change = np.zeros((8, NAMES, 2), np.float32)
    change[:4, :2], change[4:, :2] = [0.0, 0.8], [-0.8, 0.0]
    rows = Rows(jnp.zeros((8, INPUTS, 2)), jnp.zeros((8, 2)), jnp.asarray(change))
    past = memory.write(memory.empty(8, NAMES, INPUTS), rows, jnp.asarray(values))
    now = jnp.asarray(values[0]).at[0].set(jnp.array([200.0, 200.0])).at[1].set(jnp.array([400.0, 200.0]))

    def first(now):
        aim = Aim(jnp.int32(1), now[1] - jnp.array([25.0, 0.0]))
        return levels(ROOM, known, past, now, aim, slots=4, key=random.key(0))

    found = first(now)
    assert found.used.tolist() == [True, False, False] and int(found.control[0]) == 0
    np.testing.assert_allclose(found.goal[0], [440.0, 200.0], atol=1e-3)
    there = first(now.at[0].set(jnp.array([438.0, 203.0])))
    np.testing.assert_allclose(there.goal[0], [438.0 - 16.0, 203.0], atol=1e-3)


def test_first_births_are_told_by_kind():
    births = [
        ("object_1", "robot", 900),
        ("robot", "action", 250),
        ("object_2", "object_1", 4000),
        ("object_2", "robot", 800),
    ]
    assert firsts(births) == {"robot": 250, "object": 800, "object by object": 4000}
    assert firsts([]) == {}
