"""The mazes of OGBench and Gymnasium-Robotics: where episodes begin and end, how bodies move, and what is refused."""

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy import stats

import envs
from envs.tasks import TASKS
from tests.made import jitted, made
from tests.scripts import load

N = 3000
GIANT = {1: ((1, 1), (10, 14)), 2: ((1, 14), (10, 1)), 3: ((8, 14), (1, 1)), 4: ((8, 3), (5, 12)), 5: ((5, 9), (3, 8))}
LENGTHS = {"medium": [40, 40, 24, 40, 32], "large": [60, 76, 48, 56, 60], "giant": [120, 104, 120, 104, 68]}  # m
U_CELLS = [(0, 0), (1, 0), (2, 0), (2, 1), (0, 2), (1, 2), (2, 2)]  # free cells of the U-maze, (column, row)


def episodes(env, n=N):
    """Starts and goals [n, 2] of fresh episodes."""
    obs = np.asarray(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), n)).obs)
    return obs[:, :2], obs[:, env.state_dim :]


def middle(cell):
    """Place (x, y) of a cell (row, column) of OGBench, in m."""
    return np.array([4.0 * (cell[1] - 1), 4.0 * (cell[0] - 1)])


def check_uniform(offsets, noise):
    """Chi-square over eight parts of each side of a square of side 2 `noise`."""
    assert (np.abs(offsets) <= noise + 1e-4).all()
    for along in offsets.T:
        parts = np.clip(((along + noise) / (2 * noise) * 8).astype(int), 0, 7)
        assert stats.chisquare(np.bincount(parts, minlength=8)).pvalue > 1e-4


def test_an_episode_has_one_of_the_five_tasks_all_alike_with_noise_on_start_and_goal():
    starts, goals = episodes(made("pointmaze-giant"))
    begin, end = (np.array([middle(pair[i]) for pair in GIANT.values()]) for i in (0, 1))
    fits = (np.abs(starts[:, None] - begin).max(-1) <= 1.001) & (np.abs(goals[:, None] - end).max(-1) <= 1.001)
    assert (fits.sum(axis=1) == 1).all()
    task = fits.argmax(axis=1)
    assert stats.chisquare(np.bincount(task, minlength=5)).pvalue > 1e-4
    check_uniform(starts - begin[task], 1.0)
    check_uniform(goals - end[task], 1.0)
    assert abs(np.corrcoef((starts - begin[task])[:, 0], (goals - end[task])[:, 0])[0, 1]) < 0.08


def test_a_task_by_its_number_has_its_own_start_unless_starts_are_anywhere():
    starts, goals = episodes(made("antmaze-giant", goals="task4"), 100)
    assert np.abs(starts - middle(GIANT[4][0])).max() <= 1.001 and np.abs(goals - middle(GIANT[4][1])).max() <= 1.001
    starts, goals = episodes(made("pointmaze-giant", goals="task4", start="free"), 300)
    assert np.abs(goals - middle(GIANT[4][1])).max() <= 1.001 and np.ptp(starts, axis=0).min() > 30


@pytest.mark.parametrize("name", LENGTHS)
def test_the_ways_of_the_tasks_are_as_long_as_those_of_ogbench(name):
    from envs.routes import routes

    arena = TASKS[f"antmaze-{name}"].arena
    found = []
    for n in range(1, 6):
        pair = TASKS[f"antmaze-{name}"].pairs[f"task{n}"]
        both = (np.array(pair.lower) + np.array(pair.upper)).reshape(2, 2) / 2
        start, goal = map(arena.cell_at, both)
        way = [tuple(both[0]), *routes(arena, start, [goal])[goal]]
        found.append(sum(abs(a - b) for leg in zip(way, way[1:], strict=False) for a, b in zip(*leg, strict=True)))
    assert found == LENGTHS[name]


def test_start_and_goal_of_gymnasium_robotics_are_in_two_different_cells_all_alike():
    starts, goals = episodes(made("PointMaze_UMaze"))
    centres = np.array([(x, y - 2) for x, y in U_CELLS])  # the first start is in the last row
    begin, end = (np.linalg.norm(points[:, None] - centres, axis=-1).argmin(axis=1) for points in (starts, goals))
    counts = np.bincount(7 * begin + end, minlength=49).reshape(7, 7)
    assert (np.diag(counts) == 0).all()
    assert stats.chisquare(counts[~np.eye(7, dtype=bool)]).pvalue > 1e-4
    check_uniform(starts - centres[begin], 0.25)
    check_uniform(goals - centres[end], 0.25)


