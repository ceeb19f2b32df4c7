"""Known lenses: camera files, the first guess from EXIF, pixels and normalised image coordinates.

Takes files and image sizes, gives a `pycolmap.Camera`. May import `support`. Its face: `files.read_camera`,
`guess.guess_camera`, `projection.normalized_from_pixels`, `projection.pixels_from_normalized`.
"""
