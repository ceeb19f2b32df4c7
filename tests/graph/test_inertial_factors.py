import subprocess
import sys
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, G, L, S, V, X

from factorsfm.graph.inertial_factors import bias_prior, gravity_prior, inertial_factor, inertial_graph, preintegrated
from factorsfm.inertial.alignment import align_inertial
from factorsfm.inertial.preintegration import inertial_steps, preintegrate
from factorsfm.inertial.recording import GRAVITY, ImuNoise
from factorsfm.support.errors import InputError
from factorsfm.support.rotations import exponential
from factorsfm.synthetic.imu import handheld_path, simulate_imu
from tests.graph.test_factors import assert_gtsam_derivatives
from tests.inertial_problems import METRES_PER_UNIT, angle, inertial_problem

PATH = handheld_path(3.0, 1)
DOWN = GRAVITY * np.array([0.1, 0.98, -0.17]) / np.linalg.norm([0.1, 0.98, -0.17])
BIASES = np.array([0.01, -0.02, 0.005]), np.array([0.1, 0.2, -0.05])
TIMES = 1.013, 1.317  # between samples
CAM_FROM_IMU = exponential(np.array([[0.4, -1.0, 0.3]]))[0]


def recording(rate=400.0, **options):
    """Of an IMU whose biases in the camera's axes are `BIASES`."""
    biases = (bias @ CAM_FROM_IMU for bias in BIASES)
    names = "gyroscope_bias", "accelerometer_bias"
    options = {"cam_from_imu": CAM_FROM_IMU, "time_offset": 0.3, **dict(zip(names, biases, strict=True)), **options}
    return simulate_imu(PATH, rate, gravity=DOWN, **options)


def true_values(scale=1.0):
    """States of the frames 4 and 7 at `TIMES`, in units of this many metres, and gravity."""
    values, motion = gtsam.Values(), PATH.motion(np.array(TIMES))
    for k, i in enumerate((4, 7)):
        values.insert(X(i), gtsam.Pose3(gtsam.Rot3(motion.world_from_cam[k]), motion.center[k] / scale))
        values.insert(V(i), motion.velocity[k] / scale)
        values.insert(B(i), gtsam.imuBias.ConstantBias(BIASES[1] / scale, BIASES[0]))
    values.insert(G(0), DOWN / scale)
    return values


def factor(gravity_key=None, scale=1.0, biases=BIASES, gravity=DOWN, **options):
    return inertial_factor(4, 7, preintegrated(recording(**options), *TIMES, gravity, *biases, scale), gravity_key)


@pytest.mark.parametrize("gravity_key", [None, G(0)])
@pytest.mark.parametrize("scale", [1.0, METRES_PER_UNIT])
def test_the_error_vanishes_at_the_truth(gravity_key, scale):
    """It falls with the fourth power of the rate (its root with the square), in a map of any unit."""
    errors = [factor(gravity_key, scale, rate=rate).error(true_values(scale)) for rate in (200.0, 400.0)]
    assert errors[0] < 0.02
    assert errors[1] < 0.15 * errors[0]
    moved = true_values(scale)
    moved.update(V(7), moved.atVector(V(7)) + np.array([0.02, 0.0, 0.0]) / scale)
    assert factor(gravity_key, scale).error(moved) > 50.0


def test_a_gravity_to_be_estimated_overrides_that_of_the_measurements():
    wrong = np.array([0.0, GRAVITY, 0.0])
    assert factor(gravity=wrong).error(true_values()) > 1000.0
    assert factor(G(0), gravity=wrong).error(true_values()) < 0.01


def test_the_mean_of_a_step_beats_the_force_taken_at_its_start():
    """GTSAM's own step is of first order: without the half turn the same samples are off by far more."""
    samples, (start, end) = recording(200.0).at_camera(), TIMES
    plain = gtsam.PreintegratedCombinedMeasurements(
        preintegrated_parameters(samples.noise), gtsam.imuBias.ConstantBias(BIASES[1], BIASES[0])
    )
    inside = (samples.time >= start) & (samples.time < end)
    for force, turn in zip(samples.accelerometer[inside], samples.gyroscope[inside], strict=True):
        plain.integrateMeasurement(force, turn, 0.005)
    truth = preintegrate(recording(1600.0).at_camera(), *(np.array([t]) for t in TIMES), *BIASES).velocity[0]
    ours = preintegrated(samples, start, end, DOWN, *BIASES).deltaVij()
    assert np.linalg.norm(ours - truth) < 0.05 * np.linalg.norm(plain.deltaVij() - truth)


