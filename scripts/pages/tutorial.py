"""Do what docs/tutorial.md says, in a fresh clone in an empty folder, and write what it prints into the page.

    python scripts/pages/tutorial.py [--keep FOLDER]

Each block of commands runs as it stands, its files are written as the page has them, and the `console` block after it
becomes the last lines of what was printed. A command that fails ends all, and the page stays as it is. The script ends
with the seconds of each block. `--keep` names the folder, which must be empty or not exist; by default it is a
temporary one, which is deleted. It takes some ten minutes on two cores.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "tutorial.md"
BLOCK = re.compile(r'^```(?P<kind>\w+)(?: title="(?P<name>[^"]+)")?\n(?P<text>.*?)^```\n', re.DOTALL | re.MULTILINE)
MOST = 14  # lines of what a block prints
WIDEST = 118  # characters of a line


def told(text: str, folder: Path) -> tuple[str, list[tuple[str, float]]]:
    """The page `text` with what its commands print in `folder`, a clone, and the seconds of each block of commands."""
    made, end, seconds = "", 0, []
    printed: str | None = None
    for block in BLOCK.finditer(text):
        made += text[end : block.start()]
        end = block.end()
        if block["name"]:
            (folder / block["name"]).write_text(block["text"], encoding="utf-8")
        if block["kind"] == "console":
            if printed is None:
                raise SystemExit("error: docs/tutorial.md: a console block follows no commands")
            made += f"```console\n{printed}```\n"
        else:
            made += block[0]
        if block["kind"] == "bash":
            start = time.monotonic()
            printed = shown(run(block["text"], folder))
            seconds.append((block["text"].splitlines()[0], time.monotonic() - start))
        elif block["kind"] == "console":
            printed = None
    return made + text[end:], seconds


def run(commands: str, folder: Path) -> str:
    """All that the commands print, in `folder` with its virtual environment; SystemExit if one fails."""
    script = f"set -e; [ ! -d .venv ] || . .venv/bin/activate\n{commands}"
    done = subprocess.run(
        ["bash", "-c", script], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"error: {commands.splitlines()[0]}: exit code {done.returncode}\n{done.stdout}")
    return done.stdout


def shown(printed: str) -> str:
    """Its last lines, without trailing blanks and lines that are empty."""
    whole = [line.rstrip() for line in printed.splitlines() if line.strip()]
    lines = [line if len(line) <= WIDEST else f"{line[: WIDEST - 1].rstrip()}…" for line in whole]
    return "".join(f"{line}\n" for line in ["..."] * (len(lines) > MOST) + lines[-MOST:])


def main(arguments: list[str] | None = None) -> None:
    """Write the page, and print the seconds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, metavar="FOLDER")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        folder = (options.keep or Path(temporary) / "STAR").resolve()
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
        made, seconds = told(PAGE.read_text(encoding="utf-8"), folder)
    PAGE.write_text(made, encoding="utf-8")
    for command, took in seconds:
        print(f"{took:6.0f} s  {command}")
    print(f"{sum(took for _, took in seconds):6.0f} s  in all")


if __name__ == "__main__":
    main()
