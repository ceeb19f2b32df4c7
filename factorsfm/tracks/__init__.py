"""Where things are seen: optical flow for video, matches for image sets.

Takes images, gives tracks. May import `priors` and what lies below it.
"""
