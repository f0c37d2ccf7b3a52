"""From any named skeleton to the standard one: names and rest poses, the transfer itself, and the legs."""

from motionlab.retarget.rigs import RIGS, Match, match
from motionlab.retarget.transfer import Retargeted, retarget

__all__ = ["RIGS", "Match", "Retargeted", "match", "retarget"]
