"""Use the package as a newcomer who has only the wheel: nobody's folder, another user, a folder `envs` of their own.

    python scripts/checks/wheel.py

Builds the wheel, unpacks it into an empty folder, and there trains, lists, evaluates and reports a small run, acts with
an agent of the package in a Gymnasium loop of three lines, and draws a task where pictures can be drawn. Dependencies
are those of the Python that runs this. Root does all of it as another user who may run this Python; with none, and for
anybody else, only the home is another. Ends with code 1 at the first failure.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
NOBODY = 65534
SMALL = (
    "train point_maze --run-dir runs/mine --quiet --total-env-steps 480 --trainer.num_envs 4 --trainer.eval_every 1 "
    "--trainer.eval_episodes 3 --env.options.episode_length 60 --tutor.unroll 2 --controller.ppo.hidden [8] "
    "--commander.enabled false --tutor.enabled false"  # the Controller alone compiles in a fifth of the time
)
ACT = """
import star
agent = star.load("point_maze")
env = agent.env()
obs, info = env.reset(seed=0)
for _ in range(20): obs, *_ = env.step(agent.act(obs))
print(star.__file__, obs["achieved_goal"])
"""
# All in one process, as imports take seconds: a script, then commands as the console script does them.
USE = """
import sys
script, *commands = sys.argv[1:]
exec(script)
from star.cli import main
for command in commands:
    print(f"star {command}", flush=True)
    if code := main(command.split()): sys.exit(code)
"""
DRAW = "render ant_maze --out film.gif --steps 10 --every 5 --height 120 --quiet"
CANNOT_DRAW = ("pictures need OpenGL", "MUJOCO_GL")


def main() -> None:
    """Do it all, and say what was done."""
    with tempfile.TemporaryDirectory() as folder:
        home, site = Path(folder), Path(folder) / "site"
        wheel = build(home)
        with zipfile.ZipFile(wheel) as packed:
            packed.extractall(site)
        work = home / "work"
        (work / "envs").mkdir(parents=True)
        (work / "envs" / "__init__.py").write_text("")
        for path in (home, *home.rglob("*")):
            path.chmod(0o777)
        user = Newcomer(work, site)
        print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB")
        commands = (SMALL, "ls", "evaluate runs/mine --quiet --json", "report runs/mine --out report.html", DRAW)
        # A script beside a folder `envs` would import that one, so it is run as a module is: from elsewhere.
        done = user.python("-P", "-c", USE, ACT, *commands)
        print(done.stdout.rstrip())
        if not done.stdout.startswith(str(site)):
            raise SystemExit(f"star was imported from elsewhere than {site}\n{done.stderr}")
        if f"star {DRAW}" not in done.stdout or (
            done.returncode and not any(one in done.stderr for one in CANNOT_DRAW)
        ):
            raise SystemExit(f"code {done.returncode}\n{done.stderr}")
        print(f"not drawn: {done.stderr.strip()}" if done.returncode else "drawn: film.gif")


class Newcomer:
    """Another user, in the folder `work`, with the package in `site`."""

    def __init__(self, work: Path, site: Path) -> None:
        self._work = work
        named = ("PATH", "LANG", "MUJOCO_GL", "JAX_", "XLA_")
        self._environment = {k: v for k, v in os.environ.items() if k.startswith(named)}
        self._environment |= {"PYTHONPATH": str(site), "HOME": str(work)}
        self._who = another() if os.geteuid() == 0 else {}
        print("as another user" if self._who else "as this user, in another home")

    def python(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Python with these arguments, run to its end."""
        command = [sys.executable, *words]
        return subprocess.run(
            command, cwd=self._work, env=self._environment, capture_output=True, text=True, **self._who
        )


def another() -> dict[str, Any]:
    """Arguments of `subprocess.run` for another user, if there is one who may run this Python."""
    who: dict[str, Any] = {"user": NOBODY, "group": NOBODY, "extra_groups": []}
    try:
        return who if subprocess.run([sys.executable, "-c", "import jax"], **who).returncode == 0 else {}
    except PermissionError:
        return {}


def build(folder: Path) -> Path:
    """The wheel of this clone."""
    words = ["pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run([sys.executable, "-m", *words], check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


if __name__ == "__main__":
    main()
