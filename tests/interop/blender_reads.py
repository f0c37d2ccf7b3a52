"""What Blender makes of a file: ``python blender_reads.py FILE FPS FRAME... [BACK]`` prints it, JSON.

BACK: a .glb, .gltf (its numbers in a .bin beside it) or .bvh that its exporter writes, with the settings that it has.

Run by itself, not imported: Blender as a module (``bpy``) does not share a process with others.
"""

import json
import os
import sys

import bpy


def main(path: str, fps: float, frames: list[int], back: str = "") -> dict:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    first = 0
    if path.endswith(".glb"):  # keys are in seconds; Blender puts them on frames of the scene's rate, from 0
        scene.render.fps, scene.render.fps_base = round(fps), 1.0
        bpy.ops.import_scene.gltf(filepath=path)
    else:  # what a person chooses in the dialogue: centimetres, facing where our world faces, the file's rate; from 1
        first = 1
        settings = {"global_scale": 0.01, "axis_forward": "Z", "axis_up": "Y", "update_scene_fps": True}
        bpy.ops.import_anim.bvh(filepath=path, **settings)
    objects = [o for o in bpy.data.objects if not o.name.startswith("Icosphere")]  # the shape that bones are drawn with
    armatures = [o for o in objects if o.type == "ARMATURE"]
    meshes = [o for o in objects if o.type == "MESH"]
    found = {
        "version": bpy.app.version_string,
        "fps": scene.render.fps / scene.render.fps_base,
        "objects": len(objects),
        "actions": len(bpy.data.actions),
        "spans": [[round(frame) for frame in action.frame_range] for action in bpy.data.actions],
        "armatures": {o.name: moved_by(o) for o in armatures},
        "lengths": {o.name: {bone.name: bone.length for bone in o.data.bones} for o in armatures},
        "meshes": {o.name: [m.object.name for m in o.modifiers if m.type == "ARMATURE"] for o in meshes},
        "joints": {o.name: [] for o in armatures},
        "vertices": {o.name: [] for o in meshes},
    }
    for frame in frames:
        scene.frame_set(first + frame)
        graph = bpy.context.evaluated_depsgraph_get()
        for o in armatures:
            posed = o.evaluated_get(graph)
            heads = {bone.name: list(posed.matrix_world @ bone.head) for bone in posed.pose.bones}
            found["joints"][o.name].append(heads)
        for o in meshes:
            posed = o.evaluated_get(graph)
            points = [list(posed.matrix_world @ vertex.co) for vertex in posed.to_mesh().vertices]
            found["vertices"][o.name].append(points)
    if back.endswith(".bvh"):
        bpy.context.view_layer.objects.active = armatures[0]
        bpy.ops.export_anim.bvh(filepath=back, frame_start=first, frame_end=first + found["spans"][0][1])
    elif back:
        bpy.ops.export_scene.gltf(filepath=back, export_format="GLTF_SEPARATE" if back.endswith(".gltf") else "GLB")
    return found


def moved_by(thing) -> str:
    """The action that plays on an object, with its slot where Blender has slots (4.4 and later)."""
    action = thing.animation_data and thing.animation_data.action
    slot = getattr(thing.animation_data, "action_slot", None)
    return f"{action.name} {slot.identifier if slot else ''}".strip() if action else ""


if __name__ == "__main__":
    frames, backs = ([word for word in sys.argv[3:] if word.isdigit() == digits] for digits in (True, False))
    print(json.dumps(main(sys.argv[1], float(sys.argv[2]), [int(frame) for frame in frames], *backs)), flush=True)
    os._exit(0)  # what exported falls over itself when Python takes it down
