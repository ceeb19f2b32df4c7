"""Pixels in: image files, folders, video files, live sources, cuts.

Takes paths and devices, gives frames. May import `synthetic` and what lies below it.
"""
