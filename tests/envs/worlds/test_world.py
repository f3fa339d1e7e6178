import dataclasses
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import install_import_hook

from envs import worlds
from envs.common import plugins
from envs.common.errors import UserError
from envs.options import EnvError
from star import debugging
from tests.scripts import load

PAGE = (Path(__file__).parents[3] / "docs" / "worlds.md").read_text(encoding="utf-8")


def add(sequence, length):
    """The sums of the primitives so far, and the second task only if they are positive."""
    active = (jnp.arange(3) < length)[:, None]
    path = jnp.cumsum(jnp.where(active, sequence, 0.0), axis=0)
    return worlds.outcomes((path[-1], True), (path[-1, :1], path[-1, 0] > 0)), path


def make(scale=1.0):
    """A world of a user's own: two numbers are added up, three times at most."""

    def show(goal):
        return jnp.tile(goal[:2] / (3 * scale), (3, 1))

    def split(goal):
        return (0, goal[:2] / 2), (0, goal[:2])

    goals = np.random.default_rng(0).uniform(-3, 3, (5, 2))
    tasks = (
        worlds.Task("sum", (-3.0,) * 2, (3.0,) * 2, goals=lambda: goals, demonstrate=show, decompose=split),
        worlds.Task("first", (0.0,), (3.0,), goals=lambda: goals[:, :1]),
    )
    return worlds.World("adding", 2, 3, tasks, add)


ADDING = make()


def broken():
    raise RuntimeError("no such luck")


def nothing():
    return 3


def changed(**changes):
    return lambda: dataclasses.replace(ADDING, **changes)


def task(*bounds, name="sum"):
    return worlds.Task(name, *bounds, goals=lambda: np.zeros((1, 2)))


no_length = changed(longest=0)
no_tasks = changed(tasks=())
twins = changed(tasks=(task((0.0,), (1.0,)), task((0.0,), (1.0,))))
too_wide = changed(tasks=(task((0.0,) * 5, (1.0,) * 5),))
upside_down = changed(tasks=(task((1.0,), (0.0,)),))
other_tasks = changed(tasks=ADDING.tasks[:1])
no_path = changed(simulate=lambda sequence, length: (add(sequence, length)[0], ()))
raising = changed(simulate=lambda sequence, length: sequence @ jnp.zeros(9))


@pytest.fixture(autouse=True)
def here(monkeypatch):
    monkeypatch.setitem(sys.modules, "adding", sys.modules[__name__])
    monkeypatch.setenv(plugins.TRUSTED, "adding")


def test_a_world_is_found_by_its_name_or_that_of_its_function():
    assert worlds.names() == ("pen", "throw", "fishing", "table")
    assert [worlds.make(name).name for name in worlds.names()] == list(worlds.names())
    assert worlds.make("adding:make", scale=2.0).longest == 3


