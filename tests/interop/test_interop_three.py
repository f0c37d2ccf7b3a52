"""three.js in headless Chromium plays what we write: joints and skin at five times are ours, and people are seen.

`make interop` fetches three.js and names its folder in $MOTIONLAB_THREE; Chromium is the system's. The picture of the
last run is kept as ``three.png`` in $MOTIONLAB_INTEROP_OUT, to be looked at.
"""

import base64
import io
import json
import os
import shutil
import subprocess
import threading
from dataclasses import replace
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from motionlab.body import BodyModel, lbs, tailored
from motionlab.io import gltf

pytestmark = pytest.mark.interop
FRAMES = (0, 17, 40, 63, 80)
THREE = Path(os.environ.get("MOTIONLAB_THREE", "no folder"))
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
WORLD_FROM_GLTF = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
FLAGS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--mute-audio")


class Pages(SimpleHTTPRequestHandler):
    """Serves the page, three.js and the file; keeps what the page posts."""

    def translate_path(self, path: str) -> str:
        where = path.partition("?")[0]
        if where == "/scene.glb":
            return str(self.server.scene)
        if where.startswith("/three/"):
            return str(THREE / where.removeprefix("/three/"))
        return str(Path(__file__).with_name("three.html"))

    def do_POST(self) -> None:
        self.server.found = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.send_response(204)
        self.end_headers()
        self.server.done.set()

    def log_message(self, *_: object) -> None:
        """Nothing."""


def play(scene: Path, times: list[float], folder: Path) -> dict:
    """What the page found."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Pages)
    server.scene, server.done = scene, threading.Event()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page = f"http://127.0.0.1:{server.server_port}/?times={','.join(map(str, times))}"
    with open(folder / "chromium.log", "wb") as log:
        browser = subprocess.Popen(
            [CHROMIUM, *FLAGS, f"--user-data-dir={folder / 'profile'}", page], stdout=log, stderr=log
        )
        try:
            assert server.done.wait(120), (folder / "chromium.log").read_text(errors="replace")[-2000:]
        finally:
            browser.terminate()
            browser.wait(30)
            server.shutdown()
            server.server_close()
    return server.found


@pytest.fixture(scope="module")
def people(motions):
    walk, other = (replace(motion.cut(0, 90), contacts=None) for motion in motions)
    return [walk, replace(other, root=other.root + torch.tensor([-1.5, 0.0, 0.0]))]


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")
@pytest.mark.skipif(not THREE.is_dir(), reason="no three.js: make interop, which needs npm")
def test_two_people_move_as_ours_do_and_are_seen(tmp_path, people, monkeypatch):
    body = BodyModel.from_anny()
    monkeypatch.setattr(gltf, "_COLOUR", (0.7, 0.1, 0.05))
    gltf.save(tmp_path / "two.glb", people, body, names=["Anna", "Bert"])
    found = play(tmp_path / "two.glb", [frame / 30 for frame in FRAMES], tmp_path)
    assert "error" not in found, found["error"]
    assert found["clips"] == 1 and abs(found["length"] - 89 / 30) < 1e-4 and len(found["people"]) == 2
    for (name, theirs), motion in zip(sorted(found["people"].items()), people, strict=True):
        assert theirs["bones"] == 22, name
        joints = np.array(theirs["joints"]) @ WORLD_FROM_GLTF.T
        now, later = (motion.positions[[frame + k for frame in FRAMES]].numpy() for k in (0, 1))
        assert np.abs(joints - now).max() < 1e-3 < 5e-3 < np.abs(joints - later).max()
        skin = np.array(theirs["vertices"]) @ WORLD_FROM_GLTF.T
        ours = lbs(tailored(body, motion.skeleton), motion.skeleton, motion.root, motion.rot)[
            list(FRAMES), ::50
        ].numpy()
        assert np.quantile(np.linalg.norm(skin - ours, axis=-1), 0.99) < 2e-3
    png = base64.b64decode(found["picture"].partition(",")[2])
    if folder := os.environ.get("MOTIONLAB_INTEROP_OUT"):
        (Path(folder) / "three.png").write_bytes(png)
    picture = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    red = picture[..., 0] - picture[..., 2] > 60  # their colour, none of the page's
    columns = np.flatnonzero(red.any(0))
    assert picture.shape == (480, 640, 3) and 0.02 < red.mean() < 0.4
    assert (np.diff(columns) > 5).sum() == 1  # two, with a gap between them
