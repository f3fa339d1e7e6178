"""Measure how well SGIM and other selectors spend their episodes on beds whose laws are known.

    python scripts/benchmarks/selection.py [--seeds 16] [--blocks 2400] [--out results/sgim]

Every selector runs with each of its constants. The first table shows for each selector those with the largest mean AUC
over all beds, the others those with the largest AUC on one bed. Written are selection.json, table.md and curves.png.

    AUC         mean over time of the mastery, the competence in all that can be learnt
    t90         episodes until the mastery exceeds .9, median over seeds
    hopeless    share of the time before that in regions where nothing can be learnt
    idle        share of the time before that with strategies that teach nothing
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from star import sgim
from star.report.statistics import over_seeds
from star.sgim import beds, selectors
from star.sgim.beds import Bed
from star.sgim.selectors import Selector

EPISODES = 5  # of a block


def all_beds() -> dict[str, tuple[Bed, list[int], list[int]]]:
    """Beds by name, with their hopeless regions and idle strategies."""
    lower, upper = beds.frontier().regions.lower, beds.frontier().regions.upper
    above = [r for r in range(len(lower)) if upper[r, 0] <= lower[r, 1]]  # x_1 < x_2 everywhere
    six = {f"six regions, noise {noise:g}": (beds.six_regions(noise=noise), [4, 5], [3]) for noise in (0, 0.05, 0.2)}
    walls = np.flatnonzero(beds.PLAN == "#").tolist()
    return {
        **six,
        "frontier": (beds.frontier(), above, [2]),
        "key and door": (beds.key_and_door(noise=0.05), walls, [2]),
    }


def all_selectors(bed: Bed) -> Iterator[tuple[str, str, Selector]]:
    """Name, constants and selector."""
    size, space = (bed.regions.capacity, bed.strategies), bed.regions
    costs = [1.0] * bed.strategies
    yield "uniform", "", selectors.uniform(*size)
    yield "round robin", "", selectors.round_robin(*size)
    for every in (2, 4, 8):
        teacher = 2 if bed.strategies == 4 else 1
        rule = selectors.fixed_frequency(sgim.Config(), space, bed.strategies, teacher=teacher, every=every)
        yield "fixed frequency (SGIM-D)", f"every {every}", rule
    yield "SGIM", "defaults", selectors.sgim(sgim.Config(), space, costs)
    for sharpness, optimism in itertools.product((4.0, 8.0, 12.0), (0.005, 0.01, 0.015, 0.02)):
        config = sgim.Config(sharpness=sharpness, optimism=optimism)
        yield "SGIM, swept", f"sharpness {sharpness:g}, optimism {optimism}", selectors.sgim(config, space, costs)
    yield "SGIM, absolute progress", "forgetting 1", selectors.sgim(sgim.Config(forgetting=1.0), space, costs)
    for bonus in (0.001, 0.003, 0.01, 0.03):
        yield "UCB1", f"bonus {bonus}", selectors.ucb(*size, bonus=bonus)
        for discount in (0.98, 0.99, 0.995):
            yield (
                "discounted UCB",
                f"bonus {bonus}, discount {discount}",
                selectors.ucb(*size, bonus=bonus, discount=discount),
            )
        for window in (100, 200, 400):
            yield (
                "sliding-window UCB",
                f"bonus {bonus}, window {window}",
                selectors.ucb(*size, bonus=bonus, window=window),
            )
    for rate in (0.001, 0.01, 0.03, 0.1):
        yield "Exp3", f"rate {rate}", selectors.exp3(*size, rate=rate)
        for share in (0.001, 0.01):
            yield "Exp3.S", f"rate {rate}, share {share}", selectors.exp3(*size, rate=rate, share=share)
        yield "Exp4", f"rate {rate}", selectors.exp4(sgim.Config(), space, bed.strategies, rate=rate)
    for every in (100, 250):
        yield "ALP-GMM", f"every {every}", selectors.alp_gmm(space, bed.strategies, every=every)
    yield "oracle", "knows the law", beds.oracle(bed)


def measure(
    bed: Bed, selector: Selector, hopeless: list[int], idle: list[int], *, seeds: int, blocks: int
) -> dict[str, Any]:
    """The history of `seeds` learners."""
    play: Callable = jax.jit(jax.vmap(lambda key: beds.run(bed, selector, blocks=blocks, episodes=EPISODES, key=key)))
    course = jax.tree.map(np.asarray, play(jax.random.split(jax.random.key(0), seeds)))
    until = np.asarray(jax.vmap(beds.until_mastered)(course))
    before = np.arange(blocks) < until[:, None]

    def share(hit: np.ndarray) -> float:
        return float((hit & before).sum() / max(before.sum(), 1))

    return {
        "auc": course.mastery.mean(axis=1).round(4).tolist(),
        "t90": (until * EPISODES).tolist(),
        "hopeless": share(np.isin(course.region, hopeless)),
        "idle": share(np.isin(course.strategy, idle)),
        "curve": course.mastery.mean(axis=0)[:: max(1, blocks // 50)].round(3).tolist(),
    }


def fair(found: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Of each selector the rows of all beds with the constants of largest mean AUC over beds; best selectors first."""
    settings: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in found:
        settings.setdefault((row["selector"], row["constants"]), []).append(row)
    chosen: dict[str, list[dict[str, Any]]] = {}
    for rows in sorted(settings.values(), key=lambda rows: -np.mean([row["auc"] for row in rows])):
        chosen.setdefault(rows[0]["selector"], rows)
    return list(chosen.values())


