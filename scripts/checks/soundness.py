"""Does reachability analysis keep its word? Its hulls and verdicts against networks evaluated in float64.

    python scripts/checks/soundness.py RUN... [--triples 1000000] [--points 1000] [--out FILE.json]

    triples     of so many random networks, each with a box and a point in it of its own: how many images lie outside of
                the hull. Half of the networks are forward models, in a random space under a random command
    verdicts    of all ordered pairs of regions of the last checkpoint of each RUN and seed: all corners and so many
                random points of each part that the full recursion judged REACHES, through the forward model
        strict      with `refinement.reach_share` 1: how many of them do not arrive in the target region
        trained     with that of the run, which lets a share of the hull lie beside the target: how many images are
                    outside of the hull, and `arrive`, the share of points that reach the target

Exits with 1 if any image is outside, or any point under the strict verdict does not arrive. There is no tolerance
besides the bounds on rounding that are part of every hull: `nearest_ulp` is how far inside its border the nearest image
was, in units in the last place (float32) of the largest number involved; negative is outside.
"""

from __future__ import annotations

import argparse
import json
import sys
from functools import partial
from itertools import pairwise, product
from math import ceil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from star.abstraction import forward_model, reachability
from star.abstraction.forward_model import ForwardModelState
from star.abstraction.reachability import Network
from star.abstraction.sections import ForwardModelConfig
from star.agent.sections import AgentConfig
from star.agent.state import TrainState
from star.config.loading import load_run, parse
from star.training import program as programs
from star.training import provenance
from star.training.checkpoint import load_state

NETWORKS = [  # widths of input, hidden layers and output; residual
    ((2, 2), True),
    ((2, 16, 2), False),
    ((3, 8, 8, 3), True),
    ((4, 20, 12, 7, 3), False),
]
MODELS = [  # dimensions of the space, hidden layers, residual
    (2, (8,), False),
    (2, (32, 32), True),
    (3, (16, 16), True),
]
CHUNK = 10_000


def check_triples(count: int, *, seed: int = 0, chunk: int = CHUNK) -> dict[str, Any]:
    """Number of triples with their image outside, of `count` random ones in equal shares of NETWORKS and of MODELS."""
    rng = np.random.default_rng(seed)
    kinds = [(partial(random_networks, *one), 0.5 / len(NETWORKS)) for one in NETWORKS]
    kinds += [(partial(random_models, *one), 0.5 / len(MODELS)) for one in MODELS]
    outside, nearest, done = 0, np.inf, 0
    for kind, share in kinds:
        left = ceil(count * share)
        while left > 0:
            margin = margins(*kind(rng, chunk))[: min(left, chunk)]
            outside, nearest = outside + int((margin < 0).sum()), min(nearest, float(margin.min()))
            done, left = done + len(margin), left - len(margin)
    return {"triples": done, "outside": outside, "nearest_ulp": nearest}


