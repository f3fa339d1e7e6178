import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import envs
from envs import gym, registration, render
from envs.maze import MazeEnv

PAGE = Path(__file__).parents[2] / "docs" / "gymnasium.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
POINT, ANT = "star/PointMaze-v0", "star/AntMaze-v0"
SHORT = {POINT: {"episode_length": 4}, ANT: {"episode_length": 4, "engine": "native"}}
SPARSE = {"goals": "test", "success_radius": 15.9, "reward": "sparse"}
B = 3


def make(name=POINT, **options):
    return gymnasium.make(name, **(SHORT[name] | options)).unwrapped


def make_vec(name=POINT, **options):
    return gymnasium.make_vec(name, num_envs=B, **(SHORT[name] | options))


def act(env, seed=0):
    env.action_space.seed(seed)
    return env.action_space.sample()


def episode(env, seed):
    """All that an environment tells during one episode."""
    told, over = [env.reset(seed=seed)], False
    for i in range(4):
        told.append(env.step(act(env, i if seed is None else 4 * seed + i)))
        over = np.any(told[-1][2:4])
    assert over
    return told


def same(a, b):
    """Whether two trees of dictionaries and tuples are equal, to the bit and in type."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list) or (isinstance(a, np.ndarray) and a.dtype == object):
        return len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and np.asarray(a).dtype == np.asarray(b).dtype and np.array_equal(a, b)


def kind(tree):
    """A tree with the type and shape of each leaf in place of its values."""
    if isinstance(tree, dict):
        return {key: kind(value) for key, value in tree.items()}
    if isinstance(tree, tuple) or (isinstance(tree, np.ndarray) and tree.dtype == object):
        return [kind(value) for value in tree]
    return type(tree) if tree is None else (type(tree), np.asarray(tree).dtype, np.shape(tree))


@pytest.fixture
def painted(monkeypatch):
    """Calls of `render.frame`, which then draws nothing."""
    calls = []

    def frame(env, data, *, width, height, camera="follow", marks=render.NOTHING):
        calls.append((env, data, camera))
        assert len(marks.goal) == len(env.goal_indices)
        return np.zeros((height, width, 3), np.uint8)

    monkeypatch.setattr(render, "frame", frame)
    return calls


def test_every_task_is_registered_under_its_title():
    assert registration.gym_id("ant_2rooms") == "star/Ant2Rooms-v0"
    assert registration.gym_id("point_maze") == POINT
    ours = {name for name, spec in gymnasium.registry.items() if spec.namespace == "star"}
    assert ours == {registration.gym_id(task) for task in envs.names()}


@pytest.mark.parametrize("task", envs.names())
def test_every_task_can_be_made_and_has_the_spaces_of_its_row(task):
    env = gymnasium.make(registration.gym_id(task)).unwrapped
    assert env.maze.name == task
    goal = (len(env.maze.goal_indices),)
    shapes = {name: space.shape for name, space in env.observation_space.items()}
    assert shapes == {"observation": (env.maze.state_dim,), "achieved_goal": goal, "desired_goal": goal}
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (env.maze.action_size,))


def test_registering_imports_neither_jax_nor_mujoco():
    code = (
        "import sys, gymnasium, envs.registration;"
        f"assert gymnasium.spec('{ANT}').kwargs == {{'task': 'ant_maze'}};"
        "heavy = {'jax', 'brax', 'mujoco', 'envs.gym'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_id_may_name_the_module_that_registers_it():
    assert gymnasium.make(f"envs.registration:{POINT}").unwrapped.maze.name == "point_maze"


@pytest.mark.parametrize("name", [POINT, ANT])
def test_gymnasiums_own_checker_passes_without_a_warning(name, painted):
    check_env(make(name))
    assert painted


@pytest.mark.parametrize("name", [POINT, ANT])
def test_the_same_seed_gives_the_same_episodes(name):
    first, second = make(name), make(name)
    assert same(episode(first, 7), episode(second, 7))
    assert same(first.reset(), second.reset())
    assert not same(first.reset(), first.reset())
    assert not same(episode(first, 7), episode(first, 8))


def test_an_observation_is_the_state_and_both_goals():
    env = make(**SPARSE)
    obs, info = env.reset(seed=0)
    assert obs in env.observation_space
    for seed in range(3):
        before, action = obs["observation"], act(env, seed)
        obs, *_ = env.step(action)
        velocity = 0.7 * before[2:] + 0.3 * 4 * action
        np.testing.assert_allclose(obs["observation"], [*(before[:2] + 0.1 * velocity), *velocity], rtol=1e-5)
        np.testing.assert_array_equal(obs["achieved_goal"], obs["observation"][:2])
        np.testing.assert_array_equal(obs["desired_goal"], [0, 16])


def test_info_tells_distance_and_success():
    env = make(**SPARSE)
    obs, info = env.reset(seed=0)
    distances, successes = [info["distance"]], [info["is_success"]]
    for _ in range(4):
        obs, *_, info = env.step(np.array([0, 1]))
        distances.append(info["distance"])
        successes.append(info["is_success"])
        assert info["distance"] == pytest.approx(np.linalg.norm(obs["observation"][:2] - [0, 16]))
    assert np.diff(distances).max() < 0
    assert successes == [distance < SPARSE["success_radius"] for distance in distances]
    assert set(successes) == {False, True}


@pytest.mark.parametrize(("name", "options"), [(POINT, {}), (POINT, SPARSE), (ANT, {})], ids=["point", "sparse", "ant"])
def test_a_reward_is_to_the_bit_what_compute_reward_makes_of_the_goals(name, options):
    env = make(name, **options)
    found, pairs = [], []
    for seed in range(20):
        for obs, reward, *_ in episode(env, seed)[1:]:
            assert type(reward) is float
            assert env.compute_reward(obs["achieved_goal"], obs["desired_goal"], {}) == reward
            found.append(reward)
            pairs.append((obs["achieved_goal"], obs["desired_goal"]))
    achieved, desired = np.moveaxis(np.array(pairs), 1, 0)
    batch = env.compute_reward(achieved, desired, [{}] * len(found))
    assert isinstance(batch, np.ndarray)
    np.testing.assert_array_equal(batch, found)
    np.testing.assert_array_equal(env.compute_reward(achieved[None], desired[None], None), [found])
    distance = np.linalg.norm(achieved - desired, axis=1)
    np.testing.assert_allclose(found, distance < env.maze.success_radius if options else -distance, rtol=1e-5)
    assert len(set(found)) > 1


def test_the_time_limit_truncates():
    flags = [step[2:4] for step in episode(make(), 0)[1:]]
    assert flags == [(False, False)] * 3 + [(False, True)]


def test_a_fault_of_the_simulator_truncates_and_is_told():
    env, vector = make(), make_vec()
    start, info = env.reset(seed=0)
    assert not info["fault"]
    obs, _, terminated, truncated, info = env.step(np.full(2, np.nan))
    assert (terminated, truncated, info["fault"]) == (False, True, True)
    assert same(obs, start)
    vector.reset(seed=0)
    actions = np.zeros((B, 2))
    actions[1] = np.nan
    _, _, terminated, truncated, infos = vector.step(actions)
    assert not terminated.any()
    np.testing.assert_array_equal(truncated, [False, True, False])
    np.testing.assert_array_equal(infos["final_info"]["fault"], truncated)
    assert not infos["fault"].any()


def test_an_end_that_is_no_truncation_terminates():
    env = make()
    env.reset(seed=0)
    state, record = env._program.step(env._state, np.zeros((1, 2), np.float32))
    ended = np.array(record)
    ended[:, -3:] = [1, 0, 0]
    env._program = env._program._replace(step=lambda *_: (state, ended))
    assert env.step(np.zeros(2))[2:4] == (True, False)


@pytest.mark.parametrize("make", [make, make_vec])
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"goal": "test"}, ["goal", "goals"]),
        ({"episode_length": 0}, ["episode_length", "0", "from 1 to"]),
        ({"engine": "wrap"}, ["wrap", "allowed"]),
    ],
)
def test_a_wrong_option_is_told_in_one_line(make, options, words):
    with pytest.raises(envs.EnvError) as caught:
        make(**options)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


def test_what_cannot_be_done_is_told():
    env, vector = make(), make_vec()
    for one in (env, vector):
        with pytest.raises(ResetNeeded):
            one.step(act(one))
        one.reset(seed=0)
        with pytest.raises(ValueError, match=re.escape("(1,)")):
            one.step(np.zeros(1))
    with pytest.raises(envs.EnvError, match="ansi"):
        gym.GymEnv("point_maze", render_mode="ansi")
    with pytest.raises(envs.EnvError, match="num_envs"):
        gym.GymVectorEnv("point_maze", 0)
    for mask in ([True] * B, np.ones(B), np.ones(B + 1, bool), np.zeros(B, bool)):
        with pytest.raises(ValueError, match="reset_mask"):
            vector.reset(options={"reset_mask": mask})


@pytest.mark.parametrize(
    ("make", "allowed"), [pytest.param(make, "none", id="one"), pytest.param(make_vec, "reset_mask", id="batch")]
)
def test_an_option_that_reset_does_not_know_is_told_in_one_line_and_nothing_is_reset(make, allowed):
    env, other = make(), make()
    assert same(env.reset(seed=0, options={}), other.reset(seed=0, options=None))
    with pytest.raises(ValueError, match=f"^reset has no option 'goal'; allowed: {allowed}$"):
        env.reset(seed=1, options={"goal": [0, 16]})
    assert same(env.step(act(env)), other.step(act(other)))
    assert same(env.reset(), other.reset())


def test_a_batch_refuses_what_comes_with_a_mask_and_one_environment_the_mask():
    mask = {"reset_mask": np.ones(B, bool)}
    with pytest.raises(ValueError, match="'start'"):
        make_vec().reset(options=mask | {"start": 0})
    with pytest.raises(ValueError, match="'reset_mask'"):
        make().reset(options=mask)


def test_environments_of_one_kind_are_compiled_once(monkeypatch):
    traced = []
    plain = MazeEnv.step
    monkeypatch.setattr(MazeEnv, "step", lambda *args: traced.append(1) or plain(*args))
    for _ in range(3):
        env = make(episode_length=9)
        env.reset(seed=0)
        env.step(act(env))
    assert len(traced) == 1
    assert make(episode_length=8).maze.episode_length == 8


def test_a_map_that_changed_is_read_again(tmp_path):
    path = tmp_path / "map.txt"
    seen = []
    for rows in ("1111\n1r01\n1111", "11111\n1r001\n11111"):
        path.write_text(rows)
        seen.append(make(map=str(path)).maze.arena.rows)
    assert seen[0] != seen[1]


def test_a_batch_speaks_like_gymnasiums_own_vector_environment():
    ours = make_vec()
    sync = make_vec(vectorization_mode="sync", vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP})
    assert ours.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert ours.observation_space == sync.observation_space
    assert ours.single_action_space == sync.single_action_space
    assert ours.action_space == sync.action_space
    steps = episode(ours, 0)
    for own, their in zip(steps, episode(sync, 0), strict=True):
        assert kind(own) == kind(their)
        assert own[0] in ours.observation_space
    assert kind(steps[-1]) != kind(steps[-2])
    mask = {"reset_mask": np.array([True, False, True])}
    assert kind(ours.reset(options=mask)) == kind(sync.reset(options=mask))


def test_one_pair_of_goals_is_rewarded_like_many():
    env = make()
    achieved, desired = np.random.default_rng(0).uniform(-20, 20, (2, 20_000, 2)).astype(np.float32)
    together = env.compute_reward(achieved, desired, {})
    assert [env.compute_reward(*pair, {}) for pair in zip(achieved, desired, strict=True)] == together.tolist()


@pytest.mark.parametrize("name", [POINT, ANT])
def test_the_rewards_of_a_batch_are_to_the_bit_those_of_compute_reward(name):
    vector = make_vec(name)
    for seed in range(10):
        for obs, rewards, _, ended, infos in episode(vector, seed)[1:]:
            for i in range(B):
                reached = infos["final_obs"][i] if ended[i] else {key: value[i] for key, value in obs.items()}
                assert vector.compute_reward(reached["achieved_goal"], reached["desired_goal"], {}) == rewards[i]


@pytest.mark.parametrize("name", [POINT, ANT])
def test_a_batch_with_the_same_seed_gives_the_same_episodes(name):
    first, second = make_vec(name), make_vec(name)
    assert same(episode(first, 7), episode(second, 7))
    assert same(episode(first, None), episode(second, None))
    assert not same(episode(first, 7), episode(first, 8))


@pytest.mark.parametrize("kind", [list, tuple, np.array])
def test_a_list_of_seeds_gives_each_environment_the_episodes_of_its_seed_alone(kind):
    batch, one = make_vec(), make()
    seeds, last = range(4, 4 + B), np.arange(B) == B - 1
    first, _ = batch.reset(seed=kind(seeds))
    again, _ = batch.reset(options={"reset_mask": last})
    for seen, expected in ((first, one.reset(seed=3 + B)[0]), (again, one.reset()[0])):
        np.testing.assert_equal({key: value[-1] for key, value in seen.items()}, expected)
    kept, _ = batch.reset(seed=[None] * (B - 1) + [9])
    np.testing.assert_equal({key: value[-1] for key, value in kept.items()}, one.reset(seed=9)[0])
    one.reset(seed=4)
    np.testing.assert_equal({key: value[0] for key, value in kept.items()}, one.reset()[0])
    np.testing.assert_equal(batch.reset(seed=3)[0], batch.reset(seed=3)[0])


@pytest.mark.parametrize("number", [0, 1, B + 1])
def test_seeds_of_another_number_are_refused_in_one_line(number):
    with pytest.raises(ValueError, match=rf"seed is a list of {number}; allowed: a whole number, or a list of {B}"):
        make_vec().reset(seed=[1] * number)


@pytest.mark.parametrize("built", [make, make_vec])
def test_a_seed_may_be_a_number_of_numpy(built):
    np.testing.assert_equal(built().reset(seed=np.int64(5))[0], built().reset(seed=5)[0])


def test_an_environment_that_ends_begins_anew_within_the_step():
    vector = make_vec()
    steps = episode(vector, 0)
    goals = steps[0][0]["desired_goal"]
    for obs, *_, infos in steps[1:-1]:
        assert "final_obs" not in infos
        np.testing.assert_array_equal(obs["desired_goal"], goals)
    obs, rewards, terminated, truncated, infos = steps[-1]
    assert truncated.all() and not terminated.any()
    assert (obs["desired_goal"] != goals).any(axis=1).all()
    assert np.abs(obs["achieved_goal"]).max() <= 0.1
    np.testing.assert_array_equal(np.stack([final["desired_goal"] for final in infos["final_obs"]]), goals)
    np.testing.assert_allclose(infos["final_info"]["distance"], -rewards)
    np.testing.assert_allclose(
        infos["distance"], np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"], axis=1), rtol=1e-6
    )


def test_a_mask_resets_its_environments_alone():
    vector = make_vec()
    vector.reset(seed=0)
    before, *_ = vector.step(act(vector))
    mask = np.array([True, False, True])
    after, infos = vector.reset(options={"reset_mask": mask})
    for key in before:
        np.testing.assert_array_equal(after[key][~mask], before[key][~mask])
        assert (after[key][mask] != before[key][mask]).any(axis=1).all()
    np.testing.assert_array_equal(infos["_distance"], mask)
    for _ in range(3):
        *_, truncated, infos = vector.step(act(vector))
    np.testing.assert_array_equal(truncated, ~mask)
    np.testing.assert_array_equal(infos["_final_obs"], ~mask)
    assert [final is not None for final in infos["final_obs"]] == [False, True, False]


def test_gymnasiums_statistics_count_our_episodes():
    vector = RecordEpisodeStatistics(make_vec())
    *_, (*_, infos) = steps = episode(vector, 0)
    np.testing.assert_array_equal(infos["episode"]["l"], [4] * B)
    returns = sum(rewards for _, rewards, *_ in steps[1:])
    np.testing.assert_allclose(infos["episode"]["r"], returns)


def test_a_picture_shows_the_environment_as_it_is_now(painted):
    env = make(render_mode="rgb_array", width=8, height=6, camera="top")
    obs, _ = env.reset(seed=0)
    for _ in range(2):
        assert env.render().shape == (6, 8, 3)
        maze, data, camera = painted[-1]
        assert (maze, camera) == (env.maze, "top")
        np.testing.assert_array_equal(data.position, obs["achieved_goal"])
        obs, *_ = env.step(np.ones(2))
    vector = make_vec(render_mode="rgb_array", width=8, height=6)
    obs, _ = vector.reset(seed=0)
    assert np.shape(vector.render()) == (B, 6, 8, 3)
    np.testing.assert_array_equal([data.position for _, data, _ in painted[-B:]], obs["achieved_goal"])


def test_a_picture_is_really_drawn():
    env = make(ANT, render_mode="rgb_array", width=64, height=48)
    env.reset(seed=0)
    try:
        pixels = env.render()
    except envs.EnvError as error:
        pytest.skip(str(error))
    assert pixels.shape == (48, 64, 3) and pixels.std() > 0


@pytest.mark.parametrize("make", [make, make_vec])
def test_without_a_render_mode_there_is_no_picture(make):
    env = make()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


@pytest.mark.parametrize("example", [text for text in EXAMPLES if "stable_baselines3" not in text])
def test_every_example_of_the_page_runs(example):
    exec(compile(example, str(PAGE), "exec"), {})


def test_the_page_has_examples():
    assert len(EXAMPLES) >= 3
