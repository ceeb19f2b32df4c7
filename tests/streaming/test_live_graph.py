"""The live graph as a user of GTSAM gets it."""

from collections import Counter

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, X

from factorsfm import Stream
from tests.rendered import FRAMES, Maps, rendered, simulated_maps


def kinds(graph: gtsam.NonlinearFactorGraph) -> Counter[str]:
    return Counter(type(graph.at(k)).__name__ for k in range(graph.size()))


def test_the_graph_holds_poses_landmarks_and_affines_with_their_factors() -> None:
    shot = rendered("truck")
    with Stream(shot.camera, depth=Maps(simulated_maps("truck"))) as stream:
        empty, nothing = stream.graph()
        assert (empty.size(), nothing.size()) == (0, 0)
        updates = [stream.push(image) for image in shot.images]
        stream.trajectory()  # takes over what the graph is working on
        graph, values = stream.graph()
        keyframes, points = list(stream._mapper.keyframes), stream.points[0]
    assert len(updates) == FRAMES
    count = kinds(graph)
    poses = [k for k in range(FRAMES) if values.exists(X(k))]
    assert poses == keyframes
    assert all(values.exists(A(k)) for k in poses)
    keys = list(values.keys())
    landmarks = [key for key in keys if gtsam.symbolChr(key) == ord("l")]
    assert 0.8 * len(points) < len(landmarks) <= len(points)
    assert count["GenericProjectionFactorCal3_S2"] > 2 * len(landmarks)
    assert count["ProjectionFactorPPPCCal3_S2"] >= 0.9 * len(landmarks)
    assert count["PriorFactorCal3_S2"] == len(poses)
    assert count["PriorFactorPoint3"] == len(landmarks)
    assert values.atPoint3(L(gtsam.symbolIndex(landmarks[0]))).shape == (3,)
    # The copy is whole: GTSAM solves it, and stays where iSAM2 is.
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert graph.error(solved) > 0.9 * graph.error(values)
    moved = [np.linalg.norm(solved.atPose3(X(k)).translation() - values.atPose3(X(k)).translation()) for k in poses]
    assert max(moved) < 2e-3


def test_a_frame_becomes_a_keyframe_on_request() -> None:
    shot = rendered("truck")
    with Stream(shot.camera, depth=Maps(simulated_maps("truck"))) as plain:
        usual = [k for k, image in enumerate(shot.images) if plain.push(image).keyframe]
    wanted = next(k for k in range(5, FRAMES) if k not in usual)
    with Stream(shot.camera, depth=Maps(simulated_maps("truck"))) as stream:
        updates = [stream.push(image, keyframe=k == wanted) for k, image in enumerate(shot.images)]
        _, values = stream.graph()
    assert updates[wanted].keyframe
    assert values.exists(X(wanted))
    assert all(update.cam_from_world is not None for update in updates)