@pytest.mark.parametrize(
    ("name", "facts"),
    [
        ("antmaze-giant", (4.0, 2.0, 0.5, 1000, 0.1, 29, "terminate")),
        ("pointmaze-medium", (4.0, 2.0, 1.0, 1000, 0.1, 4, "terminate")),
        ("AntMaze_UMaze", (4.0, 2.0, 0.45, 700, 0.05, 29, "ignore")),
        ("PointMaze_Large", (1.0, 0.4, 0.45, 800, 0.01, 4, "ignore")),
    ],
)
def test_facts_of_the_rows(name, facts):
    env, options = made(name), TASKS[name].options()
    assert (env.arena.cell, env.arena.wall_height, env.success_radius, env.episode_length) == facts[:4]
    assert (round(env.dt, 9), env.state_dim, options["at_goal"].default) == facts[4:]
    assert options["reward"].default == "sparse"
    model = env.model
    assert {2 * model.geom_size[i, 2] for i in range(model.ngeom) if model.geom(i).name.startswith("wall")} == {
        min(facts[1], facts[0] / 2)
    }


def at(env, state, *, goal):
    """`state` with a goal that far along x from where the body is."""
    return jitted(env.with_goal)(state, np.asarray(state.obs[:2]) + np.array([goal, 0.0], np.float32))


@pytest.mark.parametrize(
    ("at_goal", "flags"), [("ignore", (0, 0)), ("terminate", (1, 0)), ("truncate", (1, 1)), ("new_goal", (0, 0))]
)
def test_success_does_to_an_episode_what_the_option_says(at_goal, flags):
    env = made("PointMaze_UMaze", at_goal=at_goal)
    state, step = jitted(env.reset)(jax.random.key(0)), jitted(env.step)
    far, near = (step(at(env, state, goal=goal), jnp.zeros(2)) for goal in (0.46, 0.44))
    assert [float(one.metrics["success"]) for one in (far, near)] == [0.0, 1.0]
    assert (float(far.done), float(near.done), float(near.info["truncation"])) == (0.0, *flags)
    after = step(near, jnp.ones(2))
    assert (float(after.done), float(after.info["truncation"])) == flags
    assert bool((after.obs == near.obs).all()) == bool(flags[0])
    changed = np.abs(after.obs[4:] - near.obs[4:]).max() > 1e-3
    assert changed == (at_goal == "new_goal")
    assert float(after.metrics["success"]) == (at_goal != "new_goal")


def test_the_point_of_gymnasium_robotics_moves_as_a_pushed_ball_in_mujoco():
    ball = mujoco.MjModel.from_xml_string("""
        <mujoco><option timestep=".01" gravity="0 0 0" integrator="Euler"/><worldbody><body>
          <joint name="x" type="slide" axis="1 0 0" damping="1"/><joint name="y" type="slide" axis="0 1 0" damping="1"/>
          <geom size=".1" density="1000"/></body></worldbody>
        <actuator><motor joint="x" gear="100"/><motor joint="y" gear="100"/></actuator></mujoco>""")
    data, body = mujoco.MjData(ball), made("PointMaze_Large").body
    state, step = body.init(jax.random.key(0), jnp.zeros(2)), jitted(body.step)
    for action in np.random.default_rng(0).uniform(-1, 1, (12, 2)):
        data.ctrl = action
        data.qvel = np.clip(data.qvel, -5, 5)
        mujoco.mj_step(ball, data)
        state = step(state, jnp.asarray(action, jnp.float32))
        np.testing.assert_allclose(state.position, data.qpos, atol=1e-6)
        np.testing.assert_allclose(state.velocity, data.qvel, atol=1e-5)


def test_the_speed_of_that_point_is_limited_before_it_is_pushed():
    body = made("PointMaze_Large").body
    state = body.init(jax.random.key(0), jnp.zeros(2)).replace(velocity=jnp.array([9.0, 0.0]))
    assert float(jitted(body.step)(state, jnp.zeros(2)).velocity[0]) == pytest.approx(5.0 * 4.18879 / 4.19879, rel=1e-4)


def test_the_point_of_ogbench_moves_by_a_fifth_of_its_action():
    body = made("pointmaze-giant").body
    state, step = body.init(jax.random.key(0), jnp.zeros(2)), jitted(body.step)
    for action in ([1.0, -0.5], [-1.0, 1.0]):
        after = step(state, jnp.array(action))
        np.testing.assert_allclose(after.position - state.position, 0.2 * np.array(action), atol=1e-6)
        state = after


