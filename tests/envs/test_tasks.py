"""Every row of the registry: goals, starts, options."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import stats

import envs
from envs import maze
from envs.places import Places
from envs.tasks import TASKS
from tests.made import jitted, made

DRAWS = 10_000
ANT_TASKS = [name for name in envs.names() if name.startswith("ant_")]


@partial(jax.jit, static_argnums=0)
def draws_of(sets, key):
    """`DRAWS` points of each of `sets`."""
    keys = jax.random.split(key, DRAWS)
    return [jax.vmap(partial(maze.sample, places))(keys) for places in sets]


def draws(*sets):
    return map(np.asarray, draws_of(sets, jax.random.key(0)))


def slow_shares(places):
    """The probability of each box, from its volume."""
    volumes = []
    for lower, upper in zip(places.lower, places.upper, strict=True):
        sides = [high - low for low, high in zip(lower, upper, strict=True) if high > low]
        volumes.append(float(np.prod(sides)) if sides else 0.0)
    return np.array(volumes) / sum(volumes) if any(volumes) else np.full(len(volumes), 1 / len(volumes))


def test_goals_and_starts_follow_the_stated_distributions():
    """Chi-square over boxes, and over four parts of each side within the boxes.

    The mazes that have pairs of starts and goals are in test_field_mazes.py.
    """
    tasks = [task for task in TASKS.values() if not task.pairs]
    sets = {places for task in tasks for places in (*task.goals.values(), *task.starts.values())}
    assert len(sets) > 30
    for places, drawn in zip(sets, draws(*sets), strict=True):
        lower, upper = np.array(places.lower), np.array(places.upper)
        inside = ((drawn[:, None] >= lower - 1e-4) & (drawn[:, None] <= upper + 1e-4)).all(axis=2)
        assert (inside.sum(axis=1) == 1).all(), "outside, or boxes overlap"
        box = inside.argmax(axis=1)
        if len(lower) > 1:
            counts = np.bincount(box, minlength=len(lower))
            assert stats.chisquare(counts, DRAWS * slow_shares(places)).pvalue > 1e-5
        for axis in np.flatnonzero((upper > lower).all(axis=0)):
            part = (drawn[:, axis] - lower[box, axis]) / (upper - lower)[box, axis]
            counts = np.bincount(np.clip((4 * part).astype(int), 0, 3), minlength=4)
            assert stats.chisquare(counts).pvalue > 1e-5


def test_boxes_are_chosen_by_volume():
    places = Places(lower=((0.0, 0.0), (10.0, 0.0)), upper=((1.0, 1.0), (13.0, 1.0)))
    (drawn,) = draws(places)
    assert (drawn[:, 0] > 5).mean() == pytest.approx(0.75, abs=0.02)


@pytest.mark.parametrize("name", ["ant_fall", "ant_maze_sparse", "point_maze_cam", "point_big_maze"])
def test_resets_use_the_goals_and_starts_of_the_options(name):
    env = envs.make(name, **({"engine": "native"} if name in ANT_TASKS else {}), goals="free", start="free")
    keys = jax.random.split(jax.random.key(0), 200)
    obs = np.asarray(jax.jit(jax.vmap(env.reset))(keys).obs)
    arena = env.arena
    for points in (obs[:, :2], obs[:, env.state_dim :][:, :2]):
        column, row = np.rint(points / arena.cell).astype(int).T
        symbols = {arena.rows[r + arena.origin[0]][c + arena.origin[1]] for r, c in zip(row, column, strict=True)}
        assert symbols <= set("0rg")
        assert len(np.unique(points, axis=0)) > min(len(arena.centres("0rg")), 100) / 2


@pytest.mark.parametrize("name", ["point_maze", "point_2rooms", "point_maze_sparse"])
def test_a_point_that_starts_anywhere_starts_clear_of_the_walls(name):
    env = envs.make(name, start="free", **({"cell": 1.5} if name == "point_2rooms" else {}))
    x, y = np.asarray(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 4000)).obs[:, :2]).T
    for x_lo, y_lo, x_hi, y_hi in env.arena.walls():
        assert not ((x > x_lo - 0.499) & (x < x_hi + 0.499) & (y > y_lo - 0.499) & (y < y_hi + 0.499)).any()


def test_nobody_in_the_gap_is_near_a_goal():
    for options in ({"goals": "free"}, {"goals": "test"}):
        env = envs.make("ant_fall", engine="native", **options)
        goals = np.asarray(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 500)).obs[:, -3:])
        below = np.stack([goals[:, 0], np.clip(goals[:, 1], 12.3, 19.7), np.full(500, 0.8)], axis=1)
        assert (np.linalg.norm(goals - below, axis=1) > env.success_radius).all()


def test_published_maps_goals_and_radii():
    rows = {name: TASKS[name] for name in ("ant_maze", "ant_maze_cam", "ant_fall", "ant_push", "ant_maze_sparse")}
    assert rows["ant_fall"].goals["test"].lower == ((0.0, 27.0, 4.5),)
    assert rows["ant_push"].goals["test"].lower == ((0.0, 19.0),)
    assert rows["ant_maze_sparse"].goals["test"].lower == ((2.0, 9.0),)
    assert [row.success_radius for row in rows.values()] == [5.0, 5.0, 5.0, 5.0, 1.0]
    assert [row.arena.cell for row in rows.values()] == [8.0, 8.0, 8.0, 8.0, 2.0]
    np.testing.assert_array_equal(rows["ant_fall"].arena.centres("B"), [[8.0, 8.0]])
    np.testing.assert_array_equal(rows["ant_fall"].arena.chasms(), [[-4.0, 12.0, 12.0, 20.0]])
    assert TASKS["ant_maze_sparse"].options()["reward"].default == "sparse"


def test_jaxgcrl_mazes_keep_their_first_index_as_x():
    big = TASKS["ant_big_maze"]
    test_goals = set(big.goals["test"].lower)
    # rows of the published map that hold goals for evaluation, (row, column) - (1, 1) times 4 m
    cells = [(1, 5), (1, 6), (2, 5), (2, 6), (5, 3), (5, 6), (6, 2), (6, 3), (6, 5), (6, 6)]
    assert test_goals == {(4.0 * (r - 1), 4.0 * (c - 1)) for r, c in cells}
    assert len(TASKS["ant_hardest_maze"].goals["train"].lower) == 45
    assert (big.success_radius, big.arena.cell) == (0.5, 4.0)


def test_in_the_open_goals_lie_around_the_start_and_walls_far_off():
    task = TASKS["ant_open"]
    train, start = draws(task.goals["train"], task.starts["task"])
    np.testing.assert_allclose(np.linalg.norm(train, axis=1), 10.0, rtol=1e-5)
    angles = np.sort(np.arctan2(*train.T))
    assert np.diff(angles).max() * 10.0 < 0.5, "goals leave no gap as wide as success"
    assert 0.09 < np.abs(start).max() <= 0.1 and abs(start.mean()) < 0.01
    assert np.abs(task.arena.walls()).max(axis=1).min() > 28.0 - 1e-6 and task.success_radius == 0.5


def test_cells_of_another_size_scale_x_and_y_and_leave_heights():
    env = made("ant_fall", cell=4.0, goals="test")
    assert [corner.tolist() for corner in env.space] == [[-2.0, -2.0, 0.0], [6.0, 14.0, 8.0]]
    assert env.region_cuts == ((2.0,), (8.0,), ()) and env.subgoal_scale == (5.0, 5.0, 0.5)
    assert jax.jit(env.reset)(jax.random.key(0)).obs[-3:].tolist() == [0.0, 13.5, 4.5]
    assert (env.arena.floor_height, env.success_radius) == (4.0, 2.5)
    assert TASKS["ant_maze_stochastic"].resized(2.0).block_noise == 0.25


def test_sparse_reward_pays_success_and_only_that():
    env = made("point_maze", reward="sparse", success_radius=2.0)
    state, step = jitted(made("point_maze").reset)(jax.random.key(0)), jax.jit(env.step)
    for goal, paid in (((0.0, 1.5), 1.0), ((0.0, 2.5), 0.0)):
        after = step(state.replace(info={**state.info, "goal": jnp.array(goal)}), jnp.zeros(2))
        assert (float(after.reward), float(after.metrics["success"])) == (paid, paid)
        assert float(after.metrics["distance"]) == pytest.approx(goal[1], abs=0.2)


def test_rewards_of_arrays_are_those_of_single_goals():
    rng = np.random.default_rng(0)
    achieved, desired = rng.normal(0, 4, (5, 7, 2)), rng.normal(0, 4, (5, 7, 2))
    for options in ({}, {"reward": "sparse"}):
        env = envs.make("point_maze", **options)
        together = env.reward(achieved, desired)
        for i in np.ndindex(5, 7):
            distance = np.hypot(*(achieved[i] - desired[i]))
            assert together[i] == pytest.approx(float(distance < 5) if options else -distance)


def test_noise_on_positions_has_the_given_size_and_is_off_by_default():
    states = jax.jit(jax.vmap(made("point_maze").reset))(jax.random.split(jax.random.key(0), 500))

    def travelled(**options):
        still = states.replace(
            pipeline_state=states.pipeline_state.replace(
                data=states.pipeline_state.data.replace(velocity=jnp.zeros((500, 2)))
            )
        )
        step = jax.jit(jax.vmap(made("point_maze", **options).step))
        after = step(step(still, jnp.zeros((500, 2))), jnp.zeros((500, 2)))
        return np.asarray(after.obs[:, :2] - still.obs[:, :2])

    assert (travelled() == 0).all()
    np.testing.assert_allclose(travelled(position_noise=0.05).std(axis=0), 0.05 * np.sqrt(2), rtol=0.1)


def test_noise_moves_the_ant_too():
    env = envs.make("ant_maze", engine="native", position_noise=0.1)
    data = env.body.init(jax.random.key(0), jnp.zeros(2))
    moved = env.body.displace(data, jnp.array([1.0, -2.0]))
    np.testing.assert_allclose(moved.qpos[:2] - data.qpos[:2], [1.0, -2.0], rtol=1e-5)
    np.testing.assert_array_equal(moved.qpos[2:], data.qpos[2:])


def test_the_action_scale_multiplies_actions():
    point, slow = made("point_maze"), made("point_maze", action_scale=0.5)
    state = jitted(point.reset)(jax.random.key(0))
    half = jax.jit(slow.step)(state, jnp.ones(2)).obs
    np.testing.assert_allclose(half, jitted(point.step)(state, 0.5 * jnp.ones(2)).obs, rtol=1e-6)
    ant = envs.make("ant_maze", engine="native", action_scale=2.0).body
    np.testing.assert_array_equal(ant.physics.model.actuator_ctrlrange, np.tile([-60.0, 60.0], (8, 1)))


def test_only_torso_and_shins_collide_with_feet():
    model = envs.make("ant_maze", engine="native", collisions="feet").body.physics.model
    names = {model.geom(i).name for i in np.flatnonzero(model.geom_contype)}
    assert names == {"torso", "shin_1", "shin_2", "shin_3", "shin_4"}


ON_ITS_BACK = {3: 0.0, 4: 1.0, 5: 0.0, 6: 0.0}  # entries of qpos
IN_THE_GAP = {1: 16.0, 2: 0.75}
ABOVE = {2: 6.0}


@pytest.mark.parametrize("how", ["ignore", "terminate", "truncate"])
@pytest.mark.parametrize(
    ("option", "name", "place"),
    [("flip", "flipped", ON_ITS_BACK), ("fall", "fallen", IN_THE_GAP), ("unhealthy", "unhealthy", ABOVE)],
)
def test_a_flipped_or_fallen_ant_ends_the_episode_only_if_asked_and_stays_ended(option, name, place, how):
    env = made("ant_fall", **{option: how})
    state = jitted(made("ant_fall").reset)(jax.random.key(0))
    data = state.pipeline_state.data
    lost = data.replace(qpos=data.qpos.at[jnp.array([*place])].set(jnp.array([*place.values()])), qvel=0 * data.qvel)
    step = jax.jit(env.step)
    fine, after = (
        step(state.replace(pipeline_state=state.pipeline_state.replace(data=x)), jnp.zeros(8)) for x in (data, lost)
    )
    flags = {"ignore": (0.0, 0.0), "terminate": (1.0, 0.0), "truncate": (1.0, 1.0)}[how]
    assert (float(after.done), float(after.info["truncation"])) == flags
    assert [float(x.metrics[name]) for x in (fine, after)] == [0.0, 1.0]
    upright = after.replace(pipeline_state=after.pipeline_state.replace(data=data))
    again = step(upright, jnp.zeros(8))
    assert (float(again.done), float(again.info["truncation"])) == flags
    assert bool((again.obs == after.obs).all()) == (how != "ignore")


def test_the_preset_of_jaxgcrl_gives_its_ant_and_what_is_given_by_name_wins():
    env = made("ant_u4_maze", preset="jaxgcrl", action_scale=2.0)
    model = env.body.physics.model
    assert (env.dt, env.episode_length, env.observation_size) == (pytest.approx(0.05), 1000, 31)
    assert model.actuator_ctrlrange[0, 1] == 60.0
    touching = {
        frozenset(model.geom(i).name.split("_")[0] for i in pair)
        for pair in itertools.combinations(range(model.ngeom), 2)
        if any(model.geom_contype[a] & model.geom_conaffinity[b] for a, b in (pair, pair[::-1]))
    }
    assert touching == {*map(frozenset, ({"floor", "foot"}, {"wall", "foot"}, {"wall", "torso"}, {"wall", "hip"}))} | {
        frozenset({"foot"}), frozenset({"foot", "torso"}), frozenset({"foot", "hip"})
    }  # fmt: skip
    state = jitted(env.reset)(jax.random.key(0))
    np.testing.assert_array_equal(state.obs[:2], 0.0)
    np.testing.assert_allclose(state.obs[7:15], [0, 1, 0, -1, 0, -1, 0, 1], atol=0.1)
    assert abs(state.obs[2] - 0.55) <= 0.1


def test_links_weigh_as_much_as_in_spring_and_all_else_is_the_other_preset():
    light, heavy = (made("ant_u4_maze", preset=preset).body for preset in ("jaxgcrl", "jaxgcrl_spring"))
    model = heavy.physics.model
    np.testing.assert_array_equal(model.body_mass[1:], np.ones(9))
    np.testing.assert_array_equal(model.body_inertia[1:], np.ones((9, 3)))
    for name in ("body_ipos", "geom_size", "geom_pos", "geom_contype", "jnt_range", "actuator_gear"):
        np.testing.assert_array_equal(getattr(model, name), getattr(light.physics.model, name))


def test_limits_of_the_heavy_ant_are_springs_of_1000_newton_metres_and_its_hinges_are_damped_by_10():
    model = made("ant_u4_maze", preset="jaxgcrl_spring").body.physics.model
    np.testing.assert_array_equal(model.dof_armature, np.zeros(14))
    np.testing.assert_array_equal(model.dof_damping, [0.0] * 6 + [10.0] * 8)
    data = mujoco.MjData(model)
    data.qpos[2] = 5.0  # in the air
    beyond = np.linspace(0.05, 0.4, 8)
    data.qpos[7:15] = np.where(np.arange(8) % 3, model.jnt_range[1:, 1] + beyond, model.jnt_range[1:, 0] - beyond)
    mujoco.mj_forward(model, data)
    signs = np.where(np.arange(8) % 3, -1.0, 1.0)
    np.testing.assert_allclose(data.qfrc_constraint[6:14], 1000.0 * signs * beyond, rtol=0.05)


def test_the_heavy_ant_begins_with_no_foot_in_the_floor_and_else_as_the_other():
    """MuJoCo would throw it up."""
    starts, env = [], made("ant_u4_maze", preset="jaxgcrl_spring")
    for one in (made("ant_u4_maze", preset="jaxgcrl"), env):
        starts.append(jitted(jax.vmap(one.reset))(jax.random.split(jax.random.key(0), 64)).obs)
    light, heavy = map(np.asarray, starts)
    np.testing.assert_array_equal(np.delete(light, 2, axis=1), np.delete(heavy, 2, axis=1))
    model = env.body.physics.model
    data, depth = mujoco.MjData(model), []
    for start in (*light, *heavy):
        data.qpos[:15] = start[:15]
        mujoco.mj_kinematics(model, data)
        depth.append(min(data.geom(f"foot_{leg}").xpos[2] for leg in range(1, 5)) - 0.08)
    before, after = np.split(np.array(depth), 2)
    np.testing.assert_allclose(after, np.maximum(before, 0.0), atol=1e-6)
    assert (before < -0.05).mean() > 0.5


@pytest.mark.parametrize(("height", "over"), [(0.19, 1.0), (0.5, 0.0), (1.01, 1.0)])
def test_an_ant_that_is_too_low_or_too_high_ends_the_episode_of_jaxgcrl(height, over):
    env = made("ant_u4_maze", preset="jaxgcrl", action_scale=2.0)
    data = jitted(env.reset)(jax.random.key(0)).pipeline_state.data
    assert float(env.body.unhealthy(data.replace(qpos=data.qpos.at[2].set(height)))) == over


def test_only_the_mazes_of_jaxgcrl_have_its_preset():
    message = r'^option "preset" of ant_fall is .jaxgcrl.; allowed: fast, published$'
    with pytest.raises(envs.EnvError, match=message):
        envs.make("ant_fall", preset="jaxgcrl")


def test_dropped_contacts_end_the_episode_and_are_counted_once():
    env = made("ant_maze")
    state, step = jitted(env.reset)(jax.random.key(0)), jitted(env.step)
    full = state.replace(
        pipeline_state=state.pipeline_state.replace(
            data=state.pipeline_state.data.replace(overflow=jnp.ones(()))  # native hands it on
        )
    )
    after = step(full, jnp.zeros(8))
    assert (float(after.done), float(after.info["truncation"]), float(after.metrics["overflow"])) == (1.0, 1.0, 1.0)
    np.testing.assert_array_equal(after.obs, state.obs)
    assert float(step(after, jnp.zeros(8)).metrics["overflow"]) == 0.0


@pytest.mark.parametrize(
    ("name", "extra"),
    [("ant_fall", 4), ("ant_push", 4), ("ant_maze_stochastic", 2), ("ant_maze_cam", 1), ("ant_maze", 0)],
)
def test_the_full_observation_appends_what_is_hidden(name, extra):
    env = envs.make(name, engine="native", observe="full")
    state = jax.jit(env.reset)(jax.random.key(0))
    data = state.pipeline_state.data
    assert env.state_dim == 30 + extra
    hidden = state.obs[30 : env.state_dim]
    flag = [0.0] if name == "ant_maze_cam" else []
    np.testing.assert_array_equal(hidden, np.concatenate([data.qpos[15:], data.qvel[14:], flag]))
    plain = jitted(made(name).reset)(jax.random.key(0))
    np.testing.assert_array_equal(plain.obs[:30], state.obs[:30])


def test_the_block_of_the_stochastic_maze_starts_elsewhere_every_time():
    env = envs.make("ant_maze_stochastic", engine="native")
    keys = jax.random.split(jax.random.key(0), 2000)
    slid = np.asarray(jax.jit(jax.vmap(env.reset))(keys).pipeline_state.data.qpos)[:, 15]
    assert stats.kstest(slid, "norm").pvalue > 1e-4
