"""What the developer's page adds to the package works: a rule of the Commander and a strategy of SGIM."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

from tests.small import EPOCH, RUN, arrays

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "development.md").read_text(encoding="utf-8")


def changed(package):
    """Make the changes of the page in a copy of the package, each of them to be found in one place."""
    for name, text in re.findall(r'```python title="(.*?)"\n(.*?)```', PAGE, re.DOTALL):
        (package / "star" / "agent" / name).write_text(text)
    for name, text in re.findall(r'```diff title="(.*?)"\n(.*?)```', PAGE, re.DOTALL):
        code = (package / name).read_text(encoding="utf-8")
        for old, new in re.findall(r"((?:^-.*\n)+)((?:^\+.*\n)+)", text, re.MULTILINE):
            before, after = (re.sub(r"^[-+]", "", lines, flags=re.MULTILINE) for lines in (old, new))
            assert code.count(before) == 1, before
            code = code.replace(before, after)
        (package / name).write_text(code)


def test_a_rule_and_a_strategy_that_are_added_as_the_page_says_train(tmp_path):
    for folder in ("star", "envs"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    changed(tmp_path)
    rule = (tmp_path / "star" / "agent" / "counting.py").read_text()
    for name in re.findall(r"_rule\(section\)\.(\w+)", (ROOT / "star" / "agent" / "commander.py").read_text()):
        assert re.search(rf"\b{name}\b", rule), f"{name}, which is called where regions are cut or elsewhere"
    (tmp_path / "run.yaml").write_text(json.dumps(RUN))
    words = "star train run.yaml --run-dir run --quiet --commander.learner count --total-env-steps".split()
    words += [str(2 * EPOCH), "--sgim.strategies", "[autonomous, halfway]"]
    words += ["--tutor.enabled", "false", "--refinement.enabled", "false"]  # for the sake of compilation
    words += ["--trainer.checkpoint_every", "1"]
    subprocess.run([sys.executable, "-m", *words], cwd=tmp_path, check=True)
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert len(rows) == 2 and any(row["sgim/share_halfway"] > 0 for row in rows)
    assert {row["commander/non_finite"] for row in rows} == {0}
    # The rest is of a Commander without a Tutor.
    assert all(row["abstraction/regions"] > 1 and not any(key.startswith("tutor/") for key in row) for row in rows)
    regions = [json.loads(line) for line in (tmp_path / "run" / "regions.jsonl").read_text().splitlines()]
    assert sum(regions[-1]["chosen"]) > 0
    first, last = (arrays(tmp_path / "run", n * EPOCH) for n in (1, 2))
    assert any((last[name] != first[name]).any() for name in first if name.startswith("controller/params/"))
