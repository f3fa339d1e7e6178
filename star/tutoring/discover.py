"""`star tutor discover`: the prerequisites in a user's own scores, as JSON, GraphML and a figure."""

from __future__ import annotations

import argparse
import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from envs.common import files, modes
from envs.common.errors import UserError
from star.config.loading import parse
from star.tutoring import tables, tracing
from star.tutoring.sections import DiscoveryConfig
from star.tutoring.tables import Tables
from star.tutoring.tracing import FEATURES, Found, Scores

MOST_NUMBERS = 2**29
"""Of features that are kept in memory, 2 GiB; of more scores, some students are drawn."""
NAMES = ("graph.json", "graph.graphml", "graph.png")
Edge = dict[str, Any]


def discover(options: argparse.Namespace, overrides: Mapping[str, Any]) -> int:
    """Read both files, find the graph, write and print it."""
    modes.check_learning()
    config = _settings(overrides)
    out: Path = options.out
    _check(out, force=options.force)
    found = bounded(tables.read(options.scores, options.skills), seed=options.seed)
    with Console(stderr=True).status(f"fitting {config.members} models to {len(found.right):,} scores"):
        graph = of_tables(config, found, seed=options.seed)
    edges = edges_of(found.skills, graph)
    about = {
        "students": found.students,
        "scores": len(found.right),
        "exercises": len(found.needs),
        "seed": options.seed,
    }
    write(out, found.skills, edges, about | {"discovery": config.model_dump(mode="json")})
    for edge in edges:
        print(f"{edge['share']:.2f}  {edge['prerequisite']} -> {edge['skill']}")
    print(f"{len(edges)} prerequisites among {len(found.skills)} skills, with the share of models that have them")
    print(f"graph:   {', '.join(str(out / name) for name in NAMES)}")
    return 0


def of_tables(config: DiscoveryConfig, found: Tables, *, seed: int) -> Found:
    """The graph in `found`, on the host."""
    scores = Scores(
        student=jnp.asarray(found.student, jnp.int32),
        exercise=jnp.asarray(found.exercise, jnp.int32),
        right=jnp.asarray(found.right),
    )

    return jax.device_get(_discover(config, jnp.asarray(found.needs), scores, found.students, key=modes.key(seed)))


_discover = jax.jit(tracing.discover, static_argnums=3)


def bounded(found: Tables, *, seed: int) -> Tables:
    """`found`, or so many of its students, drawn at random, that their features stay in memory."""
    most = MOST_NUMBERS // (FEATURES * len(found.skills))
    if len(found.right) <= most:
        return found
    order = np.random.default_rng(seed).permutation(found.students)
    total = np.cumsum(np.bincount(found.student)[order])
    chosen = np.sort(order[: max(1, int(np.searchsorted(total, most, side="right")))])
    mine = np.isin(found.student, chosen)
    student = np.searchsorted(chosen, found.student[mine])
    return Tables(found.skills, len(chosen), found.needs, student, found.exercise[mine], found.right[mine])


def edges_of(skills: list[str], graph: Found) -> list[Edge]:
    """The edges of `graph`, the surest first."""
    found = [
        {
            "prerequisite": skills[parent],
            "skill": skills[child],
            "strength": round(float(graph.strength[child, parent]), 4),
            "share": round(float(graph.share[child, parent]), 4),
        }
        for child, parent in np.argwhere(graph.parents)
    ]
    return sorted(found, key=lambda edge: (-edge["share"], -edge["strength"]))


def write(out: Path, skills: list[str], edges: list[Edge], about: Mapping[str, Any]) -> None:
    """JSON, GraphML and a figure in the folder `out`; raises `UserError` if they cannot be written."""
    from star.training.figures import save
    from star.tutoring import figures

    try:
        out.mkdir(exist_ok=True)
    except OSError as error:
        raise UserError(f"{out}: cannot be written: {error.strerror}") from None
    number = {skill: i for i, skill in enumerate(skills)}
    shares = {(number[edge["skill"]], number[edge["prerequisite"]]): edge["share"] for edge in edges}
    json_file, graphml_file, png_file = (out / name for name in NAMES)
    with files.whole(json_file) as file:
        file.write_text(
            json.dumps({"skills": skills, "edges": edges} | dict(about), indent=1, ensure_ascii=False) + "\n", "utf-8"
        )
    with files.whole(graphml_file) as file:
        graphml(skills, edges).write(file, encoding="utf-8", xml_declaration=True)
    with files.whole(png_file) as file:
        save(figures.found_figure(skills, shares), file)


def graphml(skills: list[str], edges: list[Edge]) -> ElementTree.ElementTree:
    """The graph in GraphML: edges lead from a prerequisite to the skill, with `strength` and `share`."""
    root = ElementTree.Element("graphml", xmlns="http://graphml.graphdrawing.org/xmlns")
    for name, of, kind in (("name", "node", "string"), ("strength", "edge", "double"), ("share", "edge", "double")):
        ElementTree.SubElement(root, "key", {"id": name, "for": of, "attr.name": name, "attr.type": kind})
    graph = ElementTree.SubElement(root, "graph", id="prerequisites", edgedefault="directed")
    for i, skill in enumerate(skills):
        node = ElementTree.SubElement(graph, "node", id=f"n{i}")
        ElementTree.SubElement(node, "data", key="name").text = skill
    number = {skill: f"n{i}" for i, skill in enumerate(skills)}
    for edge in edges:
        ends = {"source": number[edge["prerequisite"]], "target": number[edge["skill"]]}
        element = ElementTree.SubElement(graph, "edge", ends)
        for name in ("strength", "share"):
            ElementTree.SubElement(element, "data", key=name).text = str(edge[name])
    tree = ElementTree.ElementTree(root)
    ElementTree.indent(tree)
    return tree


def _settings(overrides: Mapping[str, Any]) -> DiscoveryConfig:
    """Those of the models; raises `UserError` for others."""
    for key in overrides:
        if not key.startswith("discovery."):
            raise UserError(
                f"--{key}: star tutor discover takes settings of discovery alone; star settings tutoring lists them"
            )
    return parse({"experiment": "tutoring"}, overrides).discovery


def _check(out: Path, *, force: bool) -> None:
    """Raise `UserError` in one line if what is found cannot be written to `out`."""
    files.check_name(out)
    if out.exists() and not out.is_dir():
        raise UserError(f"{out}: is a file, not a folder")
    if not out.parent.is_dir():
        raise UserError(f"{out}: there is no folder {out.parent}")
    for name in NAMES if out.is_dir() else ():
        files.check(out / name, (out / name).suffix.split(), force=force)
