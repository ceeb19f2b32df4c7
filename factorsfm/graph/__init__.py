"""GTSAM: factors, the keyframe graph in iSAM2 and its process, the explicit graph of a result.

Takes measurements and first values, gives poses, points and covariances. Every ``import gtsam`` of the package stands
here. May import `adjustment` and what lies below it.
"""