def margins(low: np.ndarray, high: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Distance of each image [..., d] to the border of [low, high], in units in the last place (of the largest)."""
    unit = np.spacing(np.maximum(np.abs(low), np.abs(high)).astype(np.float32)).astype(np.float64)
    return (np.minimum(image - low, high - image) / unit).min(axis=-1)


def random_networks(
    widths: tuple[int, ...], residual: bool, rng: np.random.Generator, n: int
) -> tuple[np.ndarray, ...]:
    """Hulls (low, high) of the boxes of n random networks, and the image of a point in each, [n, out]."""
    layers = random_layers(rng, n, widths)
    lower, upper, point = random_boxes(rng, 10 ** rng.uniform(-2, 4, (n, 1)) * rng.normal(size=(n, widths[0])))
    low, high = _hulls(Network(layers=tuple((w.swapaxes(1, 2), b) for w, b in layers), residual=residual), lower, upper)
    image = evaluate(layers, point)
    return np.asarray(low), np.asarray(high), image + point if residual else image


def random_models(
    d: int, hidden: tuple[int, ...], residual: bool, rng: np.random.Generator, n: int
) -> tuple[np.ndarray, ...]:
    """The same of n forward models, each in a space and under a command of its own; images are those of F_k itself."""
    config = parse({"forward_model": {"hidden": hidden, "residual": residual, "buffer_size": 1, "batch_size": 1}})
    corner = 10 ** rng.uniform(-2, 3, (n, 1)) * rng.normal(size=(n, d))
    space = np.stack([corner, corner + 10 ** rng.uniform(0, 2, (n, d))], axis=1).astype(np.float32)
    inside = lambda: (space[:, 0] + rng.random((n, d)) * (space[:, 1] - space[:, 0])).astype(np.float32)  # noqa: E731
    lower, upper, point = random_boxes(rng, inside())
    command = np.sort(np.stack([inside(), inside()]), axis=0)
    layers = random_layers(rng, n, (3 * d, *hidden, d))
    params = {"params": {f"Dense_{i}": {"kernel": w, "bias": b} for i, (w, b) in enumerate(layers)}}
    low, high = _model_hulls(config.forward_model, params, space, command, lower, upper)
    return np.asarray(low), np.asarray(high), predict(layers, space, command, point, residual=residual)


def random_layers(rng: np.random.Generator, n: int, widths: tuple[int, ...]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Kernels [n, in, out] and biases [n, out] of n networks, small and large ones, that heed some inputs little."""
    gain = 10 ** rng.uniform(-1, 1, (n, 1, 1))
    heed = [10 ** rng.uniform(-4, 0, (n, a, 1)) for a in widths[:-1]]
    kernels = [gain * h * rng.normal(size=(n, a, b)) for h, (a, b) in zip(heed, pairwise(widths), strict=True)]
    biases = [gain[:, 0] * rng.normal(size=(n, b)) for b in widths[1:]]
    return [(w.astype(np.float32), b.astype(np.float32)) for w, b in zip(kernels, biases, strict=True)]


def random_boxes(rng: np.random.Generator, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(lower, upper, point) of boxes from points to wide ones; a quarter of the points are corners."""
    n, d = corner.shape
    lower = corner.astype(np.float32)
    size = rng.random((n, d)) * 10 ** rng.uniform(-7, 2, (n, 1)) * (rng.random((n, 1)) > 0.1)
    upper = np.maximum(lower, (lower + size).astype(np.float32))
    share = np.where(rng.random((n, 1)) < 0.25, rng.integers(0, 2, (n, d)), rng.random((n, d)))
    return lower, upper, np.clip((lower + share * (upper - lower)).astype(np.float32), lower, upper)


def evaluate(layers: Any, x: np.ndarray) -> np.ndarray:
    """The network of `layers` in float64: kernels [..., in, out], biases [..., out], inputs [..., in]."""
    x = x.astype(np.float64)
    for i, (kernel, bias) in enumerate(layers):
        x = (x[..., None, :] @ kernel.astype(np.float64))[..., 0, :] + bias
        x = np.maximum(x, 0) if i < len(layers) - 1 else x
    return x


def predict(layers: Any, space: np.ndarray, command: np.ndarray, start: np.ndarray, *, residual: bool) -> np.ndarray:
    """F_k in float64, by its equation: `space` [..., 2, d], `command` [2, ..., d], `start` [..., d]."""
    corners = space.astype(np.float64)
    middle, half = corners.sum(axis=-2) / 2, (corners[..., 1, :] - corners[..., 0, :]) / 2
    seen = np.concatenate([(x - middle) / half for x in np.broadcast_arrays(start, *command)], axis=-1)
    return (start if residual else middle) + half * evaluate(layers, seen)


@jax.jit
def _hulls(network: Network, lower: Any, upper: Any) -> Any:
    return jax.vmap(reachability.hull)(network, lower, upper)


@jax.jit
def _model_hulls(config: ForwardModelConfig, params: Any, space: Any, command: Any, lower: Any, upper: Any) -> Any:
    def one(params: Any, space: Any, below: Any, above: Any, lower: Any, upper: Any) -> Any:
        model = ForwardModelState(params=params, optimizer=None, ring=None, space=space)
        return reachability.hull(forward_model.network(config, model, below, above), lower, upper)

    return jax.vmap(one)(params, space, *command, lower, upper)


def check_verdicts(config: AgentConfig, state: TrainState, *, points: int, seed: int = 0) -> dict[str, Any]:
    """The verdicts of one seed on all ordered pairs of its regions; `state` has no axis of seeds."""
    count = int(state.abstraction.count)
    pairs = np.array([(i, j) for i, j in product(range(count), repeat=2) if i != j], np.int32)
    row: dict[str, Any] = {"regions": count, "pairs": len(pairs)}
    judge = jax.jit(lambda *arguments: _judge(*arguments))
    for name, share in (("strict", 1.0), ("trained", config.refinement.reach_share)):
        parts, outside, away, tested, nearest = 0, 0, 0, 0, np.inf
        leaves, lows, highs = jax.tree.map(np.asarray, judge(config, state, pairs, share))
        for i, (_, target) in enumerate(pairs):
            parts_of = jax.tree.map(lambda x, i=i: x[i], leaves)
            for n in np.flatnonzero(parts_of.reaches):
                rng = np.random.default_rng((seed, parts))
                image = _images(config, state, target, parts_of.lower[n], parts_of.upper[n], points, rng)
                margin = margins(lows[i, n], highs[i, n], image)
                wanted = np.asarray(state.abstraction.lower[target]), np.asarray(state.abstraction.upper[target])
                away += int((~((wanted[0] <= image) & (image <= wanted[1])).all(axis=-1)).sum())
                outside, nearest = outside + int((margin < 0).sum()), min(nearest, float(margin.min()))
                parts, tested = parts + 1, tested + len(image)
        row[name] = {"reach_share": float(share), "parts": parts, "points": tested, "outside_hull": outside}
        row[name] |= {"nearest_ulp": nearest if tested else None}
        row[name] |= {"do_not_arrive": away} if name == "strict" else {"arrive": 1 - away / tested if tested else None}
    return row


def _judge(config: AgentConfig, state: TrainState, pairs: jax.Array, share: jax.Array) -> Any:
    """The parts that the recursion ends with for each pair, and their hulls (low, high)."""
    periods = forward_model.remembered(state.forward_model)
    settings = config.refinement

    def one(pair: jax.Array) -> Any:
        region, target = pair
        wanted = state.abstraction.lower[target], state.abstraction.upper[target]
        network = forward_model.network(config.forward_model, state.forward_model, *wanted)
        leaves = reachability.examine(
            network,
            (state.abstraction.lower[region], state.abstraction.upper[region]),
            wanted,
            periods.start,
            periods.weight,
            depth=settings.depth,
            parts=settings.parts,
            reach_share=share,
            miss_share=settings.miss_share,
            min_visits=settings.min_visits,
        )
        return leaves, *jax.vmap(partial(reachability.hull, network))(leaves.lower, leaves.upper)

    return jax.lax.map(one, jnp.asarray(pairs))


def _images(
    config: AgentConfig,
    state: TrainState,
    target: int,
    lower: np.ndarray,
    upper: np.ndarray,
    points: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Images under F_k of all corners and `points` random points of a part under the command `target`."""
    model, d = state.forward_model, len(lower)
    shares = np.concatenate([np.array(list(product((0, 1), repeat=d))), rng.random((points, d))])
    start = np.clip((lower + shares * (upper - lower)).astype(np.float32), lower, upper)
    dense = model.params["params"]
    layers = [tuple(np.asarray(dense[f"Dense_{i}"][key]) for key in ("kernel", "bias")) for i in range(len(dense))]
    command = np.stack([state.abstraction.lower[target], state.abstraction.upper[target]])
    return predict(layers, np.asarray(model.space), command, start, residual=config.forward_model.residual)


def main(arguments: list[str] | None = None) -> int:
    """Print one line a check and write all figures; 1 if any of them is not sound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN")
    parser.add_argument("--triples", type=int, default=1_000_000)
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)

    report: dict[str, Any] = {"command": " ".join(["python scripts/checks/soundness.py", *(arguments or sys.argv[1:])])}
    report |= provenance.here()
    report |= {"triples": check_triples(options.triples), "verdicts": []}
    print(json.dumps(report["triples"]), flush=True)
    for run in options.runs:
        program = programs.build(load_run(run, {"env.engine": "auto"}))
        step, states = load_state(program, run, "last")
        for i, seed in enumerate(program.seeds):
            state = jax.tree.map(lambda x, i=i: x[i], states)
            row = {"run": run.name, "env": program.config.env.name, "env_steps": step, "seed": seed}
            row |= check_verdicts(program.config.hyper(), state, points=options.points)
            report["verdicts"].append(row)
            print(json.dumps(row), flush=True)
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    bad = report["triples"]["outside"] + sum(
        row["strict"]["do_not_arrive"] + row["strict"]["outside_hull"] + row["trained"]["outside_hull"]
        for row in report["verdicts"]
    )
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
