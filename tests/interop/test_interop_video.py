"""ffprobe, and the ffmpeg that imageio brings, find in our MP4s the frames, the rate and the size that we say."""

import json
import re
import shutil
import subprocess
from fractions import Fraction
from pathlib import Path

import imageio_ffmpeg
import pytest

from motionlab.motion import resample
from motionlab.viz.movie import film

pytestmark = pytest.mark.interop


def ffprobe(path: Path) -> tuple[int, float, str, str, int, int]:
    """Frames (decoded, not promised), rate, codec, pixel format, width and height, by ffprobe."""
    shown = "stream=nb_read_frames,avg_frame_rate,codec_name,pix_fmt,width,height"
    command = ["ffprobe", "-v", "error", "-count_frames", "-select_streams", "v", "-show_entries", shown]
    said = subprocess.run([*command, "-of", "json", str(path)], capture_output=True, text=True, check=True)
    (stream,) = json.loads(said.stdout)["streams"]
    rate = float(Fraction(stream["avg_frame_rate"]))
    return int(stream["nb_read_frames"]), rate, *(stream[k] for k in ("codec_name", "pix_fmt", "width", "height"))


def ffmpeg(path: Path) -> tuple[int, float, str, str, int, int]:
    """The same by ffmpeg, which decodes to nowhere."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "null", "-"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    codec, pixels, width, height, rate = re.search(
        r"Video: (\w+).*?, (\w+)\(.*?, (\d+)x(\d+).*?([\d.]+) fps", said
    ).groups()
    return int(re.findall(r"frame=\s*(\d+)", said)[-1]), float(rate), codec, pixels, int(width), int(height)


@pytest.fixture(scope="module", params=[25.0, 30.0])
def walk(request, tmp_path_factory, motions):
    """A motion and its film."""
    motion = resample(motions[0].cut(0, 36), request.param)
    return motion, film(motion, tmp_path_factory.mktemp("film") / "walk.mp4")


@pytest.mark.parametrize("ask", [ffprobe, ffmpeg])
def test_frames_and_rate_of_a_film(walk, ask):
    if ask is ffprobe and not shutil.which("ffprobe"):
        pytest.skip("no ffprobe: apt-get install ffmpeg")
    motion, made = walk
    frames, rate, codec, pixels, *size = ask(made.path)
    assert (frames, rate) == (motion.frames, motion.fps)
    assert (codec, pixels, size) == ("h264", "yuv420p", [480, 420])  # what every browser and PowerPoint play