@pytest.mark.parametrize("name", ["pointmaze-giant", "PointMaze_Large"])
def test_a_thousand_points_thrown_about_neither_pass_a_wall_nor_leave(name):
    env = made(name, start="free", position_noise=0.05)
    keys = jax.random.split(jax.random.key(0), 1000)
    radius, cell = TASKS[name].motion.radius, env.arena.cell

    @jax.jit
    def run(keys):
        state = jax.vmap(env.reset)(keys)
        data = state.pipeline_state.data
        thrown = data.replace(velocity=data.velocity + 12 * jax.random.normal(jax.random.key(2), (1000, 2)))

        def step(state, key):
            state = jax.vmap(env.step)(state, jax.random.uniform(key, (1000, 2), minval=-1) > 0)
            return state, state.obs[:, :2]

        state = state.replace(pipeline_state=state.pipeline_state.replace(data=thrown))
        return jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 60))[1]

    x, y = np.moveaxis(np.asarray(run(keys)), -1, 0)
    assert np.ptp(x) > 2 * cell
    x_lo, y_lo, x_hi, y_hi = env.arena.bounds
    assert ((x > x_lo) & (x < x_hi) & (y > y_lo) & (y < y_hi)).all()
    edge = radius - 1e-4
    for x_lo, y_lo, x_hi, y_hi in env.arena.walls():
        assert not ((x > x_lo - edge) & (x < x_hi + edge) & (y > y_lo - edge) & (y < y_hi + edge)).any()


def test_env_steps_are_those_that_ogbench_itself_made_and_margins_matter():
    """Recorded by scripts/checks/against_ogbench.py: 200 of them, 50 against a wall."""
    script = load("checks/against_ogbench")
    with np.load(script.STATES) as file:
        states = dict(file)
    wall = states["at_wall"]
    assert (len(wall), wall.sum(), states["qpos"].shape) == (200, 50, (200, 15))
    ours = script.steps(states)
    gaps = np.abs(ours["after"] - states["after"]).max(axis=1)
    assert gaps.max() < script.TOLERANCE
    assert (ours["success"] == states["success"]).all() and 50 < states["success"].sum() < 150
    assert (ours["terminated"] == states["terminated"]).all()
    for margin, noticed in (({"margin": 0.01}, ~wall), ({"wall_margin": 0.0}, wall)):
        body = envs.make("antmaze-giant", engine="native", preset="published", **margin).body
        starts = (np.float32(states[name]) for name in ("qpos", "qvel"))
        steps = jax.jit(
            jax.vmap(lambda qpos, qvel, action, body=body: body.step(body.physics.init(qpos, qvel), action))
        )
        after = steps(*starts, np.asarray(states["action"][:, script.LEGS])).qpos
        assert (np.abs(np.asarray(after) - states["after"]).max(axis=1)[noticed] > 1e-3).mean() > 0.2


def test_cells_of_another_size_scale_pairs_and_their_noise():
    half = TASKS["antmaze-giant"].resized(2.0)
    assert half.pairs["task4"].lower == ((3.5, 13.5, 21.5, 7.5),)
    assert half.pairs["task4"].upper == ((4.5, 14.5, 22.5, 8.5),)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (
            "antmaze-giant",
            {"goals": "task6"},
            "option \"goals\" of antmaze-giant is 'task6'; allowed: train, test, tasks, task1, task2, task3, task4, "
            "task5, free",
        ),
        ("antmaze-arena", {"goals": "task2"}, "option \"goals\" of antmaze-arena is 'task2'; allowed: train, test, "
            "tasks, task1, free"),
        ("pointmaze-large", {"at_goal": "stop"}, "option \"at_goal\" of pointmaze-large is 'stop'; allowed: ignore, "
            "terminate, truncate, new_goal"),
        ("antmaze-large", {"wall_margin": 1}, 'option "wall_margin" of antmaze-large is 1; allowed: a number from 0 to '
            "0.1 m"),
    ],
)  # fmt: skip
def test_what_a_task_does_not_have_is_refused_in_one_line(name, options, message):
    with pytest.raises(envs.EnvError) as caught:
        envs.make(name, **options)
    assert str(caught.value) == message


@pytest.mark.parametrize("name", ["pointmaze-medium", "PointMaze_UMaze"])
def test_gymnasiums_own_checker_passes(name):
    env = gymnasium.make(f"star/{name}-v0", episode_length=4).unwrapped
    check_env(env, skip_render_check=True)


def test_a_gymnasium_episode_ends_at_the_goal():
    env = gymnasium.make("star/pointmaze-medium-v0", episode_length=4, success_radius=100.0)
    env.reset(seed=0)
    _, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert (reward, terminated, truncated, info["is_success"]) == (1.0, True, False, True)
