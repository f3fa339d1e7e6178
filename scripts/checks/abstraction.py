"""Is the abstraction of a trained agent true? Roll out what reachability analysis has judged.

    python scripts/checks/abstraction.py RUN [--checkpoint last] [--episodes 512] [--start free] [--out FILE.json]

Agents start anywhere in the free cells and are commanded random targets, so that every decision of k env steps is a
rollout of a random pair (region, target). That is done three times: among the pairs judged REACHES, among those judged
MISSES, and among all; who is in a region without such a pair is sent anywhere. For each seed:

    reaches     of the first rollouts, of pairs judged REACHES, the share that ended in the target; `pairs` counts them
    misses      of the second ones, of pairs judged MISSES, the share that did not
    base        of the third ones, between different regions, the share that ended in the target
    error       root mean square error of the forward model on these, in units of the state, and `still`, that of the
                guess that the agent stays where it is
    walls       share of the faces between regions that lie within 1 m of the plane of a wall, and `chance`, the share
                of all positions in the space that do
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.vector import VectorEnv
from star.abstraction import forward_model
from star.abstraction.reachability import MISSES, REACHES
from star.agent import environment, levels, play
from star.agent.decisions import Decision, Roadmap, Successors
from star.agent.sections import AgentConfig
from star.agent.state import TrainState
from star.config.loading import load_run
from star.spec import Spec
from star.training import program as programs
from star.training.checkpoint import load_state

NEAR_WALL = 1.0  # m


def rollouts(
    config: AgentConfig, spec: Spec, env: VectorEnv, state: TrainState, pairs: jax.Array, key: jax.Array
) -> Any:
    """(decisions, outcomes) of all periods of one episode under random commands; leading axes [segments, B].

    Commands are drawn from `pairs` [R, R]; from a region that has none there, from all regions.
    """
    section = config.commander.model_copy(update={"epsilon_start": 1.0, "epsilon_end": 1.0, "epsilon_spread": False})
    agent = levels.of(config.model_copy(update={"commander": section}), spec, greedy=True)
    active = state.abstraction.active[:, None] & state.abstraction.active[None, :]
    chosen = jnp.where(pairs.any(axis=1, keepdims=True), pairs, active)
    roadmap = Roadmap.of(section, state.abstraction, state.graph)
    near = roadmap.allowed.near
    roadmap = roadmap.replace(allowed=Successors(near, greedy=near.pairs(active), explore=near.pairs(chosen)))
    never = jnp.zeros(())

    def segment(streams: play.Streams, key: jax.Array) -> tuple[play.Streams, Any]:
        command_key, tutor_key, rollout_key, reset_key = jax.random.split(key, 4)
        keys = (command_key, tutor_key, rollout_key)
        streams, passed, marks = play.segment(agent, env, state, roadmap, streams, env_steps=never, keys=keys)
        memory, finished = agent.commander.experience(section, agent.task, roadmap, streams.memory, passed, marks)
        streams = streams.replace(memory=memory)
        return play.restart_ended(agent, env, streams, passed, key=reset_key), finished

    start_key, scan_key = jax.random.split(key)
    streams = play.start(agent, env, key=start_key)
    keys = jax.random.split(scan_key, spec.episode_length // config.tutor.period)
    return jax.lax.scan(segment, streams, keys)[1]


def judge(
    config: AgentConfig, spec: Spec, state: TrainState, finished: dict[str, Any], walls: np.ndarray
) -> dict[str, Any]:
    """The figures of one seed. `finished` are the rollouts of "reaches", of "misses" and of "all" pairs."""
    verdicts = np.asarray(state.graph.verdict)

    def share(name: str, verdict: int | None, arrives: bool) -> dict[str, Any]:
        decision, _ = finished[name]
        counted = _complete(decision)
        if verdict is not None:
            counted &= verdicts[decision.region, decision.target] == verdict
        right = (decision.next_region == decision.target)[counted] == arrives
        pairs = {*zip(decision.region[counted], decision.target[counted], strict=True)}
        return {"share": float(right.mean()) if right.size else None, "rollouts": right.size, "pairs": len(pairs)}

    decision, outcome = finished["all"]
    counted = _complete(decision)
    error = np.asarray(forward_model.errors(config.forward_model, state.forward_model, outcome))
    still = np.square(outcome.start - outcome.end).sum(-1)
    return {
        "regions": int(state.abstraction.count),
        "reaches": share("reaches", REACHES, True),
        "misses": share("misses", MISSES, False),
        "base": share("all", None, True),
        "error": {"model": _root_mean(error, counted), "still": _root_mean(still, counted)},
        "walls": near_walls(state, walls, np.asarray(spec.space)),
    }


def near_walls(state: TrainState, walls: np.ndarray, space: np.ndarray) -> dict[str, Any]:
    """Faces of regions inside the space, in x and y, and how many of them lie near the plane of a wall."""
    count = int(state.abstraction.count)
    faces, hits, chances = 0, 0, []
    for axis in (0, 1):
        planes = np.unique(walls[:, [axis, axis + 2]])
        planes = planes[(planes > space[0, axis]) & (planes < space[1, axis])]
        upper = np.asarray(state.abstraction.upper[:count, axis])
        inner = upper[upper < space[1, axis] - 1e-4]
        distance = lambda x, planes=planes: np.abs(x[:, None] - planes).min(axis=1, initial=np.inf)  # noqa: E731
        faces, hits = faces + len(inner), hits + int((distance(inner) <= NEAR_WALL).sum())
        chances.append(float((distance(np.linspace(space[0, axis], space[1, axis], 1001)) <= NEAR_WALL).mean()))
    return {"share": hits / faces if faces else None, "faces": faces, "chance": float(np.mean(chances))}


def _complete(decision: Decision) -> np.ndarray:
    """Mask of the decisions that lasted k env steps and aimed at another region, not at the goal in it."""
    return (decision.weight > 0) & (decision.region != decision.target) & ~decision.at_goal


def _flat(x: jax.Array) -> np.ndarray:
    """The segments [T, B, ...] of all environments one after another."""
    return np.asarray(x).reshape(-1, *x.shape[2:])


def _root_mean(squares: np.ndarray, mask: np.ndarray) -> float | None:
    return float(np.sqrt(squares[mask].mean())) if mask.any() else None


def main() -> None:
    """Print one line a seed and write all figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--checkpoint", default="last")
    parser.add_argument("--episodes", type=int, default=512)
    parser.add_argument("--start", default="free", choices=("task", "free"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()

    config = load_run(options.run, {"env.engine": "auto"})
    program = programs.build(config)
    step, states = load_state(program, options.run, options.checkpoint)
    agent, spec = program.config.hyper(), program.experiment.spec
    task = environment.make(program.config, "train", start=options.start)
    env = VectorEnv(task, options.episodes, auto_reset=False)
    roll = jax.jit(partial(rollouts, agent, spec, env))
    keys = program.evaluation_keys(options.seed, stream=programs.AFTERWARDS)
    rows = []
    for i, seed in enumerate(program.seeds):
        state = jax.tree.map(lambda x, i=i: x[i], states)
        graph = state.graph
        commanded = {"reaches": graph.reaches, "misses": graph.misses, "all": jnp.zeros_like(graph.reaches)}
        finished = {
            name: jax.tree.map(_flat, roll(state, pairs, jax.random.fold_in(keys[i], n)))
            for n, (name, pairs) in enumerate(commanded.items())
        }
        row = {"seed": seed} | judge(agent, spec, state, finished, program.experiment.walls)
        rows.append(row)
        print(json.dumps(row), flush=True)
    report = {"run": str(options.run), "env": config.env.name, "env_steps": step, "start": options.start, "seeds": rows}
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
