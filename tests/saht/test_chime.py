"""The parts of CHIME, beside slow ones in NumPy that know nothing of them."""

import itertools

import jax
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
predict, draw, mixture, write = (jax.jit(x) for x in (models.predict, memory.draw, memory.mixture, memory.write))
see, step = (jax.jit(x, static_argnums=0) for x in (rooms.see, rooms.step))
EMPTY = jax.device_get(jax.jit(lambda: candidates.empty(CONFIG, INPUTS, key=random.key(0)))())
NO_BIRTHS = np.full((NAMES, NAMES + 1), NOBODY, np.int32)


def put(array, at, value):
    """`array` with `value` there."""
    array = np.array(array)
    array[at] = value
    return array


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
        places = np.zeros((3, 2), np.float32)
        places[[0, disc, other]] = [200.0, 300.0], [245.0, 300.0], [100.0, 100.0]
        after = step(room, RoomState(places, np.zeros((2, 2), np.float32)), np.array([1.0, 0.0], np.float32)).places
        moved = (np.asarray(after) - places)[:, 0]
        assert moved[disc] == pytest.approx(15.0 if disc == 1 else 0.0, abs=0.1)
        assert moved[0] == pytest.approx(20.0 if disc == 1 else 5.0, abs=0.1)


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def values_of(seed, n):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(60, 480, (n, 4, 2)), rng.uniform(size=(n, 3, 2))], axis=1).astype(np.float32)


def model(context):
    """One of object 1 by way of the robot."""
    weights = jax.tree.map(lambda leaf: leaf[0], EMPTY.models.weights)
    return Model(np.int32(1), np.int32(0), np.array([name in context for name in ROOM.contexts]), weights)


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
    seen, change = normal(1, 5, INPUTS, 2), normal(2, 5, NAMES, 2)
    rows = Rows(seen, np.zeros((5, 2), np.float32), change)
    found = predict(one, rows)
    expected = [slow_prediction(one, seen[i], change[i, 0]) for i in range(5)]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    others = seen + ~one.context[:, None] * np.float32(9)
    np.testing.assert_allclose(predict(one, rows._replace(seen=others)), found, rtol=1e-5)
    still = rows._replace(change=put(change, np.s_[:, 0], 0.0))
    assert not np.asarray(predict(one, still)).any()


def test_what_is_seen_of_a_disc_is_its_direction_and_how_large_it_looks():
    values = values_of(3, 6)
    seen = np.asarray(see(ROOM, values))
    for row, (i, j) in itertools.product(range(6), ROOM.pairs):
        line = values[row, j] - values[row, i]
        distance = max(np.hypot(*line), 20.0)
        at = NAMES + ROOM.pairs.index((i, j))
        np.testing.assert_allclose(seen[row, at], line / distance * (40 / distance) ** 2, rtol=1e-4, atol=1e-6)


def test_a_model_in_other_roles_predicts_the_same_of_discs_that_have_changed_places():
    one = model({"robot", "colour_object_1", "object_1_from_robot", "object_2_from_object_1", "fixed_1_from_robot"})
    one = one._replace(context=one.context & (np.arange(INPUTS) != ROOM.contexts.index("colour_object_1")))
    values = values_of(4, 5)
    for outcome, control in ((2, 1), (2, 0), (1, 2)):
        other = jax.device_get(in_the_roles_of(ROOM, one, np.int32(outcome), np.int32(control)))
        assert int(other.outcome) == outcome and other.context.sum() == one.context.sum()
        discs = [control, outcome, *({0, 1, 2} - {control, outcome}), 3]  # of which robot, object 1, ... play the roles
        turned = put(values, np.s_[:, discs], values[:, :4])
        moved = normal(5, 5, 2)

        def predicted(model, values, control, moved=moved):
            change = put(np.zeros((5, NAMES, 2), np.float32), np.s_[:, control], moved)
            return predict(model, Rows(see(ROOM, values), np.zeros((5, 2), np.float32), change))

        np.testing.assert_allclose(predicted(other, turned, control), predicted(one, values, 0), rtol=1e-3, atol=1e-5)


def remembered(n=64, seed=6):
    """Actions with the robot always moving, object 1 sometimes and object 2 seldom, only with object 1."""
    change = np.zeros((n, NAMES, 2), np.float32)
    change[:, 0] = 1.0
    change[::4, 1], change[1::8, 1], change[::8, 2] = 0.5, 0.5, 0.3
    rows = Rows(normal(seed, n, INPUTS, 2), np.ones((n, 2), np.float32), change)
    return jax.device_get(write(memory.empty(96, NAMES, INPUTS), rows, values_of(seed, n)))


def test_draws_are_even_and_half_of_a_mixture_has_moved():
    known = remembered()
    among = np.arange(96) < known.written
    dice = ((np.arange(640) + 0.5) / 640).astype(np.float32)
    assert set(np.bincount(draw(among, dice), minlength=96)) == {0, 10}
    pairs = np.stack(np.meshgrid(dice[::16], dice[::16]), axis=-1).reshape(-1, 2)
    drawn = np.asarray(mixture(known, among, np.int32(2), np.int32(1), pairs))
    moved = np.asarray(known.moved)
    assert moved[drawn, 1].all() and 0.45 < moved[drawn, 2].mean() < 0.55
    assert moved[np.asarray(mixture(known, among, np.int32(0), np.int32(ACTION), pairs)), 0].all()
    kept, held = jax.device_get(jax.jit(memory.parts)(known))
    assert not (kept & held).any() and held.sum() == 16 and (kept | held).sum() == 64


