"""Progress bars where nobody watches: a line every ten seconds at most, and none of what is short."""

import subprocess
import sys

LOOP = """
import sys
from motionlab.commands.printing import calm_bars
if sys.argv[1] == "calm":
    calm_bars()
from tqdm import tqdm
for _ in tqdm(range(2000)):
    pass
"""


def said(how: str) -> str:
    return subprocess.run([sys.executable, "-c", LOOP, how], capture_output=True, text=True, check=True).stderr


def test_a_short_loop_says_nothing_into_a_file():
    assert "2000/2000" in said("loud") and not said("calm")
