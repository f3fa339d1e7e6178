"""star tutor discover on a user's own scores: JSON, GraphML and a figure."""

import csv
import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from star.cli import main
from star.tutoring import discover, tables
from tests.tutoring.test_tracing import chain

SKILLS = {0: "count <to> ten", 1: "add, carry", 2: "draw"}
QUICK = ["--discovery.steps", "300", "--discovery.batch", "256", "--discovery.members", "2"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Both files; the rows of students are mixed, as a school's records are."""
    monkeypatch.chdir(tmp_path)
    scores = chain(0)
    columns = [np.asarray(x) for x in (scores.student, scores.exercise, scores.right)]
    place = np.arange(len(columns[0])) % 40
    with open("scores.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["when", "student", "exercise", "correct"])
        for row in np.lexsort((columns[0], place)):
            student, exercise, right = (column[row] for column in columns)
            writer.writerow([row, f"s{student}", f"e{exercise}", int(right)])
    with open("skills.csv", "w", newline="", encoding="utf-8-sig") as file:  # as spreadsheets write it
        csv.writer(file).writerows([["skill", "exercise"], *([name, f"e{i}"] for i, name in SKILLS.items())])
    return tmp_path


def test_the_graph_is_printed_and_written_in_three_forms(folder, capsys):
    assert main(["tutor", "discover", "scores.csv", "skills.csv", "--out", "found", *QUICK]) == 0
    assert capsys.readouterr().out.startswith("1.00  count <to> ten -> add, carry\n1 prerequisites among 3 skills")
    found = json.loads(Path("found/graph.json").read_text())
    (edge,) = found["edges"]
    assert (edge["prerequisite"], edge["skill"], edge["share"]) == (SKILLS[0], SKILLS[1], 1.0)
    assert (found["students"], found["scores"], found["discovery"]["members"]) == (150, 6000, 2)
    assert Path("found/graph.png").read_bytes().startswith(b"\x89PNG")
    space = {"g": "http://graphml.graphdrawing.org/xmlns"}
    graph = ElementTree.parse("found/graph.graphml").find("g:graph", space)
    names = {node.get("id"): node.find("g:data", space).text for node in graph.findall("g:node", space)}
    (line,) = graph.findall("g:edge", space)
    assert graph.get("edgedefault") == "directed" and sorted(names.values()) == sorted(SKILLS.values())
    assert (names[line.get("source")], names[line.get("target")]) == (SKILLS[0], SKILLS[1])
    networkx = pytest.importorskip("networkx")
    read = networkx.read_graphml("found/graph.graphml")
    ((source, target, data),) = read.edges(data=True)
    assert (read.nodes[source]["name"], read.nodes[target]["name"]) == (SKILLS[0], SKILLS[1])
    assert data == {"strength": edge["strength"], "share": 1.0}


def test_rows_of_students_may_be_mixed_and_keep_their_order(folder):
    found = tables.read(Path("scores.csv"), Path("skills.csv"))
    expected = chain(0)
    by_name = [int(name[1:]) for name in ("e0", "e1", "e2")]
    assert found.students == 150 and found.needs.shape == (3, 3) and by_name == [0, 1, 2]
    np.testing.assert_array_equal(found.right, expected.right)
    skill = found.needs.argmax(axis=1)[found.exercise]
    np.testing.assert_array_equal([found.skills[i] for i in skill], [SKILLS[i] for i in np.asarray(expected.exercise)])


def test_of_too_many_scores_whole_students_are_drawn(folder, monkeypatch):
    found = tables.read(Path("scores.csv"), Path("skills.csv"))
    monkeypatch.setattr(discover, "MOST_NUMBERS", 1000 * 3 * 4)
    fewer = discover.bounded(found, seed=0)
    assert fewer.students == 25 and (np.bincount(fewer.student) == 40).all() and len(fewer.right) == 1000
    starts = {tuple(found.right[i : i + 40]) for i in range(0, 6000, 40)}
    assert all(tuple(fewer.right[i : i + 40]) in starts for i in range(0, 1000, 40))
