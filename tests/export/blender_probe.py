"""Runs inside Blender: executes an exported script and reports the scene that has come of it.

Its arguments, after ``--``: the exported .py, a .chan file, an .obj file, an .exr file, the report to write.
"""

import json
import runpy
import sys
import tempfile

import addon_utils
import bpy


def matrix(value):
    return [list(row) for row in value]


def report_cameras(scene, camera):
    frames = []
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        graph = bpy.context.evaluated_depsgraph_get()
        render = scene.render
        evaluated = camera.evaluated_get(graph)
        projection = evaluated.calc_matrix_camera(
            graph,
            x=render.resolution_x,
            y=render.resolution_y,
            scale_x=render.pixel_aspect_x,
            scale_y=render.pixel_aspect_y,
        )
        frames.append(
            {
                "frame": frame,
                "world_from_camera": matrix(evaluated.matrix_world),
                "projection": matrix(projection),
                "lens": evaluated.data.lens,
            }
        )
    return frames


def report_object(scene, null):
    (cloud,) = null.children
    places = {}
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        places[frame] = [list(cloud.matrix_world @ vertex.co) for vertex in cloud.data.vertices]
    keys = sorted({key.co[0] for curve in null.animation_data.action.fcurves for key in curve.keyframe_points})
    return {"keys": keys, "places": places}


def report_scene(script):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    runpy.run_path(script)
    scene = bpy.context.scene
    camera = scene.camera
    mesh = bpy.data.objects["factorsfm points"].data
    report = {
        "size": [scene.render.resolution_x, scene.render.resolution_y],
        "fps": scene.render.fps / scene.render.fps_base,
        "range": [scene.frame_start, scene.frame_end],
        "sensor_width": camera.data.sensor_width,
        "keys": sorted({key.co[0] for curve in camera.animation_data.action.fcurves for key in curve.keyframe_points}),
        "not_registered": list(camera["not_registered"]),
        "frames": report_cameras(scene, camera),
        "points": [list(vertex.co) for vertex in mesh.vertices],
        "colors": [list(value.color_srgb) for value in mesh.attributes["color"].data],
        "background": None,
        "objects": {thing.name: report_object(scene, thing) for thing in bpy.data.objects if thing.type == "EMPTY"},
    }
    if camera.data.show_background_images:
        (behind,) = camera.data.background_images
        files = {}
        for frame in (scene.frame_start, scene.frame_end):
            scene.frame_set(frame)
            files[frame] = behind.image.filepath_from_user(image_user=behind.image_user)
        report["background"] = {"source": behind.image.source, "size": list(behind.image.size), "files": files}
    addon_utils.enable("io_anim_nuke_chan")
    bpy.context.view_layer.objects.active = camera
    with tempfile.NamedTemporaryFile(suffix=".chan") as file:
        bpy.ops.export.export_chan(filepath=file.name, rotation_order="ZXY")
        report["written_chan"] = file.read().decode()
    return report


def report_chan(path):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    addon_utils.enable("io_anim_nuke_chan")
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.view_layer.objects.active = camera
    camera.rotation_mode = "QUATERNION"
    bpy.ops.import_scene.import_chan(
        filepath=path, z_up=False, rotation_order="ZXY", sensor_width=36.0, sensor_height=36.0 * 480 / 640 * 600 / 1200
    )
    scene = bpy.context.scene
    keys = sorted({key.co[0] for curve in camera.animation_data.action.fcurves for key in curve.keyframe_points})
    scene.frame_start, scene.frame_end = int(keys[0]), int(keys[-1])
    return {"keys": keys, "frames": report_cameras(scene, camera)}


def report_obj(path):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.obj_import(filepath=path, forward_axis="Y", up_axis="Z")
    (thing,) = bpy.context.selected_objects
    return [
        [list(thing.matrix_world @ thing.data.vertices[i].co) for i in face.vertices] for face in thing.data.polygons
    ]


def report_exr(path):
    image = bpy.data.images.load(path)
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    rows = [0, height // 3, height - 1]  # from the bottom
    pixels = list(image.pixels)
    return {
        "size": [width, height],
        "is_float": image.is_float,
        "rows": {row: pixels[4 * width * row : 4 * width * (row + 1)] for row in rows},
    }


def report_lens(path, exr):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    clip = bpy.data.movieclips.load(exr)
    runpy.run_path(path)
    camera = clip.tracking.camera
    names = (
        "distortion_model",
        "sensor_width",
        "pixel_aspect",
        "focal_length",
        "focal_length_pixels",
        "k1",
        "k2",
        "k3",
    )
    center = camera.principal_point_pixels if hasattr(camera, "principal_point_pixels") else camera.principal
    return {**{name: getattr(camera, name) for name in names}, "center": list(center)}


script, chan, obj, exr, lens, output = sys.argv[sys.argv.index("--") + 1 :]
found = {"scene": report_scene(script), "chan": report_chan(chan), "obj": report_obj(obj), "exr": report_exr(exr)}
found["lens"] = report_lens(lens, exr)
with open(output, "w", encoding="utf-8") as file:
    json.dump(found, file)
