"""Motion to try things on: our own, made by ``tests/test_examples.py``, with the licence of the code, MIT."""

from pathlib import Path

#: A synthetic person who walks, turns to the viewer and waves: 6.6 s at 30 frames per second, the 22 standard joints.
WALK = Path(__file__).with_name("walk.bvh")
