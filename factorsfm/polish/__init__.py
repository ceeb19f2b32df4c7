"""The final solve over all frames and tracks: its start, the weight of the prior, observability, covariances.

Takes the incremental map, gives poses, points and covariances. May import `control` and what lies below it.
"""
