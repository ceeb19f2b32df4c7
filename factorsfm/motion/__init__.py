"""What moves: the camera, and what moves or rests in the image by itself.

Takes observations and solutions, gives the kind of motion and tracks to leave out. May import `graph` and what
lies below it.
"""
