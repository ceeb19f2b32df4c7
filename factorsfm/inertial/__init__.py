"""IMU: recordings and their files, preintegration, the fit of clock and axes to a camera, visual-inertial alignment.

Takes the samples of a gyroscope and an accelerometer and the poses of frames, gives metric scale and gravity, as plain
arrays. May import `camera` and what lies below it.
"""
