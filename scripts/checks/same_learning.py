"""Do two checkouts learn the same? Every layer of configs/, bit for bit, on a tiny task.

    python scripts/checks/same_learning.py OLD NEW [--only hiro,gara] [--jobs 2] [--keep DIR]
    python scripts/checks/same_learning.py OLD NEW --plant

For each layer (a file that is laid over a task with `--with`) OLD trains for five epochs. NEW trains for four, and then
goes on from OLD's checkpoint after two. All leaves of the state after four epochs have to be equal bit for bit, fresh
and resumed, and the metrics within 1e-6 of one another.

If they are not, both have to start alike, and NEW trains one epoch from each of OLD's checkpoints after 0, 2 and 4
epochs: whole numbers have to be equal, the others within 1e-5 of the largest of their leaf. Such a row is `close`, and
wants a reason in the commit. A layer that OLD does not have is `new`, and not compared. If a command fails the row
says `fails`, and the others go on.

Both checkouts run in the same Python on the same machine: rounding depends on the processor. They are compiled in
haste unless XLA_FLAGS says how. `--keep` keeps the runs of OLD and what was compiled, for the next comparison with the
same OLD. With `--plant` OLD is compared with itself, once with two random keys swapped and once with one weight
changed, and both have to be found.

Exit code: 0 if no row differs or fails (with --plant: if both plants were found), 1 if not.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp
from rich.console import Console
from rich.progress import track
from rich.table import Table

from scripts.processes import importing

FOLDERS = ("agents", "ablations", "sgim")  # of configs/, whose files are layers
EPOCHS, FRESH, FROM = 5, 4, 2  # that OLD trains; after which both are compared; after which NEW goes on
METRICS = 1e-6  # how far metrics may be apart
ROUNDING = 1e-5  # how far numbers of a `close` row may be apart, over the largest of their leaf
UPCOMING = "upcoming/"  # begins the names of what comes with the next epoch
CLOCKS = ("wall_s", "env_steps_per_s")  # metrics that tell of the machine
HASTY = "--xla_backend_optimization_level=0"
COMMAND = "import sys; from star.cli import main; sys.exit(main())"

# Plants: what runs before the command, to spoil it.
SWAPPED_KEYS = """
import jax
split = jax.random.split
def spoilt(key, num=2):  # a new state and an epoch begin with five keys
    keys = split(key, num)
    return keys[jax.numpy.array([1, 0, 2, 3, 4])] if num == 5 else keys
jax.random.split = spoilt
"""
CHANGED_WEIGHT = """
import jax, orbax.checkpoint as ocp
restore = ocp.Checkpointer.restore
def spoilt(self, *args, **kwargs):
    done = []
    def change(path, leaf):
        if done or not jax.tree_util.keystr(path, simple=True, separator="/").endswith("kernel"):
            return leaf
        done.append(True)
        return leaf.ravel().at[0].add(1e-3).reshape(leaf.shape)
    return jax.tree_util.tree_map_with_path(change, restore(self, *args, **kwargs))
