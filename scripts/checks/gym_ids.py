"""Gymnasium's own checker on every id of ours, and Stable-Baselines3 on one of them.

    python scripts/checks/gym_ids.py [--steps 4000] [TASK ...]

Each environment is made with episodes of four env steps, an ant by MuJoCo in C. Pictures are not checked. Then SAC with
hindsight (`pip install '.[sb3]'`) learns `star/pointmaze-arena-v0` for `--steps` env steps, with small cells and with
starts and goals anywhere. A line tells the success of its actions and of random ones over the same 30 episodes.
`--steps 0` leaves it out.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env

from envs.registration import gym_id
from envs.tasks import TASKS

LEARNT = "star/pointmaze-arena-v0"
EASIER: dict[str, Any] = {
    "cell": 1.5,
    "goals": "free",
    "start": "free",
    "success_radius": 1.0,
    "episode_length": 50,
}  # than OGBench's, to be learnt soon
SAC: dict[str, Any] = {
    "policy_kwargs": {"net_arch": [32, 32]},
    "learning_rate": 3e-3,
    "learning_starts": 200,
    "batch_size": 64,
    "gamma": 0.9,
    "tau": 0.05,
    "train_freq": 2,
}  # as in docs/gymnasium.md
EPISODES = 30


def check(name: str) -> str | None:
    """The complaint of Gymnasium's checker about the task `name`, None if it has none."""
    engine = {"engine": "native"} if TASKS[name].body == "ant" else {}
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # as Gymnasium's are
        try:
            env = gymnasium.make(gym_id(name), episode_length=4, **engine)
            check_env(env.unwrapped, skip_render_check=True)
            gymnasium.make(gym_id(name), episode_length=4, **engine).reset(seed=0)
        except Exception as error:  # whatever the checker raises is what is asked for
            return f"{type(error).__name__}: {error}"
    return None


def success(env: gymnasium.Env[Any, Any], act: Callable[[Any], np.ndarray]) -> float:
    """Share of `EPISODES` episodes that reach their goal at any env step, actions being `act(obs)`."""
    reached = []
    for seed in range(EPISODES):
        obs, _ = env.reset(seed=seed)
        over = found = False
        while not over:
            obs, _, terminated, truncated, info = env.step(act(obs))
            over, found = terminated or truncated, found or info["is_success"]
        reached.append(found)
    return float(np.mean(reached))


def learn(steps: int) -> dict[str, Any]:
    """Success of random actions and of an agent of Stable-Baselines3 after `steps` env steps."""
    import torch
    from stable_baselines3 import SAC as Agent
    from stable_baselines3 import HerReplayBuffer

    torch.set_num_threads(1)
    began = time.monotonic()
    env = gymnasium.make(LEARNT, **EASIER)
    env.action_space.seed(0)
    random = success(env, lambda obs: env.action_space.sample())
    agent = Agent("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, seed=0, **SAC)
    agent.learn(steps)
    learnt = success(env, lambda obs: agent.predict(obs, deterministic=True)[0])
    seconds = round(time.monotonic() - began, 1)
    return {"id": LEARNT, **EASIER, "steps": steps, "seed": 0, "random": random, "learnt": learnt, "seconds": seconds}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=list(TASKS))
    parser.add_argument("--steps", type=int, default=4000)
    options = parser.parse_args()
    faults = {name: said for name in options.tasks if (said := check(name))}
    print(json.dumps({"checked": len(options.tasks), "faults": faults}), flush=True)
    if options.steps:
        print(json.dumps(learn(options.steps)))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
