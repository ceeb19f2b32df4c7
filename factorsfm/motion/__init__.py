"""Motion of the camera, and tracks that do not belong to the scene.

Takes observations and solutions, gives the kind of motion and tracks to leave out. May import `graph` and what
lies below it.
"""
