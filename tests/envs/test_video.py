import base64
import importlib.util
import io
import json
import re
import shutil
import stat
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from envs import EnvError, UserError, video

COLOURS = [(200, 40, 40), (40, 200, 40), (40, 40, 200)]


def pictures():
    return [np.full((20, 30, 3), colour, np.uint8) for colour in COLOURS]


def frames_of(path):
    page = path.read_text(encoding="utf-8")
    encoded = json.loads(re.search(r"const frames = (\[.*\]);", page)[1])
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(frame))).convert("RGB")) for frame in encoded]


@pytest.fixture
def no_ffmpeg(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)


@pytest.mark.parametrize("suffix", [".png", ".PNG", ".jpg"])
def test_a_still_holds_the_first_picture_and_draws_no_other(tmp_path, suffix):
    drawn = []

    def drawing():
        for picture in pictures():
            drawn.append(picture)
            yield picture

    path = tmp_path / f"still{suffix}"
    assert video.write(path, drawing()) == 1 and len(drawn) == 1
    np.testing.assert_allclose(np.asarray(Image.open(path).convert("RGB")), drawn[0], atol=4)


def test_a_gif_holds_every_picture_at_its_pace(tmp_path):
    path = tmp_path / "film.gif"
    assert video.write(path, pictures(), fps=10) == 3
    with Image.open(path) as film:
        assert (film.n_frames, film.info["duration"], film.info["loop"]) == (3, 100, 0)
        film.seek(2)
        np.testing.assert_allclose(np.asarray(film.convert("RGB"))[0, 0], COLOURS[2], atol=4)


def test_a_page_holds_every_picture_and_needs_no_network(tmp_path):
    path = tmp_path / "a <b> film.html"
    assert video.write(path, pictures(), fps=5) == 3
    for frame, picture in zip(frames_of(path), pictures(), strict=True):
        np.testing.assert_allclose(frame, picture, atol=8)
    page = re.sub(r"const frames = .*", "", path.read_text(encoding="utf-8"))
    assert not re.search(r"https?:|//|src=|href=|@import|url\(|%[A-Z]+%|<b>", page)
    assert "a &lt;b&gt; film" in page and "1000 / (5 *" in page


def test_an_mp4_holds_every_picture(tmp_path):
    try:
        ffmpeg = video._ffmpeg()
    except EnvError as error:
        pytest.skip(str(error))
    path = tmp_path / "film.mp4"
    assert video.write(path, pictures(), fps=10) == 3
    command = [ffmpeg, "-loglevel", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    frames = np.frombuffer(subprocess.run(command, capture_output=True, check=True).stdout, np.uint8)
    np.testing.assert_allclose(frames.reshape(3, 20, 30, 3), pictures(), atol=12)


def test_a_film_may_change_its_ffmpeg(tmp_path, monkeypatch):
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\nfor last; do :; done\ncat > $last\n")
    program.chmod(program.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setattr(shutil, "which", lambda name: str(program))
    video.write(tmp_path / "film.mp4", pictures())
    assert (tmp_path / "film.mp4").read_bytes() == b"".join(picture.tobytes() for picture in pictures())


def test_what_ffmpeg_complains_about_is_told_in_one_line(tmp_path, monkeypatch):
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho first >&2\necho no such codec >&2\nexit 1\n")
    program.chmod(program.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setattr(shutil, "which", lambda name: str(program))
    with pytest.raises(UserError) as error:
        video.write(tmp_path / "film.mp4", [np.zeros((400, 400, 3), np.uint8)] * 3)
    assert str(error.value) == "film.mp4: ffmpeg failed: no such codec"
    assert not (tmp_path / "film.mp4").exists()


def test_without_ffmpeg_an_mp4_is_refused_and_others_are_not(tmp_path, no_ffmpeg):
    with pytest.raises(EnvError, match=r"\.mp4 needs ffmpeg: pip install .*, or choose \.html, \.gif or \.png"):
        video.check(tmp_path / "film.mp4")
    video.check(tmp_path / "film.html")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("film.avi", "allowed endings: .png, .jpg, .mp4, .gif, .html"),
        ("film", "allowed endings"),
        ("nowhere/film.gif", "there is no folder"),
        ("old.gif", "exists; replace it with --force"),
        ("folder.gif", "is a folder"),
    ],
)
def test_what_cannot_be_written_is_refused_in_one_line(tmp_path, name, said):
    (tmp_path / "old.gif").write_text("precious")
    (tmp_path / "folder.gif").mkdir()
    with pytest.raises(UserError) as error:
        video.check(tmp_path / name)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_an_existing_file_may_be_replaced_with_force(tmp_path):
    (tmp_path / "old.gif").write_text("old")
    video.check(tmp_path / "old.gif", force=True)


@pytest.mark.parametrize("suffix", [".png", ".gif", ".html"])
def test_drawing_that_fails_leaves_everything_as_it_was(tmp_path, suffix):
    def failing():
        if suffix != ".png":
            yield pictures()[0]
        raise RuntimeError("no more")

    path = tmp_path / f"film{suffix}"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="no more"):
        video.write(path, failing())
    assert path.read_text() == "old" and [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_a_full_disk_is_told_in_one_line(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(UserError, match="film.html: cannot be written: No space left on device$"):
        video.write(tmp_path / "film.html", pictures())
