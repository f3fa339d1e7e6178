import dataclasses

import numpy as np
import pytest

from envs import worlds
from envs.options import EnvError
from envs.worlds import draw
from tests.envs.worlds.test_world import ADDING

PEN, THROW = worlds.make("pen"), worlds.make("throw")


def shown(world, task):
    """(trace, length, goal) of a demonstration."""
    goal = np.asarray(world.benchmark(task))[3]
    sequence, length = world.demonstrate(task, goal)
    return world.trace(sequence, length), int(length), goal


def near(picture, colour):
    """Number of pixels of about this colour (#rrggbb)."""
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return int((np.abs(picture.astype(int) - wanted) < 12).all(axis=-1).sum())


@pytest.mark.parametrize("world, task", [(PEN, "line"), (THROW, "thrown"), (ADDING, "sum")], ids=lambda x: str(x)[:9])
def test_a_picture_shows_the_goal_only_if_there_is_one(world, task):
    trace, _, goal = shown(world, task)
    with_goal, without = (draw.still(world, trace, task=task, goal=goal), draw.still(world, trace))
    assert with_goal.shape == without.shape and with_goal.dtype == np.uint8 and with_goal.shape[0] == 340
    assert near(with_goal, draw.GOAL) > 20 and near(without, draw.GOAL) == 0


def test_a_film_ends_with_what_came_of_it_and_moves():
    trace, length, goal = shown(PEN, "joystick_1")
    frames = list(draw.film(PEN, trace, length=length, every=30, task="joystick_1", goal=goal, height=120))
    assert len(frames) == 3 and (frames[0] != frames[1]).any()
    np.testing.assert_array_equal(frames[-1], draw.still(PEN, trace, step=59, task=3, goal=goal, height=120))


def test_a_world_without_a_sketch_is_shown_by_its_outcomes():
    trace, length, _ = shown(ADDING, "sum")
    picture = draw.still(ADDING, trace)
    assert near(picture, draw.TIP) > 20
    assert len(list(draw.film(ADDING, trace, length=length, every=1))) == 3


def test_a_batch_or_an_unknown_task_is_refused_in_one_line():
    batch = ADDING.trace(np.zeros((2, 3, 2)), 1)
    with pytest.raises(EnvError, match=r"a trace of \[2\] executions; allowed: one"):
        draw.still(ADDING, batch)
    with pytest.raises(EnvError, match='task "smu" is not one of adding'):
        draw.still(dataclasses.replace(ADDING), ADDING.trace(np.zeros((3, 2)), 1), task="smu")
