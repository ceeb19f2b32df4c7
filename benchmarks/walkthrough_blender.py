"""Runs inside Blender: an exported scene, a cube, where its foot is seen, and pictures of it.

Its arguments, after ``--``: the exported .py, the .py that adds the cube, the folder to write to, the frames to render.
"""

import json
import math
import runpy
import sys

import bpy
from bpy_extras.object_utils import world_to_camera_view

SAMPLES = 128


def feet(scene, cube):
    """By frame the pixels of the corners of the lowest face, centres at integers."""
    width, height = scene.render.resolution_x, scene.render.resolution_y
    corners = [cube.matrix_world @ vertex.co for vertex in cube.data.vertices]
    lowest = sorted(corners, key=lambda corner: corner.z)[:4]
    found = {}
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        seen = [world_to_camera_view(scene, scene.camera, corner) for corner in lowest]
        found[frame] = [[x * width - 0.5, (1 - y) * height - 0.5] for x, y, _ in seen]
    return found


def light(scene, cube):
    """A sun and a sky, an orange cube, and a floor that shows nothing but the shadow."""
    paint = bpy.data.materials.new("paint")
    paint.use_nodes = True
    paint.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.7, 0.16, 0.02, 1)
    cube.data.materials.append(paint)
    bpy.ops.mesh.primitive_plane_add(size=20)
    bpy.context.object.is_shadow_catcher = True
    bpy.ops.object.light_add(type="SUN", rotation=(math.radians(30), math.radians(-40), 0))
    bpy.context.object.data.energy = 2.2
    bpy.context.object.data.angle = math.radians(8)
    scene.world = bpy.data.worlds.new("sky")
    scene.world.color = (0.25, 0.25, 0.25)
    scene.render.engine = "CYCLES"
    scene.cycles.samples = SAMPLES
    scene.cycles.use_denoising = False  # Debian's Blender has no denoiser
    scene.render.film_transparent = True
    scene.render.image_settings.color_mode = "RGBA"
    scene.view_settings.view_transform = "Standard"


script, add_cube, folder, *frames = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
runpy.run_path(script)
runpy.run_path(add_cube)
scene, cube = bpy.context.scene, bpy.context.object
bpy.context.view_layer.update()
with open(f"{folder}/feet.json", "w", encoding="utf-8") as file:
    json.dump(feet(scene, cube), file)
if frames:
    light(scene, cube)
for frame in map(int, frames):
    scene.frame_set(frame)
    scene.render.filepath = f"{folder}/{frame}.png"
    bpy.ops.render.render(write_still=True)