def population(*slots):
    """Slots of (outcome, control, competence, on)."""
    empty = EMPTY
    for i, (outcome, control, competence, on) in enumerate(slots):
        found = empty.models
        empty = empty.replace(
            models=found._replace(outcome=put(found.outcome, i, outcome), control=put(found.control, i, control)),
            active=put(empty.active, i, True),
            enabled=put(empty.enabled, i, on),
            competence=put(empty.competence, i, competence),
            born=put(empty.born, i, 100),
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
    found = possible(CONFIG, population(*slots), known, np.arange(96) < known.written)
    pairs = {(int(o), ACTION if c == NAMES else int(c)) for o, c in np.argwhere(found)}
    assert pairs == expected


def judged(own, slots, parent=1.0):
    none = np.full((7, 4), np.inf, np.float32)
    for (i, j), value in slots.items():
        none[i, j] = value
    return Judged(own=put(np.ones(7, np.float32), 4, own), slots=none, parent=np.full(7, parent, np.float32))


@pytest.mark.parametrize(
    ("own", "rival", "born"), [(0.5, 0.9, True), (0.5, 0.51, False), (0.75, np.inf, False), (0.5, np.inf, True)]
)
def test_what_is_competent_and_explains_more_than_others_is_born_and_the_first_birth_is_kept(own, rival, born):
    known = population((0, ACTION, 0.9, True), (2, 0, 0.9, True))
    found = known.models
    known = known.replace(
        models=found._replace(outcome=put(found.outcome, 4, 1), control=put(found.control, 4, 0)),
        active=put(known.active, 4, True),
        age=put(known.age, 4, CONFIG.trial - 1),
    )
    told = judged(own, {(4, 1): rival})
    after, births = jax.device_get(succeed(CONFIG, known, told, NO_BIRTHS, now=np.int32(250)))
    assert bool(after.active[2]) == born and int(births[1, 0]) == (250 if born else NOBODY)
    assert not after.active[4]
    young = known.replace(age=put(known.age, 4, 0))
    after, _ = jax.device_get(succeed(CONFIG, young, told, births, now=np.int32(250)))
    assert not after.active[2] and after.active[4]


@pytest.mark.parametrize(
    ("own", "parent", "inputs", "better"),
    [(0.4, 0.5, 1, True), (0.48, 0.5, 1, False), (0.505, 0.5, 0, True), (0.6, 0.5, 0, False)],
)
def test_a_changed_copy_takes_the_place_of_its_parent_if_it_is_better_or_simpler(own, parent, inputs, better):
    known = population((1, ACTION, 0.5, True))
    context = put(put(known.models.context, np.s_[0, :1], inputs == 0), np.s_[4, 1 : 1 + inputs], True)
    known = known.replace(
        models=known.models._replace(context=context, outcome=put(known.models.outcome, 4, 1)),
        active=put(known.active, 4, True),
        age=put(known.age, 4, CONFIG.trial),
        parent=put(known.parent, 4, 0),
    )
    after, _ = jax.device_get(succeed(CONFIG, known, judged(own, {}, parent), NO_BIRTHS, now=np.int32(250)))
    np.testing.assert_array_equal(after.models.context[0], context[4 if better else 0])
    assert int(after.born[0]) == 100 and after.active.sum() == 1


def test_a_slot_of_no_use_is_switched_off_after_a_while_and_on_again():
    known, told = population((1, ACTION, 0.1, True)), judged(1.0, {})
    for count in range(1, CONFIG.patience + 1):
        known = switch(CONFIG, known, told)
        assert bool(known.enabled[0]) == (count < CONFIG.patience)
    known = known.replace(competence=put(known.competence, 0, 0.8))
    for count in range(1, CONFIG.patience + 1):
        known = switch(CONFIG, known, told.replace(own=put(told.own, 0, 0.2)))
        assert bool(known.enabled[0]) == (count == CONFIG.patience)


def test_what_is_imagined_follows_from_one_model_to_the_next_and_the_largest_change_counts():
    chain = [(0, ACTION), (1, 0), (2, 1), (2, 0)]
    known = population(*((outcome, control, 0.9, True) for outcome, control in chain))
    contexts = np.array([[name == "object_1_from_robot" for name in ROOM.contexts]] * 7)
    known = known.replace(models=known.models._replace(context=contexts))
    values, actions = values_of(8, 1)[0], np.array([[0.5, -0.2], [1.0, 0.3]], np.float32)
    path = imagine(ROOM, known, values, actions, slots=4)
    now = np.array(values)
    for t in range(2):
        seen = np.asarray(see(ROOM, now))
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
    known = known.replace(models=known.models._replace(context=put(known.models.context, (1, at), True)))
    values = np.zeros((8, NAMES, 2), np.float32)
    values[:, 0], values[:, 1] = [300.0, 300.0], [300.0, 340.0]
    values[4:, 0] = [340.0, 340.0]  # right of the object, from where it goes left
    change = np.zeros((8, NAMES, 2), np.float32)
    change[:4, :2], change[4:, :2] = [0.0, 0.8], [-0.8, 0.0]
    rows = Rows(np.zeros((8, INPUTS, 2), np.float32), np.zeros((8, 2), np.float32), change)
    past = write(memory.empty(8, NAMES, INPUTS), rows, values)
    now = put(values[0], [0, 1], [[200.0, 200.0], [400.0, 200.0]])

    def first(now):
        aim = Aim(np.int32(1), now[1] - np.array([25.0, 0.0], np.float32))
        return jax.device_get(levels(ROOM, known, past, now, aim, slots=4, key=random.key(0)))

    found = first(now)
    assert found.used.tolist() == [True, False, False] and int(found.control[0]) == 0
    np.testing.assert_allclose(found.goal[0], [440.0, 200.0], atol=1e-3)
    there = first(put(now, 0, [438.0, 203.0]))
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
