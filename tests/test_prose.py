"""Plain English: short sentences, none of which opens with a noun clause."""

import ast
from pathlib import Path

import pytest

from tests import prose

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("results/*.md")]
)
CODE = sorted(path for folder in ("star", "envs", "scripts") for path in (ROOT / folder).rglob("*.py"))
MEAN, LONGEST = 25, 45  # words a sentence


def faults(sentences, place, *, longest=LONGEST):
    long = [f"{place}: {prose.words(one)} words: {one}" for one in sentences if prose.words(one) > longest]
    return long + [f"{place}: opens with a clause: {one}" for one in sentences if prose.opens_with_a_clause(one)]


@pytest.mark.parametrize("page", PAGES)
def test_the_sentences_of_a_page_are_short_and_open_plainly(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    sentences, cells = prose.of_page(text), prose.of_cells(text)
    longest = 10_000 if page.startswith("docs/notebook/") else LONGEST
    found = faults(sentences + cells, page, longest=longest)
    assert not found, "\n".join(found)
    assert sum(map(prose.words, sentences)) <= MEAN * len(sentences)


@pytest.mark.parametrize("folder", ["star", "envs", "scripts"])
def test_docstrings_comments_and_messages_are_short_and_open_plainly(folder):
    found = []
    for path in (path for path in CODE if path.relative_to(ROOT).parts[0] == folder):
        source = path.read_text(encoding="utf-8")
        tree, name = ast.parse(source), path.relative_to(ROOT)
        for texts, split in (
            (prose.docstrings(tree), prose.of_docstring),
            (prose.comments(source), prose.of_text),
            (prose.messages(tree), prose.of_text),
        ):
            found += [fault for line, text in texts for fault in faults(split(text), f"{name}:{line}")]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("sentence", "clause"),
    [
        ("What is measured is told.", True),
        ("**Who falls** cannot climb out.", True),
        ("That a box is cut is rare.", True),
        ("How many there are, nobody knows.", True),
        ("What is measured?", False),
        ("That is rare.", False),
        ("The box is cut where it has to be.", False),
    ],
)
def test_an_opening_clause_is_told_from_a_question_and_from_pointing(sentence, clause):
    assert prose.opens_with_a_clause(sentence) == clause


def test_sentences_are_found_in_pages_docstrings_and_messages():
    page = "# What it is\n\nOne [link](what.md) here. Two\nlines: `What x`.\n\n```\nWhat code\n```\n\n| What | is |\n"
    assert prose.of_page(page) == ["One link here.", "Two lines:", "`What x`."]
    assert prose.of_cells(page) == ["What", "is"]
    text = "Does it.\n\n    How it looks\n\nArgs:\n  size: a length\n    in m. Never 0.\n"
    assert prose.of_docstring(text) == ["Does it.", "Args:", "a length in m.", "Never 0."]
    tree = ast.parse('f(g, f"no {x} here", key="a b")\n# c\n"alone"\n')
    assert [text for _, text in prose.messages(tree)] == ["no X here", "a b"]
    assert [text for _, text in prose.docstrings(tree)] == ["alone"]
    assert prose.comments("x = 1  # one\n# two\n# three\n") == [(1, "one"), (2, "two three")]
