"""Two things that fill the image and move against each other: told apart by how they turn."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.frames.frame import Frame
from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.graph.process import GraphProcess
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.map_update import update_map
from factorsfm.mapping.mapper import Mapper
from factorsfm.mapping.point_map import PointMap
from factorsfm.motion.readings import solution_from
from factorsfm.motion.turning import turning_groups
from factorsfm.polish.camera_starts import best_solution
from factorsfm.streaming.frame_update import frame_update
from factorsfm.support.options import MapperOptions, Options, PolishOptions
from tests.estimation_problems import (
    angles_between,
    make_problem,
    mapped_images,
    perturbed,
    tracks_at,
    with_points,
)

SMALL_PX = 0.1


def with_follower(count, width, frames=16):
    """A problem whose last `count` points are of a body that follows the camera and sways, at the left of the image.

    Args:
        width: of the body, as a share of the image.

    Returns:
        The problem, and how many points are the scene's, which are right of the body.
    """
    problem = make_problem("handheld", frames=frames, points=240, parallax=0.02, noise_px=SMALL_PX)
    truth, o, k = problem.truth, problem.observations, problem.frames
    edge = (width - 0.5) * 640 / problem.focal
    first = o.pixels[o.first, 0] / problem.focal
    scene = np.flatnonzero(first > edge)
    rng = np.random.default_rng(0)
    body = np.column_stack([rng.uniform(-320 / problem.focal, edge, count), rng.uniform(-0.25, 0.25, count)])
    body = np.column_stack([body, np.ones(count)]) * rng.uniform(0.45, 0.55, count)[:, None]
    sway = 0.004 * np.sin(np.arange(k)[:, None] * [1.3, 0.7, 0.4])
    seen = body[:, None] + sway
    xy = problem.focal * seen[..., :2] / seen[..., 2:] + SMALL_PX * rng.standard_normal((count, k, 2))
    part = replace(problem, truth=truth.of(scene), points=problem.points[scene], observations=o.of(scene))
    return with_points(part, body, xy), len(scene)


@pytest.mark.parametrize("count", [40, 120])
def test_groups_are_the_scene_and_the_body(count):
    problem, scene = with_follower(count, 0.4)
    o = problem.observations
    groups = turning_groups(o, problem.truth.normalized(o), problem.focal)
    assert len(groups) >= 2
    assert all(group[:scene].all() or not group[:scene].any() or not group[scene:].any() for group in groups)
    assert not (groups[0][:scene].any() and groups[0][scene:].any())
    assert max(group[:scene].mean() for group in groups) > 0.6


def test_what_turns_together_is_no_group():
    problem = make_problem("handheld", frames=16, points=160, parallax=0.005, noise_px=SMALL_PX)
    o = problem.observations
    assert turning_groups(o, problem.truth.normalized(o), problem.focal) == []


@pytest.mark.parametrize("count", [60, 140])
def test_a_solution_that_went_with_both_is_given_up(count):
    problem, scene = with_follower(count, 0.4)
    wrong = solution_from(perturbed(problem.truth, structure=0.2), problem.observations, PolishOptions())
    rotations = problem.truth.rotation
    assert problem.focal * angles_between(wrong.state.rotation, rotations).max() > 3.0
    found = best_solution(wrong.state, problem.observations, Options())
    assert not (found.kept >= scene).any()
    assert len(found.kept) > 0.9 * scene
    assert 0.01 < problem.focal * angles_between(found.adjustment.state.rotation, rotations).max() < 0.6
    assert 0.0 < found.rival < 1.0


def test_a_young_map_begins_again_without_the_body():
    problem, scene = with_follower(120, 0.4, frames=5)
    wrong = solution_from(perturbed(problem.truth, structure=0.2), problem.observations, PolishOptions())
    images = mapped_images(problem, wrong.state, guided=range(4))
    points = PointMap()
    points.set(np.arange(len(problem.points)), wrong.state.points)
    update = update_map(MapCopy(images, points, MapperOptions(), problem.focal), KeyframeGraph())
    assert update.committed
    assert not (update.ids >= scene).any()
    assert update.moving > 100
    assert update.begins_again
    assert "move by themselves" in update.note
    turn = [angles_between(r[None], problem.truth.rotation[k][None])[0] for k, (r, _) in update.poses.items()]
    assert 1e-6 < problem.focal * max(turn) < 1.5


def test_a_map_that_changes_its_mind_says_that_the_poses_before_are_void():
    problem, _ = with_follower(120, 0.4, frames=30)
    mapper = Mapper(GraphProcess(), problem.focal, 640, Options.preset_named("geometry"), has_prior=False)
    updates = []
    for k in range(8):
        frame = Frame(k, np.zeros((360, 640, 3), np.uint8), f"{k:06d}", None)
        image = mapper.add(tracks_at(k, *problem.of_frame(k)), lambda: None)
        updates.append(frame_update(frame, image, mapper, [], focal_changed=False))
        assert not mapper.news.starts_anew  # the graph goes on, with the factors of an IMU and of the caller
    mapper.close()
    first = next(update for update in updates if update.starts_anew)
    assert first.index == 6
    again, at_odds = first.note.split("; ")
    assert again == "120 tracks move by themselves, the map begins again without them"
    assert at_odds.startswith("49% of the image is at odds with the map")
    assert all(update.starts_anew == bool(update.note) for update in updates)
