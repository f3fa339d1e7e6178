"""Make a file of a trained agent that comes with the package: `star render --agent NAME`, `star.load("NAME")`.

    python scripts/results/ship.py RUN NAME [--checkpoint last]

It holds the config and one checkpoint, of the run's first seed, with what greedy episodes need of it. It is evaluated
on the CPU, beside the same agent with all that it had learnt, and refused if it acts otherwise in any of 200 episodes.
Writes results/agents/NAME.zip, at most 2 MB.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax

import star
from envs.common import files
from star.agent.sections import AgentConfig
from star.agent.slim import slim
from star.agent.state import TrainState
from star.config.agents import FOLDER
from star.config.loading import load_run, load_to_act
from star.training import program as programs
from star.training import run_folder
from star.training.checkpoint import Checkpoints, load_state

LARGEST = 2_000_000  # bytes


def main() -> None:
    """Write the file and print where it is, how large, and what its agent can do."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("name")
    parser.add_argument("--checkpoint", default="last")
    options = parser.parse_args()

    jax.config.update("jax_platforms", "cpu")  # physics is not reproducible on every engine of a GPU
    out = FOLDER / f"{options.name}.zip"
    with tempfile.TemporaryDirectory() as folder:
        alone = Path(folder) / options.name
        found = []
        for kept, where in ((lambda config, state: state, Path(folder) / "whole"), (slim, alone)):
            write(options.run, options.checkpoint, where, kept)
            evaluated = star.evaluate(where, {"trainer.eval_episodes": 200, "env.engine": "auto"})
            found.append([evaluated[name] for name in ("success_final", "success_any", "distance", "path_length")])
        if found[0] != found[1]:
            parser.error(f"{options.run}: acts otherwise once it is made small")
        packed = Path(shutil.make_archive(str(Path(folder) / "packed"), "zip", alone))
        if packed.stat().st_size > LARGEST:
            parser.error(f"{options.run}: takes {packed.stat().st_size:,} bytes, more than {LARGEST:,}")
        out.parent.mkdir(parents=True, exist_ok=True)
        with files.whole(out) as partial:
            shutil.copyfile(packed, partial)
    print(f"{out}: {out.stat().st_size:,} bytes, success_final {found[0][0]:.3f} of 200 episodes")


def write(run_dir: Path, wanted: str, alone: Path, kept: Callable[[AgentConfig, TrainState], TrainState]) -> None:
    """The first agent in a checkpoint of `run_dir` as a run of its own, with what is `kept` of its state."""
    program = programs.build(load_to_act(run_dir, {}))
    env_steps, states = load_state(program, run_dir, wanted)
    values = load_run(run_dir, {}).model_dump(mode="json")
    values["trainer"] |= {"seed": program.seeds[0], "num_seeds": 1, "devices": 1, "sinks": []}
    config = type(program.config).model_validate(values)
    alone.mkdir()
    run_folder.note(alone, config)
    checkpoints = Checkpoints(alone)
    checkpoints.save(env_steps, kept(program.hyper, jax.tree.map(lambda leaf: leaf[:1], states)), config, score=None)
    checkpoints.close()


if __name__ == "__main__":
    main()
