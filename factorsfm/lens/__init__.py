"""Unknown optics: search, estimate and certainty of focal length and distortion; zoom; rolling shutter.

Takes a solved adjustment, gives lenses with standard deviations. May import `mapping` and what lies below it.
"""