def best(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each selector on each bed the constants with the largest AUC."""
    chosen: dict[tuple[str, str], dict[str, Any]] = {}
    for row in found:
        key = (row["bed"], row["selector"])
        if key not in chosen or np.mean(row["auc"]) > np.mean(chosen[key]["auc"]):
            chosen[key] = row
    return list(chosen.values())


def table(found: list[dict[str, Any]]) -> str:
    """A Markdown table of all beds and one for each, best selectors first."""
    names = list(dict.fromkeys(row["bed"] for row in found))
    lines = [
        "**One setting for all beds**: AUC",
        "",
        f"| selector | constants | mean | {' | '.join(names)} |",
        "|---|---|---|" + "---|" * len(names),
    ]
    for rows in fair(found):
        mean = interval(np.mean([row["auc"] for row in rows], axis=0).tolist())
        each = " | ".join(f"{np.mean(row['auc']):.3f}" for row in rows)
        lines.append(f"| {rows[0]['selector']} | {rows[0]['constants']} | {mean} | {each} |")
    for bed in names:
        lines += [
            "",
            f"**{bed}**",
            "",
            "| selector | constants | AUC | t90 | hopeless | idle |",
            "|---|---|---|---|---|---|",
        ]
        for row in sorted((row for row in best(found) if row["bed"] == bed), key=lambda row: -np.mean(row["auc"])):
            rest = f"{np.median(row['t90']):,.0f} | {row['hopeless']:.2f} | {row['idle']:.2f}"
            lines.append(f"| {row['selector']} | {row['constants']} | {interval(row['auc'])} | {rest} |")
    return "\n".join([*lines, ""])


def interval(auc: Sequence[float]) -> str:
    """Mean over seeds and its interval (Student's t)."""
    return "{:.3f} [{:.3f}, {:.3f}]".format(*over_seeds(np.asarray(auc)))


def draw(found: list[dict[str, Any]], blocks: int, path: Path) -> None:
    """Mastery over time, one panel a bed."""
    names = list(dict.fromkeys(row["bed"] for row in found))
    figure = Figure(figsize=(4.2 * len(names), 4), layout="constrained")
    for axis, bed in zip(figure.subplots(1, len(names), sharey=True, squeeze=False)[0], names, strict=True):
        for number, row in enumerate(row for row in best(found) if row["bed"] == bed):
            at = np.linspace(0, blocks * EPISODES, len(row["curve"]))
            style = {"color": f"C{number % 10}", "ls": "-" if number < 10 else "--"}
            axis.plot(at, row["curve"], label=row["selector"], lw=2.5 if row["selector"] == "SGIM" else 1, **style)
        axis.set(title=bed, xlabel="episodes")
        axis.grid(alpha=0.3)
    figure.axes[0].set(ylabel="mastery")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center", fontsize="small")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--blocks", type=int, default=2400)
    parser.add_argument("--out", type=Path, default=Path("results/sgim"))
    options = parser.parse_args()
    found = []
    for name, (bed, hopeless, idle) in all_beds().items():
        for selector, constants, rule in all_selectors(bed):
            row = measure(bed, rule, hopeless, idle, seeds=options.seeds, blocks=options.blocks)
            found.append({"bed": name, "selector": selector, "constants": constants, "seeds": options.seeds} | row)
            print(f"{name}: {selector} {constants}: AUC {np.mean(row['auc']):.3f}", flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "selection.json").write_text(json.dumps(found) + "\n", encoding="utf-8")
    (options.out / "table.md").write_text(table(found), encoding="utf-8")
    draw(found, options.blocks, options.out / "curves.png")
    print(table(found))


if __name__ == "__main__":
    main()
