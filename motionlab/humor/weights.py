"""How much each energy of the test-time optimisation counts in each of its three stages."""

from __future__ import annotations

from dataclasses import asdict, dataclass

Triple = tuple[float, float, float]

_DATA = ("joints2d", "joints3d")
#: The terms that the official code evaluates in each stage, whatever its weights say.
ACTIVE = {
    1: _DATA,
    2: (*_DATA, "joints3d_smooth", "pose_prior", "shape_prior"),
    3: (*_DATA, "shape_prior", "motion_prior", "init_motion_prior", "joint_consistency", "bone_length", "contact_vel",
        "contact_height", "floor_reg"),
}  # fmt: skip
#: Frames that stage 3 rolls out in its first sub-stage.
SHORT = 15


@dataclass(frozen=True)
class Weights:
    """One triple per term: its weight in stages 1, 2 and 3. The fields are named as the functions of ``energies``.

    Source: the configurations of the official code: ``RGB`` its demo, ``JOINTS`` and ``KEYPOINTS`` its AMASS tasks
    (surface keypoints go into ``joints3d``). Its PROX-D set is left out: it needs the depth term, which is not here.
    """

    joints2d: Triple = (0.0, 0.0, 0.0)
    joints3d: Triple = (0.0, 0.0, 0.0)
    pose_prior: Triple = (0.0, 0.0, 0.0)
    shape_prior: Triple = (0.0, 0.0, 0.0)
    joints3d_smooth: Triple = (0.0, 0.0, 0.0)
    motion_prior: Triple = (0.0, 0.0, 0.0)
    init_motion_prior: Triple = (0.0, 0.0, 0.0)
    joint_consistency: Triple = (0.0, 0.0, 0.0)
    bone_length: Triple = (0.0, 0.0, 0.0)
    contact_vel: Triple = (0.0, 0.0, 0.0)
    contact_height: Triple = (0.0, 0.0, 0.0)
    floor_reg: Triple = (0.0, 0.0, 0.0)

    @property
    def pull(self) -> float:
        """The motion prior's weight in stage 3 beside a square metre between joints."""
        return self.motion_prior[2] / max(self.joint_consistency[2], 1e-9)

    def of(self, stage: int, *, frames: int | None = None, listed: bool = False) -> dict[str, float]:
        """The weights above zero of one stage, by term.

        frames: of the clip, from the second sub-stage of stage 3 on: the initial state's weight grows by frames/15,
        to keep its share beside terms that are summed over frames. None: as listed. (Shape and floor terms take their
        number of frames as an argument.)
        listed: also terms whose weight is listed, though the official code leaves them out in this stage: it lists
        smoothness and priors for stage 1, and has only the data there.
        """
        found = {name: triple[stage - 1] for name, triple in asdict(self).items()}
        if frames is not None:
            found["init_motion_prior"] *= frames / SHORT
        return {name: weight for name, weight in found.items() if weight and (listed or name in ACTIVE[stage])}


def _last(weight: float) -> Triple:
    return (0.0, 0.0, weight)


RGB = Weights(
    joints2d=(0.001, 0.001, 0.001),
    pose_prior=(0.04, 0.04, 0.0),
    shape_prior=(0.05, 0.05, 0.05),
    joints3d_smooth=(100.0, 100.0, 0.0),
    motion_prior=_last(0.075),
    init_motion_prior=_last(0.075),
    joint_consistency=_last(100.0),
    bone_length=_last(2000.0),
    contact_vel=_last(100.0),
    contact_height=_last(10.0),
    floor_reg=_last(0.167),
)
#: As RGB, but for contact velocities.
IMAPPER = Weights(**asdict(RGB) | {"contact_vel": _last(0.0)})
PROX = Weights(**asdict(RGB) | {"motion_prior": _last(0.05), "init_motion_prior": _last(0.05)})
#: As RGB, with a quarter of its smoothness, which draws walking people towards the camera, where they move less.
#: Chosen on synthetic walks that no table uses: stage 3's error there fell from 5 to 3 cm.
RGB_LIGHT = Weights(**asdict(RGB) | {"joints3d_smooth": (25.0, 25.0, 0.0)})
JOINTS = Weights(
    joints3d=(1.0, 1.0, 1.0),
    pose_prior=(2e-4, 2e-4, 0.0),
    shape_prior=(1.67e-4, 1.67e-4, 1.67e-4),
    joints3d_smooth=(10.0, 10.0, 0.0),
    motion_prior=_last(1e-3),
    init_motion_prior=_last(1e-3),
    joint_consistency=_last(1.0),
    bone_length=_last(10.0),
    contact_vel=_last(1.0),
    contact_height=_last(1.0),
)
KEYPOINTS = Weights(
    **asdict(JOINTS)
    | {"joints3d_smooth": (0.1, 0.1, 0.0), "motion_prior": _last(5e-4), "init_motion_prior": _last(5e-4)}
)