ocp.Checkpointer.restore = spoilt
"""

SMALL: dict[str, Any] = {
    "commander.period": 20,
    "tutor.unroll": 3,
    "tutor.ppo.hidden": [8],
    "tutor.ppo.passes": 2,
    "tutor.ppo.minibatches": 2,
    "controller.ppo.hidden": [8],
    "controller.ppo.passes": 2,
    "controller.ppo.minibatches": 2,
    "abstraction.max_regions": 48,
    "forward_model.hidden": [8],
    "forward_model.buffer_size": 64,
    "forward_model.batch_size": 8,
    "forward_model.updates_per_epoch": 4,
    "refinement.min_transitions": 1,
    "refinement.min_visits": 1,
    "refinement.depth": 5,
    "refinement.pairs_per_epoch": 16,
    "refinement.error_tolerance": 0.9,
    "refinement.reach_share": 0.2,
    "abstraction.min_width": 0.01,
    "trainer.num_envs": 8,
    "trainer.eval_every": 1,
    "trainer.eval_episodes": 4,
    "trainer.checkpoint_every": 1,
    "trainer.keep_checkpoints": 9,
    "trainer.on_non_finite": "rollback",  # which keeps a checkpoint of the start
}
SMALL_TD3: dict[str, Any] = {
    f"{level}.td3.{key}": value
    for level in ("tutor", "controller")
    for key, value in {
        "hidden": [8], "batch_size": 16, "buffer_size": 512, "min_transitions": 16, "updates_per_rollout": 2
    }.items()
}  # fmt: skip
EPISODE = 60  # env steps
POINT: dict[str, Any] = SMALL | {"env.options.episode_length": EPISODE}
ANT: dict[str, Any] = POINT | {"env.engine": "native", "tutor.unroll": 3}
ADJACENCY: dict[str, Any] = {
    f"tutor.adjacency.{key}": value
    for key, value in {"hidden": [8], "features": 4, "batch_size": 16, "updates_per_epoch": 4}.items()
}
IMITATION: dict[str, Any] = {"sgim.imitation_batch": 16}


class Row(NamedTuple):
    """The task on which a layer is compared: a config, what makes it small, and layers below the one of the row."""

    config: str = "point_maze"
    settings: Mapping[str, Any] = POINT
    below: tuple[str, ...] = ()


CRL: dict[str, Any] = POINT | {
    "tutor.period": 30, "tutor.unroll": 1, "commander.period": 30,
    "controller.crl.hidden": [8], "controller.crl.batch_size": 16, "controller.crl.buffer_size": 480,
    "controller.crl.min_transitions": 16, "controller.crl.updates_per_rollout": 2,
}  # fmt: skip
CHRONOSRL: dict[str, Any] = POINT | {
    "tutor.period": 30, "tutor.unroll": 1, "commander.period": 30,
    "controller.chronosrl.width": 8, "controller.chronosrl.blocks": 1, "controller.chronosrl.batch_size": 16,
    "controller.chronosrl.buffer_size": 480, "controller.chronosrl.min_transitions": 16,
    "controller.chronosrl.updates_per_rollout": 2,
}  # fmt: skip

ROWS: dict[str, Row] = {
    "agents/chronosrl": Row(settings=CHRONOSRL),
    "agents/crl": Row(settings=CRL),
    "agents/flat": Row(),
    "agents/flat_td3": Row(settings=POINT | SMALL_TD3),
    "agents/frugal": Row(settings={key: value for key, value in POINT.items() if key != "tutor.unroll"}),
    "agents/gara": Row("ant_maze_cpu", ANT),
    "agents/hiro": Row(),
    "agents/hrac": Row(settings=POINT | SMALL_TD3 | ADJACENCY),
    "ablations/grid": Row(),
    "ablations/no_heading": Row("ant_maze_cam", ANT),
    "ablations/no_mask": Row(),
    "ablations/no_passages": Row(),
    "ablations/no_refinement": Row(),
    "ablations/no_straight": Row(),
    "ablations/one_box": Row(),
    "ablations/one_box_goals": Row(),
    "ablations/one_box_goals_unrefined": Row(),
    "ablations/one_box_unrefined": Row(),
    "ablations/published": Row("ant_maze_cpu", ANT | SMALL_TD3 | {"refinement.parts": 8}),
    "ablations/q_learning": Row(),
    "ablations/random_cuts": Row(),
    "ablations/reached_regions": Row(),
    "ablations/td3": Row(settings=POINT | SMALL_TD3),
    "ablations/td3_tutor": Row(settings=POINT | SMALL_TD3),
    "ablations/td3_uncorrected": Row(settings=POINT | SMALL_TD3),
    "ablations/world_frame": Row("ant_maze_cpu", ANT),
    "ablations/wrong_boxes": Row(),
    "sgim/all": Row(),
    "sgim/exploration": Row(),
    "sgim/goals": Row(),
    "sgim/guide": Row(),
    "sgim/poor": Row(),
    "sgim/refinement": Row(),
    "sgim/sgim_acts": Row(settings=POINT | IMITATION),
    "sgim/sgim_d": Row(settings=POINT | IMITATION),
    "sgim/sgim_pb": Row(settings=POINT | IMITATION),
    "sgim/strategies": Row(),
}


VERDICTS = ("same", "close", "differs", "fails", "new")


class Place(NamedTuple):
    """The folder of runs, and one in which those of OLD and compiled programs may stay."""

    folder: Path
    kept: Path


class Found(NamedTuple):
    """The result of a comparison: one of `VERDICTS`, the first difference, and the number of OLD's cuts."""

    verdict: str
    detail: str = ""
    splits: int = 0


