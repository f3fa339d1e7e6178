import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "docs" / "gymnasium.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
EPISODES = 40


@pytest.fixture(scope="module")
def trained():
    """What the page's example leaves behind: an environment and a model trained with hindsight.

    PyTorch takes seconds to import, which only the process that runs these tests needs.
    """
    pytest.importorskip("stable_baselines3")
    import torch

    torch.set_num_threads(1)
    (example,) = (text for text in EXAMPLES if "stable_baselines3" in text)
    names: dict = {}
    exec(compile(example, str(PAGE), "exec"), names)
    return SimpleNamespace(**names)


def success(env, act):
    """Share of episodes at whose end the goal is reached, actions being `act(obs)`."""
    (obs, _), reached = env.reset(seed=1), []
    while len(reached) < EPISODES:
        obs, _, _, ended, info = env.step(act(obs))
        if ended:
            reached.append(info["is_success"])
            obs, _ = env.reset()
    return np.mean(reached)


def test_hindsight_learns_to_reach_goals(trained):
    assert trained.model.num_timesteps == 2000
    trained.env.action_space.seed(0)
    assert success(trained.env, lambda obs: trained.env.action_space.sample()) < 0.4
    assert success(trained.env, lambda obs: trained.model.predict(obs, deterministic=True)[0]) > 0.7


def test_relabelled_rewards_are_those_of_compute_reward(trained):
    np.random.seed(0)
    batch = trained.model.replay_buffer.sample(1000)
    goals, reached = batch.observations["desired_goal"].numpy(), batch.next_observations["achieved_goal"].numpy()
    rewards = trained.env.unwrapped.compute_reward(reached, goals, {})
    np.testing.assert_array_equal(batch.rewards.numpy()[:, 0], rewards)
    assert set(np.unique(rewards)) == {0.0, 1.0}
    asked = trained.model.replay_buffer.observations["desired_goal"].reshape(-1, 2)
    relabelled = ~(goals[:, None] == asked[: trained.model.num_timesteps]).all(axis=-1).any(axis=1)
    assert relabelled.mean() == pytest.approx(0.8)


def test_the_checker_of_stable_baselines_passes(trained):
    from stable_baselines3.common import env_checker

    env_checker.check_env(trained.env.unwrapped)
