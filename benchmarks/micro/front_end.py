"""Cost of what runs at a frame: tracking, registration, networks."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.inputs import NETWORK_FILES
from benchmarks.markdown import table
from benchmarks.micro.timing import DEPTH_SIGMA, PIXEL_SIGMA, seconds
from factorsfm import DepthModel, Frame, TrackerOptions
from factorsfm.camera.projection import normalized_from_pixels
from factorsfm.mapping.registration import register_image
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.synthetic import render_shot, synthetic_scene
from factorsfm.tracks.flow import FlowTracker


def front_end(models: Path) -> str:
    """Table of the milliseconds per frame of the tracker, the registration and the networks."""
    shot = render_shot("handheld", 8, 960, 540)
    rows: list[list[object]] = []
    for count in (300, 1000):
        tracker = FlowTracker(TrackerOptions(max_tracks=count))
        tracker.track(shot.images[0])
        times = []
        for image in shot.images[1:]:
            start = time.perf_counter()
            alive = len(tracker.track(image).ids)
            times.append(time.perf_counter() - start)
        rows.append([f"tracking, 960x540, {alive} tracks", f"{1e3 * np.median(times):.1f}"])
    scene = synthetic_scene("dolly", 2, 1200, parallax=0.05)
    ids, xy = scene.observe(PIXEL_SIGMA)[1]
    start_pose = scene.cam_from_world[0]
    for count in (250, 1000):
        few = ids[:count]
        observed = normalized_from_pixels(scene.camera, xy[:count])
        inverse = scene.inverse_depth(1, few, noise=DEPTH_SIGMA)
        for what, depth in (("", None), (" with depth", ImageDepth(inverse, np.ones(len(few)), 1.0))):
            spent = seconds(
                partial(
                    register_image,
                    scene.points[few],
                    observed,
                    start_pose.rotation.matrix(),
                    start_pose.translation,
                    focal=float(scene.camera.focal_length_x),
                    sigma=PIXEL_SIGMA,
                    inlier_px=3.0,
                    depth=depth,
                )
            )
            rows.append([f"registration{what}, {len(few)} points", f"{1e3 * spent:.1f}"])
    frame = Frame(0, shot.images[0], "0", None)
    for name, file in NETWORK_FILES.items():
        if (models / file).is_file():
            rows.append([f"network {name}", f"{1e3 * seconds(partial(DepthModel(models / file), frame)):.1f}"])
        else:
            rows.append([f"network {name}: {file} is not in {models}", "–"])
    return table(["part", "ms per frame"], rows)
