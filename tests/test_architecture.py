"""The plan of the house: how long things are, who imports whom, and where the names of learners may stand."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LEVELS = ("commander", "goal_only", "tutor", "passing", "controller")


def sources(*folders):
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def name(path):
    """That of a module, such as star.agent.play."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name(path): path for path in sources("star", "envs")}


def imported(path):
    """The modules of ours that one imports, anywhere in it but for types alone."""
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {one if one in MODULES else node.module for one in inner}
    return {module for module in found if module in MODULES}


def package(module):
    """The room of a module: a folder; of what stands in `star` itself each file is one, and `envs` is one but for
    `envs.common`."""
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] == "star" or parts[1:2] == ["common"] else parts[0]


def lengths(tree):
    """(name, lines) of all functions, those within others too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name, node.end_lineno - node.lineno + 1


@pytest.mark.parametrize("path", sources("star", "envs"), ids=name)
def test_files_and_functions_are_short_enough_to_be_read_in_one_sitting(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400
    assert [(function, lines) for function, lines in lengths(parsed(path)) if lines > 60] == []


def test_the_epoch_and_episodes_are_short_and_do_not_ask_which_levels_there_are():
    epoch, play = ROOT / "star/agent/epoch.py", ROOT / "star/agent/play.py"
    texts = [path.read_text(encoding="utf-8") for path in (epoch, play)]
    assert [len(text.splitlines()) <= most for text, most in zip(texts, (200, 250), strict=True)] == [True, True]
    assert not any("enabled" in text for text in texts)
    tests = [node for path in (epoch, play) for node in ast.walk(parsed(path)) if _asks_for_none(node)]
    assert 0 < len(tests) <= 8


def _asks_for_none(node):
    if not isinstance(node, ast.Compare) or not isinstance(node.ops[0], ast.Is | ast.IsNot):
        return False
    return any(isinstance(side, ast.Constant) and side.value is None for side in node.comparators)


def test_packages_import_one_another_in_one_direction():
    above = {}
    for module, path in MODULES.items():
        above.setdefault(package(module), set()).update(map(package, imported(path)))
    above = {room: below - {room} for room, below in above.items()}
    try:
        order = list(TopologicalSorter(above).static_order())
    except CycleError as error:
        pytest.fail(f"a cycle: {' <- '.join(error.args[1])}")
    assert order.index("envs.common") < order.index("star.learners") < order.index("star.agent")


def test_the_cycle_of_the_tests_above_can_be_found():
    with pytest.raises(CycleError):
        list(TopologicalSorter({"a": {"b"}, "b": {"a"}}).static_order())
    assert imported(ROOT / "star/agent/levels.py") >= {"star.agent.tutor", "star.abstraction.regions"}


def test_environments_know_nothing_of_agents_and_levels_nothing_of_one_another():
    for module, path in MODULES.items():
        if module.split(".")[0] == "envs":
            assert not any(one.split(".")[0] == "star" for one in imported(path)), module
    for level in LEVELS:
        others = {f"star.agent.{other}" for other in LEVELS} - {f"star.agent.{level}"}
        if level == "goal_only":  # what it leaves as it is, it takes from the Commander whose place it takes
            others -= {"star.agent.commander"}
        assert not imported(MODULES[f"star.agent.{level}"]) & others, level


def test_what_runs_an_experiment_knows_neither_agents_nor_tasks():
    for module, path in MODULES.items():
        if module.startswith(("star.training", "star.sweeps", "star.report", "star.cli", "star.config")):
            rooms = set(map(package, imported(path)))
            assert not rooms & {"star.agent", "star.saht", "star.sgim", "star.abstraction", "star.learners", "envs"}, (
                module
            )


def test_a_run_begins_without_what_only_figures_and_intervals_need():
    """Matplotlib and scipy.stats are a third of what it takes to import the trainer."""
    seen, left, others = set(), ["star.training.trainer", "star.agent.experiment", "star.saht.experiment"], set()
    while left:
        module = left.pop()
        if module in seen:
            continue
        seen.add(module)
        for node in parsed(MODULES[module]).body:
            if isinstance(node, ast.Import):
                names = {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names = {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
            else:
                continue
            left.extend(names & MODULES.keys())
            others |= names - MODULES.keys()
    assert {"star.training.loop", "star.training.figures", "star.report.statistics"} <= seen and "jax" in others
    assert not [one for one in others if one.split(".")[0] == "matplotlib" or one.startswith("scipy.stats")]


def test_only_learners_know_which_learners_there_are():
    for path in sources("star"):
        if path.is_relative_to(ROOT / "star/learners"):
            continue
        tree = parsed(path)
        assert "TD3State" not in path.read_text(encoding="utf-8"), path
        assert not [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and node.value == "td3"], path


def test_the_margin_of_goals_has_one_owner():
    readers = {
        name(path)
        for path in sources("star")
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.Attribute) and node.attr == "goal_margin" and isinstance(node.value, ast.Attribute)
    }
    assert readers == {"star.agent.task"}
