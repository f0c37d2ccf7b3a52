"""Motion to try things on. It is our own and has the licence of the code, MIT; ``data_synth.example_walk`` made it."""

from pathlib import Path

#: A synthetic person who walks, turns to the viewer and waves: 6.6 s at 30 frames per second, the 22 standard joints.
WALK = Path(__file__).with_name("walk.bvh")
