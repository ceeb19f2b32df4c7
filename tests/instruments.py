"""What instruments on a camera measure of rendered shots, as the files that the examples of the pages read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from factorsfm import DepthFolder, Reconstruction, Stream, read_camera, read_frames
from factorsfm.camera.files import camera_to_json
from factorsfm.camera.projection import normalized_from_pixels
from factorsfm.inertial.recording import ImuNoise
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import RenderedShot, handheld_path, simulate_imu
from factorsfm.synthetic.scene import room_camera
from factorsfm.synthetic.shot import FRAMES_PER_SECOND, render_views

METRES = 5.3  # in a unit of the rendered shot
SURVEYED_FRAME = 2
WALK_FRAMES = 108
_WALK = handheld_path(WALK_FRAMES / FRAMES_PER_SECOND + 0.5, 1)
_WALK_TIMES = np.arange(WALK_FRAMES) / FRAMES_PER_SECOND
_DOWN = np.array([0.5, 9.7, 1.2]) / np.linalg.norm([0.5, 9.7, 1.2])


def write_measurements(shot: RenderedShot, folder: Path) -> None:
    """Odometry, fixes and a surveyed corner of a shot that lies in the folder, in metres."""
    poses = [pose.inverse() for pose in shot.cam_from_world]
    rows = np.array([[*(METRES * pose.translation), *pose.rotation.quat] for pose in poses])
    np.savetxt(folder / "odometry.csv", rows, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    turn = cv2.Rodrigues(np.array([0.2, -0.4, 1.1]))[0]  # from the first camera to east, north and up
    origin = np.array([412.0, -77.0, 30.0])
    fixes = rows[:, :3] @ turn.T + origin
    np.savetxt(folder / "fixes.csv", fixes, delimiter=",", header="east,north,up", comments="")
    half = np.array([0.2, -0.4, 1.1]) / 2
    angle = float(np.linalg.norm(half))
    np.savetxt(folder / "first.txt", [*origin, *(np.sin(angle) * half / angle), np.cos(angle)])
    np.savetxt(folder / "surveyed.txt", [*_surveyed_corner(shot, folder)])
    _write_tracks(shot, folder / "tracks.csv")


def _write_tracks(shot: RenderedShot, path: Path) -> None:
    """Three points of the first frame, marked in all frames."""
    camera, rows = shot.camera, ["track,frame,x,y"]
    for name, (x, y) in (("left", (60, 60)), ("middle", (128, 80)), ("right", (190, 70))):
        ray = np.append(normalized_from_pixels(camera, np.array([[x, y]], np.float64))[0], 1.0)
        point = shot.cam_from_world[0].inverse() * (shot.depths[0][y, x] * ray)
        for frame, pose in enumerate(shot.cam_from_world):
            u, v = camera.img_from_cam(pose * point)
            rows.append(f"{name},{frame},{u:.3f},{v:.3f}")
    path.write_text("\n".join(rows) + "\n")


def _surveyed_corner(shot: RenderedShot, folder: Path) -> list[float]:
    """A corner that a stream follows, in the frame in which it is surveyed, and its place in metres."""
    with Stream(read_camera(folder / "camera.json"), depth=DepthFolder(folder / "depth", "inverse")) as stream:
        for frame in read_frames(folder / "shot.mp4"):
            stream.push(frame, keyframe=True)
            stream.trajectory()
            if frame.index == SURVEYED_FRAME:
                (pixels, mapped), ids = stream.tracks, stream.track_ids
        mapped = mapped & np.isin(ids, stream.track_ids)  # seen until the end
    depths = shot.depths[SURVEYED_FRAME]
    inside = np.clip(pixels[mapped].round().astype(int), 3, [252, 140])
    flat = np.array([np.ptp(depths[y - 2 : y + 3, x - 2 : x + 3]) < 0.02 for x, y in inside])
    moves = (
        np.linalg.norm(inside - [128, 72], axis=1) / depths[inside[:, 1], inside[:, 0]]
    )  # as the camera comes nearer
    chosen = int(np.argmax(moves * flat))
    (x, y), (column, row) = pixels[mapped][chosen], inside[chosen]
    ray = np.append(normalized_from_pixels(shot.camera, np.array([[x, y]]))[0], 1.0)
    place = shot.cam_from_world[SURVEYED_FRAME].inverse() * (depths[row, column] * ray)
    return [x, y, *(METRES * place)]


def write_walk(folder: Path) -> None:
    """A handheld video of a room in metres, and the recording of an IMU on its camera."""
    camera = room_camera(320, 180)
    (folder / "walk.json").write_text(json.dumps(camera_to_json(camera)))
    video = cv2.VideoWriter(str(folder / "walk.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_SECOND, (320, 180))
    for image in render_views(_WALK.poses(_WALK_TIMES), 320, 180, 1):
        video.write(image)
    video.release()
    imu = simulate_imu(
        _WALK, 200.0, gravity=9.81 * _DOWN, gyroscope_bias=[0.01, -0.02, 0.015],
        accelerometer_bias=[0.1, -0.05, 0.15], noise=ImuNoise(), seed=1,
    )  # fmt: skip
    samples = np.column_stack([imu.time, imu.gyroscope, imu.accelerometer])
    names = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    np.savetxt(folder / "imu.csv", samples, delimiter=",", header=names, comments="")
    (folder / "imu.json").write_text(json.dumps({"file": "imu.csv", "cam_from_imu": [0, 0, 0, 1], "time_offset": 0}))


def _scale(centers: np.ndarray, truth: np.ndarray) -> float:
    """Lengths of a path over the true ones."""
    found, true = centers - centers[0], truth - truth[0]
    return float(np.sum(np.linalg.norm(found, axis=1)) / np.sum(np.linalg.norm(true, axis=1)))


def _check_metric(names: dict[str, Any], shot: RenderedShot, tolerance: float) -> None:
    reconstruction: Reconstruction = names["reconstruction"]
    assert reconstruction.metric
    truth = METRES * pose_arrays(shot.cam_from_world)[1]
    assert abs(_scale(reconstruction.camera_centers(), truth) - 1.0) < tolerance


def _check_landmark(names: dict[str, Any], shot: RenderedShot) -> None:
    """Lengths as well as the parallax of ten frames shows the distance of one corner."""
    std = names["reconstruction"].control.scale_std
    assert 0.004 < std < 0.02
    _check_metric(names, shot, 4 * std)
    found = names["reconstruction"].points[names["reconstruction"].track_ids == names["track"]]
    np.testing.assert_allclose(found[0], names["place"], atol=0.02 * np.linalg.norm(names["place"]))


def _check_walk(names: dict[str, Any], shot: RenderedShot) -> None:
    """Scale within 2 %, gravity within half a degree, twice that where the mounting had to be found."""
    rotations, centers = pose_arrays(_WALK.poses(_WALK_TIMES))
    frames = names["reconstruction"].registered
    rows = [frame.index for frame in frames]
    if "solved" in names:
        from gtsam.symbol_shorthand import G, X

        solved = names["solved"]
        places = np.array([solved.atPose3(X(i)).translation() for i in rows])
        first, up = solved.atPose3(X(rows[0])).rotation().matrix(), -solved.atPoint3(G(0))
    else:
        places = names["reconstruction"].camera_centers()
        first, up = frames[0].cam_from_world.rotation.matrix().T, np.array(names["reconstruction"].imu.up)
    assert abs(_scale(places, centers[rows]) - 1.0) < 0.02
    off = (first @ rotations[rows[0]].T @ -_DOWN) @ up / np.linalg.norm(up)
    assert np.degrees(np.arccos(min(1.0, off))) < (0.5 if "solved" in names else 1.0)  # mounting known, or found


# By a file that an example reads: whether its result is true.
CHECKS: dict[str, Callable[[dict[str, Any], RenderedShot], None]] = {
    "odometry.csv": lambda names, shot: _check_metric(names, shot, 0.01),
    "fixes.csv": lambda names, shot: _check_metric(names, shot, 0.01),
    "surveyed.txt": _check_landmark,
    "walk.mp4": _check_walk,
}
