"""Captury's table of joint positions, of its takes of people who fall."""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab.io.judging import axes_to_matrix

FPS = 50.0


def joints(path: Path, names: Iterable[str]) -> Tensor:
    """Reads some joints (T, K, 3) of a biomech.csv: metres, z up, in the world of the cameras (x and y change sign).

    The groups of line 3 count the columns off: a place takes three, angles four.
    """
    rows = [line.split(";") for line in path.read_text().splitlines()]
    starts, end = {}, 3
    for group in filter(None, (cell.strip() for cell in rows[2])):
        starts.setdefault(re.sub("Positions?$", "", group), end)
        end += 4 if group.endswith("Angles") else 3
    columns = [starts[name] + k for name in names for k in range(3)]
    table = np.array([[row[k] for k in columns] for row in rows[5 : 5 + int(rows[1][1])]], np.float32)
    places = torch.from_numpy(table).double().unflatten(-1, (-1, 3)) / 1000
    return (places @ axes_to_matrix("-x-yz").T).float()
