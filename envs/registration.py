"""Puts every task into Gymnasium's registry: `ant_maze` is `star/AntMaze-v0`.

    import gymnasium
    import envs

    env = gymnasium.make("star/AntMaze-v0", goals="test")

or, in one, `gymnasium.make("envs:star/AntMaze-v0")`. Needs Gymnasium, but neither JAX nor MuJoCo: these are imported
when the first environment is made.
"""

from __future__ import annotations

import gymnasium

from envs.tasks import names


def gym_id(task: str) -> str:
    """Gymnasium's id of a task: `ant_2rooms` is `star/Ant2Rooms-v0`; names with `-` or capitals stay as they are."""
    kept = "-" in task or not task.islower()
    return f"star/{task if kept else task.title().replace('_', '')}-v0"


def register() -> None:
    """Register every task that is not yet registered. The time limit is the task's own, `episode_length`."""
    for task in names():
        if gym_id(task) not in gymnasium.registry:
            gymnasium.register(
                gym_id(task),
                entry_point="envs.gym:GymEnv",
                vector_entry_point="envs.gym:GymVectorEnv",
                kwargs={"task": task},
            )


register()