@pytest.mark.parametrize(
    "name, options, said",
    [
        (
            "pne",
            {},
            "world 'pne' is unknown; allowed: pen, throw, fishing, table; did you mean \"pen\"?, or module:",
        ),
        ("pen", {"nose": 1}, 'option "nose" (1) is not one of pen: allowed: noise; did you mean "noise"?'),
        ("table", {"links": 2}, 'option "links" of table is 2; allowed: a number from 0.8 to 1'),
        ("throw", {"scale": 2}, 'option "scale" (2) is not one of throw: allowed: noise'),
        ("pen", {"noise": -1}, 'option "noise" of pen is -1; allowed: a number from 0 to 1'),
        ("adding:make", {"noise": "much"}, "option \"noise\" of adding:make is 'much'; allowed: a number from 0 to 1"),
        ("adding:make", {"sale": 1}, 'option "sale" is not one of adding:make; allowed: scale; did you mean "scale"?'),
        ("adding:nothing", {}, "adding:nothing: makes 3; allowed: an envs.worlds.World"),
        ("adding:broken", {}, "adding:broken: raises RuntimeError: no such luck"),
        ("adding:PAGE", {}, "adding:PAGE: is a str; allowed: a function that makes a world"),
        ("adding:maek", {}, "adding:maek: adding holds no maek (did you mean make?)"),
        ("adding:no_length", {}, "adding:no_length: longest is 0; allowed: a whole number from 1"),
        ("adding:no_tasks", {}, "its tasks are called (); allowed: one task or more"),
        ("adding:twins", {}, "its tasks are called ('sum', 'sum'); allowed: one task or more, each with its own name"),
        ("adding:too_wide", {}, "bounds of sum have the shapes ((5,), (5,)); allowed: 1 to 4 numbers each"),
        ("adding:upside_down", {}, "bounds of sum are (1.0,) and (0.0,); allowed: lower below upper"),
        ("adding:other_tasks", {}, "simulate gives no outcomes of 1 tasks; allowed: (envs.worlds.outcomes(...), path)"),
        ("adding:no_path", {}, "a path has leading axes []; allowed: one, the same number of control steps for each"),
        ("adding:raising", {}, "adding:raising: simulate raises TypeError: dot_general requires"),
        ("logging:basicConfig", {}, "only a file names it, so it is not imported; type --import logging"),
    ],
)
def test_what_cannot_be_had_is_said_in_one_line(name, options, said):
    with pytest.raises(UserError) as caught:
        worlds.make(name, **options)
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda w: w.execute(np.zeros((4, 2)), 1), "a sequence has the shape [4, 2]; allowed: [..., 3, 2]"),
        (lambda w: w.execute(np.zeros(3), 1), "a sequence has the shape [3]; allowed: [..., 3, 2]"),
        (lambda w: w.execute(np.zeros((5, 3, 2)), np.ones(4, int)), "length has the shape [4] of int32; allowed: [5]"),
        (lambda w: w.execute(np.zeros((3, 2)), 1.5), "length has the shape [] of float32; allowed: [] of int32"),
        (lambda w: w.demonstrate("sum", np.zeros(2)), "a goal has the shape [2]; allowed: [..., 4]"),
        (lambda w: w.decompose("smu", np.zeros(4)), 'task "smu" is not one of adding; allowed: sum, first; did you'),
        (lambda w: w.benchmark(2), 'task "2" is not one of adding; allowed: sum, first'),
        (lambda w: w.demonstrate(1, np.zeros(4)), "nobody demonstrates first in adding; allowed: sum"),
        (lambda w: dataclasses.replace(w, noise=0.1).execute(np.zeros((3, 2)), 1), "has noise 0.1, which needs a key"),
    ],
)
def test_wrong_shapes_and_tasks_are_said_in_one_line(call, said):
    with pytest.raises(EnvError) as caught:
        call(ADDING)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_outcomes_goals_and_bounds_end_with_zeros():
    found = ADDING.execute(np.full((3, 2), 0.5), 2)
    np.testing.assert_allclose(found.value, [(1, 1, 0, 0), (1, 0, 0, 0)])
    assert found.reached.tolist() == [True, True] and ADDING.dims == (2, 1)
    assert ADDING.upper.tolist() == [[3, 3, 0, 0], [3, 0, 0, 0]] and ADDING.benchmark("first").shape == (5, 4)
    missed = ADDING.execute(np.full((3, 2), -0.5), 1)
    assert missed.reached.tolist() == [True, False] and not missed.value[1].any()


def test_any_number_of_leading_axes_gives_the_same_as_one_after_the_other():
    sequences = np.random.default_rng(0).uniform(-1, 1, (2, 4, 3, 2)).astype(np.float32)
    lengths = np.arange(8).reshape(2, 4) % 3 + 1
    whole = ADDING.trace(sequences, lengths)
    mapped = jax.vmap(jax.vmap(ADDING.trace))(sequences, lengths)
    assert whole.path.shape == (2, 4, 3, 2) and whole.outcomes.value.shape == (2, 4, 2, 4)
    jax.tree.map(np.testing.assert_array_equal, whole, mapped)
    for at in np.ndindex(2, 4):
        alone = ADDING.execute(sequences[at], int(lengths[at]))
        jax.tree.map(lambda one, all, at=at: np.testing.assert_array_equal(one, all[at]), alone, whole.outcomes)
    shown, length = ADDING.demonstrate("sum", np.zeros((2, 5, 4)))
    assert shown.shape == (2, 5, 3, 2) and length.shape == (2, 5)


