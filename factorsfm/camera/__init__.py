"""Known lenses: camera files, also of other programs, other lens models, the guess from EXIF, undistortion, pixels.

Takes files and image sizes, gives a `pycolmap.Camera`. May import `support`. Its face: `files.read_camera`,
`guess.guess_camera`, `projection.normalized_from_pixels`, `projection.pixels_from_normalized`.
"""