def preintegrated_parameters(noise):
    parameters = gtsam.PreintegrationCombinedParams(DOWN)
    parameters.setGyroscopeCovariance(noise.gyroscope**2 * np.eye(3))
    parameters.setAccelerometerCovariance(noise.accelerometer**2 * np.eye(3))
    return parameters


def test_it_agrees_with_gtsams_own_mounting():
    """`body_P_sensor` of a rotation; the biases of that one are in the IMU's axes."""
    mounted = recording(800.0)
    parameters = preintegrated_parameters(mounted.noise)
    parameters.setBodyPSensor(gtsam.Pose3(gtsam.Rot3(CAM_FROM_IMU), np.zeros(3)))
    own = gtsam.PreintegratedCombinedMeasurements(
        parameters, gtsam.imuBias.ConstantBias(BIASES[1] @ CAM_FROM_IMU, BIASES[0] @ CAM_FROM_IMU)
    )
    k = int(np.searchsorted(mounted.time, 0.7))
    start, end = mounted.time[k] + 0.3, mounted.time[k + 240] + 0.3
    for force, turn in zip(mounted.accelerometer[k : k + 240], mounted.gyroscope[k : k + 240], strict=True):
        own.integrateMeasurement(force, turn, 1 / 800)
    ours = preintegrated(mounted, start, end, DOWN, *BIASES)
    assert np.linalg.norm(ours.deltaRij().logmap(own.deltaRij())) < 1e-3
    np.testing.assert_allclose(ours.deltaVij(), own.deltaVij(), atol=5e-3)
    np.testing.assert_allclose(ours.deltaPij(), own.deltaPij(), atol=1e-3)


def test_a_lever_arm_is_taken_away():
    errors = [factor(rate=400.0, lever_arm=arm).error(true_values()) for arm in ([0, 0, 0], [0.06, -0.03, 0.02])]
    assert errors[1] < errors[0] + 0.2
    ignored = replace(recording(lever_arm=[0.06, -0.03, 0.02]), lever_arm=np.zeros(3))
    assert inertial_factor(4, 7, preintegrated(ignored, *TIMES, DOWN, *BIASES)).error(true_values()) > 5.0


def test_gtsams_own_lever_arm_leaves_out_the_angular_acceleration():
    """Why `body_P_sensor` stays unset: with it the velocity is hardly better than with no lever arm at all."""
    arm, none = np.array([0.06, -0.03, 0.02]), np.zeros(3)
    off, at_center = (simulate_imu(PATH, 800.0, lever_arm=lever) for lever in (arm, none))
    truth = preintegrate(at_center, *(np.array([t]) for t in TIMES), none, none).velocity[0]
    parameters = preintegrated_parameters(off.noise)
    parameters.setBodyPSensor(gtsam.Pose3(gtsam.Rot3(), arm))
    own = gtsam.PreintegratedCombinedMeasurements(parameters)
    samples = zip(*(values[0] for values in inertial_steps(off, *(np.array([t]) for t in TIMES))), strict=True)
    for duration, turn, force in samples:
        own.integrateMeasurement(force, turn, max(duration, 1e-9))
    assert np.linalg.norm(preintegrated(off, *TIMES, DOWN, none, none).deltaVij() - truth) < 1e-5
    assert np.linalg.norm(own.deltaVij() - truth) > 5e-3


@pytest.mark.parametrize("gravity_key", [None, G(0)])
@pytest.mark.parametrize("scale", [1.0, METRES_PER_UNIT])
def test_derivatives(gravity_key, scale):
    """Away from the truth and from the biases of the preintegration, by central differences of the residual itself."""
    values = true_values(scale)
    values.update(X(7), values.atPose3(X(7)).retract(np.array([1e-3, -2e-3, 1e-3, 1e-3, 2e-3, -1e-3])))
    values.update(V(4), values.atVector(V(4)) + [1e-3, 2e-3, -3e-3])
    tested = factor(gravity_key, scale)
    loose = tested.cloneWithNewNoiseModel(gtsam.noiseModel.Unit.Create(15))
    assert_gtsam_derivatives(loose, values)