def main() -> int:
    """Compare, print a table, return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, metavar="OLD", help="checkout to compare with")
    parser.add_argument("new", type=Path, metavar="NEW", help="checkout that is compared")
    parser.add_argument("--only", help="rows whose name holds one of these words, separated by commas")
    parser.add_argument("--jobs", type=int, default=2, help="rows compared at a time (default: 2)")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="where the runs of OLD stay, to be used again")
    parser.add_argument("--plant", action="store_true", help="show that a swapped key and a changed weight are found")
    options = parser.parse_args()
    for checkout in (options.old, options.new):
        if not (checkout / "star").is_dir():
            parser.error(f"{checkout}: is not a checkout, it holds no star/")
    with tempfile.TemporaryDirectory() as folder:
        place = Place(Path(folder), (options.keep or Path(folder) / "kept").resolve())
        if options.plant:
            return planted(options.old.resolve(), place)
        chosen = [name for name in ROWS if not options.only or any(word in name for word in options.only.split(","))]
        return compared(options.old.resolve(), options.new.resolve(), chosen, place, jobs=options.jobs)


def compared(old: Path, new: Path, names: list[str], place: Place, *, jobs: int) -> int:
    """Compare the rows `names` and print what was found."""
    table = Table("layer", "verdict", "cuts", "first difference")
    with ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(tried, old, new, name, place) for name in names]
        console = Console(stderr=True)
        found = [future.result() for future in track(futures, "comparing", console=console, transient=True)]
    for name, each in zip(names, found, strict=True):
        table.add_row(name, each.verdict, str(each.splits), each.detail)
    Console(width=160).print(table)
    count = {verdict: sum(each.verdict == verdict for each in found) for verdict in VERDICTS}
    print(", ".join(f"{number} {verdict}" for verdict, number in count.items()))
    return int(count["differs"] + count["fails"] > 0)


def tried(old: Path, new: Path, name: str, place: Place) -> Found:
    """`compare`, for layers that OLD may not have and commands that may fail."""
    if not (old / "configs" / f"{name}.yaml").exists():
        return Found("new")
    try:
        return compare(old, new, name, place)
    except RuntimeError as error:
        return Found("fails", str(error))


def planted(old: Path, place: Place) -> int:
    """Compare OLD with itself after each plant; returns 0 if all were found and nothing else was."""
    wrong = 0
    for plant, spoilt in {"nothing": "", "two keys swapped": SWAPPED_KEYS, "a weight changed": CHANGED_WEIGHT}.items():
        spot = place._replace(folder=place.folder / plant.replace(" ", "_"))
        found = compare(old, old, "agents/hiro", spot, spoilt=spoilt)
        print(f"planted {plant}: {found.verdict} {found.detail}")
        wrong += found.verdict != ("differs" if spoilt else "same")
    return int(wrong > 0)


def compare(old: Path, new: Path, name: str, place: Place, *, spoilt: str = "") -> Found:
    """Train both checkouts on the row `name`; the code `spoilt` runs before the commands of NEW."""
    row, folder = ROWS[name], place.folder / name
    folder.mkdir(parents=True)
    run = Commands(row, place)
    make_demonstrations(folder / "demos.npz")
    layers = [word for layer in (*row.below, name) for word in ("--with", old / "configs" / f"{layer}.yaml")]
    begin = ["train", old / "configs" / f"{row.config}.yaml", *layers, "--run-dir"]
    theirs, fresh, resumed = place.kept / name, folder / "new", folder / "resumed"
    if not (theirs / "checkpoints" / str(run.steps(EPOCHS))).exists():
        shutil.rmtree(theirs, ignore_errors=True)
        run(old, folder, *begin, theirs, epochs=EPOCHS)
    run(new, folder, *begin, fresh, epochs=FRESH, spoilt=spoilt)
    run.go_on(new, theirs, resumed, after=FROM, to=FRESH, spoilt=spoilt)
    end = run.steps(FRESH)
    wrong = [
        f"{path.name}: {difference}"
        for path in (fresh, resumed)
        for difference in (*bits(leaves(theirs, end), leaves(path, end)), *metrics(theirs, path, end))
    ]
    splits = int(sum(line.get("refinement/splits", 0) for line in lines(theirs)))
    if not wrong:
        return Found("same", splits=splits)
    far = [f"{fresh.name}, at the start: {each}" for each in rounding(leaves(theirs, 0), leaves(fresh, 0))]
    for after in (0, 2, 4):
        path, end = folder / f"from_{after}", run.steps(after + 1)
        run.go_on(new, theirs, path, after=after, to=after + 1, spoilt=spoilt)
        far += [f"{path.name}: {each}" for each in rounding(leaves(theirs, end), leaves(path, end))]
    return Found("differs" if far else "close", (far or wrong)[0], splits)


class Commands(NamedTuple):
    """The command `star` of any checkout, on the task of a row."""

    row: Row
    place: Place

    def __call__(self, checkout: Path, folder: Path, *words: Any, epochs: int, spoilt: str = "") -> None:
        """Run the command in `folder`, after the code `spoilt`, until so many epochs are over.

        Raises:
          RuntimeError: with its last words, if it fails.
        """
        resumes = "--resume" in words
        settings = {} if resumes else dict(self.row.settings)
        arguments = [str(word) for word in words]
        for key, value in (settings | {"trainer.total_env_steps": self.steps(epochs)}).items():
            arguments += [f"--{key}", value if isinstance(value, str) else json.dumps(value)]
        here = importing(checkout) | {
            "JAX_PLATFORMS": "cpu",
            "MUJOCO_GL": "disable",
            "XLA_FLAGS": os.environ.get("XLA_FLAGS", HASTY),
            "JAX_COMPILATION_CACHE_DIR": str(self.place.kept / "cache"),
        }
        command = [sys.executable, "-c", spoilt + COMMAND, *arguments, "--quiet"]
        done = subprocess.run(command, cwd=folder, env=os.environ | here, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{checkout}: star {' '.join(arguments)}: {done.stderr.strip()[-2000:]}")

    def go_on(self, checkout: Path, run: Path, copy: Path, *, after: int, to: int, spoilt: str = "") -> None:
        """Let a checkout train the `copy` of a `run` from its checkpoint after some epochs up to others."""
        shutil.copytree(run, copy)
        for checkpoint in (copy / "checkpoints").iterdir():
            if int(checkpoint.name) > self.steps(after):
                shutil.rmtree(checkpoint)
        self(checkout, copy.parent, "train", "--resume", copy, epochs=to, spoilt=spoilt)

    def steps(self, epochs: int) -> int:
        """Env steps of so many epochs."""
        return epochs * EPISODE * self.row.settings["trainer.num_envs"]


def leaves(run: Path, env_steps: int) -> dict[str, np.ndarray]:
    """All leaves of the state in a checkpoint, by their names, as the next epoch begins with them."""
    path = (run / "checkpoints" / str(env_steps) / "state").absolute()
    here = jax.sharding.SingleDeviceSharding(jax.devices("cpu")[0])
    with ocp.Checkpointer(ocp.StandardCheckpointHandler()) as reader:
        shapes = reader.metadata(path).item_metadata.tree
        template = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=here), shapes)
        found = reader.restore(path, args=ocp.args.StandardRestore(template))
    named = jax.tree_util.tree_flatten_with_path(found)[0]
    kept = {jax.tree_util.keystr(place, simple=True, separator="/"): np.asarray(leaf) for place, leaf in named}
    upcoming = {name.removeprefix(UPCOMING): leaf for name, leaf in kept.items() if name.startswith(UPCOMING)}
    return {name: leaf for name, leaf in kept.items() if not name.startswith(UPCOMING)} | upcoming


def bits(old: Mapping[str, np.ndarray], new: Mapping[str, np.ndarray]) -> list[str]:
    """Differences between two states, leaf by leaf, if only in a bit."""
    return [
        f"{name} {_apart(old.get(name), new.get(name))}"
        for name in sorted(old | new)
        if name not in old or name not in new or not _equal(old[name], new[name])
    ]


def rounding(old: Mapping[str, np.ndarray], new: Mapping[str, np.ndarray]) -> list[str]:
    """Differences between two states by more than rounding."""
    wrong = []
    for name in sorted(old | new):
        if name not in old or name not in new or old[name].shape != new[name].shape:
            wrong.append(f"{name} is not in both, or of another shape")
            continue
        a, b = old[name], new[name]
        if np.issubdtype(a.dtype, np.floating):
            finite = np.isfinite(a)
            largest = np.abs(a[finite]).max(initial=1e-30)
            same = np.array_equal(a[~finite], b[~finite], equal_nan=True)
            fine = same and (np.abs(a[finite] - b[finite]) <= ROUNDING * largest).all()
        else:
            fine = np.array_equal(a, b)
        if not fine:
            wrong.append(f"{name} {_apart(a, b)}")
    return wrong


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    return (a.shape, a.dtype) == (b.shape, b.dtype) and a.tobytes() == b.tobytes()


def _apart(a: np.ndarray | None, b: np.ndarray | None) -> str:
    if a is None or b is None or a.shape != b.shape:
        return "is not in both, or of another shape"
    return f"by up to {np.nanmax(np.abs(a.astype(float) - b.astype(float)), initial=0.0):.3g}"


def metrics(old: Path, new: Path, end: int) -> list[str]:
    """Differences between the metrics of two runs up to so many env steps."""
    wrong = []
    theirs, ours = ([line for line in lines(run) if line["env_steps"] <= end] for run in (old, new))
    if len(theirs) != len(ours):
        wrong.append(f"metrics of {len(theirs)} and {len(ours)} epochs")
    for a, b in zip(theirs, ours, strict=False):
        for key in sorted((a | b).keys() - set(CLOCKS)):
            x, y = a.get(key), b.get(key)
            if x is None or y is None or not np.isclose(x, y, rtol=METRICS, atol=METRICS, equal_nan=True):
                wrong.append(f"{key} is {x} and {y} after {a['env_steps']} env steps")
    return wrong


def lines(run: Path) -> list[dict[str, Any]]:
    """The metrics of a run."""
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]


def make_demonstrations(path: Path) -> None:
    """Write four random demonstrations in the Point Maze: nobody has to learn from them, only to be shown them."""
    rng = np.random.default_rng(0)
    count, waypoints, moments = 4, 3, 13
    route = rng.uniform(-1, 1, (count, waypoints, 2)).astype(np.float32)
    np.savez_compressed(
        path,
        format=1,
        env="point_maze",
        starts=np.zeros((count, 2), np.float32),
        outcomes=route[:, -1],
        waypoints=route,
        lengths=np.full(count, moments - 1),
        states=rng.uniform(-1, 1, (count, moments, 4)).astype(np.float32),
        actions=rng.uniform(-1, 1, (count, moments, 2)).astype(np.float32),
    )


if __name__ == "__main__":
    sys.exit(main())