def test_a_decomposition_names_the_tasks_and_goals_in_their_order():
    parts = ADDING.decompose("sum", np.array([2.0, -1.0, 0, 0]))
    assert parts.tasks.tolist() == [0, 0] and parts.exists
    assert parts.goals.tolist() == [[1, -0.5, 0, 0], [2, -1, 0, 0]]
    assert not ADDING.decompose("first", np.zeros(4)).exists


def test_noise_of_the_given_size_is_added_to_every_number_and_primitives_stay_within_their_range():
    noisy = worlds.make("adding:make", noise=0.1)
    sequences = np.zeros((2000, 3, 2))
    one = noisy.execute(sequences, 1, key=jax.random.key(0)).value[:, 0, :2]
    assert np.std(one, axis=0) == pytest.approx(0.1, rel=0.1) and np.abs(np.mean(one, axis=0)).max() < 0.01
    again, other = (noisy.execute(sequences, 1, key=jax.random.key(seed)).value[:, 0, :2] for seed in (0, 1))
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()
    assert (noisy.execute(sequences + 1, 1, key=jax.random.key(0)).value[:, 0, :2] <= 1).all()
    assert ADDING.execute(sequences[0] + 7, 1).value[0, 0] == 1


def test_nothing_is_compiled_twice():
    traced = []

    def counted(sequence, length):
        traced.append(sequence)
        return add(sequence, length)

    world = dataclasses.replace(ADDING, simulate=counted)
    for length in (1, 2, 3):
        world.execute(np.full((4, 3, 2), 0.1 * length), length)
        world.execute(np.zeros((4, 3, 2), np.float64), np.full(4, length))
        world.trace(np.zeros((4, 3, 2)), length)
    assert len(traced) == 2  # of `execute` and of `trace`
    assert all(worlds.make(name, noise=0.1) == worlds.make(name, noise=0.1) for name in worlds.names())


def test_arrays_have_the_shapes_that_they_are_said_to_have():
    before = {name: sys.modules.pop(name) for name in list(sys.modules) if name.startswith("envs.worlds")}
    try:
        with install_import_hook("envs.worlds", f"{debugging.__name__}.shapes"):
            import envs.worlds as checked

            for world in map(checked.make, checked.names()):
                sequence, goal = jnp.zeros((world.longest, world.primitive)), jnp.zeros(4)
                jax.eval_shape(world.simulate, sequence, jnp.int32(1))
                for task in world.tasks:
                    jax.eval_shape(task.demonstrate, goal)
                    if task.decompose is not None:
                        jax.eval_shape(task.decompose, goal)
                with pytest.raises(TypeError):
                    jax.eval_shape(world.simulate, jnp.zeros((world.longest, 3)), jnp.zeros(1, jnp.int32))
    finally:
        for name in [name for name in sys.modules if name.startswith("envs.worlds")]:
            del sys.modules[name]
        sys.modules.update(before)
        sys.modules["envs"].worlds = before["envs.worlds"]


def test_the_benchmark_counts_executions():
    row = load("benchmarks/worlds").measure("throw", 4, repeats=2)
    assert row["executions_per_s"] > 0 and row["cpu_us"] > 0


def test_the_world_of_the_page_works_as_it_says(tmp_path, monkeypatch):
    ((name, text),) = re.findall(r'```python title="(.*?)"\n(.*?)```', PAGE, re.DOTALL)
    assert len(text.splitlines()) <= 30
    (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    names: dict = {}
    for example in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(compile(example, "worlds.md", "exec"), names)
    assert names["error"] < 0.05 and (tmp_path / "bell.gif").stat().st_size > 1000
