"""The notebook runs from top to bottom."""

import json
from pathlib import Path

import star

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "star.ipynb"


def test_the_cells_of_the_notebook_run_one_after_another(monkeypatch, capsys):
    """Nothing is trained and evaluated: other tests do that for the Python page."""
    asked, seeds = [], [{"seed": i, "success_any": 0.5, "success_any_interval": [0.4, 0.6]} for i in range(2)]
    monkeypatch.setattr(star, "train", lambda *given: asked.append(given) or {"run": "runs/new"})
    monkeypatch.setattr(star, "evaluate", lambda *given: asked.append(given) or {"seeds": seeds})
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert all(cell["cell_type"] == "markdown" or not cell["outputs"] for cell in cells)
    names = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    told = capsys.readouterr().out
    assert told.startswith("reached: True after ") and told.count("seed ") == 2
    trained = ("point_maze", {"trainer.num_seeds": 2, "trainer.total_env_steps": 400_000})
    assert asked == [trained, ("runs/new", {"trainer.eval_episodes": 100})]
    assert abs(names["way"][-1] - names["obs"]["desired_goal"]).max() < 5
    (axis,) = names["draw"](names["agent"].regions, names["way"], names["obs"]["desired_goal"]).axes
    assert len(axis.patches) > len(names["agent"].regions.lower) > 4
