"""What a newcomer has who installs the wheel: scripts/checks/wheel.py."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_wheel_alone_trains_lists_evaluates_reports_acts_and_draws():
    environment = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}  # it compiles in two thirds of the time
    words = [sys.executable, str(ROOT / "scripts" / "checks" / "wheel.py")]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for said in ("trained 480 env steps", "mine  point_maze", '"episodes": 3', "report.html: 1 run", "site/star"):
        assert said in done.stdout
