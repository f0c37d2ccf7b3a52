"""An animator's tools: a motion of any skeleton in, a motion of the same skeleton out. Nothing of the library imports
this room.

A motion is put on the 22 standard joints, a model or a curve makes what is missing, and only what was made goes back to
the joints of the file; what was kept stays bit for bit.

    corrections    a model on any skeleton: retarget, fill in windows, transfer the change back
    filling        between keys, hidden joints; ``editor`` in JupyterLab (keyframes)
    restore        without noise and glitches, poses from handles, new motion
    looping        feet that stand stay where they are (foot_locking); the end meets the beginning
    rewriting      into the file that the motion came from
"""