def test_its_covariance_is_that_of_our_preintegration():
    measurements = preintegrated(recording(), *TIMES, DOWN, *BIASES)
    ours = preintegrate(recording().at_camera(), *(np.array([t]) for t in TIMES), *BIASES).covariance[0]
    order = [0, 1, 2, 6, 7, 8, 3, 4, 5]  # GTSAM has the position before the velocity
    theirs, ours = measurements.preintMeasCov()[:9, :9], ours[np.ix_(order, order)]
    ratio = np.sqrt(np.diag(theirs) / np.diag(ours))
    np.testing.assert_allclose(ratio, 1.0, atol=0.05)
    assert measurements.preintMeasCov()[9, 9] == pytest.approx(ImuNoise().accelerometer_walk ** 2 * 0.304, rel=1e-3)


@pytest.mark.parametrize("gravity_key", [None, G(0)])
def test_it_crosses_to_another_process(gravity_key, tmp_path):
    graph, values = gtsam.NonlinearFactorGraph(), true_values()
    graph.add(factor(gravity_key))
    graph.add(bias_prior(4, ImuNoise(), *BIASES))
    graph.add(gravity_prior(G(0), DOWN))
    values.update(V(4), np.array([0.1, 0.0, 0.2]))
    (tmp_path / "graph").write_text(graph.serialize())
    (tmp_path / "values").write_text(values.serialize())
    program = (
        "import sys, gtsam; g, v = gtsam.NonlinearFactorGraph(), gtsam.Values();"
        "g.deserialize(open(sys.argv[1]).read()); v.deserialize(open(sys.argv[2]).read());"
        "print(g.size(), repr(g.error(v)), repr(g.linearize(v).error(v.zeroVectors())))"
    )
    arguments = [sys.executable, "-c", program, tmp_path / "graph", tmp_path / "values"]
    there = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout.split()
    assert there[0] == "3"
    assert float(there[1]) == pytest.approx(graph.error(values), rel=1e-12)
    assert float(there[2]) == pytest.approx(graph.linearize(values).error(values.zeroVectors()), rel=1e-12)
    back = gtsam.NonlinearFactorGraph()
    back.deserialize(graph.serialize())
    assert back.equals(graph, 1e-12)


def test_the_prior_of_gravity_holds_its_magnitude_alone():
    turned = exponential(np.array([[0.1, 0.0, 0.05]]))[0] @ DOWN
    values = gtsam.Values()
    values.insert(G(0), turned / METRES_PER_UNIT)
    assert gravity_prior(G(0), DOWN, METRES_PER_UNIT).error(values) < 5.0
    values.update(G(0), 1.01 * DOWN / METRES_PER_UNIT)
    assert gravity_prior(G(0), DOWN, METRES_PER_UNIT).error(values) > 10.0


def test_times_outside_the_recording_are_refused():
    with pytest.raises(InputError, match=r"covers 0.000 to 3.000 s; 2.900 to 3.200 s are asked for"):
        preintegrated(recording(), 2.9, 3.2, DOWN, *BIASES)


# --- scale and gravity of a map ----------------------------------------------------------------------------------


def visual_factor(i, rotation, center, covariance):
    """A measured pose of a map without scale on ``X(i)`` (metres) and ``S(0)``, ln of the metres per unit."""
    measured = gtsam.Rot3(rotation)

    def error(this, values, jacobians):
        pose, units = values.atPose3(X(i)), np.exp(-values.atVector(S(0))[0])
        turn = measured.between(pose.rotation())
        place = units * rotation.T @ pose.translation()
        if jacobians is not None:
            by_pose, by_scale = np.zeros((6, 6)), np.zeros((6, 1))
            by_pose[:3, :3] = gtsam.Rot3.LogmapDerivative(gtsam.Rot3.Logmap(turn))
            by_pose[3:, 3:], by_scale[3:, 0] = units * turn.matrix(), -place
            jacobians[0], jacobians[1] = np.asfortranarray(by_pose), np.asfortranarray(by_scale)
        return np.concatenate([gtsam.Rot3.Logmap(turn), place - rotation.T @ center])

    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(covariance), [X(i), S(0)], error)


