"""Colours by role, the same in every figure; distinguishable with a colour-vision deficiency.

Source: Okabe & Ito 2008 (black, orange, sky, green, blue, vermillion, purple), Tol 2021 (wine, indigo); brown is ours.
"""

from matplotlib.colors import to_rgb

ROLE = {  # what a thing is in the argument, and the one colour it has in all notebooks
    "truth": "#1b1b1b",
    "observation": "#8a8a8a",
    "baseline": "#e69f00",
    "ours": "#0072b2",
    "stage2": "#56b4e9",
    "stage3": "#332288",
    "axis-angle": "#d55e00",
    "6d": "#009e73",
    "quaternion": "#882255",
    "synthetic": "#cc79a7",
    "real": "#664400",
}
#: Behind every scene and plot: paper, floor tiles, quiet lines, text.
PAPER, TILE, LINE, INK = "#f6f7f9", "#e4e7ec", "#c3c9d3", "#30343b"


def colour(role: str | tuple[float, float, float]) -> tuple[float, float, float]:
    """Returns the colour of a role as (r, g, b) in 0..1; a colour stands for itself.

    Raises:
        KeyError: no such role; lists the roles.
    """
    if isinstance(role, str) and role not in ROLE:
        raise KeyError(f"no role {role!r}; roles are {', '.join(ROLE)}")
    return to_rgb(ROLE[role] if isinstance(role, str) else role)


def blend(a: str | tuple, b: str | tuple, share: float) -> tuple[float, float, float]:
    """Computes the colour a fraction ``share`` of the way from a to b, (r, g, b) in 0..1."""
    return tuple((1 - share) * x + share * y for x, y in zip(to_rgb(a), to_rgb(b), strict=True))


def sides(base: str | tuple) -> dict[str, tuple[float, float, float]]:
    """Computes three tones of one colour: the left of a body is light, the right is dark, the middle between."""
    tones = {"left": ("white", 0.42), "middle": ("white", 0.16), "right": ("black", 0.2)}
    return {side: blend(base, *tone) for side, tone in tones.items()}


def side_of(name: str) -> str:
    """Returns "left", "right" or "middle", from the name of a joint or keypoint in the usual spellings.

    >>> [side_of(name) for name in ("left_hip", "RightArm", "lfemur", "Hand_L_end", "mixamorig:LeftFoot", "lowerback")]
    ['left', 'right', 'left', 'left', 'left', 'middle']
    """
    plain = name.rsplit(":", 1)[-1].lower()
    words = plain.replace(".", "_").replace(" ", "_").split("_")
    for side in ("left", "right"):
        if side in plain or side[0] in words or plain.startswith(tuple(side[0] + limb for limb in _LIMBS)):
            return side
    return "middle"


_LIMBS = ("femur", "tibia", "foot", "toes", "humerus", "radius", "wrist", "hand", "fingers", "thumb", "clavicle", "hip",
          "knee", "ankle", "shoulder", "elbow")  # fmt: skip
