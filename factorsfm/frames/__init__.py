"""Pixels in: image files, folders, video files, live sources, cuts.

Takes paths and devices, gives frames. May import `synthetic` and what lies below it. Its face: `frame.Frame`,
`reading.read_frames` (a video or folder), `live_sources.open_source` (also cameras, network streams, pipes and folders
that fill), `unordered.read_images` (photographs in any order), `cuts.CutDetector`.
"""
