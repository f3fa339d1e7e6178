"""Pictures on disk: .png and .jpg hold one, .mp4, .gif and .html many.

A file appears whole or not at all. The .html is a page of its own, with a player and all pictures inside; it works
from disk and without a network. An .mp4 needs ffmpeg, the program or the package imageio-ffmpeg.
"""

from __future__ import annotations

import base64
import contextlib
import html
import importlib.util
import io
import itertools
import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator
from importlib import resources
from pathlib import Path

import numpy as np
from PIL import Image

from envs.common import extras, files
from envs.options import EnvError

STILLS = (".png", ".jpg")
FILMS = (".mp4", ".gif", ".html")
QUALITY = {".jpg": 90, ".html": 75}  # of JPEG and WebP, up to 100


def check(path: Path, *, force: bool = False) -> None:
    """Raise `UserError` in one line if `write` could not write `path`, or would replace it without `force`."""
    files.check(path, STILLS + FILMS, force=force)
    if path.suffix.lower() == ".mp4":
        _ffmpeg()


def is_still(path: Path) -> bool:
    """True if `path` can hold only one picture."""
    return path.suffix.lower() in STILLS


def sampled(count: int, every: int) -> list[int]:
    """Every `every`th of the first `count` numbers, and the last of them."""
    return sorted({*range(0, count, every), count - 1})


def moments(path: Path, count: int, *, every: int) -> list[int]:
    """The moments that `path` shows, of `count`: the last one in a still, else every `every`th and the last one."""
    return [count - 1] if is_still(path) else sampled(count, every)


def told(path: Path, written: int) -> str:
    """The words for so many pictures in `path`."""
    return f"{path}: {written} picture{'s' * (written > 1)}"


def write(path: Path, pictures: Iterable[np.ndarray], *, fps: float = 20.0) -> int:
    """Write pictures (uint8 [h, w, 3], all of one size), `fps` of them a second; returns how many there were.

    An existing file is replaced. A still takes the first picture and leaves the others undrawn.

    Raises:
      UserError: in one line, if the file cannot be written.
    """
    counted = _Counted(pictures)
    with files.whole(path) as partial:
        _WRITERS[path.suffix.lower()](partial, counted, fps)
    return counted.count


class _Counted:
    """An iterator that counts what it has given."""

    def __init__(self, pictures: Iterable[np.ndarray]) -> None:
        self._pictures = iter(pictures)
        self.count = 0

    def __iter__(self) -> Iterator[np.ndarray]:
        return self

    def __next__(self) -> np.ndarray:
        picture = next(self._pictures)
        self.count += 1
        return picture


def _write_still(path: Path, pictures: Iterator[np.ndarray], fps: float) -> None:
    image = Image.fromarray(next(pictures))
    if path.suffix.lower() == ".jpg":
        image.save(path, quality=QUALITY[".jpg"], subsampling=0, optimize=True)
    else:
        image.save(path, optimize=True)


def _write_gif(path: Path, pictures: Iterator[np.ndarray], fps: float) -> None:
    images = (
        Image.fromarray(picture).quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        for picture in pictures
    )
    first = next(images)
    first.save(path, save_all=True, append_images=images, duration=max(20, round(1000 / fps)), loop=0)


def _write_mp4(path: Path, pictures: Iterator[np.ndarray], fps: float) -> None:
    first = next(pictures)
    height, width, _ = first.shape
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    target = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-movflags", "+faststart", str(path)]
    command = [_ffmpeg(), "-y", "-loglevel", "error", *source, *target]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said)
        assert process.stdin is not None
        try:
            with contextlib.suppress(BrokenPipeError), process.stdin:  # a closed pipe: ffmpeg has given up
                for picture in itertools.chain([first], pictures):
                    process.stdin.write(picture.tobytes())
        except BaseException:
            process.kill()
            raise
        finally:
            process.wait()
        said.seek(0)
        words = said.read().decode(errors="replace").strip().splitlines()
    if process.returncode:
        raise EnvError(f"{path.name}: ffmpeg failed: {words[-1] if words else f'exit code {process.returncode}'}")


def _write_html(path: Path, pictures: Iterator[np.ndarray], fps: float) -> None:
    frames = []
    width = height = 0
    for picture in pictures:
        height, width, _ = picture.shape
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "WEBP", quality=QUALITY[".html"], method=1)
        frames.append(base64.b64encode(buffer.getvalue()).decode("ascii"))
    page = resources.files("envs").joinpath("assets", "player.html").read_text(encoding="utf-8")
    for word, value in {
        "TITLE": html.escape(path.stem),
        "WIDTH": str(width),
        "HEIGHT": str(height),
        "FPS": f"{fps:g}",
        "FRAMES": json.dumps(frames),
    }.items():
        page = page.replace(f"%{word}%", value)
    path.write_text(page, encoding="utf-8")


_WRITERS: dict[str, Callable[[Path, Iterator[np.ndarray], float], None]] = {
    ".png": _write_still,
    ".jpg": _write_still,
    ".gif": _write_gif,
    ".mp4": _write_mp4,
    ".html": _write_html,
}


def _ffmpeg() -> str:
    """The program ffmpeg; raises `EnvError` in one line if there is none."""
    found = shutil.which("ffmpeg")
    if found:
        return found
    if importlib.util.find_spec("imageio_ffmpeg") is not None:
        import imageio_ffmpeg

        try:
            return imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError:
            pass
    raise EnvError(f".mp4 needs ffmpeg: {extras.install('video')}, or choose .html, .gif or .png")
