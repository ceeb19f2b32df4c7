"""The incremental mapper of video: start, registration, triangulation, keyframes, the point map.

Takes the tracks of one image after another, gives poses and a map. May import `motion` and what lies below it.
"""
