"""From a video to a scene: ``motionlab fit``. Nothing of the library imports this room.

A clip goes through it once, from the top:

    clip           what a detector wrote, the film that it is of, the camera: put together, checked  -> Clip
      detect       no keypoints: found in the film by an optional extra
    scene_fit      the people of a clip fitted under one camera, long footage in windows             -> SceneFit
    overlay        the skins over what filmed them                                                   -> an MP4
    scene_report   what there is to doubt: lines for a terminal, a page of HTML
    fit            ``run_clip``: all of it, into one folder
"""
