"""What aitviewer makes of an AMASS file: ``python aitviewer_reads.py MOTION.npz MODELS OUT.npz FPS``, by its own reader
and the body models of the package smplx. Writes the joints, z up, as they are and at another rate."""

import sys

import numpy as np
from aitviewer.configuration import CONFIG
from aitviewer.models.smpl import SMPLLayer
from aitviewer.renderables.smpl import SMPLSequence

source, models, target, fps = sys.argv[1:]
CONFIG.update_conf({"smplx_models": models, "device": "cpu"})
layer = SMPLLayer(model_type="smplh", gender="neutral", ext="npz", device=CONFIG.device)
read = [SMPLSequence.from_amass(source, smpl_layer=layer, z_up=False, fps_out=rate) for rate in (None, float(fps))]
np.savez(target, joints=read[0].joints, other=read[1].joints)