def solved(problem):
    """Values and marginals of the graph of poses, velocities, biases, scale and gravity, from the alignment."""
    poses = problem.poses
    alignment = align_inertial(problem.recording, poses)
    graph, values = inertial_graph(problem.recording, range(len(poses.time)), poses.time, alignment, G(0))
    for i, measured in enumerate(zip(poses.world_from_cam, poses.center, poses.covariance, strict=True)):
        graph.add(visual_factor(i, *measured))
        values.insert(X(i), gtsam.Pose3(gtsam.Rot3(measured[0]), alignment.scale * measured[1]))
    values.insert(S(0), np.array([np.log(alignment.scale)]))
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return values, gtsam.Marginals(graph, values)


def test_scale_and_gravity_of_twenty_handheld_shots():
    """Six seconds, keyframes 0.3 s apart, positions to 0.1 % of the path, rotations to 0.02 degrees, a phone's IMU."""
    scales, gravities, by_sigma, chi = [], [], [], []
    for seed in range(20):
        problem = inertial_problem(seed)
        values, marginals = solved(problem)
        scales.append(np.log(METRES_PER_UNIT) - values.atVector(S(0))[0])
        by_sigma.append(scales[-1] / np.sqrt(marginals.marginalCovariance(S(0))[0, 0]))
        off = values.atPoint3(G(0)) - problem.gravity
        gravities.append(angle(values.atPoint3(G(0)), problem.gravity))
        chi.append(off @ np.linalg.solve(marginals.marginalCovariance(G(0)), off))
    scales, by_sigma = np.abs(scales), np.abs(by_sigma)
    assert 0.002 < np.median(scales) < 0.008
    assert scales.max() < 0.02
    assert 0.05 < np.median(gravities) < 0.25
    assert max(gravities) < 0.5
    assert by_sigma.max() < 3.0
    assert max(chi) < 14.2  # three standard deviations in three dimensions
    assert 0.7 < np.sqrt(np.mean(by_sigma**2)) < 1.4
    assert 0.4 < np.mean(chi) / 3 < 1.4


def test_a_map_of_landmarks_takes_the_scale_of_the_factors():
    """Landmarks in units of 3.7 m; the factors take the unit for a fifth more, and the map shrinks to it."""
    problem, scale = inertial_problem(0), 1.2 * METRES_PER_UNIT
    poses, rng, noise = problem.poses, np.random.default_rng(0), gtsam.noiseModel.Isotropic.Sigma(2, 0.3)
    count, lens = len(poses.time), gtsam.Cal3_S2(500.0, 500.0, 0.0, 0.0, 0.0)
    alignment = align_inertial(problem.recording, poses)
    graph, values = inertial_graph(problem.recording, range(count), poses.time, alignment, G(0), scale)
    truth = [
        gtsam.Pose3(gtsam.Rot3(rotation), center / METRES_PER_UNIT)
        for rotation, center in zip(problem.motion.world_from_cam, problem.motion.center, strict=True)
    ]
    graph.add(gtsam.PriorFactorPose3(X(0), truth[0], gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    for i, pose in enumerate(truth):
        values.insert(X(i), pose)
    for j, point in enumerate(rng.uniform([-0.4, -0.3, 0.6], [0.4, 0.3, 2.0], (60, 3))):
        values.insert(L(j), point)
        for i, pose in enumerate(truth):
            pixels = gtsam.PinholeCameraCal3_S2(pose, lens).project(point) + 0.3 * rng.standard_normal(2)
            graph.add(gtsam.GenericProjectionFactorCal3_S2(pixels, noise, X(i), L(j), lens))
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    sizes = [sum(v.atPose3(X(0)).range(v.atPose3(X(i))) for i in range(1, count)) for v in (values, solution)]
    assert sizes[1] * scale / (sizes[0] * METRES_PER_UNIT) == pytest.approx(1.0, abs=0.005)
    assert angle(solution.atPoint3(G(0)), problem.gravity) < 0.5
